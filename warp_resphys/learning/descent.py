"""Least squares for few unknowns between 0 and 1 whose derivatives cost more than their residuals.

As `linalg.least_squares.UnitBox`, but derivatives are computed only at points from which a step is taken, and a search
ends without an evaluation where the linearisation expects no decrease.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from typing_extensions import override

from ..linalg.least_squares import Array, Move, Point, UnitBox
from .bounded_misfit import LinearMisfit

Linearise = Callable[[Array, bool], LinearMisfit | None]
Evaluated = Callable[[Array, float], None]


class AtOnce:
    """Residuals that come with their derivatives, of which the last ones are kept; see the argument of `Descent`."""

    def __init__(self, linearise: Linearise) -> None:
        self._linearise = linearise
        self._last: tuple[Array, LinearMisfit | None] | None = None

    def __call__(self, x: Array, derivatives: bool) -> LinearMisfit | None:
        """Returns the misfit at unknowns (P,), with derivatives in any case."""
        del derivatives
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = x.copy(), self._linearise(x, True)
        return self._last[1]


class Descent(UnitBox):
    """Objective of a search, with derivatives at points from which a step is taken.

    Args:
        linearise: returns the misfit at unknowns (P,), with derivatives or without; None if it fails.
        tolerance: relative decrease; a step from which less is expected is taken without an evaluation, as the last.
        evaluated: called with unknowns and the objective after each step, infinite if the evaluation failed.

    Attributes:
        stuck_at: the last point (1, P) without derivatives; None if all had some.
    """

    def __init__(self, linearise: Linearise, tolerance: float, evaluated: Evaluated) -> None:
        super().__init__(self._differentiated)
        self._linearise, self._tolerance, self._evaluated = linearise, tolerance, evaluated
        self.stuck_at: torch.Tensor | None = None
        self._end: Point | None = None  # of the last step, if it needs no evaluation

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        end, self._end = self._end, None
        if end is not None and torch.equal(x, end.x):
            self._evaluated(x[0].numpy(), float(end.value))
            return end
        linear = self._linearise(x[0].numpy(), False)
        value = math.inf if linear is None or not math.isfinite(linear.loss) else linear.loss
        self._evaluated(x[0].numpy(), value)
        return Point(x, x.new_tensor([value]))

    @override
    def linearise(self, point: Point) -> Move:
        whole = super().evaluate(point.x)
        if not math.isfinite(float(whole.value)):
            self.stuck_at = point.x
        step, (gradient,), (matrix,) = super().linearise(whole), *whole.kept

        def move(damping: torch.Tensor) -> torch.Tensor:
            x = step(damping)
            change = (x - point.x)[0]
            expected = replace(point, value=point.value + change @ (gradient + 0.5 * matrix @ change))
            is_short = bool((self.distance(point, expected) <= self._tolerance) & (damping <= 1.0).all())
            self._end = replace(expected, x=x) if is_short else None
            return x

        return move

    def _differentiated(self, x: Array) -> tuple[float, Array, Array]:
        """Returns the objective, its gradient (P,) and the Gauss-Newton matrix (P, P); zero if there is none."""
        linear = self._linearise(x, True)
        if linear is None or not np.isfinite(linear.gauss_newton).all():
            return math.inf, np.zeros_like(x), np.zeros((len(x), len(x)))
        return linear.loss, linear.gradient, linear.gauss_newton
