"""Plans: inputs that make points follow a path, by Gauss-Newton on a prediction model,
within bounds and rate limits.

The inputs of a plan are piecewise linear between knots. Each iteration solves a quadratic program
for the change of the knots: it minimises the distance of the points from the path, plus small
penalties on the inputs and their changes. Derivatives are differences of motions that are predicted
at once. The best of the whole change, its half, quarter and eighth is taken, as inputs need not
follow their commands linearly, as with a learned actuator or a slow valve.

A reduced model plans whole motions by a receding horizon in which it is the robot itself. The
robot's simulator plays the plan, and the difference of its point from the model's is added to the
model's in the next plan (iterative learning control).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch

from ..io.arrays import FloatArray
from ..io.errors import InputError, needs_extra
from ..robot.robot import Robot
from ..settings.control import LimitsOfInputs
from .linear_model import LinearModel
from .polynomials import around
from .reduced_model import ReducedModel
from .sampling import OnProgress

_TOLERANCE: Final = 1e-5  # of a quadratic program
_ENOUGH: Final = (
    1e-3  # change of a plan, as a share of the inputs' ranges, below which the iterations stop
)
_DIFFERENCE: Final = 1e-3  # of knots for derivatives, as a share of the inputs' ranges
_SHARES: Final = 0.5 ** np.arange(4.0)  # of a change of the knots, of which the best is taken
_SHORTER: Final = 0.25  # factor on a correction that made the motion worse
_PLAYED: Final = 3  # plans begin anew after one of so many parts of the horizon


@dataclass(frozen=True)
class Horizon:
    """Length of a plan, and how finely it is found.

    Attributes:
        steps: H; past the end of the path, its last point is repeated.
        pieces: of the piecewise linear inputs, from 1 to H.
        weight: of the mean squares of the inputs, as shares of their ranges, and of their changes
            between knots, as shares of the rate limits, beside squared distances in millimetres.
        iterations: of Gauss-Newton, at most.
    """

    steps: int
    pieces: int
    weight: float = 1e-2
    iterations: int = 1


class Planner:
    """Plans over a horizon along a path; each begins where the last one was left.

    Args:
        model: of the robot, whose `respond` predicts it.
        tracked: (d, 3 M) from the observed points to the coordinates that follow the path.
        limits: of each input; the first plan begins at the lower ones.
        path: (T, d) reference of the points after each step [m], NaN where they are free.
        horizon: of H steps.
    """

    def __init__(
        self,
        model: ReducedModel | LinearModel,
        tracked: FloatArray,
        limits: LimitsOfInputs,
        path: FloatArray,
        horizon: Horizon,
    ) -> None:
        self.model, self.limits = model, limits
        self.tracked, self.path = tracked, path
        self.steps = steps = horizon.steps
        pieces = horizon.pieces
        self._weight, self._iterations = horizon.weight, horizon.iterations
        ends = np.arange(1, steps + 1) / steps * pieces  # of the steps, in pieces
        self._lines = np.maximum(1.0 - np.abs(ends[:, None] - np.arange(pieces + 1.0)), 0.0)
        self._most = limits.rate * (steps * model.time_step / pieces) / limits.range
        # From knots as shares of the ranges to their changes as shares of the rate limits, (P, P).
        jumps = np.kron(np.eye(pieces) - np.eye(pieces, k=-1), np.eye(model.parts))
        self._jumps = np.asarray(jumps / self._most, dtype=np.float64)
        self._knots = np.full((pieces + 1, model.parts), limits.low)

    def plan(
        self,
        number: int,
        start: Any,
        bias: FloatArray | None = None,
        offset: FloatArray | None = None,
        played: int = 1,
    ) -> FloatArray:
        """Returns the inputs (H, n) from a step on.

        Args:
            number: of the step.
            start: state of the model.
            bias: (r,) added to the reduced coordinates of the equilibria.
            offset: (T, d) or (d,) added to the points that the model predicts [m].
            played: number of steps until the next plan.

        Raises:
            InputError: the quadratic program has no solution.
        """
        rows = np.minimum(np.arange(number, number + self.steps), len(self.path) - 1)
        goal = self.path[rows]
        if offset is not None:
            goal = goal - (offset if offset.ndim == 1 else offset[rows])
        limits, first = self.limits, self._knots[0]

        def knots_of(shares: FloatArray) -> FloatArray:
            """Knots (B, K, n) of B plans, the first of which is known."""
            knots = limits.low + limits.range * shares.reshape(len(shares), -1, len(first))
            return np.concatenate(
                [np.broadcast_to(first, (len(knots), 1, len(first))), knots], axis=1
            )

        def points_of(shares: FloatArray) -> FloatArray:
            """Points (H, B, d) of B plans [m]."""
            inputs = np.einsum("tk,bkn->tbn", self._lines, knots_of(shares))
            return np.asarray(self.model.respond(start, inputs, bias) @ self.tracked.T)

        shares = ((self._knots[1:] - limits.low) / limits.range).ravel()
        for _ in range(self._iterations):
            points = points_of(around(shares, _DIFFERENCE))
            slopes = np.moveaxis(points[:, 1:] - points[:, :1], 1, 2) / _DIFFERENCE
            step = self._step(slopes, points[:, 0] - goal, shares)
            trials = shares + _SHARES[:, None] * step
            shares = trials[self._costs(points_of(trials), goal, trials).argmin()]
            if np.abs(step).max() < _ENOUGH:
                break
        (knots,) = knots_of(shares[None])
        inputs = self._lines @ knots
        series = np.concatenate([knots[:1], inputs])
        at = np.arange(len(knots)) / (len(knots) - 1) * self.steps
        later = np.minimum(at + played, self.steps)
        self._knots = np.stack(
            [np.interp(later, np.arange(self.steps + 1), column) for column in series.T], axis=1
        )
        return np.asarray(inputs)

    def _step(self, slopes: FloatArray, errors: FloatArray, shares: FloatArray) -> FloatArray:
        """Change (P,) of the knots after the first, as shares (P,) of the inputs' ranges."""
        finite = np.isfinite(errors).ravel()
        j = 1e3 * slopes.reshape(errors.size, -1) * finite[:, None]
        pull = j.T @ (1e3 * np.where(finite, errors.ravel(), 0.0))
        d, jump = self._jumps, self._changes(shares)
        weight = self._weight * errors.size / len(shares)
        hessian = j.T @ j + weight * (np.eye(len(shares)) + d.T @ d)
        pull = pull + weight * (shares + d.T @ jump)
        return solve_program(hessian, pull, d, -1.0 - jump, 1.0 - jump, -shares, 1.0 - shares)

    def _changes(self, shares: FloatArray) -> FloatArray:
        """Changes (..., P) between knots, as shares of the rate limits."""
        first = (self._knots[0] - self.limits.low) / self.limits.range
        return np.asarray(
            shares @ self._jumps.T - np.pad(first, (0, shares.shape[-1] - len(first))) / self._most
        )

    def _costs(self, points: FloatArray, goal: FloatArray, shares: FloatArray) -> FloatArray:
        """Costs (B,) of plans (B, P) with points (H, B, d) [m] and goals (H, d).

        Infinite where the model diverges.
        """
        errors = np.where(np.isfinite(goal)[:, None], points - goal[:, None], 0.0)
        size = (shares**2).mean(1) + (self._changes(shares) ** 2).mean(1)
        costs = 1e6 * (errors**2).sum((0, 2)) + self._weight * goal.size * size
        return np.where(np.isfinite(costs), costs, np.inf)


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
    with needs_extra("control", "control needs"):
        import piqp
    solver = piqp.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = _TOLERANCE, _TOLERANCE
    solver.setup(hessian, gradient, None, None, rows, least, most, low, high)
    if solver.solve() != piqp.PIQP_SOLVED:
        raise InputError(
            "no inputs satisfy their bounds and rate limits: raise the rate limits, or begin "
            "within the bounds."
        )
    return np.asarray(solver.result.x)


def tracked_of(labels: Sequence[str], chosen: Sequence[str]) -> FloatArray:
    """Returns the matrix (3, 3 M) from M markers to the mean of the chosen ones.

    Raises:
        InputError: an unknown marker, or none.
    """
    check_chosen("tracked", chosen, labels)
    weights = [[chosen.count(label) / len(chosen) for label in labels]]
    return np.asarray(np.kron(weights, np.eye(3)), dtype=np.float64)


def check_chosen(key: str, chosen: Sequence[str], known: Sequence[str]) -> None:
    """Raises an `InputError` about a setting unless it has names, all of which are known."""
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        raise InputError(
            f"{key} names {unknown[0] if unknown else 'none'}: choose from {', '.join(known)}."
        )


def follow(
    robot: Robot,
    model: ReducedModel,
    planner_of: Callable[[FloatArray], Planner],
    paths: FloatArray,
    corrections: int,
    on_progress: OnProgress = lambda steps: None,
) -> list[dict[str, FloatArray]]:
    """Returns the best plans for paths, as arrays by name (`control_files.write_motions`).

    Args:
        robot: whose point follows the paths.
        model: its reduced model.
        planner_of: returns a planner for a path (T, d).
        paths: (B, T, d) references of the point after each step [m].
        corrections: number of corrections by the robot.
        on_progress: called with the number of further simulation steps that are done.

    Raises:
        InputError: no inputs satisfy their bounds.
        ConvergenceError: the robot's simulation fails.
    """
    tracked = planner_of(paths[0]).tracked
    low = np.full(model.parts, planner_of(paths[0]).limits.low)
    start, offsets = model.rest(low), np.zeros_like(paths)
    wanted = np.stack(
        [
            _planned(model, planner_of(path), offset)
            for path, offset in zip(paths, offsets, strict=True)
        ]
    )
    inputs = wanted
    kept = wanted.copy()
    errors = list[FloatArray]()
    best = np.full(len(paths), np.inf)
    kept_markers, shares = list[FloatArray](paths), np.ones(len(paths))
    for _ in range(corrections + 1):
        markers = _played(robot, model.name, low, inputs, on_progress)
        points = markers[:, 1:] @ tracked.T
        errors.append(1e3 * np.linalg.norm(points - paths, axis=2).mean(1))
        for row, error in enumerate(errors[-1]):
            if error < best[row]:
                best[row], shares[row] = error, 1.0
                kept[row], kept_markers[row] = inputs[row], markers[row]
                offset = points[row] - model.respond(start, inputs[row][:, None])[:, 0] @ tracked.T
                wanted[row] = _planned(model, planner_of(paths[row]), offset)
            else:
                shares[row] *= _SHORTER
        inputs = kept + shares[:, None, None] * (wanted - kept)
    rows = zip(paths, kept, kept_markers, np.array(errors).T, strict=True)
    return [
        {
            "path": path,
            "inputs": commands,
            "points": markers[1:] @ tracked.T,
            "markers": markers,
            "errors_mm": mm,
        }
        for path, commands, markers, mm in rows
    ]


def _planned(model: ReducedModel, planner: Planner, offset: FloatArray) -> FloatArray:
    """Inputs (T, n) for a whole path, whose points are off
    from those of the model by (T, d) [m].
    """
    state, inputs = model.rest(np.full(model.parts, planner.limits.low)), list[FloatArray]()
    steps = max(planner.steps // _PLAYED, 1)
    for number in range(0, len(planner.path), steps):
        now = planner.plan(number, state, offset=offset, played=steps)
        now = now[: min(steps, len(planner.path) - number)]
        state = model.move(state, now[:, None])[2]
        inputs.append(now)
    return np.concatenate(inputs)


@torch.no_grad()
def _played(
    robot: Robot, name: str, low: FloatArray, inputs: FloatArray, on_progress: OnProgress
) -> FloatArray:
    """Markers (B, T + 1, 3 M) of the robot under inputs (B, T, n) [m]."""
    start = robot.begin(len(inputs), **{name: low})
    commands = robot.simulator.tensor(inputs.swapaxes(0, 1))
    series: dict[str, Any] = {name: commands}
    motion = robot.rollout(start, on_step=lambda number: on_progress(1), **series)
    return np.asarray(motion.markers.flatten(2).swapaxes(0, 1).double().cpu().numpy())
