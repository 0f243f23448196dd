"""The discretised equations of motion of a body: its energies,
time integrator, solver and buffers.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from threading import get_ident
from typing import Any, SupportsFloat

import numpy as np
import torch

from ...io.errors import InputError, check_type, in_short
from ..energies.base import PlacedEnergy
from ..energies.launcher import lasting
from ..energies.materials import Material
from ..fem.bodies import Body
from ..fem.coordinates import DeviceCoordinates
from ..linalg.threads import is_shared, shards_of
from ..stepping.adjoints import refuse_transforms
from ..stepping.inputs import Inputs
from ..stepping.integrators import make_integrator
from ..stepping.quantity import Quantity
from ..stepping.state import Constants, State
from .assembly import BlockPattern
from .energy_set import EnergySet, Materials, place_energies
from .solver_settings import SolverSettings
from .workspace import Workspace

_GRAVITY = Quantity("gravity", "m/s^2", per="axis")


class EquationsOfMotion:
    """Energies, unknowns and buffers of a body, for time steps and static equilibria.

    Args:
        body: the body.
        material: its materials.
        gravity: acceleration (3,) [m/s^2].
        time_step: h [s].
        integrator: name of the time integrator.
        settings: settings of the solver.
        tensors: ``device`` of all tensors and ``dtype`` of states, for torch's functions.

    Attributes:
        rest_positions: (N, 3) [m].
        fixed: (D,) fixed vertices.
        method: the time integrator.
        coordinates: map from control vertices to all vertices.
        energies: the energies.
        parameters: parameters of the energies by name, and ``gravity``.
        defaults: default values of the parameters.
        counts: number of values of an input or a parameter per environment, by name.

    Raises:
        InputError: numbers out of range, an unknown integrator, a body without unknowns, or
            energies that the integrator or the solver cannot treat.
    """

    def __init__(
        self,
        body: Body,
        material: Material | Materials,
        gravity: Sequence[float],
        time_step: float,
        integrator: str,
        settings: SolverSettings,
        tensors: Mapping[str, Any],
    ) -> None:
        check_type("the body", body, Body)
        if not isinstance(time_step, SupportsFloat) or isinstance(time_step, str):
            raise InputError(
                f"time_step is {in_short(time_step)}: it must be a number, in seconds."
            )
        if not (np.isfinite(time_step) and time_step > 0.0):
            raise InputError(f"time_step is {time_step:g}: it must be positive, in seconds.")
        if tensors["dtype"] not in (torch.float64, torch.float32):
            raise InputError(f"dtype is {tensors['dtype']}: choose torch.float64 or torch.float32.")
        if np.shape(gravity) != (3,) or not np.isfinite(gravity).all():
            raise InputError(
                f"gravity is {gravity}: it must be three finite accelerations, in m/s^2."
            )
        self.body = body
        self.time_step = time_step
        self.settings = settings
        self.method = make_integrator(integrator)
        self.rest_positions = torch.as_tensor(body.vertices, **tensors)
        self.fixed = torch.as_tensor(body.fixed_vertices, device=tensors["device"])
        self.coordinates = DeviceCoordinates(body.coordinates, self.rest_positions)
        placed = place_energies(body, material)
        _check_choices(body, placed, integrator, settings.name)
        where = (body, self.coordinates, self.rest_positions, self.method, time_step)
        self.energies = EnergySet(placed, *where)
        self.parameters: dict[str, Quantity] = {**self.energies.parameters, "gravity": _GRAVITY}
        self.defaults: dict[str, Any] = {**self.energies.defaults, "gravity": [list(gravity)]}
        self.counts = {**self.energies.counts, "gravity": 3}
        self._attached_mass = self.tensor(body.attached_mass)
        # Vertices without unknowns.
        eliminated = np.union1d(body.fixed_vertices, body.coordinates.dependent)
        sets = [points for item in placed for points in item.points]
        pattern = BlockPattern(body.vertices, eliminated, sets, body.coordinates.sliding)
        self._make_workspace = partial(
            Workspace, placed, body.coordinates, self.fixed, pattern, **tensors
        )
        # By thread, batch size and `is_shared`.
        self.workspaces: dict[tuple[int, int, bool], Workspace] = {}

    def workspace(self, batch: int) -> Workspace:
        """Returns the calling thread's buffers for a batch size,
        made at their first use, also in inference mode.

        Threads that have ended leave theirs to new ones, whose identifiers are the same.
        """
        key = get_ident(), batch, is_shared()
        if key not in self.workspaces:
            with lasting():
                workspace = self._make_workspace(batch=batch)
                shards = shards_of(
                    batch, workspace.potential.device, 3 * len(workspace.pattern.free)
                )
                workspace.shards += [
                    (rows, self._make_workspace(batch=rows.stop - rows.start)) for rows in shards
                ]
            self.workspaces[key] = workspace
        return self.workspaces[key]

    def tensor(self, values: object) -> torch.Tensor:
        """Returns values with the device and dtype of states."""
        refuse_transforms(values)
        try:
            return torch.as_tensor(
                values, device=self.rest_positions.device, dtype=self.rest_positions.dtype
            )
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            if isinstance(error, RuntimeError) and hasattr(values, "shape"):
                raise  # of a device
            raise InputError(
                f"values are {in_short(values)}: give numbers, or an array or a tensor."
            ) from error

    def rest_state(self, batch: int) -> State:
        """Returns the undeformed body at rest, for a batch of one or more environments."""
        check_count("batch", batch)
        q = self.rest_positions.expand(batch, -1, -1).clone()
        return State(q, torch.zeros_like(q))

    def before_equilibrium(
        self,
        inputs: Inputs,
        constants: Constants,
        start: torch.Tensor | None,
        batch: int | None,
        after: State | None,
    ) -> State:
        """Returns the state that a static equilibrium continues (arguments:
        `Simulator.static_equilibrium`).
        """
        if batch is None:
            sizes = [len(value) for value in inputs.fields.values()] + (
                [] if start is None else [len(start)]
            )
            batch = max(*sizes, constants.batch, 1 if after is None else after.batch)
        state = self.rest_state(batch) if after is None else after
        return state.repeat(batch) if state.batch == 1 < batch else state

    def prepare(self, parameters: Mapping[str, Any] | Constants | None) -> Constants:
        """Computes stiffness, mass and weight from values
        that replace the defaults of parameters, by name.
        """
        if isinstance(parameters, Constants):
            return parameters
        check_type("parameters", parameters, Mapping | None)
        parameters = parameters or {}
        for name, value in parameters.items():
            if name not in self.parameters:
                raise InputError(
                    f"{name!r} is not a parameter of this simulator: it has "
                    f"{', '.join(self.parameters)}."
                )
            self.parameters[name].check(value)
        whole = {**self.defaults, **parameters}
        tensors = {
            name: self.parameters[name].shaped(self.tensor(value)) for name, value in whole.items()
        }
        values, mass = self.energies.prepare(tensors)
        inertia, weight = mass.inertia + self._attached_mass, mass.weight + self._attached_mass
        return Constants(inertia, weight, tensors["gravity"], mass.damping, values)

    def fitted(self, inputs: Inputs | None, batch: int | None = None) -> Inputs:
        """Returns inputs with the device and dtype of states
        where they are numbers (`Inputs.fitted`).
        """
        refuse_transforms()
        if inputs is None:
            return Inputs()
        if not isinstance(inputs, Inputs):
            raise InputError(
                f"the inputs are a {type(inputs).__name__}: give Inputs(external_force=...), say."
            )
        return inputs.fitted(self.counts, self.rest_positions, batch)

    def check_inputs(self, inputs: Inputs, batch: int) -> None:
        """Raises InputError for inputs that do not fit."""
        accepted = {
            name: (quantity, self.counts[name]) for name, quantity in self.energies.inputs.items()
        }
        inputs.check(accepted, batch, self.body.n_vertices, len(self.fixed), self.rest_positions)

    def checked(
        self, state: State, inputs: Inputs | None, parameters: Mapping[str, Any] | Constants | None
    ) -> tuple[Inputs, Constants]:
        """Returns inputs and constants, or raises InputError if these or the state do not fit."""
        check_type("the state", state, State)
        inputs, constants = self.fitted(inputs, state.batch), self.prepare(parameters)
        state.check(self.body.n_vertices, self.rest_positions)
        self.check_inputs(inputs, state.batch)
        constants.check_batch(state.batch)
        self.energies.check_memory(state.memory, state.batch, self.rest_positions)
        return inputs, constants


def check_count(name: str, value: object) -> None:
    """Raises InputError unless a value is a whole number, one or more."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise InputError(f"{name} is {value!r}: it must be a whole number, one or more.")


def _check_choices(body: Body, placed: list[PlacedEnergy], integrator: str, solver: str) -> None:
    """Raises InputError for a body that cannot move,
    or that the integrator or the solver cannot treat.
    """
    if len(body.fixed_vertices) == body.n_vertices:
        raise InputError("every vertex is fixed: leave some free to move.")
    if solver == "projective_dynamics" and len(body.coordinates.sliding):
        raise InputError(
            "solver is projective_dynamics, which knows no symmetry planes: choose quasi_newton."
        )
    if integrator == "midpoint" and any(member.controls for _, member, _ in body.members):
        raise InputError(
            "integrator is midpoint, by which rigid parts ring: choose implicit_euler or bdf2."
        )
    barriers = any(item.energy.is_barrier for item in placed)  # through which states must not pass
    if barriers and integrator == "midpoint":
        raise InputError(
            "integrator is midpoint, which extrapolates from the middle of a step and may "
            "penetrate: with contact, choose implicit_euler or bdf2."
        )
    if barriers and solver == "projective_dynamics":
        raise InputError(
            "solver is projective_dynamics, "
            "whose constant matrix knows no contact: choose quasi_newton."
        )
