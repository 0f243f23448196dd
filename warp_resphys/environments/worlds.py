"""What environments step: B robots of a run, each with parameters of its own, or bodies of the simulated laboratory."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..control.laboratory import Laboratory
from ..control.reduced import ReducedModel
from ..control.reduced_batch import advance, begin, observed
from ..io.errors import InputError
from ..mesh.mesh import boundary_triangles
from ..robot.inputs import BASE
from ..robot.robot import Robot
from ..robot.state import RobotState
from ..stepping.state import State

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

_FURTHEST: Final = 20.0  # times the coordinates of equilibria, beyond which a reduced model has failed
_LEAST: Final = 1e-3  # of the value in an identification, below which a drawn parameter is not taken


class World(ABC):
    """B bodies that take commands and show markers.

    Attributes:
        count: B.
        time_step: h [s].
        input: by which they are driven.
        parts: n of its values.
    """

    count: int
    time_step: float
    input: str
    parts: int

    @abstractmethod
    def begin(self, chosen: BoolArray) -> None:
        """Brings some of the bodies (B,) back to rest without inputs."""

    @abstractmethod
    def step(self, commands: FloatArray) -> BoolArray:
        """One time step under commands (B, n); which of the simulations (B,) have failed."""

    @abstractmethod
    def markers(self) -> FloatArray:
        """(B, M, 3) where they are [m]."""

    def vary(self, random: Sequence[np.random.Generator]) -> None:
        """Draws parameters anew, of each body by itself; for all of them, before `begin`."""
        del random

    def bodies(self) -> tuple[IntArray, FloatArray]:
        """(S, 3) triangles of a body's surface, and (B, N, 3) vertices [m]; none where only markers are known."""
        return np.zeros((0, 3), dtype=np.int64), np.zeros((self.count, 0, 3))


class RobotWorld(World):
    """Robots of a run or of a file.

    Args:
        robot: that was loaded with ``on_failure="count"``.
        given: the input.
        count: B.
        spread: by how many standard deviations of its identification parameters vary; 0 for none.
        mixed: (k, n) what each of k commands is in the n values of the input; each its own, if left out.
        shown: numbers of what is shown, of all markers or vertices.

    Raises:
        InputError: there is no such input, or parameters are to vary that have no deviations.
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
                f"{robot.description.name} has no deviations of its parameters, so that nothing tells how they vary: "
                "set spread to 0, or take a run that identifies some."
            )
        self._nominal = self.robot = robot
        self.count, self.time_step, self.input = count, robot.time_step, given
        self._mixed = np.eye(len(robot.inputs[given].parts)) if mixed is None else mixed
        self.parts, self._spread, self._shown = len(self._mixed), spread, shown
        self._rest = self._begun()
        self._state = self._rest

    def vary(self, random: Sequence[np.random.Generator]) -> None:
        """See `World.vary`: from the normal distribution that identification found, where that is positive."""
        if not self._spread:
            return
        known = self._nominal.description
        uncertainty: Mapping[str, Any] = known.uncertainty or {}
        names = list(uncertainty["deviation"])
        deviation = np.array([uncertainty["deviation"][name] for name in names])
        root = np.linalg.cholesky(np.array(uncertainty["correlation"]) + 1e-9 * np.eye(len(names)))
        mean = np.array([known.parameters[name] for name in names])
        drawn = np.stack([root @ each.standard_normal(len(names)) for each in random])
        values = mean + self._spread * deviation * drawn
        values = np.where(mean > 0.0, np.maximum(values, _LEAST * mean), values)
        limits = {"poissons_ratio": (0.0, 0.499)}
        given = {name: np.clip(values[:, at], *limits.get(name, (-np.inf, np.inf))) for at, name in enumerate(names)}
        like = self._nominal.simulator
        self.robot = self._nominal.with_parameters(**{name: like.tensor(each) for name, each in given.items()})
        self._rest = self._begun()

    def _begun(self) -> RobotState:
        with torch.no_grad():
            return self.robot.begin(self.count)

    def begin(self, chosen: BoolArray) -> None:
        """See `World.begin`."""
        if chosen.all():
            self._state = self._rest
        else:
            self._state = self._rest.where(torch.as_tensor(chosen, device=self._rest.q.device), self._state)

    @torch.no_grad()
    def step(self, commands: FloatArray) -> BoolArray:
        """See `World.step`."""
        self._state = self.robot.step(self._state, **{self.input: commands @ self._mixed})
        lost = self._state.lost
        return np.zeros(self.count, dtype=np.bool_) if lost is None else np.asarray(lost.cpu().numpy())

    def markers(self) -> FloatArray:
        """See `World.markers`; vertices of a robot without markers."""
        found = self.robot.observe(self._state)
        found = found if self._shown is None else found[:, list(self._shown)]
        return np.asarray(found.double().cpu().numpy())

    def bodies(self) -> tuple[IntArray, FloatArray]:
        """See `World.bodies`."""
        return boundary_triangles(self.robot.simulator.body.mesh), self._state.q.double().cpu().numpy()

    @property
    def state(self) -> RobotState:
        """Of the robots."""
        return self._state


class ReducedWorld(World):
    """Reduced models of a robot, some hundred times as fast; see `control.reduced`."""

    def __init__(self, model: ReducedModel, count: int) -> None:
        self._model, self.count, self.time_step = model, count, model.time_step
        self.input, self.parts = model.name, model.parts
        self._rest = self._batch = begin(model, count, np.zeros(model.parts))
        self._furthest = _FURTHEST * np.abs(model.static.coefficients).max()
        self._lost = np.zeros(count, dtype=np.bool_)

    def begin(self, chosen: BoolArray) -> None:
        """See `World.begin`."""
        self._batch, self._lost = self._rest.where(chosen, self._batch), self._lost & ~chosen

    def step(self, commands: FloatArray) -> BoolArray:
        """See `World.step`: a model fails that goes further than the robot ever could, and rests until it begins."""
        with np.errstate(over="ignore", invalid="ignore"):
            self._batch = advance(self._model, self._batch, commands)
        self._lost = self._lost | ~(np.abs(self._batch.z) < self._furthest).all(axis=1)
        if self._lost.any():
            self._batch = self._rest.where(self._lost, self._batch)
        return self._lost

    def markers(self) -> FloatArray:
        """See `World.markers`."""
        return observed(self._model, self._batch)


class LaboratoryWorld(World):
    """Bodies of a simulated laboratory; see `control.laboratory.Laboratory`.

    Attributes:
        noise: standard deviation of what cameras see [m].
    """

    def __init__(self, settings: Mapping[str, Any], run_dir: Path, given: str, count: int, seed: int) -> None:
        self._laboratory = Laboratory(settings, run_dir, given, count, seed, "count")
        self._lost = np.zeros(count, dtype=np.bool_)
        self.count, self.time_step, self.input = count, float(settings["time_step"]), given
        self.parts = self._laboratory.parts
        self._rest = self._laboratory.state
        self.noise = float(settings["laboratory"]["noise"])

    def begin(self, chosen: BoolArray) -> None:
        """See `World.begin`."""
        self._lost = self._lost & ~chosen
        self._put_to_rest(chosen)

    def _put_to_rest(self, chosen: BoolArray) -> None:
        if chosen.all():
            self._laboratory.state = self._rest
            return
        pick = torch.as_tensor(chosen, device=self._rest.q.device)
        rest, now = self._rest.tensors(), self._laboratory.state.tensors()
        still = {"previous_q": self._rest.q, "previous_v": self._rest.v}

        def mixed(name: str, value: torch.Tensor) -> torch.Tensor:
            other = rest.get(name, still.get(name, torch.zeros_like(value)))
            return torch.where(pick.view(-1, *[1] * (value.ndim - 1)), other, value)

        self._laboratory.state = State.from_tensors({name: mixed(name, value) for name, value in now.items()})

    def step(self, commands: FloatArray) -> BoolArray:
        """See `World.step`; a body whose simulation fails rests until it begins."""
        self._lost = self._lost | self._laboratory.step(commands)
        if self._lost.any():
            self._put_to_rest(self._lost)
        return self._lost

    def markers(self) -> FloatArray:
        """See `World.markers`; cameras see them with a noise."""
        return self._laboratory.truth()

    def bodies(self) -> tuple[IntArray, FloatArray]:
        """See `World.bodies`."""
        return self._laboratory.bodies()


def rests(robot: Robot, given: str, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(S, M, 3) where the markers of a robot rest under inputs [m], and these (S, n), of those under which it does.

    Args:
        robot: that is asked.
        given: the input, of which the experiment's trials tell the range; the base has none.
        shares: (B, n) of the range.
    """
    known = robot.inputs[given]
    assert given != BASE
    if known.low is None or known.high is None:
        raise InputError(f"the trials of {robot.description.name} tell no range of {given}: give limits of it.")
    low, high = np.array(known.low), np.array(known.high)
    with torch.no_grad():
        q, settled = robot.settle_some(len(shares), **{given: low + shares * (high - low)})
        q = q[settled]
        found = robot.observe(RobotState(State(q, torch.zeros_like(q)))).double().cpu().numpy()
    return found, shares[settled.cpu().numpy()]
