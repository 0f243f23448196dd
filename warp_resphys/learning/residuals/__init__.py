"""Residual forces: their reconstruction, the networks that predict them,
and simulators corrected by them.
"""
