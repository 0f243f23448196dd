"""Preconditioned conjugate gradients for a batch of matrix-free systems."""

from collections.abc import Callable
from typing import NamedTuple

import torch

LinearMap = Callable[[torch.Tensor], torch.Tensor]


class Iterate(NamedTuple):
    """Result of `conjugate_gradients`."""

    x: torch.Tensor  # (B, ...) solutions
    converged: torch.Tensor  # (B,) bool
    iterations: int  # largest number of iterations in the batch


def conjugate_gradients(
    operator: LinearMap,
    preconditioner: LinearMap,
    right: torch.Tensor,
    tolerance: float,
    max_iterations: int = 500,
    shortest: float = 0.0,
) -> Iterate:
    """Solves a batch of symmetric positive definite systems.

    A system stops at the first direction of non-positive curvature and returns the iterate before
    it (Steihaug 1983), or the preconditioned right-hand side if that is the first direction.

    Args:
        operator: maps (B, ...) to (B, ...).
        preconditioner: positive definite approximate inverse of the operator.
        right: (B, ...) right-hand sides.
        tolerance: relative, in the preconditioner's norm.
        max_iterations: limit after which the last iterate is returned.
        shortest: largest entry of the preconditioned residual below which a system is solved as
            well.
    """

    def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a * b).flatten(1).sum(1)

    column = (-1, *(1,) * (right.ndim - 1))
    tiny = torch.finfo(right.dtype).tiny
    x = torch.zeros_like(right)
    r = right.clone()
    z = preconditioner(r)
    d = z.clone()
    rz = dot(r, z)
    goal = tolerance**2 * rz
    indefinite = torch.zeros_like(rz, dtype=torch.bool)
    count = 0
    for count in range(max_iterations + 1):
        short = z.abs().flatten(1).amax(1) <= shortest
        active = (rz > goal) & ~short & ~indefinite
        if count == max_iterations or not bool(active.any()):
            break
        hd = operator(d)
        curvature = dot(d, hd)
        stopped = active & ~(curvature > 0.0)
        if count == 0 and bool(stopped.any()):
            x += torch.where(stopped.view(column), z, 0.0)
        indefinite |= stopped
        step = torch.where(active & ~stopped, rz / curvature.clamp_min(tiny), 0.0).view(column)
        x += step * d
        r -= step * hd
        z = preconditioner(r)
        new_rz = dot(r, z)
        d = z + (new_rz / rz.clamp_min(tiny)).view(column) * d
        rz = new_rz
    return Iterate(x, (rz >= 0.0) & ((rz <= goal) | short) & ~indefinite, count)
