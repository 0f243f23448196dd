"""A robot for interactive simulation: driven by hand or by a recorded trial,
pulled, with changed parameters.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
import torch

from ..core.energies.contact.contact_points import MOTION
from ..core.energies.contact.obstacle_contact import Contact
from ..core.mesh.volume_mesh import surface_vertices
from ..core.stepping.quantity import Quantity
from ..core.stepping.state import State
from ..data.markers import Markers
from ..data.registration import RigidTransform, kabsch
from ..experiment.build import bound_markers, marker_view_of
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError
from ..robot.actuation import BASE
from ..robot.loading import RecordedTrial, recorded_trial
from ..robot.robot import Robot

MATERIAL: Final = (
    "youngs_modulus",
    "poissons_ratio",
    "density",
    "mass_damping",
    "stiffness_damping",
)
_ROUNDING: Final = 1e-9  # Of times [s].
_PATCH: Final = 0.06  # Radius of the surface patch that is grabbed, over the size of the body.
_PULL: Final = 10.0  # Pulling force at a distance of one body size, in weights of the body.
_STIFFEST: Final = (
    0.25  # Upper bound of the stiffness of a pull, in mass of the body over squared time step.
)
_WIDE: Final = 1.4  # Logarithm of the factor by which a parameter may be changed.
_BEYOND: Final = 1.25  # Largest input, over that of the trials.
_BASE_SPEED: Final = 1.0  # Largest speed of the base, in sizes of the body, and rad, a second.
# Largest displacement of base and obstacles, over the body's size, and rotation [rad].
_MOVED: Final = (0.25, 0.5)


class LiveRobot:
    """A robot that is stepped, and interactions between the steps.

    Args:
        robot: with one environment.

    Attributes:
        size: longest side of the body [m].
        surface: (S,) vertices of its boundary.
        inputs: (C,) commanded values by name.
        limits: lowest and highest values (C,) of the parts of each input.
        parameters: quantities and original values of the parameters that may be changed, by name.
        held: weights (N,) of the vertices that are pulled, and the point (3,) to which they are
            [m]; None if none is.
        moved: (O,) inputs that moved obstacles in the last step, by name.
        time: since the start of the motion [s].
        failure: why the simulation stopped; empty while it runs.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = self._original = robot
        mesh = robot.simulator.body.mesh
        self.size = float(np.ptp(mesh.vertices, axis=0).max())
        self.surface = surface_vertices(mesh)
        self.inputs = {
            name: np.zeros(len(robot_input.parts)) for name, robot_input in robot.inputs.items()
        }
        self.limits = {name: self._limits(name) for name in robot.inputs}
        self.parameters = {} if robot.is_data_driven else _changeable(robot)
        mass = float(robot.constants.mass.sum())
        weight = mass * float(np.linalg.norm(robot.simulator.gravity)) or mass
        # [N/m]
        self._stiffness = min(_PULL * weight / self.size, _STIFFEST * mass / robot.time_step**2)
        self.held: tuple[FloatArray, FloatArray] | None = None
        self._on_body = _markers_on_body(robot)
        self.moved: dict[str, FloatArray] = {}
        self.state: State
        self.trial: RecordedTrial | None = None
        self.failure = ""
        self.reset()

    def _limits(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest values (C,) of the parts of an input."""
        robot_input = self._original.inputs[name]
        if name == BASE:
            far = np.repeat([_MOVED[0] * self.size, _MOVED[1]], 3)
            return -far, far
        if robot_input.quantity in MOTION:
            far = np.full(
                len(robot_input.parts),
                _MOVED[1] if robot_input.unit == "rad" else _MOVED[0] * self.size,
            )
            return -far, far
        if robot_input.low is None or robot_input.high is None:
            return np.zeros(len(robot_input.parts)), np.full(
                len(robot_input.parts), robot_input.quantity.typical
            )
        return _BEYOND * np.minimum(robot_input.low, 0.0), _BEYOND * np.maximum(
            robot_input.high, 0.0
        )

    # Views of the state

    @property
    def positions(self) -> FloatArray:
        """Positions (N, 3) of the vertices [m]."""
        return np.asarray(self.state.q[0].double().cpu().numpy())

    @property
    def markers(self) -> FloatArray:
        """Simulated markers (M, 3) [m]; empty where every vertex is observed."""
        if not self.robot.labels:
            return np.empty((0, 3))
        seen = self._as_recorded()
        return seen if self._on_body is None else self._to_body(seen).apply(seen)

    @property
    def measured(self) -> FloatArray | None:
        """Measured markers (M, 3) of the trial at this time [m],
        interpolated linearly between frames.

        NaN for hidden markers; None without a trial.
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
        """Simulated markers (M, 3) in the frame of the recordings [m]."""
        markers = self.robot.observe(self.state)[0].double().cpu().numpy()
        shift = None if self.trial is None else self.trial.shift
        return np.asarray(markers if shift is None else markers + shift)

    def _to_body(self, recorded: FloatArray) -> RigidTransform:
        """Transform to the frame of the body from that of the recordings,
        in which markers (M, 3) are given [m].
        """
        assert self._on_body is not None
        on_body = self._on_body(self.state.q)[0].double().cpu().numpy()
        seen = np.isfinite(recorded).all(axis=1)
        return kabsch(recorded[seen], on_body[seen])

    @property
    def has_left(self) -> bool:
        """Whether the state is outside the training range of the learned force."""
        return bool(self.state.left[0])

    @property
    def target(self) -> FloatArray | None:
        """Measured positions (N, 3) of the vertices [m], where every one is observed."""
        return None if self.robot.labels else self.measured

    # Interactions

    def set_input(self, name: str, part: int, value: float) -> None:
        """Commands a value; a trial that plays ends."""
        self.trial = None
        self.inputs[name][part] = value

    def set_parameter(self, name: str, value: float) -> None:
        """Changes a parameter; the motion continues.

        Raises:
            InputError: the value is out of range.
        """
        self.robot = self.robot.with_parameters(**{name: value})

    def grab(self, point: FloatArray) -> None:
        """Grabs the surface around a point (3,) [m]."""
        if self.robot.is_data_driven:
            raise InputError(
                "a network in the simulator's place feels no force: view another model to pull it."
            )
        q = self.positions
        away = np.linalg.norm(q[self.surface] - point, axis=1)
        near = np.exp(-0.5 * ((away - away.min()) / (_PATCH * self.size)) ** 2)
        weights = np.zeros(len(q))
        weights[self.surface] = near / near.sum()
        self.held = weights, np.asarray(point, dtype=np.float64)

    def drag(self, target: FloatArray) -> None:
        """Sets the point (3,) [m] towards which the grabbed patch is pulled."""
        if self.held is not None:
            self.held = self.held[0], np.asarray(target, dtype=np.float64)

    def let_go(self) -> None:
        """Releases the grabbed patch."""
        self.held = None

    def play_trial(self, name: str | None) -> None:
        """Starts a recorded trial from its initial state; None ends the trial.

        Raises:
            InputError: there is no such trial.
            ConvergenceError: the initial state cannot be computed.
        """
        self.trial = None if name is None else recorded_trial(self._original, name)
        self.reset()

    def reset(self) -> None:
        """Restarts from the initial state of the trial, or from rest without inputs."""
        self.time, self.failure = 0.0, ""
        self.held, self.moved = None, {}
        for values in self.inputs.values():
            values[:] = 0.0
        with torch.no_grad():
            self.state = self.robot.begin() if self.trial is None else self.trial.start

    def restore(self) -> None:
        """Undoes every change of a parameter."""
        self.robot = self._original

    # Time

    def step(self) -> bool:
        """Simulates one time step.

        Returns False where the trial is over or the simulation failed.
        """
        if self.failure or (
            self.trial is not None and self.time >= self.trial.times[-1] - _ROUNDING
        ):
            return False
        acting = dict[str, torch.Tensor | FloatArray](self._commanded())
        if self.held is not None:
            weights, target = self.held
            acting["external_force"] = weights[:, None] * (
                self._stiffness * (target - weights @ self.positions)
            )
        moving = [quantity.name for quantity in MOTION if quantity.name in acting]
        wanted = {name: np.asarray(acting.pop(name)) for name in moving}
        placed = self._obstacles(wanted)
        try:
            with torch.no_grad():
                self.state = self.robot.step(self.state, **acting, **placed)
        except (ConvergenceError, InputError) as error:
            self.failure = f"Stopped: {error}"
            return False
        self.time, self.moved = self.time + self.robot.time_step, placed
        return True

    @property
    def _reach(self) -> float:
        """Distance at which contact begins [m], by which obstacles may move in a step.

        Infinite without contact.
        """
        contacts = [
            energy for energy in self.robot.simulator.body.energies if isinstance(energy, Contact)
        ]
        return min((contact.distance for contact in contacts), default=np.inf)

    def _obstacles(self, wanted: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Inputs (O,) that move obstacles in the next step, by name.

        In a trial obstacles move as recorded; by sliders, by as much as contact allows in a step.
        """
        placed = dict[str, FloatArray]()
        names = [quantity.name for quantity in MOTION if quantity.name in self.robot.inputs]
        for number, name in enumerate(names):
            values = np.zeros(len(self.robot.inputs[name].parts))
            if name in wanted:
                target = wanted[name]
                before = self.moved.get(name, np.zeros_like(values))
                far = self._reach if number < 3 else self._reach / self.size
                step = (
                    target - before
                    if self.trial is not None
                    else np.clip(target - before, -far, far)
                )
                values = before + step
            placed[name] = values
        return placed

    def _commanded(self) -> Mapping[str, FloatArray]:
        """Inputs of the next step; those of a trial are stored in `inputs` for display."""
        if self.trial is not None:
            number = round(self.time / self.robot.time_step)
            for name, value in self.trial.inputs.items():
                at = torch.as_tensor(value)
                at = at[min(number, len(at) - 1)] if at.ndim == 3 else at
                self.inputs[name][:] = at.reshape(-1).double().cpu().numpy()
        acting = {name: values.copy() for name, values in self.inputs.items() if name != BASE}
        if self._base is not None or (BASE in self.inputs and self.inputs[BASE].any()):
            acting[BASE] = (
                self.inputs[BASE].copy() if self.trial is not None else self._moved_base()
            )
        return acting

    @property
    def _base(self) -> torch.Tensor | None:
        """Displacement (1, 2, 6) of the base before and after the last step [m, rad].

        None if it never moved.
        """
        return self.state.memory_of().get(BASE)

    def _moved_base(self) -> FloatArray:
        """Motion of the base (6,) towards its commanded value, at no more than `_BASE_SPEED`."""
        target = self.inputs[BASE]
        now = np.zeros(6) if self._base is None else self._base[0, -1].double().cpu().numpy()
        far = np.repeat([self.size, 1.0], 3) * _BASE_SPEED * self.robot.time_step
        return np.asarray(now + np.clip(target - now, -far, far))


def _markers_on_body(robot: Robot) -> Markers | None:
    """Markers in the frame of the body, where recordings have their own frame.

    None where these are the same.
    """
    about = robot.description
    if (
        about.markers is None
        or about.bound is None
        or not marker_view_of(about.markers, about.labels, about.sets).shape_alone
    ):
        return None
    markers = bound_markers(about.markers, about.mesh, about.bound.numpy(), about.labels)
    return markers.to(robot.simulator.rest_positions)


def _changeable(robot: Robot) -> dict[str, tuple[Quantity, float]]:
    """Scalar parameters with their quantities and values, identified ones first."""
    simulator, changeable = robot.simulator, dict[str, tuple[Quantity, float]]()
    for name in (*robot.parameters, *MATERIAL):
        quantity = simulator.parameters.get(name)
        if quantity is None or name in changeable or name == "gravity":
            continue
        value = simulator.tensor(
            robot.parameters.get(name, simulator.defaults.get(name, float("nan")))
        )
        if value.numel() == 1 and bool(torch.isfinite(value).all()):
            changeable[name] = (quantity, float(value))
    return changeable


def range_of(quantity: Quantity, value: float) -> tuple[float, float]:
    """Returns the lowest and highest value to which a parameter may be set,
    given its original value.
    """
    at = torch.tensor(value, dtype=torch.float64)
    if value == quantity.lower:  # Such as zero damping.
        return value, value + quantity.typical
    low, high = (
        float(quantity.varied(at, torch.tensor(sign * _WIDE, dtype=torch.float64)))
        for sign in (-1, 1)
    )
    return low, high
