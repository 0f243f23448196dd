"""Finite elements as integration points, and the bodies made of them.

Public: `body.Body` and `body.PointMass`; `elements.discretise` and `elements.Points` for new energies.
"""
