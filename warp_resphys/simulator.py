"""Batched, differentiable simulation of one body."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse
import torch

from .assembly import BlockPattern
from .body import Body
from .equilibrium import Equilibrium, GreenStrain, Workspace
from .errors import InputError
from .integrator import ImplicitStage, State, make_integrator
from .material import MODELS, Material, as_parameter
from .point_terms import StepTerms
from .pressure import ChamberPressure
from .solver import SolveReport, SolverSettings

GRAVITY = (0.0, 0.0, -9.80709)
PRESSURE_COUPLINGS = ("implicit", "explicit")


@dataclass(frozen=True)
class MaterialTensors:
    """What a material makes of a body: differentiable tensors, computed once a roll-out.

    Attributes:
        shape_stiffness: (1 or B, P) [J].
        volume_stiffness: (1 or B, P) [J].
        mass: (1 or B, N) [kg].
        weight: (1 or B, N, 3) force of gravity [N].
        mass_damping: (1 or B, 1) [1/s].
        stiffness_damping: (1 or B,) [s].
        damped: whether stiffness damping acts at all.
        model: the material's.
        fibre_stiffness: (1 or B, C) [N/m]; None without fibres.
    """

    shape_stiffness: torch.Tensor
    volume_stiffness: torch.Tensor
    mass: torch.Tensor
    weight: torch.Tensor
    mass_damping: torch.Tensor
    stiffness_damping: torch.Tensor
    damped: bool
    model: str
    fibre_stiffness: torch.Tensor | None = None

    def check_batch(self, batch: int) -> None:
        """Refuses constants of another number of environments.

        Raises:
            InputError: some constant has neither one value nor one for each environment.
        """
        constants = (self.shape_stiffness, self.mass, self.mass_damping, self.stiffness_damping, self.fibre_stiffness)
        for tensor in constants:
            if tensor is not None and len(tensor) not in (1, batch):
                raise InputError(
                    f"a material parameter has values for {len(tensor)} environments, but the state has {batch}."
                )


@dataclass(frozen=True)
class Trajectory:
    """Result of a roll-out.

    Attributes:
        q: (T + 1, B, N, 3) positions, the start included [m].
        v: (T + 1, B, N, 3) velocities [m/s].
        reports: T outcomes of the solver.
        final: the last state, from which a further roll-out goes on.
    """

    q: torch.Tensor
    v: torch.Tensor
    reports: list[SolveReport]
    final: State


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
        material: its constants; every method takes another one by keyword.
        time_step: h [s].
        gravity: acceleration (3,) [m/s^2].
        integrator: ``implicit_euler``, ``bdf2`` or ``midpoint``.
        solver: a name, or `SolverSettings`.
        relative_tolerance: shorthand for that field of the settings.
        device: a torch device.
        dtype: ``torch.float64``, or ``torch.float32`` for states, loads and factors. Forces are evaluated in float64 in
            both: single precision leaves a nearly incompressible solid no digit of them. A float32 step is as good as
            its positions then, 4e-9 m on a beam of 0.1 m, from a relative tolerance of 1e-5 on.
        pressure_coupling: ``implicit``, pressure acts on the chambers as they are at the end of a step (in its middle,
            for ``midpoint``); or ``explicit``, as they are at its start, as published.

    Raises:
        InputError: a time step that is not positive, an unknown integrator, solver or coupling, or a CUDA device that
            is not there.
    """

    body: Body
    material: Material = field(default_factory=Material)
    time_step: float = 0.01
    gravity: Sequence[float] = GRAVITY
    integrator: str = "implicit_euler"
    solver: str | SolverSettings = "quasi_newton"
    relative_tolerance: float | None = None
    device: str | torch.device = "cpu"
    dtype: torch.dtype = torch.float64
    pressure_coupling: str = "implicit"

    def __post_init__(self) -> None:
        """Uploads what is constant."""
        if not (np.isfinite(self.time_step) and self.time_step > 0.0):
            raise InputError(f"time_step is {self.time_step:g}: it must be positive, in seconds.")
        if self.dtype not in (torch.float64, torch.float32):
            raise InputError(f"dtype is {self.dtype}: choose torch.float64 or torch.float32.")
        if self.pressure_coupling not in PRESSURE_COUPLINGS:
            raise InputError(
                f"pressure_coupling is {self.pressure_coupling!r}: choose one of {', '.join(PRESSURE_COUPLINGS)}."
            )
        self.device = _device(self.device)
        settings = SolverSettings(name=self.solver) if isinstance(self.solver, str) else self.solver
        if self.relative_tolerance is not None:
            settings = replace(settings, relative_tolerance=self.relative_tolerance)
        self.settings = settings
        self.method = make_integrator(self.integrator)
        self._pattern = BlockPattern(self.body)
        if np.shape(self.gravity) != (3,) or not np.isfinite(self.gravity).all():
            raise InputError(f"gravity is {self.gravity}: it must be three finite accelerations, in m/s^2.")
        self._gravity = self.tensor(self.gravity)
        self.rest_positions = self.tensor(self.body.mesh.vertices)  # (N, 3) [m]
        self.fixed = torch.as_tensor(self.body.fixed_vertices, device=self.device)
        self._workspaces: dict[tuple[int, str], Workspace] = {}
        self._chambers: dict[int, ChamberPressure] = {}
        sets = self.body.discretisation.point_sets
        self._shape_volume = self._sparse(scipy.sparse.vstack([s.shape_volume for s in sets]))
        self._volume_volume = self._sparse(scipy.sparse.vstack([s.volume_volume for s in sets]))
        self._mass_volume = self._sparse(self.body.mass_volume)
        self._load_volume = self._sparse(self.body.load_volume)
        self._attached_mass = self.tensor(self.body.attached_mass)
        self._built = True

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

    def _sparse(self, matrix: scipy.sparse.sparray) -> torch.Tensor:
        coo = matrix.tocoo()
        indices = torch.as_tensor(np.stack([coo.row, coo.col]).astype(np.int64))
        tensor = torch.sparse_coo_tensor(indices, torch.as_tensor(coo.data), coo.shape, check_invariants=False)
        return tensor.to(device=self.device, dtype=self.dtype).coalesce()

    def _spread(self, operator: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """(1 or B, rows): a sparse (rows, M) operator applied to (1 or B, 1 or M) element values."""
        m = operator.shape[1]
        if values.shape[1] not in (1, m):
            raise InputError(
                f"a material parameter has {values.shape[1]} values for {m} elements: give one value, one an element "
                f"({m}), or one an environment with shape (B, 1)."
            )
        return torch.sparse.mm(operator, values.expand(-1, m).mT).mT

    def prepare(
        self,
        material: Material | MaterialTensors | None = None,
        attached_mass: torch.Tensor | None = None,
        gravity: torch.Tensor | None = None,
    ) -> MaterialTensors:
        """Turns a material into stiffness, mass and weight; pass the result to `step` when stepping one by one.

        Args:
            material: another material than the simulator's; what is prepared already is returned as it is.
            attached_mass: (1 or B, N) in place of the body's, other weights in every environment [kg].
            gravity: (1 or B, 3) in place of the simulator's [m/s^2].
        """
        if isinstance(material, MaterialTensors):
            return material
        material = self.material if material is None else material
        attached = self._attached_mass if attached_mass is None else attached_mass
        acceleration = self._gravity if gravity is None else gravity[:, None, :]
        device = torch.device(self.device)
        mu, lame_lambda = material.lame(device, self.dtype)
        density = as_parameter(material.density, device, self.dtype)
        mass = self._spread(self._mass_volume, density) + attached
        loaded = self._spread(self._load_volume, density) + attached
        damping = self.tensor(material.stiffness_damping).reshape(-1)
        damped = bool((damping > 0).any()) or damping.requires_grad
        return MaterialTensors(
            shape_stiffness=self._spread(self._shape_volume, mu.broadcast_to(self._common(mu, lame_lambda))),
            volume_stiffness=self._spread(self._volume_volume, lame_lambda),
            mass=mass,
            weight=loaded[..., None] * acceleration,
            mass_damping=self.tensor(material.mass_damping).reshape(-1, 1),
            stiffness_damping=damping,
            damped=damped,
            model=material.model,
            fibre_stiffness=self._fibre_stiffness(material),
        )

    def _fibre_stiffness(self, material: Material) -> torch.Tensor | None:
        stiffness = as_parameter(material.fibre_stiffness, torch.device(self.device), self.dtype)
        chambers = len(self.body.chambers)
        if self.body.fibres is None:
            if bool((stiffness > 0.0).any()):
                raise InputError(
                    "the material has a fibre_stiffness, but the body has no fibres: give it some, or leave that out."
                )
            return None
        if stiffness.shape[1] not in (1, chambers):
            raise InputError(
                f"fibre_stiffness has {stiffness.shape[1]} values for {chambers} chambers: give one value, or one for "
                "each chamber."
            )
        return stiffness.expand(-1, chambers)

    @staticmethod
    def _common(*tensors: torch.Tensor) -> torch.Size:
        return torch.Size(np.broadcast_shapes(*(t.shape for t in tensors)))

    def workspace(self, batch: int, model: str | None = None) -> Workspace:
        """Buffers for a batch size and material model, made at their first use."""
        key = (batch, model or self.material.model)
        if key not in self._workspaces:
            self._workspaces[key] = Workspace(
                self.body, MODELS[key[1]], self._pattern, batch, torch.device(self.device), self.dtype
            )
        return self._workspaces[key]

    def chambers(self, batch: int) -> ChamberPressure:
        """Volumes of the chambers, and the force of pressure in a given state, for a batch size.

        Raises:
            InputError: the body has no chambers.
        """
        if batch not in self._chambers:
            device = torch.device(self.device)
            self._chambers[batch] = ChamberPressure(self.body, batch, device, self.dtype)
        return self._chambers[batch]

    def rest_state(self, batch: int = 1) -> State:
        """The undeformed body at rest."""
        q = self.rest_positions.expand(batch, -1, -1).clone()
        return State(q, torch.zeros_like(q))

    def step(
        self,
        state: State,
        external_force: torch.Tensor | None = None,
        fixed_positions: torch.Tensor | None = None,
        material: Material | MaterialTensors | None = None,
        pressure: torch.Tensor | None = None,
    ) -> tuple[State, SolveReport]:
        """Advances a batch by one time step.

        Args:
            state: where it is.
            external_force: (B, N, 3) held during the step, gravity not included [N]; zero where left out.
            fixed_positions: (B, D, 3) of the fixed vertices at the end of the step, in the order of
                ``body.fixed_vertices`` [m]; where they are, if left out.
            material: another material than the simulator's, or one already prepared.
            pressure: (B, C) gauge pressure in each chamber during the step [Pa]; none where left out.

        Returns:
            The new state, differentiable, and the solver's report.

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: see `solver.SolverSettings.on_failure`.
        """
        tensors = self.prepare(material)
        self._check(state, external_force, fixed_positions, pressure=pressure)
        tensors.check_batch(state.batch)
        stage = self.method.stage(state, self.time_step)
        if fixed_positions is None:
            fixed_positions = state.q[:, self.fixed]
        at_stage = state.q[:, self.fixed] + stage.end * (fixed_positions - state.q[:, self.fixed])
        workspace = self.workspace(state.batch, tensors.model)
        external_force, pressure = self.coupled(state, external_force, pressure)
        terms = self.step_terms(stage, state.batch, external_force, tensors, workspace, pressure)
        reports: list[SolveReport] = []
        solver = workspace.solver("dynamics", self.settings)
        x = Equilibrium.apply(workspace, solver, reports, stage.target, at_stage, *terms.tensors())
        new = self.method.finish(state, x, self.time_step)
        if stage.end < 1.0 and len(self.fixed):
            # A prescribed motion has a velocity of its own; extrapolated from mid-step it would ring.
            velocity = (fixed_positions - state.q[:, self.fixed]) / self.time_step
            new = replace(new, v=new.v.index_copy(1, self.fixed, velocity))
        return new, reports[0]

    def coupled(
        self, state: State, external_force: torch.Tensor | None, pressure: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """External force (B, N, 3) and pressure (B, C) as they enter a step's potential: see ``pressure_coupling``."""
        if pressure is None or self.pressure_coupling == "implicit":
            return external_force, pressure
        push = self.chambers(state.batch).force(state.q, pressure)
        return push if external_force is None else external_force + push, None

    def step_terms(
        self,
        stage: ImplicitStage,
        batch: int,
        external_force: torch.Tensor | None,
        tensors: MaterialTensors,
        workspace: Workspace,
        pressure: torch.Tensor | None = None,
    ) -> StepTerms:
        """The incremental potential of a step, differentiable in everything that it depends on."""
        h = stage.step
        # Mass damping is linear in x: it joins inertia and moves the target.
        damping = tensors.mass_damping[..., None] * h  # (1 or B, 1, 1)
        force = tensors.weight if external_force is None else tensors.weight + external_force
        strain = None
        if tensors.damped:
            p = workspace.potential
            strain = sum(w * GreenStrain.apply(p, q) for q, w in stage.strain_weights)
        return StepTerms(
            target=(stage.target + damping * stage.velocity_reference) / (1.0 + damping),
            inertia=(tensors.mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1),
            force=force.expand(batch, -1, -1),
            shape_stiffness=tensors.shape_stiffness,
            volume_stiffness=tensors.volume_stiffness,
            viscosity=(tensors.stiffness_damping / h).expand(batch),
            reference_strain=strain,
            pressure=pressure,
            fibre_stiffness=tensors.fibre_stiffness,
        )

    def static_equilibrium(
        self,
        external_force: torch.Tensor | None = None,
        fixed_positions: torch.Tensor | None = None,
        material: Material | MaterialTensors | None = None,
        start: torch.Tensor | None = None,
        batch: int | None = None,
        pressure: torch.Tensor | None = None,
    ) -> State:
        """The state of rest under gravity and constant loads, differentiable like a step.

        Args:
            external_force: (B, N, 3) [N].
            fixed_positions: (B, D, 3) of the fixed vertices [m].
            material: another material than the simulator's, or one already prepared.
            start: (B, N, 3) first guess [m]; the rest shape where left out.
            batch: environments, where no other argument tells.
            pressure: (B, C) gauge pressure in each chamber [Pa].

        Raises:
            InputError: wrong shapes, values that are not finite, or a body without fixed vertices.
            ConvergenceError: no equilibrium was found.
        """
        if not len(self.fixed):
            raise InputError("a body without fixed vertices has no static equilibrium: fix some vertices.")
        given = [t for t in (external_force, fixed_positions, start, pressure) if t is not None]
        tensors = self.prepare(material)
        batch = batch or max([len(t) for t in given] + [len(tensors.shape_stiffness), len(tensors.weight)])
        state = self.rest_state(batch)
        self._check(state, external_force, fixed_positions, start, pressure)
        tensors.check_batch(batch)
        if fixed_positions is None:
            fixed_positions = state.q[:, self.fixed]
        force = tensors.weight if external_force is None else tensors.weight + external_force
        workspace = self.workspace(batch, tensors.model)
        settings = replace(self.settings, name="newton", on_failure="raise")
        x = Equilibrium.apply(
            workspace,
            workspace.solver("statics", settings),
            [],
            state.q if start is None else start.detach(),
            fixed_positions,
            state.q,
            torch.zeros(batch, self.body.n_vertices, device=self.device, dtype=self.dtype),
            force.expand(batch, -1, -1),
            tensors.shape_stiffness,
            tensors.volume_stiffness,
            torch.zeros(batch, device=self.device, dtype=self.dtype),
            None,
            pressure,
            tensors.fibre_stiffness,
        )
        return State(x, torch.zeros_like(x))

    def rollout(
        self,
        state: State,
        steps: int,
        external_forces: torch.Tensor | None = None,
        fixed_positions: torch.Tensor | None = None,
        material: Material | MaterialTensors | None = None,
        pressures: torch.Tensor | None = None,
    ) -> Trajectory:
        """Steps many times.

        Memory grows by the states and terms of each step, never by factors: the adjoint of a step rebuilds its Hessian
        from the state it led to.

        Args:
            state: the start.
            steps: T.
            external_forces: (T, B, N, 3) for each step, or (B, N, 3) throughout [N].
            fixed_positions: (T, B, D, 3) for each step, in the order of ``body.fixed_vertices`` [m].
            material: another material than the simulator's, or one already prepared.
            pressures: (T, B, C) gauge pressure in each chamber during each step, or (B, C) throughout [Pa].

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: see `step`.
        """
        if not steps >= 1:
            raise InputError(f"steps is {steps}: it must be at least 1.")
        series = (("external_forces", external_forces, 4), ("fixed_positions", fixed_positions, 4))
        for name, values, axes in (*series, ("pressures", pressures, 3)):
            if values is not None and values.ndim == axes and len(values) != steps:
                raise InputError(f"{name} has {len(values)} time steps, but {steps} are to be simulated.")
        tensors = self.prepare(material)
        states, reports = [state], []
        for t in range(steps):
            force = external_forces
            if external_forces is not None and external_forces.ndim == 4:
                force = external_forces[t]
            moved = None if fixed_positions is None else fixed_positions[t]
            pressure = pressures
            if pressures is not None and pressures.ndim == 3:
                pressure = pressures[t]
            state, report = self.step(state, force, moved, tensors, pressure)
            states.append(state)
            reports.append(report)
        q, v = (torch.stack([getattr(s, name) for s in states]) for name in ("q", "v"))
        return Trajectory(q, v, reports, state)

    def _check(
        self,
        state: State,
        external_force: torch.Tensor | None,
        fixed_positions: torch.Tensor | None,
        start: torch.Tensor | None = None,
        pressure: torch.Tensor | None = None,
    ) -> None:
        """One sentence on the first argument that cannot be simulated."""
        b, n, d, c = state.batch, self.body.n_vertices, len(self.fixed), len(self.body.chambers)
        back = (None, None) if state.previous is None else state.previous
        if not (isinstance(back, tuple) and len(back) == 2):
            raise InputError("state.previous must be the pair (q, v) of the step before, or None.")
        wanted = {
            "state.q": (state.q, (b, n, 3), "m"),
            "state.v": (state.v, (b, n, 3), "m/s"),
            "state.previous[0]": (back[0], (b, n, 3), "m"),
            "state.previous[1]": (back[1], (b, n, 3), "m/s"),
            "external_force": (external_force, (b, n, 3), "N"),
            "fixed_positions": (fixed_positions, (b, d, 3), "m"),
            "start": (start, (b, n, 3), "m"),
            "pressure": (pressure, (b, c), "Pa"),
        }
        for name, (values, shape, unit) in wanted.items():
            if values is None:
                continue
            if name == "pressure" and not c:
                raise InputError("there is a pressure, but the body has no chambers: name or find its chambers.")
            if not isinstance(values, torch.Tensor):
                raise InputError(f"{name} is a {type(values).__name__}: it must be a torch tensor.")
            if values.device.type != self.rest_positions.device.type or values.dtype != self.dtype:
                raise InputError(
                    f"{name} is {values.dtype} on {values.device}: it must be {self.dtype} on {self.device}; "
                    "Simulator.tensor converts."
                )
            if tuple(values.shape) != shape:
                raise InputError(f"{name} has shape {tuple(values.shape)}: it must be {shape} in {unit}.")
            if not bool(torch.isfinite(values).all()):
                where = (~torch.isfinite(values)).nonzero()[0].tolist()
                place = "chamber" if name == "pressure" else "vertex"
                raise InputError(
                    f"{name} is not finite in environment {where[0]}, {place} {where[1]}: check what computes it."
                )
