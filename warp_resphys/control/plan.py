"""Inputs that make points follow a path: Gauss-Newton on a reduced model, within bounds and rates, and what is left.

A plan is a broken line over knots, which a quadratic program chooses about the last one: the least distance of the
points from the path, and a little of the inputs and of how they change. The horizon of a receding plan is short and
begins where an estimate says; a plan of a whole motion is then played by the full robot, whose difference from the
reduced model moves the path of the next plan (iterative learning control on the simulated robot).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from ..io.errors import InputError

FloatArray = NDArray[np.float64]

_TOLERANCE: Final = 1e-5  # of a quadratic program
_ENOUGH: Final = 1e-3  # of the range of an input, that a plan must change by to be improved further


@dataclass(frozen=True)
class Response:
    """The motion of observed points over T steps.

    Attributes:
        y: (T, 3 M) observed points after each step [m].
        slopes: (T, 3 M, P) their derivatives by P parameters of the inputs; None if not asked for.
    """

    y: FloatArray
    slopes: FloatArray | None


class PredictionModel(Protocol):
    """A model that predicts observed points under inputs, with derivatives: a `ReducedModel` or a `LinearModel`."""

    @property
    def time_step(self) -> float:
        """The step h [s]."""
        ...

    @property
    def parts(self) -> int:
        """The number n of inputs."""
        ...

    def respond(
        self, start: Any, inputs: FloatArray, basis: FloatArray | None = None, bias: FloatArray | None = None
    ) -> Response:
        """The motion of the observed points over T steps.

        Args:
            start: the state.
            inputs: (T, n) commanded during each step, in their unit.
            basis: (T, n, P) derivatives of the inputs by parameters, for `Response.slopes`.
            bias: (r,) added to the coordinates of the equilibria, where the model has some.
        """
        ...


@dataclass(frozen=True)
class Limits:
    """What the inputs may be.

    Attributes:
        low: (n,) the least of each.
        high: (n,) the greatest.
        rate: (n,) by which each may change in a second.
    """

    low: FloatArray
    high: FloatArray
    rate: FloatArray

    @property
    def range(self) -> FloatArray:
        """(n,) from the least to the greatest."""
        return np.asarray(self.high - self.low)


@dataclass(frozen=True)
class Weights:
    """What a plan is to be good at, beside distances in millimetres.

    Attributes:
        effort: of the mean square of the inputs, as shares of their ranges.
        change: of the mean square of how they change between knots, over what they may.
    """

    effort: float = 1e-2
    change: float = 1e-2


@dataclass(frozen=True)
class Plan:
    """Inputs over T steps.

    Attributes:
        inputs: (T, n) during each step.
        knots: (K, n) at the ends of the pieces of the broken line.
        iterations: of Gauss-Newton.
    """

    inputs: FloatArray
    knots: FloatArray
    iterations: int


class Planner:
    """Plans over a number of steps.

    Args:
        model: of the robot.
        tracked: (d, 3 M) from what is observed to the coordinates that are to follow.
        limits: of the inputs.
        steps: T.
        pieces: of the broken line.
        weights: see the class.
        iterations: of Gauss-Newton, at most.
    """

    def __init__(
        self,
        model: PredictionModel,
        tracked: FloatArray,
        limits: Limits,
        steps: int,
        pieces: int,
        weights: Weights = Weights(),
        iterations: int = 8,
    ) -> None:
        if not 1 <= pieces <= steps:
            raise InputError(f"a plan of {steps} steps cannot have {pieces} pieces: give from 1 to {steps}.")
        self.model, self.tracked, self.limits, self.steps = model, tracked, limits, steps
        self._weights, self._iterations = weights, iterations
        self.knots = pieces + 1
        n = model.parts
        at = np.arange(1, steps + 1) / steps * pieces
        left = np.minimum(at.astype(np.int64), pieces - 1)
        lines = np.zeros((steps, self.knots))
        lines[np.arange(steps), left] = 1.0 - (at - left)
        lines[np.arange(steps), left + 1] += at - left
        self.lines = lines
        # The first knot is the input before the plan, and stays.
        free = lines[:, 1:]
        self._basis = np.einsum("tk,ij->tikj", free, np.eye(n)).reshape(steps, n, -1) * np.tile(limits.range, pieces)
        seconds = steps * model.time_step / pieces
        self._most = np.tile(limits.rate * seconds / limits.range, pieces)
        difference = np.eye(pieces) - np.eye(pieces, k=-1)
        self._difference = np.kron(difference, np.eye(n))

    def plan(
        self,
        start: Any,
        before: FloatArray,
        path: FloatArray,
        guess: FloatArray | None = None,
        bias: FloatArray | None = None,
        offset: FloatArray | None = None,
    ) -> Plan:
        """The best inputs.

        Args:
            start: where the model is.
            before: (n,) the inputs until now.
            path: (T, d) where the points are to be after each step [m], NaN where that does not matter.
            guess: (K, n) knots to begin with; the inputs until now, if left out.
            bias: see `ReducedModel.respond`.
            offset: (T, d) or (d,) added to where the model has the points [m].

        Raises:
            InputError: the quadratic program has no solution.
        """
        limits, n = self.limits, self.model.parts
        goal = path - (0.0 if offset is None else offset)
        knots = np.repeat(before[None], self.knots, axis=0) if guess is None else guess.copy()
        knots[0] = before
        knots = np.clip(knots, limits.low, limits.high)
        iterations = 0
        for iterations in range(1, self._iterations + 1):  # noqa: B007
            found = self.model.respond(start, self.lines @ knots, self._basis, bias)
            assert found.slopes is not None
            step = self._step(found.slopes, found.y @ self.tracked.T - goal, knots, None)
            knots[1:] += limits.range * step.reshape(-1, n)
            if np.abs(step).max() < _ENOUGH:
                break
        return Plan(self.inputs(knots), knots, iterations)

    def inputs(self, knots: FloatArray) -> FloatArray:
        """(T, n) of knots (K, n)."""
        return np.asarray(self.lines @ knots)

    def corrected(
        self, start: Any, knots: FloatArray, left: FloatArray, gradient: FloatArray | None = None
    ) -> FloatArray:
        """(K, n) better knots, by one step of Gauss-Newton from others.

        Args:
            start: where the model is.
            knots: (K, n).
            left: (T, d) how far the robot's points were from the path with these [m].
            gradient: (K, n) of half the sum of their squares by the knots, if it is known otherwise than by the model.
        """
        slopes = self.model.respond(start, self.inputs(knots), self._basis).slopes
        assert slopes is not None
        step = self._step(slopes, left, knots, gradient)
        return np.concatenate([knots[:1], knots[1:] + self.limits.range * step.reshape(-1, self.model.parts)])

    def _step(self, slopes: FloatArray, left: FloatArray, knots: FloatArray, gradient: FloatArray | None) -> FloatArray:
        """(P,) how the knots after the first are to change, as shares of the inputs' ranges."""
        count, weights, limits = max(left.size, 1), self._weights, self.limits
        first, *others = (knots - limits.low) / limits.range
        x = np.concatenate(others)
        known = np.isfinite(left).ravel()
        j = 1e3 * (self.tracked @ slopes).reshape(left.size, -1) * known[:, None]
        pull = j.T @ (1e3 * np.where(known, left.ravel(), 0.0))
        if gradient is not None:
            pull = 1e6 * (gradient[1:] * limits.range).ravel()
        d = self._difference / self._most[:, None]
        start = np.concatenate([first, np.zeros(len(x) - len(first))])
        jump = d @ x - start / self._most
        effort = weights.effort / len(x) * count
        change = weights.change / len(x) * count
        hessian = j.T @ j + effort * np.eye(len(x)) + change * d.T @ d
        pull = pull + effort * x + change * d.T @ jump
        return solve_program(hessian, pull, d, -1.0 - jump, 1.0 - jump, -x, 1.0 - x)


def solve_program(
    hessian: FloatArray,
    gradient: FloatArray,
    rows: FloatArray,
    least: FloatArray,
    most: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """(P,) the minimum of x^T H x / 2 + g^T x where rows x is between least and most, and x between low and high.

    Raises:
        InputError: the package that solves it is not installed, or there is none.
    """
    try:
        import piqp
    except ImportError:
        raise InputError(
            "control needs a package that is not installed: pip install 'warp-resphys[control]'."
        ) from None
    solver = piqp.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = _TOLERANCE, _TOLERANCE
    solver.setup(hessian, gradient, None, None, rows, least, most, low, high)
    if solver.solve() != piqp.PIQP_SOLVED:
        raise InputError("no inputs are within their bounds and rates: raise the rates, or begin within the bounds.")
    return np.asarray(solver.result.x)


def tracked_of(labels: Sequence[str], chosen: Sequence[str]) -> FloatArray:
    """(3, 3 M) the mean of some of M points.

    Raises:
        InputError: an unknown one, or none.
    """
    odd = [label for label in chosen if label not in labels]
    if odd or not chosen:
        what = f"names {odd[0]!r}" if odd else "names no marker"
        raise InputError(f"tracked {what}: choose from {', '.join(labels)}.")
    found = np.zeros((3, len(labels), 3))
    for label in chosen:
        found[:, labels.index(label)] += np.eye(3) / len(chosen)
    return found.reshape(3, -1)
