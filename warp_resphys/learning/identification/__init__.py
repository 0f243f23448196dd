"""Identification of the parameters of a simulator and of the law of its material,
with their uncertainty.
"""
