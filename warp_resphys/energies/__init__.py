"""The energies of a body and the incremental potential of a step that they add up to.

From outside: `material.Material`, `potential.IncrementalPotential`.
"""
