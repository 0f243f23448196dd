"""Simulated bodies that are commanded and observed step by step:
robots, reduced models, the simulated laboratory.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Generic, TypeVar

import numpy as np
import torch
from typing_extensions import override

from ..core.dynamics.simulator import Simulator
from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.mesh.volume_mesh import boundary_triangles
from ..core.stepping.rollout import states
from ..core.stepping.state import State
from ..coupling.mount import MountedState
from ..data.registration import kabsch
from ..experiment.build import build_body, simulation_device
from ..experiment.files import REGISTRATION
from ..experiment.laboratory import make_setup
from ..experiment.simulate import substeps_of, target_settings
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import InputError
from ..io.resuming import finished_record
from ..io.safe_files import read_json
from ..io.settings import parse
from ..robot.description import Description
from ..robot.robot import Robot
from ..settings.observed import BindingSettings, MarkerSettings
from ..settings.stage_keys import StageSettings
from .reduced_model import ReducedModel, ReducedState

_FURTHEST: Final = (
    20.0  # coordinates at which a reduced model has failed, relative to those of equilibria
)
_LEAST: Final = 1e-3  # lower bound of drawn positive parameters, relative to the identified value
_STREAM: Final = 7  # of the random number generator
_BEFORE: Final = 1_000_000  # number of the first of the frames taken before the first step
_LABORATORY: Final = "laboratory"
G: Final = 9.81  # of the weights that are units of forces [m/s^2]


S = TypeVar("S", State, ReducedState, MountedState)


class World(ABC, Generic[S]):
    """B bodies that take commands and have markers; a stepper (`stepping.rollout`).

    Bodies begin in ``rest``; those that begin again do so by ``world.rest.where(chosen, state)``.
    """

    rest: S  # state of the bodies at rest without inputs
    count: int  # B
    time_step: float  # h [s]
    input: str  # name of the commanded input
    parts: int  # number n of its values
    noise: float | None = (
        None  # standard deviation of observed markers [m]; None if the caller chooses it
    )
    travel: tuple[float, float, float] = (0.0, 0.0, 0.0)  # (3,) of the body as a whole [m]

    @abstractmethod
    def step(self, state: S, commands: FloatArray) -> S:
        """Returns the state after one time step under commands (B, n).

        Bodies that fail are lost, and stand at rest.
        """

    @abstractmethod
    def markers(self, state: S) -> FloatArray:
        """Markers (B, M, 3), without noise [m]."""

    def lost(self, state: S) -> BoolArray:
        """Which bodies (B,) have failed since they began."""
        moving = state.robot if isinstance(state, MountedState) else state
        return np.asarray(torch.as_tensor(moving.lost).cpu().numpy())

    def forces(self, state: S) -> FloatArray:
        """Forces (B, K) that hold the bodies at their fixed vertices over a weight.

        Zero where no step led to a state.

        Raises:
            InputError: nothing in this world knows them.
        """
        raise InputError(
            "forces need a simulator and fixed vertices: choose another world or robot."
        )

    def squeeze(self, state: S) -> FloatArray:
        """Forces (B,) of fingers beyond the least that holds a ball,
        over its weight, or raises InputError.
        """
        raise InputError("squeeze is for fingers that hold a ball: choose grasp or pick_and_place.")

    def vary(self, random: Sequence[np.random.Generator]) -> None:
        """Draws new parameters, by a generator for each body; all bodies begin again afterwards."""
        del random

    def bodies(self, state: S) -> tuple[IntArray, FloatArray]:
        """Surface triangles (S, 3) and vertices (B, N, 3) [m].

        Empty if the body is known by its markers only.
        """
        return np.zeros((0, 3), dtype=np.int64), np.zeros((self.count, 0, 3))

    def rigid(self, state: S) -> tuple[IntArray, FloatArray]:
        """Surface triangles (S, 3) and vertices (B, N, 3) of rigid bodies
        that carry the others [m]; empty if none.
        """
        del state
        return np.zeros((0, 3), dtype=np.int64), np.zeros((self.count, 0, 3))

    def obstacles(self) -> ObstacleSurface:
        """Surfaces of the obstacles that the bodies touch."""
        return ObstacleSurface()


def total_force(simulator: Simulator, state: State, at: str | None = None) -> FloatArray:
    """Returns the force (B, 3) on fixed vertices, of a body of a scene if it is named [N].

    Zero where it is unknown.
    """
    if state.reaction is None:
        return np.zeros((state.batch, 3))
    return np.nan_to_num(
        simulator.reaction(state, at or simulator.fixed).force.detach().double().cpu().numpy()
    )


class RobotWorld(World[State]):
    """B copies of a robot in its full simulator.

    Args:
        robot: loaded with ``on_failure="count"``.
        command: name of the commanded input.
        count: B.
        spread: variation of the parameters, in standard deviations of their identification; 0 for
            none.
        mixed: (k, n) from k commands to the n values of the input; the identity if omitted.
        shown: numbers of the observed points among all markers or vertices; all if omitted.
        time_step: h [s], a multiple of the robot's; that of the robot if omitted.

    Raises:
        InputError: there is no such input, or the run has no standard deviations of its parameters.
    """

    def __init__(
        self,
        robot: Robot,
        command: str,
        count: int,
        spread: float = 0.0,
        mixed: FloatArray | None = None,
        shown: Sequence[int] | None = None,
        time_step: float | None = None,
    ) -> None:
        if command not in robot.inputs:
            raise InputError(
                f"there is no input {command!r}: the robot has {', '.join(robot.inputs) or 'none'}."
            )
        if spread > 0.0 and robot.description.uncertainty is None:
            raise InputError(
                f"{robot.description.name} has no standard deviations of its parameters, which "
                "spread needs: set spread=0, or choose a run that identifies parameters."
            )
        self._nominal = self.robot = robot
        self.count, self.input = count, command
        self.time_step = time_step or robot.time_step
        self._substeps = round(self.time_step / robot.time_step)
        self._mixed = np.eye(len(robot.inputs[command].parts)) if mixed is None else mixed
        self.parts = len(self._mixed)
        self._spread, self._shown = spread, shown
        self.rest = self._begun()

    @override
    def vary(self, random: Sequence[np.random.Generator]) -> None:
        description = self._nominal.description
        uncertainty = description.uncertainty
        if not self._spread or uncertainty is None:
            return
        names, deviation = [*uncertainty.deviation], np.array([*uncertainty.deviation.values()])
        root = np.linalg.cholesky(np.array(uncertainty.correlation) + 1e-9 * np.eye(len(names)))
        mean = np.array([description.parameters[name] for name in names])
        drawn = np.stack([root @ generator.standard_normal(len(names)) for generator in random])
        values = mean + self._spread * deviation * drawn
        values = np.where(mean > 0.0, np.maximum(values, _LEAST * mean), values)
        parameters = dict(zip(names, values.T, strict=True))
        if "poissons_ratio" in parameters:
            parameters["poissons_ratio"] = parameters["poissons_ratio"].clip(0.0, 0.499)
        tensor = self._nominal.simulator.tensor
        self.robot = self._nominal.with_parameters(
            **{name: tensor(values) for name, values in parameters.items()}
        )
        self.rest = self._begun()

    def _begun(self) -> State:
        with torch.no_grad():
            return self.robot.begin(self.count)

    @override
    @torch.no_grad()
    def step(self, state: State, commands: FloatArray) -> State:
        inputs = {self.input: commands @ self._mixed}
        *_, state = states(
            lambda now, _: self.robot.step(now, **inputs), state, range(self._substeps)
        )
        return state

    @override
    def markers(self, state: State) -> FloatArray:
        markers = self.robot.observe(state)
        markers = markers if self._shown is None else markers[:, list(self._shown)]
        return np.asarray(markers.double().cpu().numpy())

    @override
    def forces(self, state: State) -> FloatArray:
        simulator = self._nominal.simulator
        if self._nominal.is_data_driven or not len(simulator.fixed):
            return super().forces(state)
        return total_force(simulator, state) / (G * float(simulator.prepare().load_mass.sum()))

    @override
    def bodies(self, state: State) -> tuple[IntArray, FloatArray]:
        return boundary_triangles(self.robot.simulator.body.mesh), state.q.double().cpu().numpy()

    @override
    def obstacles(self) -> ObstacleSurface:
        return ObstacleSurface.of(self.robot.simulator.body, self._nominal.parameters)


def laboratory_robot(
    settings: StageSettings, upright: bool = False, on_failure: str = "raise"
) -> Robot:
    """Returns the simulated laboratory of a run as a robot with its own markers.

    Args:
        settings: of the laboratory.
        upright: whether its body is not tilted.
        on_failure: as for `Robot`.
    """
    target, setup = target_settings(settings, settings.laboratory), make_setup(settings)
    gravity = settings.gravity if upright else tuple(setup.gravity.tolist())
    description = Description(
        name=_LABORATORY,
        model=_LABORATORY,
        settings=target.model_copy(update={"gravity": gravity}),
        material=settings.laboratory.material,
        mesh=build_body(target).mesh,
        payload_at=settings.payload_at,
        markers=MarkerSettings.of(BindingSettings.of(settings.binding)),
        labels=settings.binding.observed,
        bound=torch.from_numpy(setup.tracked),
    )
    return Robot(description, simulation_device(settings.device), on_failure)


def laboratory_settings(folder: Path) -> StageSettings:
    """Returns the settings of a run's laboratory, on the CPU.

    Raises:
        DataFileError: the run has no laboratory, or is unfinished.
    """
    return parse(StageSettings, finished_record(folder, _LABORATORY)["settings"]).model_copy(
        update={"device": "cpu"}
    )


class Laboratory(RobotWorld):
    """Bodies that stand in for the real robot: they take commands step by step,
    and cameras see their markers.

    Args:
        settings: of the laboratory.
        run_dir: of its run; the registration there gives the pose of the body in the cameras'
            frame.
        name: of the input.
        count: B.
        seed: of the noise.
        on_failure: ``raise``; or ``count``: a body whose simulation fails stays at rest until it
            begins again.
    """

    noise: float

    def __init__(
        self,
        settings: StageSettings,
        run_dir: Path,
        name: str,
        count: int,
        seed: int,
        on_failure: str = "raise",
    ) -> None:
        substeps_of(settings.time_step, settings.laboratory, _LABORATORY)
        robot = laboratory_robot(settings, on_failure=on_failure)
        super().__init__(robot, name, count, time_step=settings.time_step)
        self.noise = settings.laboratory.noise
        self._seeds = (settings.seed, _STREAM, seed)
        trials = read_json(run_dir / REGISTRATION).values()
        reference = make_setup(settings).reference
        seen = [trial["positions"] for trial in trials if "positions" in trial]
        labels = settings.binding.reference
        places = np.mean([list(map(trial.__getitem__, labels)) for trial in seen], axis=0)
        # From the frame of the body to that of the experiment.
        self._frame = kabsch(reference, places)

    @override
    def markers(self, state: State) -> FloatArray:
        return np.asarray(self._frame.apply(super().markers(state)))

    @override
    def forces(self, state: State) -> FloatArray:
        return np.asarray(super().forces(state) @ self._frame.rotation.T)

    @override
    def bodies(self, state: State) -> tuple[IntArray, FloatArray]:
        triangles, vertices = super().bodies(state)
        return triangles, np.asarray(self._frame.apply(vertices))

    @override
    def obstacles(self) -> ObstacleSurface:
        return super().obstacles().carried(self._frame.rotation, self._frame.translation)

    def seen(self, state: State, number: int) -> FloatArray:
        """Returns noisy markers (B, M, 3) after a number of steps [m].

        The step number seeds the noise.
        """
        markers = self.markers(state)
        random = np.random.default_rng([*self._seeds, number])
        return markers + self.noise * random.standard_normal(markers.shape)

    def seen_at_rest(self, frames: int = 20) -> FloatArray:
        """Returns noisy markers (B, M, 3) averaged over frames taken before anything moves [m]."""
        return np.asarray(
            np.mean([self.seen(self.rest, _BEFORE + number) for number in range(frames)], axis=0)
        )


class ReducedWorld(World[ReducedState]):
    """B copies of a robot's reduced model, a few hundred times as fast as its simulator."""

    def __init__(self, model: ReducedModel, count: int) -> None:
        self._model, self.count = model, count
        self.time_step, self.input = model.time_step, model.name
        self.parts, self.rest = model.parts, model.rest(count=count)
        self._furthest = _FURTHEST * np.abs(model.static.coefficients).max()

    @override
    def step(self, state: ReducedState, commands: FloatArray) -> ReducedState:
        with np.errstate(over="ignore", invalid="ignore"):
            after = self._model.step(state, commands)
        lost = state.lost | ~(np.abs(after.z) < self._furthest).all(axis=1)
        return replace(self.rest.where(lost, after), lost=lost) if lost.any() else after

    @override
    def markers(self, state: ReducedState) -> FloatArray:
        return self._model.observe(state).reshape(self.count, -1, 3)
