"""Preconditioned conjugate gradients for a batch of systems that are given by products with vectors."""

from collections.abc import Callable
from typing import NamedTuple

import torch

LinearMap = Callable[[torch.Tensor], torch.Tensor]


class Iterate(NamedTuple):
    """Result of the iterations of a batch."""

    x: torch.Tensor  # (B, ...)
    converged: torch.Tensor  # (B,) bool
    iterations: int  # until the last of them stopped


def conjugate_gradients(
    operator: LinearMap,
    preconditioner: LinearMap,
    right: torch.Tensor,
    tolerance: float,
    max_iterations: int = 500,
) -> Iterate:
    """Preconditioned conjugate gradients for a batch of symmetric positive definite systems.

    A system whose operator turns out not to be positive definite keeps the iterate before: it has come closer to the
    solution along directions of positive curvature (Steihaug 1983), or is a step of the preconditioner if the first
    direction is none.

    Args:
        operator: (B, ...) to (B, ...).
        preconditioner: approximate inverse of it, positive definite.
        right: (B, ...) right-hand sides.
        tolerance: relative, in the preconditioner's norm.
        max_iterations: the last iterate is returned after that many.
    """

    def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a * b).flatten(1).sum(1)

    spread = (-1, *(1,) * (right.ndim - 1))
    tiny = torch.finfo(right.dtype).tiny
    x = torch.zeros_like(right)
    r = right.clone()
    z = preconditioner(r)
    d = z.clone()
    rz = dot(r, z)
    goal = tolerance**2 * rz
    curved = torch.zeros_like(rz, dtype=torch.bool)
    count = 0
    for count in range(max_iterations + 1):
        going = (rz > goal) & ~curved
        if count == max_iterations or not bool(going.any()):
            break
        hd = operator(d)
        curvature = dot(d, hd)
        bent = going & ~(curvature > 0.0)
        if count == 0 and bool(bent.any()):
            x += torch.where(bent.view(spread), z, 0.0)
        curved |= bent
        step = torch.where(going & ~bent, rz / curvature.clamp_min(tiny), 0.0).view(spread)
        x += step * d
        r -= step * hd
        z = preconditioner(r)
        following = dot(r, z)
        d = z + (following / rz.clamp_min(tiny)).view(spread) * d
        rz = following
    return Iterate(x, (rz >= 0.0) & (rz <= goal) & ~curved, count)
