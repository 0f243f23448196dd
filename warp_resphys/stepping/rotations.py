"""Rotations by rotation vectors, and twisted bodies."""

import torch


def rotations(vectors: torch.Tensor) -> torch.Tensor:
    """Returns rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad], differentiable also at zero."""
    zero, (x, y, z) = torch.zeros_like(vectors[..., 0]), vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def twisted(positions: torch.Tensor, angles: torch.Tensor, axis: int = 0) -> torch.Tensor:
    """Returns positions (B, N, 3) of a body (N, 3) [m] twisted about the centre line of its bounding box along an axis.

    Cross-sections rotate by an angle that grows linearly from zero at the lower end to (B,) [rad] at the upper end.
    """
    low, high = positions.amin(0), positions.amax(0)
    centred = positions - 0.5 * (low + high)
    phi = angles[:, None] * (positions[:, axis] - low[axis]) / (high[axis] - low[axis])  # (B, N)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turned = positions.expand(len(angles), -1, -1).clone()
    turned[..., i] += torch.cos(phi) * centred[:, i] - torch.sin(phi) * centred[:, j] - centred[:, i]
    turned[..., j] += torch.sin(phi) * centred[:, i] + torch.cos(phi) * centred[:, j] - centred[:, j]
    return turned
