"""Inputs for whole motions, planned on a reduced model and corrected with the full simulator.

The reduced model plans by a receding horizon in which it is the robot itself. The robot's simulator plays the plan, and
what its point differs from that of the model is added to the model's in the next plan (iterative learning control).
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch

from ..robot.robot import Robot
from .files import PlannedMotion
from .plan import Planner
from .polynomials import FloatArray
from .reduced import ReducedModel

OnProgress = Callable[[int], None]

_SHORTER: Final = 0.25  # factor on a correction that made the motion worse
_PLAYED: Final = 3  # plans begin anew after one of so many parts of the horizon


def follow(
    robot: Robot,
    model: ReducedModel,
    planner_of: Callable[[FloatArray], Planner],
    paths: FloatArray,
    corrections: int,
    on_progress: OnProgress = lambda steps: None,
) -> list[PlannedMotion]:
    """Returns the best plans for paths.

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
    tracked, low = planner_of(paths[0]).tracked, np.full(model.parts, planner_of(paths[0]).limits.low)
    start, offsets = model.rest(low), np.zeros_like(paths)
    wanted = np.stack([_planned(model, planner_of(path), offset) for path, offset in zip(paths, offsets, strict=True)])
    inputs, kept, errors, best = wanted, wanted.copy(), list[FloatArray](), np.full(len(paths), np.inf)
    kept_markers, shares = list[FloatArray](paths), np.ones(len(paths))
    for _ in range(corrections + 1):
        markers = _played(robot, model.name, low, inputs, on_progress)
        points = markers[:, 1:] @ tracked.T
        errors.append(1e3 * np.linalg.norm(points - paths, axis=2).mean(1))
        for row, error in enumerate(errors[-1]):
            if error < best[row]:
                best[row], kept[row], kept_markers[row], shares[row] = error, inputs[row], markers[row], 1.0
                offset = points[row] - model.respond(start, inputs[row][:, None])[:, 0] @ tracked.T
                wanted[row] = _planned(model, planner_of(paths[row]), offset)
            else:
                shares[row] *= _SHORTER
        inputs = kept + shares[:, None, None] * (wanted - kept)
    rows = zip(paths, kept, kept_markers, np.array(errors).T, strict=True)
    return [PlannedMotion(path, own, markers[1:] @ tracked.T, markers, mm) for path, own, markers, mm in rows]


def _planned(model: ReducedModel, planner: Planner, offset: FloatArray) -> FloatArray:
    """Inputs (T, n) for a whole path, whose points are off from those of the model by (T, d) [m]."""
    state, inputs = model.rest(np.full(model.parts, planner.limits.low)), list[FloatArray]()
    steps = max(planner.steps // _PLAYED, 1)
    for number in range(0, len(planner.path), steps):
        now = planner.plan(number, state, offset=offset, played=steps)[: min(steps, len(planner.path) - number)]
        state = model.move(state, now[:, None]).end
        inputs.append(now)
    return np.concatenate(inputs)


@torch.no_grad()
def _played(robot: Robot, name: str, low: FloatArray, inputs: FloatArray, on_progress: OnProgress) -> FloatArray:
    """Markers (B, T + 1, 3 M) of the robot under inputs (B, T, n) [m]."""
    start, given = robot.begin(len(inputs), **{name: low}), robot.simulator.tensor(inputs.swapaxes(0, 1))
    series: dict[str, Any] = {name: given}
    motion = robot.rollout(start, on_step=lambda number: on_progress(1), **series)
    return np.asarray(motion.markers.flatten(2).swapaxes(0, 1).double().cpu().numpy())
