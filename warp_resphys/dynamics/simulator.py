"""Batched, differentiable simulation of one body."""

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import numpy as np
import torch

from ..energies.base import Energy, Quantity
from ..energies.explicit import HeldEnergy
from ..energies.materials import PRONY_RATIO, PRONY_TIME, Corotated, Material
from ..energies.medium import FacePoints, Medium
from ..energies.potential import StepTerms
from ..energies.solid import Solid, device_matrix, spread
from ..energies.strings import Strings
from ..fem.body import Body
from ..fem.elements import Points
from ..io.errors import ConvergenceError, InputError
from ..linalg.threads import shards_of
from .assembly import BlockPattern
from .constants import Constants
from .equilibrium import Workspace, equilibrium, ramped
from .hanging import HangingWeights
from .inputs import Inputs, check_tensor
from .integrator import ImplicitStage, State, make_integrator
from .linearisation import Linearisation
from .nonlinear_solver import SolveReport, SolverSettings
from .step_parts import StepPart
from .surrounding import Surrounding
from .viscosity import check_overstrain, relaxed, viscous_values, without_viscosity

log = logging.getLogger(__name__)

GRAVITY = (0.0, 0.0, -9.80709)
_MOST_LENGTHS = 100.0  # that a body at rest may be away from its rest shape
COUPLINGS = ("implicit", "explicit")
_MOST_ITERATIONS = 100  # of Newton's method for an equilibrium; a few are enough where it is near
_NOTHING = Inputs()
_GRAVITY = Quantity("gravity", "m/s^2", per="axis")

Parameters = Mapping[str, Any]


@dataclass(frozen=True)
class Trajectory:
    """Result of a roll-out."""

    q: torch.Tensor  # (T + 1, B, N, 3) positions, the start included [m]
    v: torch.Tensor  # (T + 1, B, N, 3) velocities [m/s]
    reports: list[SolveReport]  # T outcomes of the solver
    final: State  # the last state, from which a further roll-out goes on


def _check_count(name: str, value: object) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise InputError(f"{name} is {value!r}: it must be a whole number, one or more.")


def _device(name: str | torch.device) -> torch.device:
    """A device that the kernels run on.

    Raises:
        InputError: an unknown device, or CUDA without a CUDA device.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"device is {name!r}: choose cpu or cuda.") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device is {name!r}: choose cpu or cuda.")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device is {name!r}, but torch finds no CUDA device: choose device=cpu.")
    return device


@dataclass
class Simulator:
    """Steps a body through time.

    Args:
        body: what is simulated.
        material: its constants; every method takes other values by name (``parameters``).
        time_step: h [s].
        gravity: acceleration (3,) [m/s^2].
        integrator: ``implicit_euler``, ``bdf2`` or ``midpoint``.
        solver: a name, or `SolverSettings`.
        relative_tolerance: shorthand for that field of the settings.
        device: a torch device.
        dtype: ``torch.float64``, or ``torch.float32`` for states, loads and factors. Forces are evaluated in float64 in
            both: single precision leaves a nearly incompressible solid no digit of them. A float32 step is as good as
            its positions then, 4e-9 m on a beam of 0.1 m, from a relative tolerance of 1e-5 on.
        coupling: of the energies that are loads, such as pressure: ``implicit``, they act on the body as it is at the
            end of a step (in its middle, for ``midpoint``); or ``explicit``, as it is at its start, as published.

    Raises:
        InputError: a time step that is not positive, an unknown integrator, solver or coupling, or a CUDA device that
            is not there.

    Attributes:
        parameters: quantities that every method takes other values of, by name: the material's constants, those of the
            body's energies, and ``gravity`` (B, 3).
        inputs: what acts through the body's energies, by name.
        counts: how many values an input has, and a parameter may have beside the environments, by name.
        parts: what the parts are called that a parameter may have values for, such as tendons, by its name.
        constants: the values of the parameters.
    """

    body: Body
    material: Material = field(default_factory=Corotated)
    time_step: float = 0.01
    gravity: Sequence[float] = GRAVITY
    integrator: str = "implicit_euler"
    solver: str | SolverSettings = "quasi_newton"
    relative_tolerance: float | None = None
    device: str | torch.device = "cpu"
    dtype: torch.dtype = torch.float64
    coupling: str = "implicit"

    def __post_init__(self) -> None:
        """Uploads what is constant."""
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
        self.rest_positions = self.tensor(body.mesh.vertices)  # (N, 3) [m]
        self.fixed = torch.as_tensor(body.fixed_vertices, device=self.device)
        solid = Solid(body.discretisation, self.material, self.device, self.dtype)
        self._energies: list[tuple[Energy, Any]] = [(solid, solid.points(body.mesh))]
        own_energies = cast(Sequence[Energy], body.energies)
        self._energies += list(zip(own_energies, body.energy_points, strict=True))
        self._pattern = BlockPattern(
            body.mesh.vertices, body.fixed_vertices, [points for _, sets in self._energies for points in sets]
        )
        own = [quantity for energy in body.energies for quantity in energy.parameters]
        self.parameters: dict[str, Quantity] = {**self.material.quantities, **{each.name: each for each in own}}
        self.parameters["gravity"] = _GRAVITY
        self.inputs: dict[str, Quantity] = {each.name: each for energy in body.energies for each in energy.inputs}
        self.constants: dict[str, Any] = {**self.material.constants, "gravity": [list(self.gravity)]}
        self.counts = dict.fromkeys(self.material.quantities, len(body.mesh.cells)) | {"gravity": 3}
        self.parts: dict[str, tuple[str, ...]] = {}
        for energy in own_energies:
            self.constants |= energy.constants
            self.counts |= {each.name: energy.count for each in (*energy.parameters, *energy.inputs)}
            self.parts |= dict.fromkeys([each.name for each in energy.parameters], energy.names)
        bound = [type(each).__name__.lower() for each in own_energies if each.implicit_only]
        if self.coupling == "explicit" and bound:
            raise InputError(f"coupling is explicit, but {bound[0]} act at the end of a step alone: choose implicit.")
        self._strings = next((each for each in own_energies if isinstance(each, Strings)), None)
        self._workspaces: dict[int, Workspace] = {}
        self._held: dict[tuple[int, str], HeldEnergy] = {}
        self._mass_volume = device_matrix(body.mass_volume, self.device, self.dtype)
        self._load_volume = device_matrix(body.load_volume, self.device, self.dtype)
        self._attached_mass = self.tensor(body.attached_mass)
        parts = (self._step_part(*pair) for pair in zip(own_energies, body.energy_points, strict=True))
        self._step_parts = [part for part in parts if part is not None]
        self._built = True

    def _step_part(self, energy: Energy, points: Sequence[Points]) -> StepPart | None:
        """What an energy does over steps, if it depends on where these start."""
        if isinstance(energy, Strings):
            shares = self.tensor(energy.shares(self.body.n_vertices))
            return HangingWeights(energy, shares, self.method, self.time_step)
        if isinstance(energy, Medium):
            (faces,) = points
            assert isinstance(faces, FacePoints)
            volume = self._load_volume.sum(1).to_dense() if energy.buoyancy else None
            return Surrounding.of(faces, volume, self.rest_positions)
        return None

    def __setattr__(self, name: str, value: object) -> None:
        """Refuses changes: what was uploaded would not follow them.

        Raises:
            AttributeError: always, once the simulator is built.
        """
        if getattr(self, "_built", False):
            raise AttributeError(f"cannot set {name}: a simulator is constant; dataclasses.replace makes another one.")
        object.__setattr__(self, name, value)

    def tensor(self, values: object) -> torch.Tensor:
        """Values on the simulator's device, in its type."""
        return torch.as_tensor(values, device=self.device, dtype=self.dtype)

    def prepare(self, parameters: Parameters | Constants | None = None) -> Constants:
        """Turns parameters into stiffness, mass and weight; pass the result to `step` when stepping one by one.

        Args:
            parameters: values in place of the simulator's own, by a name of ``parameters``: numbers, (M,) tensors with
                a value for each element (or chamber), (B, 1) with one for each environment, or (B, M). What is prepared
                already is returned as it is.

        Raises:
            InputError: an unknown name, a value out of range, or another number of values than there are elements.
        """
        if isinstance(parameters, Constants):
            return parameters
        for name, value in (parameters or {}).items():
            if name not in self.parameters:
                raise InputError(f"{name!r} is no parameter of this simulator: it has {', '.join(self.parameters)}.")
            self.parameters[name].check(value)
        given = {**self.constants, **(parameters or {})}
        tensors = {name: self.parameters[name].shaped(self.tensor(value)) for name, value in given.items()}
        values = {name: v for energy, _ in self._energies for name, v in energy.prepare(tensors).items()}
        density, damping = tensors["density"], tensors["stiffness_damping"][:, 0]
        ratio, time = (self._branches(tensors, quantity) for quantity in (PRONY_RATIO, PRONY_TIME))
        return Constants(
            mass=spread(self._mass_volume, density) + self._attached_mass,
            load_mass=spread(self._load_volume, density) + self._attached_mass,
            gravity=tensors["gravity"],
            mass_damping=tensors["mass_damping"],
            stiffness_damping=damping,
            damped=bool((damping > 0).any()) or damping.requires_grad,
            prony_ratio=ratio,
            prony_time=time,
            relaxes=bool((ratio > 0).any()) or ratio.requires_grad,
            values=values,
        )

    def _branches(self, tensors: Mapping[str, torch.Tensor], quantity: Quantity) -> torch.Tensor:
        """(1 or B, K) a constant of the material's Prony branches."""
        found = [tensors[f"{quantity.name}_{k + 1}"] for k in range(len(self.material.prony))]
        return torch.cat(torch.broadcast_tensors(*found), 1) if found else self.rest_positions.new_zeros(1, 0)

    def workspace(self, batch: int) -> Workspace:
        """Buffers for a batch size, made at their first use."""
        if batch not in self._workspaces:
            workspace = self._make_workspace(batch)
            rows = shards_of(batch, workspace.potential.device)
            workspace.shards += [(each, self._make_workspace(each.stop - each.start)) for each in rows]
            self._workspaces[batch] = workspace
        return self._workspaces[batch]

    def _make_workspace(self, batch: int) -> Workspace:
        n, fixed = self.body.n_vertices, self.body.fixed_vertices
        return Workspace(self._energies, n, fixed, self._pattern, batch, torch.device(self.device), self.dtype)

    def held_energy(self, name: str, batch: int) -> HeldEnergy:
        """The energy with an input of that name, by itself in a given state.

        Raises:
            InputError: no energy of the body has that input.
        """
        if (batch, name) not in self._held:
            found = [e for e, _ in self._energies for quantity in e.inputs if quantity.name == name]
            if not found:
                known = ", ".join(self.inputs) or "none"
                raise InputError(f"no energy of the body has the input {name}: they have {known}.")
            if found[0].implicit_only:
                raise InputError(f"{name} acts through the body as it is at the end of a step: it cannot be held.")
            device = torch.device(self.device)
            self._held[batch, name] = HeldEnergy(self.body, found[0], batch, device)
        return self._held[batch, name]

    def rest_state(self, batch: int = 1) -> State:
        """The undeformed body at rest.

        Raises:
            InputError: the batch is no whole number, one or more.
        """
        _check_count("batch", batch)
        q = self.rest_positions.expand(batch, -1, -1).clone()
        return State(q, torch.zeros_like(q))

    def step(
        self, state: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> tuple[State, SolveReport]:
        """Advances a batch by one time step.

        From the positions that the last step has led to, the solver begins at what the steps before it foretell; from
        others it begins anew, and finds what a new simulator would.

        Args:
            state: where it is.
            inputs: what acts on it during the step.
            parameters: values in place of the simulator's own (see `prepare`), or prepared ones.

        Returns:
            The new state, differentiable, and the solver's report.

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: see `nonlinear_solver.SolverSettings.on_failure`.
        """
        inputs = _NOTHING if inputs is None else inputs
        constants = self.prepare(parameters)
        self._check(state, inputs, constants)
        return self._advance(state, inputs, constants)

    def _advance(self, state: State, inputs: Inputs, constants: Constants) -> tuple[State, SolveReport]:
        """`step` with arguments that have been checked."""
        stage = self.method.stage(state, self.time_step)
        workspace = self.workspace(state.batch)
        terms = self._terms(state, stage, inputs, constants)
        clamped = self._fixed_at(state, stage, inputs)
        follows = workspace.follows(state.q)
        x, report = equilibrium(workspace, "dynamics", self.settings, terms, stage.target, clamped, follows)
        new = self._finish(state, stage, inputs, constants, x)
        workspace.reached(new.q)
        return new, report

    def _fixed_at(self, state: State, stage: ImplicitStage, inputs: Inputs) -> torch.Tensor:
        """(B, D, 3) where the fixed vertices are at the stage [m]."""
        now = state.q[:, self.fixed]
        return now if inputs.fixed_positions is None else now + stage.end * (inputs.fixed_positions - now)

    def _finish(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor
    ) -> State:
        """The state that the stage's solution leads to."""
        new = self.method.finish(state, x, self.time_step)
        for part in self._step_parts:
            new = replace(new, **part.after(state, stage, inputs, constants, x))
        if constants.relaxes:
            new = replace(new, overstrain=self.relaxed(constants, state, new.q))
        if stage.end == 1.0 or not len(self.fixed):
            return new
        # A prescribed motion has a velocity of its own; extrapolated from mid-step it would ring.
        now = state.q[:, self.fixed]
        moved = torch.zeros_like(now) if inputs.fixed_positions is None else inputs.fixed_positions - now
        return replace(new, v=new.v.index_copy(1, self.fixed, moved / self.time_step))

    def relaxed(self, constants: Constants, state: State, q: torch.Tensor) -> torch.Tensor:
        """(B, K, P, 3, 3) strains of the Prony branches where a step leads from a state to positions q (B, N, 3)."""
        return relaxed(self.workspace(state.batch).potential.solid, constants, state, q, self.time_step)

    def linearise(
        self, state: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> Linearisation:
        """The residual of the step from a state, and its derivative, at any positions.

        Args:
            state: where the step starts.
            inputs: what acts during it.
            parameters: see `prepare`.

        Raises:
            InputError: wrong shapes, or values that are not finite.
        """
        inputs = _NOTHING if inputs is None else inputs
        constants = self.prepare(parameters)
        self._check(state, inputs, constants)
        stage = self.method.stage(state, self.time_step)
        return Linearisation(
            self.workspace(state.batch),
            self._terms(state, stage, inputs, constants),
            stage,
            self._fixed_at(state, stage, inputs),
            partial(self._finish, state, stage, inputs, constants),
            self.settings.linear_solver,
        )

    def _terms(self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants) -> StepTerms:
        """The incremental potential of a step, differentiable in everything that it depends on."""
        batch, h = state.batch, stage.step
        solid = self.workspace(batch).potential.solid
        # Mass damping is linear in x: it joins inertia and moves the target.
        damping = constants.mass_damping[..., None] * h  # (1 or B, 1, 1)
        mass, force = constants.mass, self._loads(inputs, constants, batch)
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        viscous = viscous_values(solid, constants, state, stage, self.time_step)
        values = self._values(constants, inputs, batch, viscous)
        for part in self._step_parts:
            values |= part.values(state, stage, inputs, constants)
        if self.coupling == "explicit":
            for energy, _ in self._energies:
                for quantity in energy.inputs if energy.is_load else ():
                    force = force + self.held_energy(quantity.name, batch).force(state.q, values[quantity.name])
                    values[quantity.name] = torch.zeros_like(values[quantity.name])
        return StepTerms(
            target=(stage.target + damping * stage.velocity_reference) / (1.0 + damping),
            inertia=(mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1),
            force=force.expand(batch, -1, -1),
            values=values,
        )

    def _values(
        self, constants: Constants, inputs: Inputs, batch: int, viscous: Mapping[str, torch.Tensor | None]
    ) -> dict[str, Any]:
        """What the energies' terms need in a step."""
        values: dict[str, Any] = {**constants.values, **viscous}
        for energy, _ in self._energies:
            for quantity in energy.inputs:
                given = inputs.actuation.get(quantity.name)
                values[quantity.name] = self.rest_positions.new_zeros(batch, energy.count) if given is None else given
        return values

    def _loads(self, inputs: Inputs, constants: Constants, batch: int, static: bool = False) -> torch.Tensor:
        """(1 or B, N, 3) gravity, external force and what parts add in equilibria or in steps [N]."""
        mass = constants.load_mass
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        weight = mass[..., None] * constants.gravity[:, None]
        for load in (inputs.external_force, *(p.load(inputs, constants, batch, static) for p in self._step_parts)):
            weight = weight if load is None else weight + load
        return weight

    def static_equilibrium(
        self,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
        start: torch.Tensor | None = None,
        batch: int | None = None,
    ) -> State:
        """The state of rest under gravity and constant inputs, differentiable like a step.

        Args:
            inputs: what acts on the body.
            parameters: see `prepare`.
            start: (B, N, 3) first guess [m]; the rest shape where left out. Where Newton's method leads nowhere from it
                in 100 iterations, the loads, inputs and motion of the clamp are put on bit by bit.
            batch: environments, where no other argument tells.

        Raises:
            InputError: wrong shapes, values that are not finite, or a body without fixed vertices.
            ConvergenceError: no equilibrium was found, or a body that only grows, as an inflated one whose material
                cannot hold the pressure.
        """
        if not len(self.fixed):
            raise InputError("a body without fixed vertices has no static equilibrium: fix some vertices.")
        inputs = _NOTHING if inputs is None else inputs
        constants = self.prepare(parameters)
        given = [*inputs.fields.values(), *([] if start is None else [start])]
        if batch is None:
            batch = max([len(t) for t in given] + [constants.batch])
        state = self.rest_state(batch)
        self._check(state, inputs, constants)
        if start is not None:
            check_tensor("start", start, tuple(state.q.shape), "m", "vertex", state.q)
        solve = partial(self._balance, inputs, constants, state.q)
        try:
            x, report = solve(1.0, state.q if start is None else start.detach())
        except ConvergenceError as error:
            log.info("an equilibrium is sought under growing loads: %s", error)
            with torch.no_grad():
                limited = self.settings.max_iterations < _MOST_ITERATIONS
                near = ramped(lambda share, at: solve(share, at)[0], state.q, error if limited else None)
            x, report = solve(1.0, near)
        lengths = self.rest_positions.amax(0) - self.rest_positions.amin(0)
        furthest = (x.detach() - self.rest_positions).abs().flatten(1).amax(1)
        if bool((grown := ~(furthest < _MOST_LENGTHS * float(lengths.max()))).any()):
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
        """(B, N, 3) the equilibrium under a share of all loads, inputs and motion of the clamp [m]."""
        batch = len(rest)
        still = without_viscosity(batch, self.rest_positions)
        values = self._values(constants, inputs, batch, still)
        for part in self._step_parts:
            values |= part.still(batch)
        driven = {quantity.name: share * values[quantity.name] for e, _ in self._energies for quantity in e.inputs}
        terms = StepTerms(
            target=rest,
            inertia=self.rest_positions.new_zeros(batch, self.body.n_vertices),
            force=share * self._loads(inputs, constants, batch, static=True).expand(batch, -1, -1),
            values={**values, **driven},
        )
        workspace, clamp = self.workspace(batch), rest[:, self.fixed]
        most = min(self.settings.max_iterations, _MOST_ITERATIONS)
        settings = replace(self.settings, name="newton", on_failure="raise", max_iterations=most)
        at = clamp if inputs.fixed_positions is None else torch.lerp(clamp, inputs.fixed_positions, share)
        return equilibrium(workspace, "statics", settings, terms, start, at)

    def rollout(
        self,
        state: State,
        steps: int,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> Trajectory:
        """Steps many times.

        Memory grows by the states and terms of each step, never by factors: the adjoint of a step rebuilds its Hessian
        from the state it led to.

        Args:
            state: the start.
            steps: T.
            inputs: what acts during all steps, or, with an axis of time, during each of them.
            parameters: see `prepare`.

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: see `step`.
        """
        _check_count("steps", steps)
        inputs = _NOTHING if inputs is None else inputs
        inputs.check_steps(steps)
        constants = self.prepare(parameters)
        states, reports = [state], []
        for t in range(steps):
            acting = inputs.at(t)
            if t == 0:
                self._check(state, acting, constants)
            elif acting is not inputs:
                self._check_inputs(acting, state.batch)
            state, report = self._advance(state, acting, constants)
            states.append(state)
            reports.append(report)
        q, v = (torch.stack([getattr(s, name) for s in states]) for name in ("q", "v"))
        return Trajectory(q, v, reports, state)

    def _check(self, state: State, inputs: Inputs, constants: Constants) -> None:
        """One sentence on the first argument that cannot be simulated."""
        batch, n, like = state.batch, self.body.n_vertices, self.rest_positions
        fields = {"state.q": state.q, "state.v": state.v}
        if state.previous is not None:
            if not (isinstance(state.previous, tuple) and len(state.previous) == 2):
                raise InputError("state.previous must be the pair (q, v) of the step before, or None.")
            fields |= {f"state.previous[{i}]": each for i, each in enumerate(state.previous)}
        for unit, (name, values) in zip(itertools.cycle(("m", "m/s")), fields.items(), strict=False):
            check_tensor(name, values, (batch, n, 3), unit, "vertex", like)
        if state.payload is not None:
            if self._strings is None:
                raise InputError("the state has a payload, but the body has no strings: leave it out.")
            shape = (batch, self._strings.count, 3)
            for name, unit in (("q", "m"), ("v", "m/s")):
                check_tensor(f"state.payload.{name}", getattr(state.payload, name), shape, unit, "string", like)
        self._check_inputs(inputs, batch)
        constants.check_batch(batch)
        if state.overstrain is not None:
            solid = self.workspace(batch).potential.solid
            check_overstrain(state.overstrain, (batch, len(self.material.prony), solid.n_points, 3, 3), like)

    def _check_inputs(self, inputs: Inputs, batch: int) -> None:
        """One sentence on the first input that cannot be simulated."""
        if not isinstance(inputs, Inputs):
            raise InputError(f"the inputs are a {type(inputs).__name__}: give Inputs(external_force=...), say.")
        energies, counts = [energy for energy, _ in self._energies], (self.body.n_vertices, len(self.fixed))
        inputs.check(energies, batch, *counts, self.rest_positions)
