"""Batched, differentiable simulation of a body."""

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch

from ..energies.base import Energy
from ..energies.explicit import ExplicitEnergy
from ..energies.materials import Corotated, Material
from ..energies.placed import PlacedEnergy
from ..energies.potential import StepTerms
from ..energies.rigid import PointInertia, rigid_energies
from ..energies.solid import solids_of
from ..fem.body import Body
from ..fem.coordinates import DeviceCoordinates
from ..io.errors import ConvergenceError, InputError
from ..linalg.threads import shards_of
from ..stepping.constants import Constants
from ..stepping.inputs import Inputs, check_tensor
from ..stepping.integrators import make_integrator
from ..stepping.quantity import Quantity
from ..stepping.state import ImplicitStage, State
from .assembly import BlockPattern
from .energy_set import EnergySet
from .equilibrium import Workspace, equilibrium, ramp_loads
from .linearisation import Linearisation
from .nonlinear_solver import SolveReport, SolverSettings
from .trajectory import Trajectory

log = logging.getLogger(__name__)

GRAVITY = (0.0, 0.0, -9.80709)
_MOST_LENGTHS = 100.0  # largest displacement of an equilibrium, in lengths of the body
COUPLINGS = ("implicit", "explicit")
_MOST_ITERATIONS = 100  # of Newton's method for an equilibrium; a few suffice from a good start
_NO_INPUTS = Inputs()
_DEPENDENT = "dependent_"  # prefix of the inertia of dependent vertices
_GRAVITY = Quantity("gravity", "m/s^2", per="axis")

Parameters = Mapping[str, Any]
Materials = Mapping[str, Any]  # by name of a region or body: a material, or the materials of its regions


def _check_count(name: str, value: object) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise InputError(f"{name} is {value!r}: it must be a whole number, one or more.")


def _device(name: str | torch.device) -> torch.device:
    """Returns the torch device, or raises InputError for an unknown device or CUDA without a CUDA device."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"device is {name!r}: choose cpu or cuda.") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device is {name!r}: choose cpu or cuda.")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device is {name!r}, but torch finds no CUDA device: choose device=cpu.")
    return device


def _flat(materials: Materials) -> dict[str, Material]:
    """Returns the materials of bodies and their regions by joined names, such as ``finger_tip``."""
    flat: dict[str, Material] = {}
    for name, material in materials.items():
        own = {"": material} if isinstance(material, Material) else _flat(material)
        flat |= {f"{name}_{region}" if region else name: value for region, value in own.items()}
    return flat


def _material_of(material: Material | Materials, name: str) -> Material | Materials:
    """Returns the material of a body, or raises InputError; a single material applies to all bodies."""
    if not name or isinstance(material, Material):
        return material
    if name not in material:
        raise InputError(f"The body {name!r} has no material. Give one: there are {', '.join(material) or 'none'}.")
    own: Material | Materials = material[name]
    return own


@dataclass
class Simulator:
    """Simulates a body over time.

    Args:
        body: a body, or a `fem.scene.Scene` of several bodies.
        material: material of the body, or materials by region of the mesh, or by body of a scene. Methods accept other
            values of the constants by name (``parameters``); those of a region or body are prefixed with its name, as
            in ``tip_youngs_modulus``.
        time_step: h [s].
        gravity: acceleration (3,) [m/s^2].
        integrator: ``implicit_euler``, ``bdf2`` or ``midpoint``.
        solver: a name, or `SolverSettings`.
        relative_tolerance: shorthand for that field of the settings.
        device: a torch device.
        dtype: ``torch.float64``, or ``torch.float32`` for states, loads and factors. Forces are evaluated in float64 in
            both cases, as in single precision those of a nearly incompressible solid have no correct digit. With a
            relative tolerance of 1e-5 a float32 step is as accurate as its positions, 4e-9 m for a beam of 0.1 m.
        coupling: time at which loads such as pressure act: ``implicit``, at the end of a step (at its middle for
            ``midpoint``); or ``explicit``, at its start, as in the publication.

    Raises:
        InputError: a time step that is not positive, an unknown integrator, solver or coupling, or a missing CUDA
            device.

    Attributes:
        parameters: parameters by name: constants of the materials and energies, and ``gravity`` (B, 3).
        inputs: inputs of the energies by name.
        counts: number of values of an input or a parameter per environment, by name.
        parts: names of the parts, such as tendons, for which a parameter may have values, by the parameter's name.
        constants: default values of the parameters.
    """

    body: Body
    material: Material | Materials = field(default_factory=Corotated)
    time_step: float = 0.01
    gravity: Sequence[float] = GRAVITY
    integrator: str = "implicit_euler"
    solver: str | SolverSettings = "quasi_newton"
    relative_tolerance: float | None = None
    device: str | torch.device = "cpu"
    dtype: torch.dtype = torch.float64
    coupling: str = "implicit"

    def __post_init__(self) -> None:
        """Checks the arguments and builds the energies."""
        if not (np.isfinite(self.time_step) and self.time_step > 0.0):
            raise InputError(f"time_step is {self.time_step:g}: it must be positive, in seconds.")
        if self.dtype not in (torch.float64, torch.float32):
            raise InputError(f"dtype is {self.dtype}: choose torch.float64 or torch.float32.")
        if self.coupling not in COUPLINGS:
            raise InputError(f"coupling is {self.coupling!r}: choose one of {', '.join(COUPLINGS)}.")
        if np.shape(self.gravity) != (3,) or not np.isfinite(self.gravity).all():
            raise InputError(f"gravity is {self.gravity}: it must be three finite accelerations, in m/s^2.")
        self.device = _device(self.device)
        settings = SolverSettings(name=self.solver) if isinstance(self.solver, str) else self.solver
        if self.relative_tolerance is not None:
            settings = replace(settings, relative_tolerance=self.relative_tolerance)
        self.settings = settings
        self.method = make_integrator(self.integrator)
        body = self.body
        self.rest_positions = self.tensor(body.vertices)  # (N, 3) [m]
        self.fixed = torch.as_tensor(body.fixed_vertices, device=self.device)
        if settings.name == "projective_dynamics" and len(body.coordinates.sliding):
            raise InputError("solver is projective_dynamics, which knows no symmetry planes: choose quasi_newton.")
        if self.integrator == "midpoint" and any(own.controls for _, own, _ in body.members):
            raise InputError("integrator is midpoint, by which rigid parts ring: choose implicit_euler or bdf2.")
        self._coordinates = DeviceCoordinates(body.coordinates, self.rest_positions)
        placed = self._place_energies()
        self._set = EnergySet(placed, body, self.rest_positions, self.method, self.time_step)
        energies = self._set
        eliminated = np.union1d(body.fixed_vertices, body.coordinates.dependent)
        sets = [points for item in placed for points in item.points]
        self._pattern = BlockPattern(body.vertices, eliminated, sets, body.coordinates.sliding)
        self.parameters: dict[str, Quantity] = {**energies.parameters, "gravity": _GRAVITY}
        self.constants: dict[str, Any] = {**energies.constants, "gravity": [list(self.gravity)]}
        self.counts = {**energies.counts, "gravity": 3}
        self.inputs, self.parts = energies.inputs, energies.parts
        followers = [name for item in placed if item.energy.implicit_only for name in item.input_names]
        if self.coupling == "explicit" and followers:
            raise InputError(
                f"coupling is explicit, but {followers[0]} is a follower load, which acts at the end of a step: choose "
                "implicit."
            )
        self._workspaces: dict[int, Workspace] = {}
        self._explicit_energies: dict[tuple[int, str], ExplicitEnergy] = {}
        self._attached_mass = self.tensor(body.attached_mass)
        self._built = True

    @property
    def materials(self) -> dict[str, Material]:
        """Materials by name of region or body; a single material for all has an empty name."""
        return {"": self.material} if isinstance(self.material, Material) else _flat(self.material)

    def _place_energies(self) -> list[PlacedEnergy]:
        """Returns the energies of all bodies: solids, rigid parts, and the bodies' own energies."""
        whole, placed = self.body, list[PlacedEnergy]()
        for name, body, first in whole.members:
            prefix = f"{name}_" if name else ""
            energies: list[tuple[Energy, str]] = [
                (solid, f"{prefix}{region}") for solid, region in solids_of(body, _material_of(self.material, name))
            ]
            for part in body.controls:
                energies += [(energy, f"{prefix}{part}_") for energy in rigid_energies(body, part, body.rigid[part])]
            items: list[tuple[Energy, Any, str]] = [(energy, energy.points(body.mesh), own) for energy, own in energies]
            given = zip(cast(Sequence[Energy], body.energies), body.energy_points, strict=True)
            items += [(energy, points, prefix) for energy, points in given]
            placed += [PlacedEnergy.of(whole, body, first, *item) for item in items]
        if whole.coordinates:
            placed.append(PlacedEnergy(PointInertia(whole.coordinates.points), (whole.coordinates.points,), _DEPENDENT))
        return placed

    def __setattr__(self, name: str, value: object) -> None:
        """Raises AttributeError once the simulator is built, because device data would not follow a change."""
        if getattr(self, "_built", False):
            raise AttributeError(f"cannot set {name}: a simulator is constant; dataclasses.replace makes another one.")
        object.__setattr__(self, name, value)

    def tensor(self, values: object) -> torch.Tensor:
        """Returns values with the simulator's device and dtype."""
        return torch.as_tensor(values, device=self.device, dtype=self.dtype)

    def prepare(self, parameters: Parameters | Constants | None = None) -> Constants:
        """Computes stiffness, mass and weight from parameters; pass the result to `step` to do so only once.

        Args:
            parameters: values that replace the defaults, by name: numbers, (M,) tensors with one value per element (or
                chamber), (B, 1) with one per environment, or (B, M). Prepared constants are returned unchanged.

        Raises:
            InputError: an unknown name, a value out of range, or a wrong number of values.
        """
        if isinstance(parameters, Constants):
            return parameters
        for name, value in (parameters or {}).items():
            if name not in self.parameters:
                raise InputError(f"{name!r} is not a parameter of this simulator: it has {', '.join(self.parameters)}.")
            self.parameters[name].check(value)
        given = {**self.constants, **(parameters or {})}
        tensors = {name: self.parameters[name].shaped(self.tensor(value)) for name, value in given.items()}
        values, mass = self._set.prepare(tensors)
        return Constants(
            mass=mass.inertia + self._attached_mass,
            load_mass=mass.weight + self._attached_mass,
            gravity=tensors["gravity"],
            mass_damping=mass.damping,
            values=values,
        )

    def workspace(self, batch: int) -> Workspace:
        """Returns the buffers for a batch size, made at their first use."""
        if batch not in self._workspaces:
            workspace = self._make_workspace(batch)
            shards = shards_of(batch, workspace.potential.device)
            workspace.shards += [(rows, self._make_workspace(rows.stop - rows.start)) for rows in shards]
            self._workspaces[batch] = workspace
        return self._workspaces[batch]

    def _make_workspace(self, batch: int) -> Workspace:
        body, device = self.body, torch.device(self.device)
        return Workspace(
            self._set.placed, body.coordinates, body.fixed_vertices, self._pattern, batch, device, self.dtype
        )

    def explicit_energy(self, name: str, batch: int) -> ExplicitEnergy:
        """Returns the energy with the named input, for evaluation at given positions.

        Raises:
            InputError: no energy of the body has that input.
        """
        if (batch, name) not in self._explicit_energies:
            placed = next((item for item in self._set.placed if name in item.input_names), None)
            if placed is None:
                accepted = ", ".join(self.inputs) or "none"
                raise InputError(f"Unknown input {name}. The energies of this body accept {accepted}.")
            energy, (points,) = placed.energy, placed.all_points or placed.points
            if energy.implicit_only:
                raise InputError(f"{name} is a follower load, so it cannot be held constant over a step.")
            device = torch.device(self.device)
            self._explicit_energies[batch, name] = ExplicitEnergy(energy, points, self.body.n_vertices, batch, device)
        return self._explicit_energies[batch, name]

    def rest_state(self, batch: int = 1) -> State:
        """Returns the undeformed body at rest, for a batch of one or more environments."""
        _check_count("batch", batch)
        q = self.rest_positions.expand(batch, -1, -1).clone()
        return State(q, torch.zeros_like(q))

    def state(self, q: object, v: object = None) -> State:
        """Returns a state without memory from arrays or tensors.

        Args:
            q: (B, N, 3) positions, or (N, 3) for a batch of one [m].
            v: velocities of the same shape; zero if omitted [m/s].

        Raises:
            InputError: another shape, or values that are not finite.
        """
        positions = self.tensor(q)
        velocities = torch.zeros_like(positions) if v is None else self.tensor(v)
        fields = [x[None] if x.ndim == 2 else x for x in (positions, velocities)]
        for name, unit, values in zip(("q", "v"), ("m", "m/s"), fields, strict=True):
            check_tensor(name, values, (len(fields[0]), self.body.n_vertices, 3), unit, "vertex", self.rest_positions)
        return State(fields[0], fields[1])

    def step(
        self, state: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> tuple[State, SolveReport]:
        """Advances a batch by one time step.

        If the state has the positions at the end of the last step, the solver starts from an extrapolation of the last
        steps; otherwise the result is that of a new simulator.

        Args:
            state: state at the start.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).

        Returns:
            The new state, differentiable, and the solver's report.

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: the solver failed, if `SolverSettings.on_failure` is ``raise``.
        """
        inputs = _NO_INPUTS if inputs is None else inputs
        constants = self.prepare(parameters)
        self._check(state, inputs, constants)
        return self._advance(state, inputs, constants)

    def _advance(self, state: State, inputs: Inputs, constants: Constants) -> tuple[State, SolveReport]:
        """Advances a batch by one time step, with checked arguments."""
        stage = self.method.stage(state, self.time_step)
        workspace = self.workspace(state.batch)
        terms = self._terms(state, stage, inputs, constants)
        clamped = self._fixed_at(state, stage, inputs)
        follows = workspace.follows(state.q)
        x, report = equilibrium(workspace, "dynamics", self.settings, terms, stage.target, clamped, follows)
        x = self._coordinates.expand(x)
        new = self._finish(state, stage, inputs, constants, x)
        workspace.record_positions(new.q)
        return new, report

    def _fixed_at(self, state: State, stage: ImplicitStage, inputs: Inputs) -> torch.Tensor:
        """Returns the positions (B, D, 3) of the fixed vertices at the stage [m]."""
        now = state.q[:, self.fixed]
        return now if inputs.fixed_positions is None else now + stage.end * (inputs.fixed_positions - now)

    def _finish(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor
    ) -> State:
        """Returns the new state from the solution x of the stage."""
        new = self.method.finish(state, x, self.time_step)
        memory = self._end_step(state, stage, inputs, constants, x, new.q)
        new = replace(new, memory=memory)
        if stage.end == 1.0 or not len(self.fixed):
            return new
        # Prescribed motions have a known velocity; extrapolation from mid-step would oscillate.
        now = state.q[:, self.fixed]
        moved = torch.zeros_like(now) if inputs.fixed_positions is None else inputs.fixed_positions - now
        return replace(new, v=new.v.index_copy(1, self.fixed, moved / self.time_step))

    def _end_step(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Returns the memory variables after a step with solution x and final positions q."""
        terms = self.workspace(state.batch).potential.energies
        return self._set.end_step(state, stage, inputs, constants, terms, x, q)

    def remember(self, state: State, q: torch.Tensor, constants: Constants) -> State:
        """Returns a state at given positions, with the memory variables after a step to these positions.

        Args:
            state: state at the start of the step.
            q: (B, N, 3) positions at its end [m].
            constants: constants from `prepare`.
        """
        stage = self.method.stage(state, self.time_step)
        x = self.method.solution_for(state, q)
        return State(q, state.v, memory=self._end_step(state, stage, _NO_INPUTS, constants, x, q))

    def linearise(
        self, state: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> Linearisation:
        """Returns the residual of a step and its derivative at any positions.

        Args:
            state: state at the start of the step.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).

        Raises:
            InputError: wrong shapes, or values that are not finite.
        """
        inputs = _NO_INPUTS if inputs is None else inputs
        constants = self.prepare(parameters)
        self._check(state, inputs, constants)
        stage = self.method.stage(state, self.time_step)
        return Linearisation(
            self.workspace(state.batch),
            self._terms(state, stage, inputs, constants),
            stage,
            self._fixed_at(state, stage, inputs),
            self._coordinates,
            partial(self._finish, state, stage, inputs, constants),
            self.settings.linear_solver,
        )

    def _terms(self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants) -> StepTerms:
        """Returns the terms of a step's incremental potential, differentiable."""
        batch, h = state.batch, stage.step
        # Mass damping is linear in x, so it is merged with inertia and target.
        damping = constants.mass_damping[..., None] * h  # (1 or B, 1, 1)
        mass, force = constants.mass, self._loads(inputs, constants, batch)
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        energies = self.workspace(batch).potential.energies
        values = self._set.values(constants, inputs, batch)
        values |= self._set.begin_step(state, stage, inputs, constants, energies)
        if self.coupling == "explicit":
            for name in (name for item in self._set.placed if item.energy.is_load for name in item.input_names):
                value = values[name]
                assert value is not None
                force = force + self.explicit_energy(name, batch).force(state.q, value)
                values[name] = torch.zeros_like(value)
        target = (stage.target + damping * stage.velocity_reference) / (1.0 + damping)
        inertia = (mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1)
        dependent = self._coordinates.dependent
        if len(dependent):
            values[f"{_DEPENDENT}inertia"] = inertia[:, dependent]
            values[f"{_DEPENDENT}target"] = target[:, dependent]
        return StepTerms(target, inertia, self._coordinates.reduce(force.expand(batch, -1, -1)), values)

    def _loads(self, inputs: Inputs, constants: Constants, batch: int, static: bool = False) -> torch.Tensor:
        """Returns the dead loads (1 or B, N, 3): gravity, external force and those of the energies [N]."""
        mass = constants.load_mass
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        force = mass[..., None] * constants.gravity[:, None]
        if inputs.external_force is not None:
            force = force + inputs.external_force
        for load in self._set.loads(constants, inputs, batch, static):
            force = force + load
        return force

    def static_equilibrium(
        self,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
        start: torch.Tensor | None = None,
        batch: int | None = None,
    ) -> State:
        """Returns the static equilibrium under gravity and constant inputs, differentiable like a step.

        Args:
            inputs: constant inputs.
            parameters: parameters or prepared constants (`prepare`).
            start: (B, N, 3) initial guess [m]; the rest shape if omitted. If Newton's method does not converge from it
                in 100 iterations, loads, inputs and motion of the fixed vertices are increased in steps.
            batch: number of environments, if no other argument implies it.

        Raises:
            InputError: wrong shapes, values that are not finite, or a body without fixed vertices.
            ConvergenceError: no equilibrium was found, or the body grows without bound, like an inflated one whose
                material cannot resist the pressure.
        """
        if not (len(self.fixed) or len(self.body.coordinates.sliding)):
            raise InputError("a body without fixed vertices has no static equilibrium: fix some vertices.")
        inputs = _NO_INPUTS if inputs is None else inputs
        constants = self.prepare(parameters)
        if batch is None:
            given = [*inputs.fields.values(), *([] if start is None else [start])]
            batch = max([len(t) for t in given] + [constants.batch])
        state = self.rest_state(batch)
        self._check(state, inputs, constants)
        if start is not None:
            check_tensor("start", start, tuple(state.q.shape), "m", "vertex", state.q)
        solve = partial(self._balance, inputs, constants, state.q)
        try:
            x, report = solve(1.0, state.q if start is None else start.detach())
        except ConvergenceError as error:
            log.debug("the equilibrium is computed under gradually increasing loads: %s", error)
            with torch.no_grad():
                limited = self.settings.max_iterations < _MOST_ITERATIONS
                near = ramp_loads(lambda share, at: solve(share, at)[0], state.q, error if limited else None)
            x, report = solve(1.0, near)
        lengths = self.rest_positions.amax(0) - self.rest_positions.amin(0)
        largest = (x.detach() - self.rest_positions).abs().flatten(1).amax(1)
        if bool((grown := ~(largest < _MOST_LENGTHS * float(lengths.max()))).any()):
            report = replace(report, converged=report.converged & ~grown)
            raise ConvergenceError(
                f"{int(grown.sum())} of {batch} bodies have no equilibrium under these loads: they grow to more than "
                f"{_MOST_LENGTHS:g} times their size; lower the loads, or take a stiffer material.",
                x.detach(),
                report,
            )
        return State(x, torch.zeros_like(x))

    def _balance(
        self, inputs: Inputs, constants: Constants, rest: torch.Tensor, share: float, start: torch.Tensor
    ) -> tuple[torch.Tensor, SolveReport]:
        """Returns the equilibrium (B, N, 3) under a fraction of all loads, inputs and motion of the clamp [m]."""
        batch = len(rest)
        values = self._set.values(constants, inputs, batch)
        for name in self.inputs:
            value = values[name]
            values[name] = None if value is None else share * value
        values |= self._set.at_rest(batch)
        terms = StepTerms(
            target=rest,
            inertia=self.rest_positions.new_zeros(batch, self.body.n_vertices),
            force=share * self._coordinates.reduce(self._loads(inputs, constants, batch, True).expand(batch, -1, -1)),
            values=values,
        )
        workspace, clamp = self.workspace(batch), rest[:, self.fixed]
        most = min(self.settings.max_iterations, _MOST_ITERATIONS)
        settings = replace(self.settings, name="newton", on_failure="raise", max_iterations=most)
        at = clamp if inputs.fixed_positions is None else torch.lerp(clamp, inputs.fixed_positions, share)
        x, report = equilibrium(workspace, "statics", settings, terms, start, at)
        return self._coordinates.expand(x), report

    def rollout(
        self,
        state: State,
        steps: int,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> Trajectory:
        """Simulates several time steps.

        For the gradient, states and terms of each step are kept, but no factors: the adjoint of a step recomputes its
        Hessian from the final state of the step.

        Args:
            state: initial state.
            steps: number of steps T.
            inputs: inputs, constant or with a time axis.
            parameters: parameters or prepared constants (`prepare`).

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: as in `step`.
        """
        _check_count("steps", steps)
        inputs = _NO_INPUTS if inputs is None else inputs
        inputs.check_steps(steps)
        constants = self.prepare(parameters)
        states, reports = [state], []
        for t in range(steps):
            current = inputs.at(t)
            if t == 0:
                self._check(state, current, constants)
            elif current is not inputs:
                self._check_inputs(current, state.batch)
            state, report = self._advance(state, current, constants)
            states.append(state)
            reports.append(report)
        q, v = (torch.stack([getattr(s, name) for s in states]) for name in ("q", "v"))
        return Trajectory(q, v, reports, state, self.body, self.time_step)

    def _check(self, state: State, inputs: Inputs, constants: Constants) -> None:
        """Raises InputError for a state, inputs or constants that do not fit."""
        batch, n, like = state.batch, self.body.n_vertices, self.rest_positions
        fields = {"state.q": state.q, "state.v": state.v}
        if state.previous is not None:
            if not (isinstance(state.previous, tuple) and len(state.previous) == 2):
                raise InputError("state.previous must be the pair (q, v) of the step before, or None.")
            fields |= {f"state.previous[{i}]": values for i, values in enumerate(state.previous)}
        for unit, (name, values) in zip(itertools.cycle(("m", "m/s")), fields.items(), strict=False):
            check_tensor(name, values, (batch, n, 3), unit, "vertex", like)
        self._check_inputs(inputs, batch)
        constants.check_batch(batch)
        self._set.check_memory(state.memory, batch, like)

    def _check_inputs(self, inputs: Inputs, batch: int) -> None:
        """Raises InputError for inputs that do not fit."""
        if not isinstance(inputs, Inputs):
            raise InputError(f"the inputs are a {type(inputs).__name__}: give Inputs(external_force=...), say.")
        accepted = {name: (quantity, self.counts[name]) for name, quantity in self.inputs.items()}
        inputs.check(accepted, batch, self.body.n_vertices, len(self.fixed), self.rest_positions)
