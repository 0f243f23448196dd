"""Classes of the configuration: every key of a run once,
with its type, range, unit, meaning and default.
"""
