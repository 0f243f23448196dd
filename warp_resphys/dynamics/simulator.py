"""Batched, differentiable simulation of a body."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from threading import get_ident
from typing import Any

import numpy as np
import torch

from ..energies.body_energies import Materials, joined_names, place_energies
from ..energies.contact import ContactForces
from ..energies.launcher import lasting
from ..energies.materials import Corotated, Material
from ..energies.obstacles import ObstacleMotion
from ..fem.bodies import Body
from ..fem.coordinates import DeviceCoordinates
from ..io.errors import ConvergenceError, InputError
from ..io.machine import find_device
from ..linalg.threads import shards_of
from ..stepping.adjoints import refuse_transforms
from ..stepping.inputs import Inputs, check_tensor
from ..stepping.integrators import make_integrator
from ..stepping.quantity import Quantity
from ..stepping.rollout import rollout
from ..stepping.state import Constants, SolveReport, State
from .assembly import BlockPattern
from .energy_set import EnergySet, SimulatorStep
from .equilibrium import Workspace, equilibrium
from .linearisation import Linearisation
from .mesh_error import CHECKED, warn_of_cells
from .nonlinear_solver import SolverSettings, check_converged
from .plausibility import warn_of_implausible
from .statics import MOST_ITERATIONS, find_equilibrium, progress_of, settle
from .trajectory import Motion

GRAVITY = (0.0, 0.0, -9.80709)
_NO_INPUTS = Inputs()
# Steps of a roll-out on a GPU after which the host checks their convergence: it waits for the GPU only then.
_STEPS_TO_CHECK = 32
_SHIFT = 1e-6  # m, along every axis, against which friction acts
_HELD_BY = 3  # vertices with friction, against all displacements and turns
_GRAVITY = Quantity("gravity", "m/s^2", per="axis")

Parameters = Mapping[str, Any]


def _check_count(name: str, value: object) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise InputError(f"{name} is {value!r}: it must be a whole number, one or more.")


@dataclass
class Simulator:
    """Simulates a body over time.

    Several threads may use a simulator: each has its own buffers. On a GPU they take turns, after a first step in one
    thread. It can be copied and pickled.

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

    Raises:
        InputError: a time step that is not positive, an unknown integrator or solver, or a missing CUDA device.

    Warns:
        ResphysWarning: a size, a material or a gravity that looks like a wrong unit, a cell that is nearly flat, or so
            many unknowns that steps are slow (`dynamics.plausibility`).

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

    def __post_init__(self) -> None:
        """Checks the arguments and builds the energies."""
        self._build()
        warn_of_implausible(self.body, self.materials, self.gravity, self.rest_positions.device.type == "cpu")

    def __getstate__(self) -> dict[str, Any]:
        """Returns the arguments, of which a copy is built: buffers, factors and Warp's arrays belong to a process."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Builds a copy from its arguments."""
        vars(self).update(state)
        self._build()

    def _build(self) -> None:
        if not (np.isfinite(self.time_step) and self.time_step > 0.0):
            raise InputError(f"time_step is {self.time_step:g}: it must be positive, in seconds.")
        if self.dtype not in (torch.float64, torch.float32):
            raise InputError(f"dtype is {self.dtype}: choose torch.float64 or torch.float32.")
        if np.shape(self.gravity) != (3,) or not np.isfinite(self.gravity).all():
            raise InputError(f"gravity is {self.gravity}: it must be three finite accelerations, in m/s^2.")
        self.device = find_device(self.device)
        settings = SolverSettings(name=self.solver) if isinstance(self.solver, str) else self.solver
        tolerance = self.relative_tolerance
        self.settings = settings if tolerance is None else replace(settings, relative_tolerance=tolerance)
        self.method = make_integrator(self.integrator)
        body = self.body
        self.rest_positions = self.tensor(body.vertices)  # (N, 3) [m]
        self.fixed = torch.as_tensor(body.fixed_vertices, device=self.device)
        if len(self.fixed) == body.n_vertices:
            raise InputError("every vertex is fixed: leave some free to move.")
        if settings.name == "projective_dynamics" and len(body.coordinates.sliding):
            raise InputError("solver is projective_dynamics, which knows no symmetry planes: choose quasi_newton.")
        if self.integrator == "midpoint" and any(own.controls for _, own, _ in body.members):
            raise InputError("integrator is midpoint, by which rigid parts ring: choose implicit_euler or bdf2.")
        self._coordinates = DeviceCoordinates(body.coordinates, self.rest_positions)
        placed = place_energies(body, self.material)
        barriers = any(item.energy.is_barrier for item in placed)  # through which states must not pass
        if barriers and self.integrator == "midpoint":
            raise InputError(
                "integrator is midpoint, which extrapolates from the middle of a step and may penetrate: with contact, "
                "choose implicit_euler or bdf2."
            )
        if barriers and settings.name == "projective_dynamics":
            raise InputError(
                "solver is projective_dynamics, whose constant matrix knows no contact: choose quasi_newton."
            )
        where = (body, self._coordinates, self.rest_positions, self.method, self.time_step)
        self._energies = energies = EnergySet(placed, *where)
        eliminated = np.union1d(body.fixed_vertices, body.coordinates.dependent)  # vertices without unknowns
        sets = [points for item in placed for points in item.points]
        pattern = BlockPattern(body.vertices, eliminated, sets, body.coordinates.sliding)
        self._make_workspace = partial(
            Workspace, placed, body.coordinates, self.fixed, pattern, device=self.device, dtype=self.dtype
        )
        self.parameters: dict[str, Quantity] = {**energies.parameters, "gravity": _GRAVITY}
        self.constants: dict[str, Any] = {**energies.constants, "gravity": [list(self.gravity)]}
        self.counts = {**energies.counts, "gravity": 3}
        self.inputs, self.parts = energies.inputs, energies.parts
        self._workspaces: dict[tuple[int, int], Workspace] = {}
        self._checked_cells: list[bool] = []  # whether they are too coarse in the first equilibria
        self._attached_mass = self.tensor(body.attached_mass)
        self._built = True

    def __repr__(self) -> str:
        """Body, names of the materials' laws, time step, integrator, dtype and device."""
        laws = ", ".join(
            f"{name}: {type(m).__name__}" if name else type(m).__name__ for name, m in self.materials.items()
        )
        numbers = f"{1e3 * self.time_step:g} ms, {self.integrator}, {self.dtype}, {self.device}"
        return f"Simulator({self.body!r}, {laws or 'no material'}, {numbers})"

    @property
    def materials(self) -> dict[str, Material]:
        """Materials by name of region or body; a single material for all has an empty name."""
        return joined_names(self.material)

    def __setattr__(self, name: str, value: object) -> None:
        """Raises AttributeError once the simulator is built, because device data would not follow a change."""
        if getattr(self, "_built", False):
            raise AttributeError(f"cannot set {name}: a simulator is constant; dataclasses.replace makes another one.")
        object.__setattr__(self, name, value)

    def tensor(self, values: object) -> torch.Tensor:
        """Returns values with the simulator's device and dtype."""
        refuse_transforms(values)
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
        values, mass = self._energies.prepare(tensors)
        inertia, weight = mass.inertia + self._attached_mass, mass.weight + self._attached_mass
        return Constants(inertia, weight, tensors["gravity"], mass.damping, values)

    def workspace(self, batch: int) -> Workspace:
        """Returns the calling thread's buffers for a batch size, made at their first use, also in inference mode.

        Threads that have ended leave theirs to new ones, whose identifiers are the same.
        """
        key = get_ident(), batch
        if key not in self._workspaces:
            with lasting():
                workspace = self._make_workspace(batch=batch)
                shards = shards_of(batch, workspace.potential.device)
                workspace.shards += [(rows, self._make_workspace(batch=rows.stop - rows.start)) for rows in shards]
            self._workspaces[key] = workspace
        return self._workspaces[key]

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
        q_batch, v_batch = (x[None] if x.ndim == 2 else x for x in (positions, velocities))
        state = State(q_batch, v_batch)
        state.check(self.body.n_vertices, self.rest_positions)
        return state

    def step(
        self,
        state: State,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
        near: torch.Tensor | None = None,
    ) -> State:
        """Advances a batch by one time step.

        If the state has the positions at the end of the last step, the solver starts from an extrapolation of the last
        steps; otherwise the result is that of a new simulator.

        Args:
            state: state at the start.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).
            near: (B, N, 3) predicted positions at the end of the step, such as those of a motion with similar
                parameters; they affect the result only within the solver's tolerance [m].

        Returns:
            The new state, differentiable, with the solver's report.

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: the solver failed, if `SolverSettings.on_failure` is ``raise``.
        """
        inputs, constants = self._checked(state, inputs, parameters)
        if near is not None:
            check_tensor("near", near, tuple(state.q.shape), "m", "vertex", state.q)
        new = self._advance(state, inputs, constants, near)
        check_converged(self.settings, new.report, new.q)
        return new

    def _advance(self, state: State, inputs: Inputs, constants: Constants, near: torch.Tensor | None = None) -> State:
        """Returns the next state, whose solve may have failed."""
        step, workspace = self._step(state, inputs, constants), self.workspace(state.batch)
        terms, clamped, follows = self._energies.step_terms(step), self._fixed_at(step), workspace.follows(state.q)
        start = step.stage.target if near is None else self.method.solution_for(state, near).detach()
        x, report = equilibrium(workspace, "dynamics", self.settings, terms, start, clamped, follows)
        x = self._coordinates.expand(x)
        new = replace(self._finish(step, x), report=report)
        workspace.record_positions(new.q)
        return new

    def _step(self, state: State, inputs: Inputs, constants: Constants) -> SimulatorStep:
        """Returns a time step from a state."""
        terms = self.workspace(state.batch).potential.energies
        return SimulatorStep(state, self.method.stage(state, self.time_step), inputs, constants, terms)

    def _fixed_at(self, step: SimulatorStep) -> torch.Tensor:
        """Returns the positions (B, D, 3) of the fixed vertices at the stage [m]."""
        now, fixed = step.state.q[:, self.fixed], step.inputs.fixed_positions
        return now if fixed is None else now + step.stage.end * (fixed - now)

    def _finish(self, step: SimulatorStep, x: torch.Tensor) -> State:
        """Returns the new state from the solution x of the stage."""
        new = self.method.finish(step.state, x, self.time_step)
        new = replace(new, memory=self._energies.end_step(step, x, new.q))
        if step.stage.end == 1.0 or not len(self.fixed):
            return new
        # Prescribed motions have a known velocity; extrapolation from mid-step would oscillate.
        now, fixed = step.state.q[:, self.fixed], step.inputs.fixed_positions
        moved = torch.zeros_like(now) if fixed is None else fixed - now
        return replace(new, v=new.v.index_copy(1, self.fixed, moved / self.time_step))

    def remember(self, state: State, q: torch.Tensor, constants: Constants, inputs: Inputs | None = None) -> State:
        """Returns a state at given positions, with the memory variables after a step to these positions.

        Args:
            state: state at the start of the step.
            q: (B, N, 3) positions at its end [m].
            constants: constants from `prepare`.
            inputs: inputs during the step.
        """
        step = self._step(state, inputs or _NO_INPUTS, constants)
        return State(q, state.v, memory=self._energies.end_step(step, self.method.solution_for(state, q), q))

    def outside(self, q: torch.Tensor, state: State, constants: Constants) -> torch.Tensor:
        """Returns positions (B, N, 3) [m] pushed out of obstacles that stand still, for a step from there.

        Args:
            q: positions, of which some may be within an obstacle.
            state: nearby, out of all obstacles: vertices are pushed to their gap in it, or to half of the distance at
                which contact begins, whichever is less.
            constants: constants from `prepare`.

        Raises:
            InputError: the obstacles leave no place.
        """
        return self._energies.outside(q, state, constants)

    def contacts(
        self, state: State, after: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> dict[str, ContactForces]:
        """Returns gaps, forces, slides and sticking at the end of a step, differentiable.

        Args:
            state: state at the start of the step.
            after: state at its end.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).

        Returns:
            Contact with ``obstacles``, and that between ``surfaces``; of the body NAME of a scene, ``NAME_obstacles``
            and ``NAME_surfaces``.

        Raises:
            InputError: wrong shapes, or values that are not finite.
        """
        inputs, constants = self._checked(state, inputs, parameters)
        with self.workspace(state.batch).potential.lock:
            return self._energies.contacts(self._step(state, inputs, constants), after.q)

    def is_held(
        self, state: State, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> bool:
        """Returns whether loads have an equilibrium: vertices are fixed, or friction holds three in every environment.

        Args:
            state: positions in which vertices are pressed against obstacles.
            inputs: inputs, of which the poses of obstacles matter.
            parameters: parameters or prepared constants (`prepare`).
        """
        if len(self.fixed) or len(self.body.coordinates.sliding):
            return True
        with torch.no_grad():
            moved = replace(state, q=state.q + _SHIFT)
            contacts = self.contacts(state, moved, inputs, parameters).values()
            rubbing = [own.friction for own in contacts if own.obstacles]
            return any(bool(((own != 0.0).any(-1).any(-1).sum(-1) >= _HELD_BY).all()) for own in rubbing)

    def obstacle_motions(
        self, states: Sequence[State], parameters: Parameters | Constants | None = None
    ) -> tuple[ObstacleMotion, ...]:
        """Returns the motions of obstacles, if there are any, in successive states of a roll-out.

        Args:
            states: states, whose memory has the poses of obstacles that move.
            parameters: parameters or prepared constants (`prepare`).
        """
        return self._energies.obstacles(states, self.prepare(parameters))

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
        inputs, constants = self._checked(state, inputs, parameters)
        step, workspace = self._step(state, inputs, constants), self.workspace(state.batch)
        terms, clamped, finish = self._energies.step_terms(step), self._fixed_at(step), partial(self._finish, step)
        name = self.settings.linear_solver
        return Linearisation(workspace, terms, step.stage, clamped, self._coordinates, finish, name)

    def static_equilibrium(
        self,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
        start: torch.Tensor | None = None,
        batch: int | None = None,
        after: State | None = None,
    ) -> State:
        """Returns the static equilibrium under gravity and constant inputs, differentiable like a step.

        Friction without rate, as of `energies.hysteresis` and `energies.contact`, makes it depend on the poses before.
        The state that is returned has the memory of such energies; that of others is of a body long at rest.

        Args:
            inputs: constant inputs.
            parameters: parameters or prepared constants (`prepare`).
            start: (B, N, 3) initial guess [m]; the rest shape if omitted. If Newton's method does not converge from it
                in 100 iterations, loads, inputs and motion of the fixed vertices are increased in steps.
            batch: number of environments, if no other argument implies it.
            after: state that friction without rate continues, of the batch or of one environment; the undeformed body
                if omitted. Friction of contact acts against the slide since its positions, with the normal forces that
                it has there: to press a body and shear it, press first, then shear after that equilibrium.

        Raises:
            InputError: wrong shapes, values that are not finite, or a body that is not held (`is_held`) in ``after``.
            ConvergenceError: no equilibrium was found, or the body grows without bound, like an inflated one whose
                material cannot resist the pressure.

        Warns:
            ResphysWarning: linear cells that are too coarse for one of the first equilibria (`dynamics.mesh_error`).
        """
        inputs = self._fitted(inputs)
        constants = self.prepare(parameters)
        if batch is None:
            given = [*inputs.fields.values(), *([] if start is None else [start])]
            batch = max([len(t) for t in given] + [constants.batch] + ([] if after is None else [after.batch]))
        state = self.rest_state(batch) if after is None else after
        if state.batch == 1 < batch:
            state = state.map(lambda value: torch.cat([value] * batch))
        inputs, constants = self._checked(state, inputs, constants)
        if start is not None:
            check_tensor("start", start, tuple(state.q.shape), "m", "vertex", state.q)
        if not self.is_held(state, inputs, constants):
            raise InputError(
                "a body without fixed vertices has no static equilibrium: fix some vertices, or lay it on an obstacle "
                "with friction, within the distance of contact."
            )
        step = SimulatorStep.endless(state, inputs, constants, self.workspace(batch).potential.energies)
        solve = partial(self._balance, step)
        limited = self.settings.max_iterations < MOST_ITERATIONS
        rest = self.rest_positions.expand_as(state.q)
        guess = state.q.detach() if start is None else start.detach()
        if self._energies.follow_pose:
            try:
                x = find_equilibrium(partial(solve, near=guess), rest, guess, limited)
            except ConvergenceError:  # The guess is far away.
                x = find_equilibrium(solve, rest, guess, limited)
            x = settle(lambda near: solve(1.0, near.detach(), near)[0], x)
        else:
            x = find_equilibrium(solve, rest, guess, limited)
        if len(self._checked_cells) < CHECKED and True not in self._checked_cells:
            at = x[0].detach().double().cpu().numpy()
            self._checked_cells.append(warn_of_cells(self.body, self._energies.placed, at, constants.values))
        return self._resting(step, x)

    def linearise_equilibrium(
        self, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None, batch: int = 1
    ) -> Linearisation:
        """Returns the residual of a static equilibrium and its derivative, as `linearise` does for a step.

        Args:
            inputs: constant inputs.
            parameters: parameters or prepared constants (`prepare`).
            batch: number of environments.

        Raises:
            InputError: wrong shapes, values that are not finite, or forces that depend on the pose without a potential
                (`follows_pose`), whose derivative this is not.
        """
        if self.follows_pose:
            raise InputError("forces of this body depend on its pose without a potential: solve its equilibria.")
        state = self.rest_state(batch)
        inputs, constants = self._checked(state, inputs, parameters)
        workspace, stage = self.workspace(batch), self.method.stage(state, self.time_step)
        step = SimulatorStep.endless(state, inputs, constants, workspace.potential.energies)
        terms, clamp, finish = self._energies.rest_terms(step, 1.0), self._fixed_at(step), partial(self._resting, step)
        return Linearisation(workspace, terms, stage, clamp, self._coordinates, finish, self.settings.linear_solver)

    @property
    def follows_pose(self) -> bool:
        """Whether forces in a static equilibrium depend on its pose without a potential, as friction of tendons."""
        return self._energies.follow_pose

    def _resting(self, step: SimulatorStep, x: torch.Tensor) -> State:
        """Returns the state in an equilibrium (B, N, 3) after a state [m]."""
        return State(x, torch.zeros_like(x), memory=self._energies.end_step(step, x, x))

    def _balance(
        self, step: SimulatorStep, share: float, start: torch.Tensor, near: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, SolveReport]:
        """Returns the equilibrium (B, N, 3) [m] after a state, under a share of loads, inputs and the clamp's motion.

        Forces that depend on the pose without a potential are those ``near`` (B, N, 3); without, they are left out.
        """
        batch, fixed = step.state.batch, step.inputs.fixed_positions
        workspace, clamp = self.workspace(batch), self.rest_positions[self.fixed].expand(batch, -1, -1)
        most = min(self.settings.max_iterations, MOST_ITERATIONS)
        settings = replace(self.settings, name="newton", on_failure="raise", max_iterations=most)
        at = clamp if fixed is None else torch.lerp(clamp, fixed, share)
        terms = self._energies.rest_terms(step, share, near)
        with progress_of(workspace.parts[0][1].potential, share, most):
            x, report = equilibrium(workspace, "statics", settings, terms, start, at)
        check_converged(settings, report, x)
        return self._coordinates.expand(x), report

    def rollout(
        self, state: State, steps: int, inputs: Inputs | None = None, parameters: Parameters | Constants | None = None
    ) -> Motion:
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
        inputs = self._fitted(inputs, state.batch)
        inputs.check_steps(steps)
        constants = self.prepare(parameters)
        self._checked(state, inputs.at(0), constants)
        together, unchecked = 1 if state.q.device.type == "cpu" else _STEPS_TO_CHECK, list[State]()

        def check() -> None:
            for solved in unchecked:
                check_converged(self.settings, solved.report, solved.q)
            unchecked.clear()

        def step(before: State, now: Inputs) -> State:
            if now is not inputs:
                self._check_inputs(now, before.batch)
            unchecked.append(self._advance(before, now, constants))
            after = unchecked[-1]
            if len(unchecked) == together:
                check()
            return after

        states = rollout(step, state, inputs.by_step(steps), lambda reached: reached)
        check()
        return Motion.of(states, self.body, self.time_step, obstacles=self.obstacle_motions(states, constants))

    def _checked(
        self, state: State, inputs: Inputs | None, parameters: Parameters | Constants | None
    ) -> tuple[Inputs, Constants]:
        """Returns inputs and constants, or raises InputError if these or the state do not fit."""
        inputs, constants = self._fitted(inputs, state.batch), self.prepare(parameters)
        state.check(self.body.n_vertices, self.rest_positions)
        self._check_inputs(inputs, state.batch)
        constants.check_batch(state.batch)
        self._energies.check_memory(state.memory, state.batch, self.rest_positions)
        return inputs, constants

    def _fitted(self, inputs: Inputs | None, batch: int | None = None) -> Inputs:
        """Returns inputs with the simulator's device and dtype where they are numbers (`Inputs.fitted`)."""
        refuse_transforms()
        if inputs is None:
            return _NO_INPUTS
        if not isinstance(inputs, Inputs):
            raise InputError(f"the inputs are a {type(inputs).__name__}: give Inputs(external_force=...), say.")
        return inputs.fitted(self.counts, self.rest_positions, batch)

    def _check_inputs(self, inputs: Inputs, batch: int) -> None:
        """Raises InputError for inputs that do not fit."""
        accepted = {name: (quantity, self.counts[name]) for name, quantity in self.inputs.items()}
        inputs.check(accepted, batch, self.body.n_vertices, len(self.fixed), self.rest_positions)
