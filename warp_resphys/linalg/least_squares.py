"""Nonlinear least squares for a batch at once: Gauss-Newton, and Levenberg-Marquardt where full steps lead astray.

A `Problem` knows its objective, where its linearisation about a point has its minimum, and how far apart two points
are; `minimise` is the loop around it, with one rule for the damping (Nocedal and Wright 2006, section 10.3). It starts
undamped, which is Gauss-Newton. A step that makes the objective larger is not taken, and the damping becomes one, or
ten times what it was; after a step that is taken it is a tenth. What one means is the problem's choice.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray
from typing_extensions import override

Array = NDArray[np.float64]
Objective = Callable[[Array], tuple[float, Array]]
Move = Callable[[torch.Tensor], torch.Tensor]

_FADING, _GROWTH, _MOST_DAMPING = 0.1, 10.0, 1e12
_MARQUARDT = 1e-2  # of a diagonal entry, what a damping of one adds to it
_RIDGE = 1e-10  # of the trace: keeps directions without influence from moving
_LARGEST_STEP, _FIRST_STEP = 0.25, 0.1  # of the range of a variable
_SMALL = 1e-4


@dataclass(frozen=True)
class Point:
    """Current iterate of a batch of problems."""

    x: torch.Tensor  # (B, ...) unknowns
    value: torch.Tensor  # (B,) objective; infinite where it cannot be evaluated, as where a simulation fails
    kept: tuple[torch.Tensor, ...] = ()  # what the problem keeps of its evaluation, each (B, ...)


class Problem(ABC):
    """A batch of sums of squares, independent of each other."""

    @abstractmethod
    def evaluate(self, x: torch.Tensor) -> Point:
        """The point at unknowns (B, ...)."""

    @abstractmethod
    def linearise(self, point: Point) -> Move:
        """The function of a damping (B,), zero or more, that gives the minimiser of the damped linearisation there."""

    @abstractmethod
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        """(B,) length of a step, in the unit of the tolerance."""


@dataclass(frozen=True)
class Solution:
    """Result of `minimise`."""

    point: Point  # the last accepted iterate
    iterations: int  # trial steps
    settled: bool  # whether every problem of the batch has converged
    moved: float  # largest distance of the last step


@torch.no_grad()
def minimise(problem: Problem, start: Point, tolerance: float, max_iterations: int) -> Solution:
    """The local minimum reached from a start.

    A problem of the batch has settled, and is left alone, when a step leads no further than the tolerance and either is
    hardly damped or leads nowhere better.

    Args:
        problem: see the class.
        start: evaluated by the problem.
        tolerance: of `Problem.distance`.
        max_iterations: steps that are tried at most, each with one evaluation.
    """
    point = start
    damping, moved = torch.zeros_like(point.value), torch.full_like(point.value, torch.inf)
    done = torch.zeros_like(point.value, dtype=torch.bool)
    taken = ~done
    for iteration in range(1, max_iterations + 1):
        if bool(taken.any()):
            step = problem.linearise(point)
        trial = problem.evaluate(_where(done, point.x, step(damping)))
        simulated = torch.isfinite(trial.value)
        better = simulated & (trial.value <= point.value)
        moved = torch.where(simulated, problem.distance(point, trial), torch.inf)
        settled = (moved <= tolerance) & (~better | (damping <= 1.0))
        taken = better & ~done
        kept = tuple(_where(taken, new, old) for new, old in zip(trial.kept, point.kept, strict=True))
        point = Point(_where(taken, trial.x, point.x), _where(taken, trial.value, point.value), kept)
        damping = torch.where(better, _FADING * damping, (_GROWTH * damping).clamp(1.0, _MOST_DAMPING))
        done |= settled
        if bool(done.all()):
            return Solution(point, iteration, True, float(moved.max()))
    return Solution(point, max_iterations, False, float(moved.max()))


def _where(mask: torch.Tensor, new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
    """(B, ...) the new rows where the mask (B,) is set, the old ones elsewhere."""
    return torch.where(mask.view(-1, *[1] * (new.ndim - 1)), new, old)


class UnitBox(Problem):
    """One objective of a few variables between 0 and 1, whose steps stay within these bounds and a trust box.

    Physical parameters lie along narrow, bent valleys of their loss, such as stiffness against Poisson's ratio. The
    Gauss-Newton matrix knows their direction from the first step. The distance is the relative decrease of the
    objective, or of 1e-4 where that is larger.

    Args:
        objective: (P,) variables to value and gradient; the value is infinite where there is none.
        matrix: (P,) variables to the (P, P) Gauss-Newton matrix 2 J^T J, or None where it cannot be had: then the last
            one is brought up to date by the change of the gradient.
    """

    def __init__(self, objective: Objective, matrix: Callable[[Array], Array | None]) -> None:
        self._objective, self._matrix = objective, matrix
        self._last: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        value, gradient = self._objective(x[0].numpy())
        return Point(x, x.new_tensor([value]), (x.new_tensor(gradient)[None],))

    @override
    def linearise(self, point: Point) -> Move:
        (x,), (gradient,) = point.x, point.kept[0]
        found = self._matrix(x.numpy())
        if found is None or not np.isfinite(found).all() or not np.trace(found) > 0.0:
            matrix = self._updated(x, gradient)
        else:
            matrix = torch.as_tensor(found) + _RIDGE * np.trace(found) * torch.eye(len(x), dtype=x.dtype)
        self._last = x, gradient, matrix
        bounds = (-x).clamp_min(-_LARGEST_STEP).numpy(), (1.0 - x).clamp_max(_LARGEST_STEP).numpy()

        def step(damping: torch.Tensor) -> torch.Tensor:
            root = torch.linalg.cholesky(damped(matrix[None], damping)[0])
            right = -torch.linalg.solve_triangular(root, gradient[:, None], upper=False)[:, 0]
            change = scipy.optimize.lsq_linear(root.mT.numpy(), right.numpy(), bounds=bounds, method="bvls").x
            return (x + torch.as_tensor(change)).clamp(0.0, 1.0)[None]

        return step

    def _updated(self, x: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """The last matrix after a BFGS update; without one, that with which the first step goes a tenth of a range."""
        if self._last is None:
            return torch.eye(len(x), dtype=x.dtype) * (gradient.norm() / _FIRST_STEP).clamp_min(1e-12)
        matrix = self._last[2]
        moved, change = x - self._last[0], gradient - self._last[1]
        if not moved @ change > 1e-10 * moved.norm() * change.norm():
            return matrix
        product = matrix @ moved
        return matrix - product.outer(product) / (moved @ product) + change.outer(change) / (moved @ change)

    @override
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        return (new.value - old.value).abs() / old.value.clamp_min(_SMALL)


def damped(matrix: torch.Tensor, damping: torch.Tensor) -> torch.Tensor:
    """(B, P, P) Gauss-Newton matrix with a damping (B,) in the units of its own diagonal (Marquardt 1963)."""
    return matrix + torch.diag_embed(_MARQUARDT * damping[:, None] * matrix.diagonal(dim1=1, dim2=2))


def ridge(matrix: torch.Tensor, right: torch.Tensor, weight: torch.Tensor | float) -> torch.Tensor:
    """(B, n, 1) minimiser of |A x - b|^2 + w |x|^2, from the smaller of its two sets of normal equations.

    Args:
        matrix: (B, m, n).
        right: (B, m, 1).
        weight: w, positive; a number or (B, 1, 1).
    """
    rows, columns = matrix.shape[1:]
    identity = torch.eye(min(rows, columns), device=matrix.device, dtype=matrix.dtype)
    if rows <= columns:
        return matrix.mT @ torch.linalg.solve(matrix @ matrix.mT + weight * identity, right)
    return torch.linalg.solve(matrix.mT @ matrix + weight * identity, matrix.mT @ right)
