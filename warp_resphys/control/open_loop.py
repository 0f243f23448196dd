"""Inputs for whole motions, planned on a reduced model and corrected by the robot itself.

The reduced model plans; the robot plays the plan; and what it leaves is planned away, by a step of Gauss-Newton whose
slopes are the reduced model's (iterative learning control on the simulated robot), or with the gradient of the robot's
own adjoint, which holds where the reduced model is wrong.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..robot.robot import Robot
from .files import PlannedMotion
from .plan import Planner
from .reduced import ReducedModel

FloatArray = NDArray[np.float64]
OnProgress = Callable[[int], None]

_SHORTER: Final = 0.25  # share of a step that is tried where all of it was worse


class Follower:
    """Plans for a robot.

    Args:
        robot: that is to follow.
        model: its reduced model.
        planner: of motions of these steps.
        corrections: by the robot.
        gradient: ``reduced`` or ``adjoint``.
    """

    def __init__(
        self, robot: Robot, model: ReducedModel, planner: Planner, corrections: int, gradient: str = "reduced"
    ) -> None:
        self._robot, self._model, self._planner = robot, model, planner
        self._corrections, self._gradient = corrections, gradient

    @property
    def rollouts(self) -> int:
        """How often the robot plays."""
        return self._corrections + 1

    def follow(self, paths: FloatArray, on_progress: OnProgress = lambda steps: None) -> list[PlannedMotion]:
        """The best plans that were found for paths (B, T, d) [m]; reports the steps of the robot that are done.

        Raises:
            InputError: no inputs are within their bounds.
            ConvergenceError: see `Robot.step`.
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
            PlannedMotion(path, planner.inputs(knots), markers[1:] @ planner.tracked.T, markers, mm)
            for path, knots, markers, mm in rows
        ]

    def _play(
        self, knots: FloatArray, paths: FloatArray, adjoint: bool, on_progress: OnProgress
    ) -> tuple[FloatArray, FloatArray | None]:
        """(B, T + 1, 3 M) where the robot has the markers [m], and (B, K, n) half the points' squares by the knots."""
        robot, planner = self._robot, self._planner
        like = robot.simulator.rest_positions
        tracked = torch.as_tensor(planner.tracked).to(like)
        chosen = torch.as_tensor(knots).to(like).requires_grad_(adjoint)
        lines = torch.as_tensor(planner.lines).to(like)
        series = torch.einsum("tk,bkn->tbn", lines, chosen)
        name = self._model.name
        given: dict[str, Any] = {name: series}
        with torch.set_grad_enabled(adjoint):
            start = robot.begin(len(knots), **{name: torch.as_tensor(planner.limits.low).to(like)})
            motion = robot.rollout(start, on_step=lambda number: on_progress(1), **given)
            markers = motion.markers.flatten(2).swapaxes(0, 1)
            if not adjoint:
                return markers.double().cpu().numpy(), None
            points = markers[:, 1:] @ tracked.mT
            half = 0.5 * (points - torch.as_tensor(paths).to(points)).square().sum()
            (slope,) = torch.autograd.grad(half, chosen)
        return markers.detach().double().cpu().numpy(), slope.cpu().double().numpy()
