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
from ..energies.explicit import ExplicitEnergy
from ..energies.materials import Corotated, Material
from ..energies.placed import PlacedEnergy
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
_MOST_LENGTHS = 100.0  # largest displacement of an equilibrium, in lengths of the body
COUPLINGS = ("implicit", "explicit")
_MOST_ITERATIONS = 100  # of Newton's method for an equilibrium; a few are enough from a good start
_NOTHING = Inputs()
_DEPENDENT = "dependent_"  # prefix of the values of vertices that others determine
_GRAVITY = Quantity("gravity", "m/s^2", per="axis")

Parameters = Mapping[str, Any]
Materials = Mapping[str, Any]  # a material, or the materials of regions, by the name of the region or body


@dataclass(frozen=True)
class Trajectory:
    """Result of a roll-out."""

    q: torch.Tensor  # (T + 1, B, N, 3) positions, the start included [m]
    v: torch.Tensor  # (T + 1, B, N, 3) velocities [m/s]
    reports: list[SolveReport]  # T outcomes of the solver
    final: State  # last state, the start of a further roll-out
    body: Body  # the simulated body
    time_step: float  # [s]

    @property
    def times(self) -> NDArray[np.float64]:
        """Times (T + 1,) of the states, from zero [s]."""
        return self.time_step * np.arange(len(self.q), dtype=np.float64)

    def save(self, path: str | Path) -> Path:
        """Writes times, positions and velocities, with their units, to an HDF5 file.

        Its datasets are ``times`` (T + 1,), ``q`` and ``v`` (T + 1, B, N, 3) and ``rest`` (N, 3), each with an
        attribute ``units``.

        Args:
            path: the file to write; missing folders are made.

        Raises:
            DataFileError: the file cannot be written.
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
            environment: index of the environment, 0 to B - 1.
            ax: matplotlib axes to draw in; a new figure by default.

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
            path: the ``.pvd`` file to write.
            environment: index of the environment, 0 to B - 1.

        Raises:
            InputError: no such environment, or another extension.
            DataFileError: the file cannot be written.
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
    """Returns a device that the kernels run on.

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
        body: the body to simulate, or a `fem.scene.Scene` of several bodies.
        material: one material, or one for each region of the mesh or body of a scene, by name. Every method accepts
            other values of its constants (``parameters``); the constants of a region or body have its name in front, as
            in ``tip_youngs_modulus``.
        time_step: h [s].
        gravity: acceleration (3,) [m/s^2].
        integrator: ``implicit_euler``, ``bdf2`` or ``midpoint``.
        solver: a name, or `SolverSettings`.
        relative_tolerance: shorthand for that field of the settings.
        device: a torch device.
        dtype: ``torch.float64``, or ``torch.float32`` for states, loads and factors. Forces are always evaluated in
            float64: single precision leaves no correct digit of them in a nearly incompressible solid. From a relative
            tolerance of 1e-5 on, a float32 step is as accurate as its positions, 4e-9 m on a beam of 0.1 m.
        coupling: when loads such as pressure are evaluated: ``implicit``, at the end of a step (in its middle for
            ``midpoint``); or ``explicit``, at its start, as published.

    Raises:
        InputError: a time step that is not positive, an unknown integrator, solver or coupling, or no CUDA device.

    Attributes:
        parameters: quantities whose values every method accepts, by name: constants of the materials and energies, and
            ``gravity`` (B, 3).
        inputs: quantities that act through the body's energies over time, by name.
        counts: number of values of an input or parameter, without the environments, by name.
        parts: names of the parts, such as tendons, that a parameter may have values for, by the parameter's name.
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
        """Checks the arguments and uploads constant data."""
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
        self._held = np.union1d(body.fixed_vertices, body.coordinates.dependent)  # not unknowns of a solve
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
        self._explicit_energies: dict[tuple[int, str], ExplicitEnergy] = {}
        self._attached_mass = self.tensor(body.attached_mass)
        self._built = True

    @property
    def materials(self) -> dict[str, Material]:
        """Materials by the name of their region or body; an empty name for one material of the whole body."""
        return {"": self.material} if isinstance(self.material, Material) else _flat(self.material)

    def _place_energies(self) -> list[PlacedEnergy]:
        """Returns the energies of all bodies: their solids, their rigid parts, and what acts in or on them."""
        whole, placed = self.body, list[PlacedEnergy]()
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
            placed += [PlacedEnergy.of(whole, body, first, energy, points, prefix) for energy, points, prefix in pairs]
        if whole.coordinates:
            placed.append(PlacedEnergy(PointInertia(whole.coordinates.points), (whole.coordinates.points,), _DEPENDENT))
        return placed

    def __setattr__(self, name: str, value: object) -> None:
        """Refuses changes, because uploaded data would not follow them.

        Raises:
            AttributeError: always, once the simulator is built.
        """
        if getattr(self, "_built", False):
            raise AttributeError(f"cannot set {name}: a simulator is constant; dataclasses.replace makes another one.")
        object.__setattr__(self, name, value)

    def tensor(self, values: object) -> torch.Tensor:
        """Returns values on the simulator's device, in its type."""
        return torch.as_tensor(values, device=self.device, dtype=self.dtype)

    def prepare(self, parameters: Parameters | Constants | None = None) -> Constants:
        """Turns parameters into stiffness, mass and weight; pass the result to `step` when stepping one by one.

        Args:
            parameters: values that replace the simulator's own, by a name of ``parameters``: numbers, tensors (M,) by
                element (or chamber), (B, 1) by environment, or (B, M). Prepared constants are returned as they are.

        Raises:
            InputError: an unknown name, a value out of range, or a number of values other than the number of elements.
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
        """Returns the buffers of a batch size, made at their first use."""
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

    def explicit_energy(self, name: str, batch: int) -> ExplicitEnergy:
        """The energy with an input of that name, by itself in a given state.

        Raises:
            InputError: no energy of the body has that input.
        """
        if (batch, name) not in self._explicit_energies:
            acting = [each for each in self._set.placed if name in each.input_names]
            if not acting:
                accepted = ", ".join(self.inputs) or "none"
                raise InputError(f"Unknown input {name}. The energies of this body accept {accepted}.")
            energy, (points,) = acting[0].energy, acting[0].all_points or acting[0].points
            if energy.implicit_only:
                raise InputError(f"{name} is a follower load, so it cannot be held constant over a step.")
            device = torch.device(self.device)
            self._explicit_energies[batch, name] = ExplicitEnergy(energy, points, self.body.n_vertices, batch, device)
        return self._explicit_energies[batch, name]

    def rest_state(self, batch: int = 1) -> State:
        """Returns the undeformed body at rest.

        Raises:
            InputError: the batch is not a whole number of at least one.
        """
        _check_count("batch", batch)
        q = self.rest_positions.expand(batch, -1, -1).clone()
        return State(q, torch.zeros_like(q))

    def state(self, q: object, v: object = None) -> State:
        """Returns a state without memory from arrays or tensors.

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

        Where the state continues the last step, the solver starts from an extrapolation of the steps before it. From
        other positions the solution is that of a new simulator.

        Args:
            state: start of the step.
            inputs: loads and actuation during the step.
            parameters: values that replace the simulator's own (see `prepare`), or prepared constants.

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
        """Advances a batch by one time step; the arguments have been checked."""
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
        """Positions (B, D, 3) of the fixed vertices at the stage [m]."""
        now = state.q[:, self.fixed]
        return now if inputs.fixed_positions is None else now + stage.end * (inputs.fixed_positions - now)

    def _finish(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor
    ) -> State:
        """Returns the new state from the stage's solution x (B, N, 3)."""
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
        """Returns the energies' memory after a step with the solution x and the new positions q."""
        terms = self.workspace(state.batch).potential.energies
        return self._set.end_step(state, stage, inputs, constants, terms, x, q)

    def remember(self, state: State, q: torch.Tensor, constants: Constants) -> State:
        """Returns the state at given positions, with the energies' memory of a step that ends there.

        Args:
            state: start of the step.
            q: (B, N, 3) positions at its end [m].
            constants: from `prepare`.
        """
        stage = self.method.stage(state, self.time_step)
        x = self.method.solution_for(state, q)
        return State(q, state.v, memory=self._end_step(state, stage, _NOTHING, constants, x, q))

    def linearise(
        self, state: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> Linearisation:
        """Returns the residual of a step and its derivative, to be evaluated at any positions.

        Args:
            state: start of the step.
            inputs: loads and actuation during the step.
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
        """Returns the terms of a step's incremental potential, differentiable in state, inputs and constants."""
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
        """Loads (1 or B, N, 3): gravity, external force and the loads of the energies [N]."""
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
        """Returns the equilibrium under gravity and constant inputs, differentiable like a step.

        Args:
            inputs: loads and actuation.
            parameters: see `prepare`.
            start: (B, N, 3) first guess [m]; the rest shape by default. If Newton's method does not converge from it in
                100 iterations, loads, inputs and motion of the clamp are increased step by step.
            batch: number of environments, if it does not follow from another argument.

        Raises:
            InputError: wrong shapes, values that are not finite, or a body without fixed vertices.
            ConvergenceError: no equilibrium was found, or the body grows without limit, as under a pressure that its
                material cannot hold.
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
        """Returns the equilibrium (B, N, 3) under a share of all loads, inputs and motion of the clamp [m]."""
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
        """Returns the trajectory of many steps.

        Memory grows by the states and terms of each step, never by factors: the adjoint of a step rebuilds its Hessian
        from the step's end.

        Args:
            state: start of the roll-out.
            steps: T.
            inputs: constant over all steps, or with a time axis T.
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
        """Raises an InputError for the first argument that cannot be simulated."""
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
        """Raises an InputError for the first input that cannot be simulated."""
        if not isinstance(inputs, Inputs):
            raise InputError(f"the inputs are a {type(inputs).__name__}: give Inputs(external_force=...), say.")
        accepted = {name: (quantity, self.counts[name]) for name, quantity in self.inputs.items()}
        inputs.check(accepted, batch, self.body.n_vertices, len(self.fixed), self.rest_positions)
