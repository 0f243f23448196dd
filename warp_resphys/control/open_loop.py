"""Inputs for whole motions, planned on a reduced model and corrected with the full simulator.

The reduced model plans, the robot's simulator plays the plan, and a Gauss-Newton step reduces the remaining error. Its
slopes are those of the reduced model (iterative learning control on the simulated robot); its gradient can come from
the adjoint of the full simulator, which is right where the reduced model is wrong.
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
        gradient: ``reduced`` or ``adjoint``.
    """

    def __init__(
        self, robot: Robot, model: ReducedModel, planner: Planner, corrections: int, gradient: str = "reduced"
    ) -> None:
        self._robot, self._model, self._planner = robot, model, planner
        self._corrections, self._gradient = corrections, gradient

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
        for number in range(self.rollouts):
            adjoint = self._gradient == "adjoint" and number < self._corrections
            markers, gradients = self._play(knots, paths, adjoint, on_progress)
            points = markers[:, 1:] @ planner.tracked.T
            errors.append(1e3 * np.linalg.norm(points - paths, axis=2).mean(1))
            for row, (path, error) in enumerate(zip(paths, errors[-1], strict=True)):
                if error < best[row]:
                    best[row], kept[row], kept_markers[row], shares[row] = error, knots[row], markers[row], 1.0
                    slope = None if gradients is None else gradients[row]
                    steps[row] = planner.corrected(start, knots[row], points[row] - path, slope) - knots[row]
                else:
                    shares[row] *= _SHORTER
                knots[row] = kept[row] + shares[row] * steps[row]
        rows = zip(paths, kept, kept_markers, np.array(errors).T, strict=True)
        return [
            PlannedMotion(path, planner.lines @ knots, markers[1:] @ planner.tracked.T, markers, mm)
            for path, knots, markers, mm in rows
        ]

    def _play(
        self, knots: FloatArray, paths: FloatArray, adjoint: bool, on_progress: OnProgress
    ) -> tuple[FloatArray, FloatArray | None]:
        """Plays plans on the robot.

        Returns:
            (B, T + 1, 3 M) markers [m]; and with ``adjoint``, (B, K, n) the gradient of half the sum of squared
            distances from the paths with respect to the knots.
        """
        robot, planner, name = self._robot, self._planner, self._model.name
        tensor = robot.simulator.tensor
        chosen = tensor(knots).requires_grad_(adjoint)
        inputs: dict[str, Any] = {name: torch.einsum("tk,bkn->tbn", tensor(planner.lines), chosen)}
        with torch.set_grad_enabled(adjoint):
            start = robot.begin(len(knots), **{name: planner.limits.low})
            motion = robot.rollout(start, on_step=lambda number: on_progress(1), **inputs)
            markers = motion.markers.flatten(2).swapaxes(0, 1)
            if not adjoint:
                return markers.double().cpu().numpy(), None
            points = markers[:, 1:] @ tensor(planner.tracked).mT
            half = 0.5 * (points - torch.as_tensor(paths).to(points)).square().sum()
            (slope,) = torch.autograd.grad(half, chosen)
        return markers.detach().double().cpu().numpy(), slope.cpu().double().numpy()
