"""Inputs that make points of a robot follow a path: references, a reduced model, plans, estimates, and baselines."""
