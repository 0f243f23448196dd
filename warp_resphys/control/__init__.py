"""Control: inputs that make a point of a robot follow a path.

Paths, reduced models, plans, estimators, baselines.
"""
