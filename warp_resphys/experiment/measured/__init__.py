"""Experiments on recordings of a real body, or of a simulated one that plays it; one module a stage."""
