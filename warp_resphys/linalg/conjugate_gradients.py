"""Conjugate gradients for a batch of systems that are known by their products alone."""

from collections.abc import Callable

import torch

LinearMap = Callable[[torch.Tensor], torch.Tensor]


def conjugate_gradients(
    operator: LinearMap,
    preconditioner: LinearMap,
    right: torch.Tensor,
    tolerance: float,
    max_iterations: int = 500,
) -> torch.Tensor:
    """Preconditioned conjugate gradients for a batch of symmetric positive definite systems.

    Args:
        operator: (B, N, 3) to (B, N, 3).
        preconditioner: approximate inverse of it.
        right: (B, N, 3) right-hand sides.
        tolerance: relative, in the preconditioner's norm.
        max_iterations: the last iterate is returned after that many.
    """
    x = torch.zeros_like(right)
    r = right.clone()
    z = preconditioner(r)
    d = z.clone()
    rz = (r * z).sum((1, 2))
    goal = tolerance**2 * rz
    for _ in range(max_iterations):
        if bool((rz <= goal).all()):
            break
        hd = operator(d)
        curvature = (d * hd).sum((1, 2))
        step = torch.where(rz > goal, rz / curvature.clamp_min(torch.finfo(r.dtype).tiny), 0.0)
        x += step[:, None, None] * d
        r -= step[:, None, None] * hd
        z = preconditioner(r)
        following = (r * z).sum((1, 2))
        d = z + (following / rz.clamp_min(torch.finfo(r.dtype).tiny))[:, None, None] * d
        rz = following
    return x
