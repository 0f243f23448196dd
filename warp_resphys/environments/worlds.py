"""Worlds of robots: simulators with varied parameters, and reduced models."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from typing_extensions import override

from ..control.reduced import ReducedModel
from ..control.world import BoolArray, FloatArray, IntArray, World
from ..io.errors import InputError
from ..mesh.mesh import boundary_triangles
from ..report.obstacles import ObstacleSurface
from ..robot.robot import Robot
from ..robot.state import RobotState

_FURTHEST: Final = 20.0  # coordinates at which a reduced model has failed, relative to those of equilibria
_LEAST: Final = 1e-3  # lower bound of drawn positive parameters, relative to the identified value


class RobotWorld(World):
    """B copies of a robot in its full simulator.

    Args:
        robot: loaded with ``on_failure="count"``.
        given: name of the commanded input.
        count: B.
        spread: variation of the parameters, in standard deviations of their identification; 0 for none.
        mixed: (k, n) from k commands to the n values of the input; the identity if omitted.
        shown: numbers of the observed points among all markers or vertices; all if omitted.

    Raises:
        InputError: there is no such input, or the run has no standard deviations of its parameters.
    """

    def __init__(
        self,
        robot: Robot,
        given: str,
        count: int,
        spread: float = 0.0,
        mixed: FloatArray | None = None,
        shown: Sequence[int] | None = None,
    ) -> None:
        if given not in robot.inputs:
            raise InputError(f"there is no input {given!r}: the robot has {', '.join(robot.inputs) or 'none'}.")
        if spread > 0.0 and not (robot.description.uncertainty or {}).get("deviation"):
            raise InputError(
                f"{robot.description.name} has no standard deviations of its parameters, which spread needs: set "
                "spread=0, or choose a run that identifies parameters."
            )
        self._nominal = self.robot = robot
        self.count, self.time_step, self.input = count, robot.time_step, given
        self._mixed = np.eye(len(robot.inputs[given].parts)) if mixed is None else mixed
        self.parts, self._spread, self._shown = len(self._mixed), spread, shown
        self._state = self._rest = self._begun()

    @override
    def vary(self, random: Sequence[np.random.Generator]) -> None:
        if not self._spread:
            return
        description = self._nominal.description
        uncertainty: Mapping[str, Any] = description.uncertainty or {}
        names = list(uncertainty["deviation"])
        deviation = np.array([uncertainty["deviation"][name] for name in names])
        root = np.linalg.cholesky(np.array(uncertainty["correlation"]) + 1e-9 * np.eye(len(names)))
        mean = np.array([description.parameters[name] for name in names])
        drawn = np.stack([root @ generator.standard_normal(len(names)) for generator in random])
        values = mean + self._spread * deviation * drawn
        values = np.where(mean > 0.0, np.maximum(values, _LEAST * mean), values)
        parameters = dict(zip(names, values.T, strict=True))
        if "poissons_ratio" in parameters:
            parameters["poissons_ratio"] = parameters["poissons_ratio"].clip(0.0, 0.499)
        tensor = self._nominal.simulator.tensor
        self.robot = self._nominal.with_parameters(**{name: tensor(values) for name, values in parameters.items()})
        self._rest = self._begun()

    def _begun(self) -> RobotState:
        with torch.no_grad():
            return self.robot.begin(self.count)

    @override
    def begin(self, chosen: BoolArray) -> None:
        self._state = self._rest.where(torch.as_tensor(chosen, device=self._rest.q.device), self._state)

    @override
    @torch.no_grad()
    def step(self, commands: FloatArray) -> BoolArray:
        self._state = self.robot.step(self._state, **{self.input: commands @ self._mixed})
        return np.asarray(self._state.lost.cpu().numpy())

    @override
    def markers(self) -> FloatArray:
        markers = self.robot.observe(self._state)
        markers = markers if self._shown is None else markers[:, list(self._shown)]
        return np.asarray(markers.double().cpu().numpy())

    @override
    def bodies(self) -> tuple[IntArray, FloatArray]:
        return boundary_triangles(self.robot.simulator.body.mesh), self._state.q.double().cpu().numpy()

    @override
    def obstacles(self) -> ObstacleSurface:
        return ObstacleSurface.of(self.robot.simulator.body, self._nominal.parameters)


class ReducedWorld(World):
    """B copies of a robot's reduced model, a few hundred times as fast as its simulator."""

    def __init__(self, model: ReducedModel, count: int) -> None:
        self._model, self.count, self.time_step = model, count, model.time_step
        self.input, self.parts = model.name, model.parts
        self._rest = self._batch = model.rest(count=count)
        self._furthest = _FURTHEST * np.abs(model.static.coefficients).max()
        self._lost = np.zeros(count, dtype=np.bool_)

    @override
    def begin(self, chosen: BoolArray) -> None:
        self._batch, self._lost = self._rest.where(chosen, self._batch), self._lost & ~chosen

    @override
    def step(self, commands: FloatArray) -> BoolArray:
        with np.errstate(over="ignore", invalid="ignore"):
            self._batch = self._model.move(self._batch, commands[None]).end
        self._lost = self._lost | ~(np.abs(self._batch.z) < self._furthest).all(axis=1)
        if self._lost.any():
            self._batch = self._rest.where(self._lost, self._batch)
        return self._lost

    @override
    def markers(self) -> FloatArray:
        return self._model.observe(self._batch).reshape(self.count, -1, 3)
