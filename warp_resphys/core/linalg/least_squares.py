"""Batched nonlinear least squares: Gauss-Newton, with Levenberg-Marquardt damping
where full steps fail.

A `Problem` gives its objective, the minimiser of its damped linearisation, and the distance between
two points; `minimise` is the loop around it (Nocedal and Wright 2006, section 10.3). It starts
undamped (Gauss-Newton). A step that increases the objective is rejected and the damping multiplied
by ten, to one at least; after an accepted step it is divided by ten. The problem defines the unit
of the damping. Where a problem follows curved valleys, the first rejected step from a point is
followed by a second one from its end before the damping grows (the watchdog of Nocedal and Wright,
section 15.6): along the floor of a valley a long step ends on the wall, and the next one at the
floor, much further on. Both are rejected if they decrease the objective by less than 5 %, as full
steps may go to and fro across a minimum.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray
from typing_extensions import override

Array = NDArray[np.float64]
Objective = Callable[[Array, bool], tuple[float, Array, Array]]
Move = Callable[[torch.Tensor], torch.Tensor]

_DECREASE, _INCREASE = 0.1, 10.0
_MAX_DAMPING = 1e12
_MARQUARDT = 1e-2  # a damping of one adds this fraction of a diagonal entry to it
# Fraction of the trace added to the diagonal, against motion in directions without influence.
_RIDGE = 1e-10
_LARGEST_STEP = 0.25  # fraction of the range of a variable
_SMALL = 1e-4
_WORTH = 0.05  # least relative decrease by two steps


@dataclass(frozen=True)
class Point:
    """Current iterate of a batch of problems."""

    x: torch.Tensor  # (B, ...) unknowns
    value: torch.Tensor  # (B,) objective; infinite where the evaluation fails
    kept: tuple[torch.Tensor, ...] = ()  # results that the problem reuses, (B, ...) each


class Problem(ABC):
    """A batch of independent sums of squares."""

    # Whether a rejected step may be followed by a second one; of a batch of one
    follows_valleys = False

    @abstractmethod
    def evaluate(self, x: torch.Tensor) -> Point:
        """Returns the point at unknowns (B, ...)."""

    @abstractmethod
    def linearise(self, point: Point) -> Move:
        """Returns the map from a damping (B,), zero or more,
        to the minimiser (B, ...) of the damped linearisation.
        """

    @abstractmethod
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        """Returns the length of a step, (B,), in the unit of the tolerance."""


@dataclass(frozen=True)
class Solution:
    """Result of `minimise`."""

    point: Point  # the last accepted iterate
    iterations: int  # trial steps
    converged: bool  # whether every problem of the batch has converged
    last_step: float  # largest distance of the last step


@torch.no_grad()
def minimise(problem: Problem, start: Point, tolerance: float, max_iterations: int) -> Solution:
    """Returns the local minimum reached from a start.

    A problem has converged, and is no longer updated, when a step is shorter than the tolerance and
    either its damping is one or less or it does not decrease the objective.

    Args:
        problem: the batch of problems.
        start: starting point, evaluated by the problem.
        tolerance: tolerance of `Problem.distance`.
        max_iterations: limit of trial steps, with one evaluation each.
    """
    point = start
    damping, distance = torch.zeros_like(point.value), torch.full_like(point.value, torch.inf)
    done = torch.zeros_like(point.value, dtype=torch.bool)
    accepted = ~done
    iteration = 0
    while iteration < max_iterations:
        iteration += 1
        fresh = bool(accepted.any())
        if fresh:
            step = problem.linearise(point)
        trial = problem.evaluate(_where(done, point.x, step(damping)))
        finite = torch.isfinite(trial.value)
        better = finite & (trial.value <= point.value)
        distance = torch.where(finite, problem.distance(point, trial), torch.inf)
        converged = (distance <= tolerance) & (~better | (damping <= 1.0))
        follows = problem.follows_valleys and fresh and iteration < max_iterations
        if follows and bool(finite & ~better & ~converged):
            iteration += 1
            second = problem.evaluate(problem.linearise(trial)(damping))
            if bool(second.value < (1.0 - _WORTH) * point.value):
                trial, better = second, ~better
        accepted = better & ~done
        kept = tuple(
            _where(accepted, new, old) for new, old in zip(trial.kept, point.kept, strict=True)
        )
        point = Point(
            _where(accepted, trial.x, point.x), _where(accepted, trial.value, point.value), kept
        )
        damping = torch.where(
            better, _DECREASE * damping, (_INCREASE * damping).clamp(1.0, _MAX_DAMPING)
        )
        done |= converged
        if bool(done.all()):
            return Solution(point, iteration, True, float(distance.max()))
    return Solution(point, iteration, False, float(distance.max()))


def _where(mask: torch.Tensor, new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
    """Returns (B, ...) new rows where the mask (B,) is set, old rows elsewhere."""
    return torch.where(mask.view(-1, *[1] * (new.ndim - 1)), new, old)


class UnitBox(Problem):
    """An objective of a few variables between 0 and 1,
    with steps limited by these bounds and a trust box.

    The loss of physical parameters has narrow curved valleys, such as stiffness against Poisson's
    ratio; the Gauss-Newton matrix gives their direction from the first step. The distance is the
    change of the objective over its value, or over 1e-4 if that is larger.

    Derivatives, which cost more than residuals, are computed only at points from which a step is
    taken.

    Args:
        objective: maps variables (P,), and whether derivatives are needed, to the value, its
            gradient (P,) and the Gauss-Newton matrix 2 J^T J (P, P); the value is infinite if the
            evaluation or the derivatives fail.
        tolerance: relative decrease; a step from which the linearisation expects less is taken
            without an evaluation, as the last.
        evaluated: called with the variables and the objective after each step.

    Attributes:
        differentiates: whether there are derivatives at the start; None before the first step.
    """

    follows_valleys = True

    def __init__(
        self,
        objective: Objective,
        tolerance: float = 0.0,
        evaluated: Callable[[Array, float], None] | None = None,
    ) -> None:
        self._objective = objective
        self._tolerance = tolerance
        self._evaluated = evaluated
        self.differentiates: bool | None = None
        self._end: Point | None = None  # of the last step, if it needs no evaluation

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        point, self._end = self._end, None
        if point is None or not torch.equal(x, point.x):
            point = Point(x, x.new_tensor([self._objective(x[0].numpy(), False)[0]]))
        if self._evaluated is not None:
            self._evaluated(x[0].numpy(), float(point.value))
        return point

    @override
    def linearise(self, point: Point) -> Move:
        (x,) = point.x
        value, *slopes = self._objective(x.numpy(), True)
        gradient, gauss_newton = (
            map(x.new_tensor, slopes) if math.isfinite(value) else (0.0 * x, torch.diag(0.0 * x))
        )
        if self.differentiates is None:
            self.differentiates = math.isfinite(value)
        added = _RIDGE * float(gauss_newton.trace()) or 1.0
        matrix = gauss_newton + added * torch.eye(len(x), dtype=x.dtype)
        bounds = (-x).clamp_min(-_LARGEST_STEP).numpy(), (1.0 - x).clamp_max(_LARGEST_STEP).numpy()

        def step(damping: torch.Tensor) -> torch.Tensor:
            root = torch.linalg.cholesky(damped(matrix[None], damping)[0])
            right = -torch.linalg.solve_triangular(root, gradient[:, None], upper=False)[:, 0]
            change = scipy.optimize.lsq_linear(
                root.mT.numpy(), right.numpy(), bounds=bounds, method="bvls"
            ).x
            end = (x + torch.as_tensor(change)).clamp(0.0, 1.0)
            change = end - x
            expected = Point(
                end[None], point.value + change @ (gradient + 0.5 * gauss_newton @ change)
            )
            is_short = bool(
                (self.distance(point, expected) <= self._tolerance) & (damping <= 1.0).all()
            )
            self._end = expected if is_short else None
            return end[None]

        return step

    @override
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        return (new.value - old.value).abs() / old.value.clamp_min(_SMALL)


def damped(matrix: torch.Tensor, damping: torch.Tensor) -> torch.Tensor:
    """Returns the Gauss-Newton matrix (B, P, P) with a damping (B,)
    in units of its diagonal (Marquardt 1963).
    """
    return matrix + torch.diag_embed(
        _MARQUARDT * damping[:, None] * matrix.diagonal(dim1=1, dim2=2)
    )


def ridge(matrix: torch.Tensor, right: torch.Tensor, weight: torch.Tensor | float) -> torch.Tensor:
    """Returns the minimiser (B, n, 1) of |A x - b|^2 + w |x|^2,
    from the smaller of its two normal equations.

    Args:
        matrix: A, (B, m, n).
        right: b, (B, m, 1).
        weight: w, positive; a number or (B, 1, 1).
    """
    rows, columns = matrix.shape[1:]
    identity = torch.eye(min(rows, columns), device=matrix.device, dtype=matrix.dtype)
    if rows <= columns:
        return matrix.mT @ torch.linalg.solve(matrix @ matrix.mT + weight * identity, right)
    return torch.linalg.solve(matrix.mT @ matrix + weight * identity, matrix.mT @ right)
