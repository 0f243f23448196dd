"""The simulator: meshes, elements, energies, linear solvers, time steps and their gradients.

It stands alone: of the rest of the package it imports `io` (errors, files, progress) and the device
code in `kernels`.
"""
