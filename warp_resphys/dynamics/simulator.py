"""Batched, differentiable simulation of one body."""

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..energies.base import Energy
from ..energies.explicit import HeldEnergy
from ..energies.materials import Corotated, Material
from ..energies.placed import Placed
from ..energies.potential import StepTerms
from ..energies.rigid import PointInertia, rigid_energies
from ..energies.solid import solids_of
from ..fem.body import Body
from ..fem.coordinates import DeviceCoordinates
from ..io.errors import ConvergenceError, InputError
from ..io.files import atomic_hdf5, create
from ..linalg.threads import shards_of
from ..mesh.motion_files import write_vtk
from ..stepping.constants import Constants
from ..stepping.inputs import Inputs, check_tensor
from ..stepping.integrators import make_integrator
from ..stepping.quantity import Quantity
from ..stepping.state import ImplicitStage, State
from .assembly import BlockPattern
from .energy_set import EnergySet
from .equilibrium import Workspace, equilibrium, ramped
from .linearisation import Linearisation
from .nonlinear_solver import SolveReport, SolverSettings

log = logging.getLogger(__name__)

GRAVITY = (0.0, 0.0, -9.80709)
_MOST_LENGTHS = 100.0  # that a body at rest may be away from its rest shape
COUPLINGS = ("implicit", "explicit")
_MOST_ITERATIONS = 100  # of Newton's method for an equilibrium; a few are enough where it is near
_NOTHING = Inputs()
_DEPENDENT = "dependent_"  # begins the names of the inertia of vertices that others determine
_GRAVITY = Quantity("gravity", "m/s^2", per="axis")

Parameters = Mapping[str, Any]
Materials = Mapping[str, Any]  # a material, or the materials of regions, by the name of the region or body


@dataclass(frozen=True)
class Trajectory:
    """Result of a roll-out."""

    q: torch.Tensor  # (T + 1, B, N, 3) positions, the start included [m]
    v: torch.Tensor  # (T + 1, B, N, 3) velocities [m/s]
    reports: list[SolveReport]  # T outcomes of the solver
    final: State  # the last state, from which a further roll-out goes on
    body: Body  # that moved
    time_step: float  # [s]

    @property
    def times(self) -> NDArray[np.float64]:
        """(T + 1,) [s], from zero."""
        return self.time_step * np.arange(len(self.q), dtype=np.float64)

    def save(self, path: str | Path) -> Path:
        """Writes times, positions and velocities, with their units, to an HDF5 file.

        Its datasets are ``times`` (T + 1,), ``q`` and ``v`` (T + 1, B, N, 3) and ``rest`` (N, 3), each with an
        attribute ``units``.

        Args:
            path: of the file; missing folders are made.

        Raises:
            DataFileError: it cannot be written.
        """
        with atomic_hdf5(path, "trajectory") as file:
            create(file, "times", self.times, "s")
            create(file, "q", _array(self.q), "m")
            create(file, "v", _array(self.v), "m/s")
            create(file, "rest", self.body.vertices, "m")
        return Path(path)

    def plot(self, vertices: ArrayLike, axis: str = "z", environment: int = 0, ax: Any = None) -> Any:
        """Draws the mean displacement of some vertices from their rest position over time.

        Args:
            vertices: numbers of the vertices, such as those of `select_vertices`; or one number.
            axis: ``x``, ``y`` or ``z``.
            environment: which of the B.
            ax: axes of matplotlib to draw in; those of a new figure where left out.

        Returns:
            The axes.

        Raises:
            InputError: an unknown axis, a vertex that the body does not have, or no such environment.
        """
        import matplotlib.pyplot as plt

        self._check(environment)
        chosen, count = np.atleast_1d(np.asarray(vertices, dtype=np.int64)), self.body.n_vertices
        if axis not in ("x", "y", "z"):
            raise InputError(f"axis is {axis!r}: choose x, y or z.")
        if not len(chosen) or chosen.min() < 0 or chosen.max() >= count:
            raise InputError(f"the vertices to plot must be one or more of 0 to {count - 1}.")
        moved = (_array(self.q[:, environment]) - self.body.vertices)[:, chosen, "xyz".index(axis)].mean(1)
        ax = plt.subplots(layout="constrained")[1] if ax is None else ax
        ax.plot(self.times, 1e3 * moved)
        ax.set(xlabel="time [s]", ylabel=f"displacement along {axis} [mm]")
        return ax

    def write_vtk(self, path: str | Path, environment: int = 0) -> Path:
        """Writes a time series for ParaView: a ``.pvd`` file, and a folder of the same name with a file for each step.

        The vertices have ``displacement`` and ``velocity``.

        Args:
            path: of the ``.pvd`` file.
            environment: which of the B.

        Raises:
            InputError: no such environment, or another extension.
            DataFileError: it cannot be written.
        """
        self._check(environment)
        q, v = (_array(values[:, environment]) for values in (self.q, self.v))
        return write_vtk(Path(path), self.body.mesh, self.times, q, v, q[:, :0])

    def _check(self, environment: int) -> None:
        if not 0 <= environment < self.q.shape[1]:
            raise InputError(f"environment is {environment}: there are {self.q.shape[1]}, numbered from 0.")


def _array(values: torch.Tensor) -> NDArray[np.float64]:
    return np.asarray(values.detach().cpu().numpy(), dtype=np.float64)


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


def _flat(materials: Materials) -> dict[str, Material]:
    """Returns the materials of bodies and of their regions by name, as in ``finger_tip``."""
    flat: dict[str, Material] = {}
    for name, material in materials.items():
        own = {"": material} if isinstance(material, Material) else _flat(material)
        flat |= {f"{name}_{region}" if region else name: value for region, value in own.items()}
    return flat


def _material_of(material: Material | Materials, name: str) -> Material | Materials:
    """Returns the material of a body by its name; all bodies may have the same.

    Raises:
        InputError: no material for the body.
    """
    if not name or isinstance(material, Material):
        return material
    if name not in material:
        raise InputError(f"The body {name!r} has no material. Give one: there are {', '.join(material) or 'none'}.")
    own: Material | Materials = material[name]
    return own


@dataclass
class Simulator:
    """Steps a body through time.

    Args:
        body: what is simulated; a `fem.scene.Scene` of several bodies is one, too.
        material: of the body, or of each of its mesh's regions by name, or of each body of a scene by name; every
            method takes other values of its constants by name (``parameters``), those of a region or body with its name
            and an underscore in front, as in ``tip_youngs_modulus``.
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
        self.rest_positions = self.tensor(body.vertices)  # (N, 3) [m]
        self.fixed = torch.as_tensor(body.fixed_vertices, device=self.device)
        if self.integrator == "midpoint" and any(own.controls for _, own, _ in body.members):
            raise InputError("integrator is midpoint, by which rigid parts ring: choose implicit_euler or bdf2.")
        self._coordinates = DeviceCoordinates(body.coordinates, self.rest_positions)
        energies = self._place_energies()
        self._set = EnergySet(energies, body, self.rest_positions, self.method, self.time_step)
        own = self._set
        self._held = np.union1d(body.fixed_vertices, body.coordinates.dependent)  # what is no unknown of a solve
        self._pattern = BlockPattern(
            body.vertices, self._held, [points for placed in energies for points in placed.points]
        )
        self.parameters: dict[str, Quantity] = {**own.parameters, "gravity": _GRAVITY}
        self.constants: dict[str, Any] = {**own.constants, "gravity": [list(self.gravity)]}
        self.counts = {**own.counts, "gravity": 3}
        self.inputs, self.parts = own.inputs, own.parts
        followers = [name for placed in energies if placed.energy.implicit_only for name in placed.input_names]
        if self.coupling == "explicit" and followers:
            raise InputError(
                f"coupling is explicit, but {followers[0]} is a follower load, which acts at the end of a step: choose "
                "implicit."
            )
        self._workspaces: dict[int, Workspace] = {}
        self._held_energies: dict[tuple[int, str], HeldEnergy] = {}
        self._attached_mass = self.tensor(body.attached_mass)
        self._built = True

    @property
    def materials(self) -> dict[str, Material]:
        """Materials by the name of their region or body; of an empty name where there is one for all."""
        return {"": self.material} if isinstance(self.material, Material) else _flat(self.material)

    def _place_energies(self) -> list[Placed]:
        """Returns the energies of all bodies: their solids, their rigid parts, and what acts in or on them."""
        whole, placed = self.body, list[Placed]()
        for name, body, first in whole.members:
            begin = f"{name}_" if name else ""
            material = _material_of(self.material, name)
            own: list[tuple[Energy, str]] = [(solid, f"{begin}{prefix}") for solid, prefix in solids_of(body, material)]
            for part in body.controls:
                own += [(energy, f"{begin}{part}_") for energy in rigid_energies(body, part, body.rigid[part])]
            pairs: list[tuple[Energy, Any, str]] = [
                (energy, energy.points(body.mesh), prefix) for energy, prefix in own
            ]
            acting = zip(cast(Sequence[Energy], body.energies), body.energy_points, strict=True)
            pairs += [(energy, points, begin) for energy, points in acting]
            placed += [Placed.on(whole, body, first, energy, points, prefix) for energy, points, prefix in pairs]
        if whole.coordinates:
            placed.append(Placed(PointInertia(whole.coordinates.points), (whole.coordinates.points,), _DEPENDENT))
        return placed

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
        values, mass = self._set.prepare(tensors)
        return Constants(
            mass=mass.inertia + self._attached_mass,
            load_mass=mass.weight + self._attached_mass,
            gravity=tensors["gravity"],
            mass_damping=mass.damping,
            values=values,
        )

    def workspace(self, batch: int) -> Workspace:
        """Buffers for a batch size, made at their first use."""
        if batch not in self._workspaces:
            workspace = self._make_workspace(batch)
            rows = shards_of(batch, workspace.potential.device)
            workspace.shards += [(shard, self._make_workspace(shard.stop - shard.start)) for shard in rows]
            self._workspaces[batch] = workspace
        return self._workspaces[batch]

    def _make_workspace(self, batch: int) -> Workspace:
        n, fixed = self.body.n_vertices, self.body.fixed_vertices
        return Workspace(
            self._set.placed, n, fixed, self._held, self._pattern, batch, torch.device(self.device), self.dtype
        )

    def held_energy(self, name: str, batch: int) -> HeldEnergy:
        """The energy with an input of that name, by itself in a given state.

        Raises:
            InputError: no energy of the body has that input.
        """
        if (batch, name) not in self._held_energies:
            acting = [placed for placed in self._set.placed if name in placed.input_names]
            if not acting:
                known = ", ".join(self.inputs) or "none"
                raise InputError(f"Unknown input {name}. The energies of this body accept {known}.")
            energy, (points,) = acting[0].energy, acting[0].all_points or acting[0].points
            if energy.implicit_only:
                raise InputError(f"{name} is a follower load, so it cannot be held constant over a step.")
            device = torch.device(self.device)
            self._held_energies[batch, name] = HeldEnergy(energy, points, self.body.n_vertices, batch, device)
        return self._held_energies[batch, name]

    def rest_state(self, batch: int = 1) -> State:
        """The undeformed body at rest.

        Raises:
            InputError: the batch is no whole number, one or more.
        """
        _check_count("batch", batch)
        q = self.rest_positions.expand(batch, -1, -1).clone()
        return State(q, torch.zeros_like(q))

    def state(self, q: object, v: object = None) -> State:
        """Builds a state, with nothing remembered, of arrays or tensors.

        Args:
            q: (B, N, 3) positions, or (N, 3) of a batch of one [m].
            v: velocities of the same shape; at rest where left out [m/s].

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
        x = self._coordinates.expand(x)
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
        memory = self._end_step(state, stage, inputs, constants, x, new.q)
        new = replace(new, memory=memory)
        if stage.end == 1.0 or not len(self.fixed):
            return new
        # A prescribed motion has a velocity of its own; extrapolated from mid-step it would ring.
        now = state.q[:, self.fixed]
        moved = torch.zeros_like(now) if inputs.fixed_positions is None else inputs.fixed_positions - now
        return replace(new, v=new.v.index_copy(1, self.fixed, moved / self.time_step))

    def _end_step(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor, q: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Returns what the energies remember after a step with the solution x that leads to positions q."""
        terms = self.workspace(state.batch).potential.energies
        return self._set.end_step(state, stage, inputs, constants, terms, x, q)

    def remember(self, state: State, q: torch.Tensor, constants: Constants) -> State:
        """Returns the state at positions that are known, with what the energies remember of a step to them.

        Args:
            state: where the step starts.
            q: (B, N, 3) positions where it ends [m].
            constants: from `prepare`.
        """
        stage = self.method.stage(state, self.time_step)
        x = self.method.solution_for(state, q)
        return State(q, state.v, memory=self._end_step(state, stage, _NOTHING, constants, x, q))

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
            self._coordinates,
            partial(self._finish, state, stage, inputs, constants),
            self.settings.linear_solver,
        )

    def _terms(self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants) -> StepTerms:
        """The incremental potential of a step, differentiable in everything that it depends on."""
        batch, h = state.batch, stage.step
        # Mass damping is linear in x: it joins inertia and moves the target.
        damping = constants.mass_damping[..., None] * h  # (1 or B, 1, 1)
        mass, force = constants.mass, self._loads(inputs, constants, batch)
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        energies = self.workspace(batch).potential.energies
        values = self._set.acting(constants, inputs, batch)
        values |= self._set.begin_step(state, stage, inputs, constants, energies)
        if self.coupling == "explicit":
            for name in (name for placed in self._set.placed if placed.energy.is_load for name in placed.input_names):
                value = values[name]
                assert value is not None
                force = force + self.held_energy(name, batch).force(state.q, value)
                values[name] = torch.zeros_like(value)
        target = (stage.target + damping * stage.velocity_reference) / (1.0 + damping)
        inertia = (mass / h**2 * (1.0 + damping[..., 0])).expand(batch, -1)
        dependent = self._coordinates.dependent
        if len(dependent):
            values[f"{_DEPENDENT}inertia"] = inertia[:, dependent]
            values[f"{_DEPENDENT}target"] = target[:, dependent]
        return StepTerms(target, inertia, self._coordinates.reduce(force.expand(batch, -1, -1)), values)

    def _loads(self, inputs: Inputs, constants: Constants, batch: int, static: bool = False) -> torch.Tensor:
        """(1 or B, N, 3) gravity, external force and what parts add in equilibria or in steps [N]."""
        mass = constants.load_mass
        if inputs.attached_mass is not None:
            mass = mass + inputs.attached_mass
        weight = mass[..., None] * constants.gravity[:, None]
        if inputs.external_force is not None:
            weight = weight + inputs.external_force
        for load in self._set.loads(constants, inputs, batch, static):
            weight = weight + load
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
            log.debug("the equilibrium is computed under gradually increasing loads: %s", error)
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
        values = self._set.acting(constants, inputs, batch)
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
        return Trajectory(q, v, reports, state, self.body, self.time_step)

    def _check(self, state: State, inputs: Inputs, constants: Constants) -> None:
        """One sentence on the first argument that cannot be simulated."""
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
        """One sentence on the first input that cannot be simulated."""
        if not isinstance(inputs, Inputs):
            raise InputError(f"the inputs are a {type(inputs).__name__}: give Inputs(external_force=...), say.")
        accepted = {name: (quantity, self.counts[name]) for name, quantity in self.inputs.items()}
        inputs.check(accepted, batch, self.body.n_vertices, len(self.fixed), self.rest_positions)
