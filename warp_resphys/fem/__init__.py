"""Finite elements as points: shape functions, integration rules, and the body that they make of a mesh.

From outside: `body.Body` and `body.PointMass`; `elements.discretise` and `elements.Points` for new energies.
"""
