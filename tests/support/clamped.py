"""Clamped bodies and random numbers."""

import torch

from warp_resphys import Body, select_vertices


def clamped(mesh, **options):
    """A body whose vertices at x = 0 are fixed."""
    return Body(mesh, fixed=select_vertices(mesh, x=0.0), **options)


def noise(*shape, seed=0):
    """Normally distributed random numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
