"""Hydra configuration groups, packaged with the library."""
