"""Plans: inputs that make points follow a path, by Gauss-Newton on a prediction model, within bounds and rate limits.

The inputs of a plan are piecewise linear between knots. Each iteration solves a quadratic program for the change of
the knots: it minimises the distance of the points from the path, plus small penalties on the inputs and their changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from ..io.errors import InputError
from .world import FloatArray

_TOLERANCE: Final = 1e-5  # of a quadratic program
_ENOUGH: Final = 1e-3  # change of a plan, as a share of the inputs' ranges, below which the iterations stop


@dataclass(frozen=True)
class Response:
    """The motion of observed points over T steps.

    Attributes:
        y: (T, 3 M) observed points after each step [m].
        slopes: (T, 3 M, P) their derivatives by P parameters of the inputs; None if not requested.
    """

    y: FloatArray
    slopes: FloatArray | None


class PredictionModel(Protocol):
    """Predicts observed points under inputs, with derivatives: a `ReducedModel` or a `LinearModel`."""

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
        """Predicts the observed points over T steps.

        Args:
            start: the state.
            inputs: (T, n) commanded during each step, in their unit.
            basis: (T, n, P) derivatives of the inputs by parameters, for `Response.slopes`.
            bias: (r,) added to the reduced coordinates of the equilibria; a linear model ignores it.
        """
        ...


@dataclass(frozen=True)
class Limits:
    """Bounds of the inputs.

    Attributes:
        low: (n,) lower bounds.
        high: (n,) upper bounds.
        rate: (n,) largest change per second.
    """

    low: FloatArray
    high: FloatArray
    rate: FloatArray

    @property
    def range(self) -> FloatArray:
        """(n,) upper less lower bounds."""
        return np.asarray(self.high - self.low)


@dataclass(frozen=True)
class Weights:
    """Weights of the penalties in a plan's objective, beside squared distances in millimetres.

    Attributes:
        effort: of the mean square of the inputs, as shares of their ranges.
        change: of the mean square of their changes between knots, as shares of the rate limits.
    """

    effort: float = 1e-2
    change: float = 1e-2


@dataclass(frozen=True)
class Horizon:
    """Length and discretisation of plans.

    Attributes:
        steps: T.
        pieces: of the piecewise linear inputs.
        weights: of the penalties.
        iterations: of Gauss-Newton, at most.
    """

    steps: int
    pieces: int
    weights: Weights = Weights()
    iterations: int = 1


@dataclass(frozen=True)
class Plan:
    """Inputs over T steps.

    Attributes:
        inputs: (T, n) during each step.
        knots: (K, n) at the ends of the linear pieces.
    """

    inputs: FloatArray
    knots: FloatArray


class Planner:
    """Plans over a fixed number of steps.

    Args:
        model: that predicts the points.
        tracked: (d, 3 M) from the observed points to the coordinates that follow the path.
        limits: of the inputs.
        horizon: of the plans.

    Attributes:
        lines: (T, K) from the knots to the inputs of each step.

    Raises:
        InputError: more pieces than steps, or none.
    """

    def __init__(self, model: PredictionModel, tracked: FloatArray, limits: Limits, horizon: Horizon) -> None:
        steps, pieces, n = horizon.steps, horizon.pieces, model.parts
        if not 1 <= pieces <= steps:
            raise InputError(f"a plan of {steps} steps cannot have {pieces} pieces: give from 1 to {steps}.")
        self.model, self.tracked, self.limits, self._horizon = model, tracked, limits, horizon
        self.steps = steps
        knots, at = np.arange(pieces + 1.0), np.arange(1, steps + 1) / steps * pieces
        self.lines = np.maximum(1.0 - np.abs(at[:, None] - knots), 0.0)
        # The first knot is the input before the plan, and stays.
        free = self.lines[:, 1:]
        self._basis = np.einsum("tk,ij->tikj", free, np.eye(n)).reshape(steps, n, -1) * np.tile(limits.range, pieces)
        seconds = steps * model.time_step / pieces
        self._most = np.tile(limits.rate * seconds / limits.range, pieces)
        self._difference = np.kron(np.eye(pieces) - np.eye(pieces, k=-1), np.eye(n))

    def plan(
        self,
        start: Any,
        before: FloatArray,
        path: FloatArray,
        guess: FloatArray | None = None,
        bias: FloatArray | None = None,
        offset: FloatArray | None = None,
    ) -> Plan:
        """Optimises the inputs.

        Args:
            start: state of the model.
            before: (n,) inputs until now.
            path: (T, d) reference of the points after each step [m], NaN where they are free.
            guess: (K, n) initial knots; constant inputs if omitted.
            bias: (r,) added to the reduced coordinates of the equilibria.
            offset: (T, d) or (d,) added to the points that the model predicts [m].

        Raises:
            InputError: the quadratic program has no solution.
        """
        limits = self.limits
        goal = path - (0.0 if offset is None else offset)
        knots = np.repeat(before[None], self.lines.shape[1], axis=0) if guess is None else guess.copy()
        knots[0] = before
        knots = np.clip(knots, limits.low, limits.high)
        for _ in range(self._horizon.iterations):
            response = self.model.respond(start, self.lines @ knots, self._basis, bias)
            assert response.slopes is not None
            step = self._step(response.slopes, response.y @ self.tracked.T - goal, knots)
            knots[1:] += limits.range * step.reshape(-1, self.model.parts)
            if np.abs(step).max() < _ENOUGH:
                break
        return Plan(self.lines @ knots, knots)

    def corrected(self, start: Any, knots: FloatArray, errors: FloatArray) -> FloatArray:
        """Returns improved knots (K, n), by one Gauss-Newton step from measured errors.

        Args:
            start: state of the model.
            knots: (K, n) that were played.
            errors: (T, d) of the robot's points from the path [m].
        """
        slopes = self.model.respond(start, self.lines @ knots, self._basis).slopes
        assert slopes is not None
        step = self._step(slopes, errors, knots)
        return np.concatenate([knots[:1], knots[1:] + self.limits.range * step.reshape(-1, self.model.parts)])

    def _step(self, slopes: FloatArray, errors: FloatArray, knots: FloatArray) -> FloatArray:
        """Change (P,) of the knots after the first, as shares of the inputs' ranges."""
        count, weights, limits = max(errors.size, 1), self._horizon.weights, self.limits
        first, *others = (knots - limits.low) / limits.range
        x = np.concatenate(others)
        finite = np.isfinite(errors).ravel()
        j = 1e3 * (self.tracked @ slopes).reshape(errors.size, -1) * finite[:, None]
        pull = j.T @ (1e3 * np.where(finite, errors.ravel(), 0.0))
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
    """Minimises x^T H x / 2 + g^T x over x (P,) with least <= rows x <= most and low <= x <= high.

    Raises:
        InputError: the solver's package is not installed, or the constraints cannot be satisfied.
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
        raise InputError(
            "no inputs satisfy their bounds and rate limits: raise the rate limits, or begin within the bounds."
        )
    return np.asarray(solver.result.x)


def tracked_of(labels: Sequence[str], chosen: Sequence[str]) -> FloatArray:
    """Returns the matrix (3, 3 M) from M markers to the mean of the chosen ones.

    Raises:
        InputError: an unknown marker, or none.
    """
    unknown = [label for label in chosen if label not in labels]
    if unknown or not chosen:
        what = f"names {unknown[0]!r}" if unknown else "names no marker"
        raise InputError(f"tracked {what}: choose from {', '.join(labels)}.")
    weights = [[chosen.count(label) / len(chosen) for label in labels]]
    return np.asarray(np.kron(weights, np.eye(3)), dtype=np.float64)
