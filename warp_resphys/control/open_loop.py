"""Inputs for whole motions, planned on a reduced model and corrected with the full simulator.

The reduced model plans, the robot's simulator plays the plan, and a Gauss-Newton step with the slopes of the reduced
model reduces the remaining error (iterative learning control on the simulated robot).
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch

from ..robot.robot import Robot
from .files import PlannedMotion
from .plan import Planner
from .reduced import ReducedModel
from .world import FloatArray

OnProgress = Callable[[int], None]

_SHORTER: Final = 0.25  # factor on a correction that made the motion worse


class Follower:
    """Plans whole motions of a robot.

    Args:
        robot: whose point follows the paths.
        model: its reduced model.
        planner: for the number of steps of the motions.
        corrections: number of corrections by the robot.
    """

    def __init__(self, robot: Robot, model: ReducedModel, planner: Planner, corrections: int) -> None:
        self._robot, self._model, self._planner, self._corrections = robot, model, planner, corrections

    @property
    def rollouts(self) -> int:
        """Number of roll-outs of the robot in `follow`."""
        return self._corrections + 1

    def follow(self, paths: FloatArray, on_progress: OnProgress = lambda steps: None) -> list[PlannedMotion]:
        """Returns the best plans for paths (B, T, d) [m].

        Args:
            paths: references of the point after each step.
            on_progress: called with the number of further simulation steps that are done.

        Raises:
            InputError: no inputs satisfy their bounds.
            ConvergenceError: the robot's simulation fails.
        """
        planner, model = self._planner, self._model
        before = np.array(planner.limits.low)
        start = model.rest(before)
        knots = np.stack([planner.plan(start, before, path).knots for path in paths])
        errors, best = [], np.full(len(paths), np.inf)
        kept, kept_markers = knots.copy(), list[FloatArray](paths)
        steps, shares = np.zeros_like(knots), np.ones(len(paths))
        for _ in range(self.rollouts):
            markers = self._play(planner.lines @ knots, on_progress)
            points = markers[:, 1:] @ planner.tracked.T
            errors.append(1e3 * np.linalg.norm(points - paths, axis=2).mean(1))
            for row, (path, error) in enumerate(zip(paths, errors[-1], strict=True)):
                if error < best[row]:
                    best[row], kept[row], kept_markers[row], shares[row] = error, knots[row], markers[row], 1.0
                    steps[row] = planner.corrected(start, knots[row], points[row] - path) - knots[row]
                else:
                    shares[row] *= _SHORTER
                knots[row] = kept[row] + shares[row] * steps[row]
        rows = zip(paths, kept, kept_markers, np.array(errors).T, strict=True)
        return [
            PlannedMotion(path, planner.lines @ knots, markers[1:] @ planner.tracked.T, markers, mm)
            for path, knots, markers, mm in rows
        ]

    @torch.no_grad()
    def _play(self, inputs: FloatArray, on_progress: OnProgress) -> FloatArray:
        """Returns the markers (B, T + 1, 3 M) of the robot under inputs (B, T, n) [m]."""
        robot, name = self._robot, self._model.name
        start = robot.begin(len(inputs), **{name: self._planner.limits.low})
        given: dict[str, Any] = {name: robot.simulator.tensor(inputs.swapaxes(0, 1))}
        motion = robot.rollout(start, on_step=lambda number: on_progress(1), **given)
        return np.asarray(motion.markers.flatten(2).swapaxes(0, 1).double().cpu().numpy())
