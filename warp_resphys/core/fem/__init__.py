"""Finite elements as integration points, and the bodies made of them.

Public: `bodies.Body` and `bodies.PointMass`; `integration_points.discretise` and `Points` for new
energies.
"""
