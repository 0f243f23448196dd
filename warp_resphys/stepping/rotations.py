"""Rotations by rotation vectors."""

import torch


def rotations(vectors: torch.Tensor) -> torch.Tensor:
    """Returns rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad], differentiable also at zero."""
    zero, (x, y, z) = torch.zeros_like(vectors[..., 0]), vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)
