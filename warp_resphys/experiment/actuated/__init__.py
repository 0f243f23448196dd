"""Experiments on bodies that pressure drives, recorded or simulated."""
