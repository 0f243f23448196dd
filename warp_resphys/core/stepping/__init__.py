"""States, inputs, constants, quantities and time integrators,
which the energies and the simulator share.
"""
