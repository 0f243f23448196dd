"""A robot that is stepped as time goes on: driven by hand or as in a recorded trial, pulled, of another material."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.markers import Markers
from ..data.rigid import RigidTransform, kabsch
from ..experiment.build import bound_markers, marker_view_of
from ..io.errors import ConvergenceError, InputError
from ..mesh.mesh import boundary_triangles, surface_vertices
from ..robot.inputs import BASE
from ..robot.loading import RecordedTrial, recorded_trial
from ..robot.robot import Robot
from ..stepping.quantity import Quantity

FloatArray = NDArray[np.float64]
MATERIAL: Final = ("youngs_modulus", "poissons_ratio", "density", "mass_damping", "stiffness_damping")
_ROUNDING: Final = 1e-9  # Of times [s].
_PATCH: Final = 0.06  # Radius of what a hand takes hold of, over the size of the body.
_PULL: Final = 10.0  # Force of a pull over one length of the body, in weights of the body,
_STIFFEST: Final = 0.25  # unless that were more than so much of its mass over the squared time step.
_WIDE: Final = 1.4  # Logarithm of the factor by which a parameter may be changed.
_BEYOND: Final = 1.25  # How much more than in the trials an input may be.
_BASE_SPEED: Final = 1.0  # Of the base that a hand moves, in lengths of the body, and rad, a second.
_MOVED: Final = (0.25, 0.5)  # How far the base may be moved, over the body's size, and turned [rad].


class LiveRobot:
    """A robot that is stepped, with what a hand does to it in between.

    Args:
        robot: of one environment.

    Attributes:
        size: longest side of the body [m].
        surface: (S,) vertices of its boundary.
        faces: (F, 3) triangles of these, numbered among them.
        inputs: (C,) values by name, as they are commanded now.
        limits: (low, high) of each input's parts (C,) that a hand may set.
        parameters: what may be changed, by name: its quantity and the value that it had.
        time: since the begin of the motion [s].
        failure: why it stands still; empty where it does not.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = self._original = robot
        mesh = robot.simulator.body.mesh
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        self.surface = surface_vertices(mesh)
        self.faces = np.searchsorted(self.surface, boundary_triangles(mesh))
        self.inputs = {name: np.zeros(len(each.parts)) for name, each in robot.inputs.items()}
        self.limits = {name: self._limits(name) for name in robot.inputs}
        self.parameters = {} if robot.is_data_driven else _changeable(robot)
        mass = float(robot.constants.mass.sum())
        weight = mass * float(np.linalg.norm(robot.simulator.gravity)) or mass
        self._stiffness = min(_PULL * weight / self.size, _STIFFEST * mass / robot.time_step**2)  # [N/m]
        self._held: tuple[FloatArray, FloatArray] | None = None  # (N,) weights of what is held, and (3,) where to [m]
        self._on_body = _markers_on_body(robot)
        self.trial: RecordedTrial | None = None
        self.failure = ""
        self.reset()

    def _limits(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Least and greatest values of an input's parts."""
        robot_input = self._original.inputs[name]
        if name == BASE:
            far = np.repeat([_MOVED[0] * self.size, _MOVED[1]], 3)
            return -far, far
        if robot_input.low is None or robot_input.high is None:
            return np.zeros(len(robot_input.parts)), np.full(len(robot_input.parts), robot_input.quantity.typical)
        least, most = np.minimum(robot_input.low, 0.0), np.maximum(robot_input.high, 0.0)
        return _BEYOND * least, _BEYOND * most

    # What is shown

    @property
    def positions(self) -> FloatArray:
        """(N, 3) of the vertices [m]."""
        return np.asarray(self.state.q[0].double().cpu().numpy())

    @property
    def markers(self) -> FloatArray:
        """(M, 3) as they are simulated [m]; none where every vertex is observed."""
        if not self.robot.labels:
            return np.empty((0, 3))
        seen = self._as_recorded()
        return seen if self._on_body is None else self._to_body(seen).apply(seen)

    @property
    def measured(self) -> FloatArray | None:
        """(M, 3) what was observed in the trial at this time [m], between two frames linear in time.

        NaN where nothing was seen; None without a trial.
        """
        if self.trial is None:
            return None
        times, seen = self.trial.times, self.trial.markers
        frame = max(int(np.searchsorted(times, self.time + _ROUNDING, side="right")) - 1, 0)
        shown = seen[frame]
        if frame + 1 < len(times) and self.time > times[frame]:
            share = (self.time - times[frame]) / (times[frame + 1] - times[frame])
            shown = (1.0 - share) * shown + share * seen[frame + 1] if share > _ROUNDING else shown
        return shown if self._on_body is None else self._to_body(self._as_recorded()).apply(shown)

    def _as_recorded(self) -> FloatArray:
        """(M, 3) the simulated markers in the frame of the recordings [m]."""
        markers = self.robot.observe(self.state)[0].double().cpu().numpy()
        shift = None if self.trial is None else self.trial.shift
        return np.asarray(markers if shift is None else markers + shift)

    def _to_body(self, recorded: FloatArray) -> RigidTransform:
        """From the frame of the recordings, in which markers (M, 3) are given, to that of the body."""
        assert self._on_body is not None
        on_body = self._on_body(self.state.q)[0].double().cpu().numpy()
        seen = np.isfinite(recorded).all(axis=1)
        return kabsch(recorded[seen], on_body[seen])

    @property
    def has_left(self) -> bool:
        """Whether it has left the states that the learned force was trained on."""
        return bool(self.state.left[0])

    @property
    def is_pulled(self) -> bool:
        """Whether a hand holds it."""
        return self._held is not None

    # What a hand does

    def set_input(self, name: str, part: int, value: float) -> None:
        """Commands a value; ends the trial that plays."""
        self.trial = None
        self.inputs[name][part] = value

    def set_parameter(self, name: str, value: float) -> None:
        """Changes a parameter; the motion goes on.

        Raises:
            InputError: the value is out of range.
        """
        self.robot = self.robot.with_parameters(**{name: value})

    def grab(self, point: FloatArray) -> None:
        """Takes hold of the surface around a point (3,) [m]."""
        if self.robot.is_data_driven:
            raise InputError("a network in the simulator's place feels no force: view another model to pull it.")
        q = self.positions
        away = np.linalg.norm(q[self.surface] - point, axis=1)
        near = np.exp(-0.5 * ((away - away.min()) / (_PATCH * self.size)) ** 2)
        weights = np.zeros(len(q))
        weights[self.surface] = near / near.sum()
        self._held = weights, np.asarray(point, dtype=np.float64)

    def drag(self, target: FloatArray) -> None:
        """Moves the point (3,) to which what is held is pulled [m]."""
        if self._held is not None:
            self._held = self._held[0], np.asarray(target, dtype=np.float64)

    def let_go(self) -> None:
        """Pulls no longer."""
        self._held = None

    def play_trial(self, name: str | None) -> None:
        """Begins a recorded trial where the identified robot begins it, or ends it.

        Raises:
            InputError: there is no such trial.
            ConvergenceError: the body cannot be brought where it begins.
        """
        self.trial = None if name is None else recorded_trial(self._original, name)
        self.reset()

    def reset(self) -> None:
        """Starts again: at the trial's start, or at rest without inputs."""
        self.time, self.failure, self._held = 0.0, "", None
        for values in self.inputs.values():
            values[:] = 0.0
        with torch.no_grad():
            self.state = self.robot.begin() if self.trial is None else self.trial.start

    def restore(self) -> None:
        """Undoes every change of a parameter."""
        self.robot = self._original

    # What time does

    def step(self) -> bool:
        """Simulates one time step, unless the trial is over or the simulation has failed; returns whether it did."""
        if self.failure or (self.trial is not None and self.time >= self.trial.times[-1] - _ROUNDING):
            return False
        acting = dict[str, torch.Tensor | FloatArray](self._commanded())
        if self._held is not None:
            weights, target = self._held
            acting["external_force"] = weights[:, None] * (self._stiffness * (target - weights @ self.positions))
        try:
            with torch.no_grad():
                state = self.robot.step(self.state, **acting)
        except ConvergenceError as error:
            self.failure = f"Stopped: {error}"
            return False
        self.state, self.time = state, self.time + self.robot.time_step
        return True

    def _commanded(self) -> Mapping[str, FloatArray]:
        """The inputs of the coming step; those of a trial are kept, to be seen."""
        if self.trial is not None:
            number = round(self.time / self.robot.time_step)
            for name, value in self.trial.inputs.items():
                at = torch.as_tensor(value)
                at = at[min(number, len(at) - 1)] if at.ndim == 3 else at
                self.inputs[name][:] = at.reshape(-1).double().cpu().numpy()
        acting = {name: values.copy() for name, values in self.inputs.items() if name != BASE}
        if self.state.base is not None or (BASE in self.inputs and self.inputs[BASE].any()):
            acting[BASE] = self.inputs[BASE].copy() if self.trial is not None else self._moved_base()
        return acting

    def _moved_base(self) -> FloatArray:
        """(6,) the base on its way to where a hand has it, no faster than it may be."""
        target = self.inputs[BASE]
        now = np.zeros(6) if self.state.base is None else self.state.base[-1, 0].double().cpu().numpy()
        far = np.repeat([self.size, 1.0], 3) * _BASE_SPEED * self.robot.time_step
        return np.asarray(now + np.clip(target - now, -far, far))


def _markers_on_body(robot: Robot) -> Markers | None:
    """Markers where they are on the body; None where they are seen so, and not in a frame of their own."""
    about = robot.description
    if about.markers is None or about.bound is None or not marker_view_of(about.markers, about.labels, about.sets).own:
        return None
    markers = bound_markers(about.markers, about.mesh, about.bound.numpy(), about.labels)
    return markers.to(robot.simulator.rest_positions)


def _changeable(robot: Robot) -> dict[str, tuple[Quantity, float]]:
    """Parameters that are one number, identified ones first, with their values."""
    simulator, changeable = robot.simulator, dict[str, tuple[Quantity, float]]()
    for name in (*robot.parameters, *MATERIAL):
        quantity = simulator.parameters.get(name)
        if quantity is None or name in changeable or name == "gravity":
            continue
        value = simulator.tensor(robot.parameters.get(name, simulator.constants.get(name, float("nan"))))
        if value.numel() == 1 and bool(torch.isfinite(value).all()):
            changeable[name] = (quantity, float(value))
    return changeable


def range_of(quantity: Quantity, value: float) -> tuple[float, float]:
    """Returns the lowest and highest value to which a parameter may be set, around its own."""
    at = torch.tensor(value, dtype=torch.float64)
    if value == quantity.lower:  # Such as no damping.
        return value, value + quantity.typical
    low, high = (float(quantity.varied(at, torch.tensor(sign * _WIDE, dtype=torch.float64))) for sign in (-1, 1))
    return low, high
