"""Energies of a body, and their sum, the incremental potential of a step.

Public: `materials.Material`, `potential.IncrementalPotential`.
"""
