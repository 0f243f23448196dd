"""Batched, differentiable simulation of a body."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from numpy.typing import ArrayLike

from ...io.errors import InputError, checks_methods
from ...io.machine import find_device
from ...io.settings import parse
from ..energies.contact.barrier import ContactForces
from ..energies.materials import Corotated, Material
from ..fem.bodies import Body
from ..fem.coordinates import SymmetryPlane
from ..stepping.inputs import Inputs, check_tensor
from ..stepping.rollout import rollout
from ..stepping.state import Constants, Reaction, State
from .energy_set import Materials, joined_names
from .equations import EquationsOfMotion, check_count
from .linearisation import Linearisation
from .mesh_error import CellCheck
from .nonlinear_solver import ConvergenceCheck, check_converged
from .plausibility import warn_of_implausible
from .solver_settings import SolverSettings
from .statics import SHIFT, StaticEquilibrium, friction_holds
from .time_step import TimeStep
from .trajectory import Motion
from .workspace import Workspace

GRAVITY = (0.0, 0.0, -9.80709)

Parameters = Mapping[str, Any]


@checks_methods("rollout", "reaction", "static_equilibrium", "is_held")
@dataclass
class Simulator:
    """Simulates a body over time.

    Several threads may use a simulator: each has its own buffers. On a GPU they take turns, after a
    first step in one thread. It can be copied and pickled.

    Args:
        body: a body, or a `fem.scene.Scene` of several bodies.
        material: material of the body, or materials by region of the mesh, or by body of a scene.
            Methods accept other values of the constants by name (``parameters``); those of a region
            or body are prefixed with its name, as in ``tip_youngs_modulus``.
        time_step: h [s].
        gravity: acceleration (3,) [m/s^2].
        integrator: ``implicit_euler``, ``bdf2`` or ``midpoint``.
        solver: a name, or `SolverSettings`.
        relative_tolerance: shorthand for that field of the settings.
        device: a torch device.
        dtype: ``torch.float64``, or ``torch.float32`` for states, loads and factors. Forces are
            evaluated in float64 in both cases, as in single precision those of a nearly
            incompressible solid have no correct digit. With a relative tolerance of 1e-5 a float32
            step is as accurate as its positions, 4e-9 m for a beam of 0.1 m.

    Raises:
        InputError: a time step that is not positive, an unknown integrator or solver, or a missing
            CUDA device.

    Warns:
        ResphysWarning: a size, a material or a gravity that looks like a wrong unit, a cell that is
            nearly flat, or so many unknowns that steps are slow (`dynamics.plausibility`).

    Attributes:
        parameters: parameters by name: constants of the materials and energies, and ``gravity``
            (B, 3).
        inputs: inputs of the energies by name.
        counts: number of values of an input or a parameter per environment, by name.
        parts: names of the parts, such as tendons, for which a parameter may have values, by the
            parameter's name.
        defaults: default values of the parameters.
        energies: all energies of the body as one (`dynamics.energy_set`).
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
        warn_of_implausible(
            self.body, self.materials, self.gravity, self.rest_positions.device.type == "cpu"
        )

    def __getstate__(self) -> dict[str, Any]:
        """Returns the arguments, of which a copy is built: buffers,
        factors and Warp's arrays belong to a process.
        """
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Builds a copy from its arguments."""
        vars(self).update(state)
        self._build()

    def _build(self) -> None:
        self.device = find_device(self.device)
        chosen = {"name": self.solver} if isinstance(self.solver, str) else self.solver
        own = (
            {}
            if self.relative_tolerance is None
            else {"relative_tolerance": self.relative_tolerance}
        )
        self.settings = parse(SolverSettings, chosen, "solver").changed(**own)
        self._equations = equations = EquationsOfMotion(
            self.body,
            self.material,
            self.gravity,
            self.time_step,
            self.integrator,
            self.settings,
            {"device": self.device, "dtype": self.dtype},
        )
        self.method = equations.method
        self.rest_positions, self.fixed = equations.rest_positions, equations.fixed
        self.parameters, self.defaults = equations.parameters, equations.defaults
        self.counts = equations.counts
        self.energies = equations.energies
        self.inputs, self.parts = self.energies.inputs, self.energies.parts
        self._check_cells = CellCheck(self.body, self.energies.placed)
        self._built = True

    def __repr__(self) -> str:
        """Body, names of the materials' laws, time step, integrator, dtype and device."""
        laws = ", ".join(
            f"{name}: {type(m).__name__}".removeprefix(": ") for name, m in self.materials.items()
        )
        numbers = f"{1e3 * self.time_step:g} ms, {self.integrator}, {self.dtype}, {self.device}"
        return f"Simulator({self.body!r}, {laws or 'no material'}, {numbers})"

    @property
    def materials(self) -> dict[str, Material]:
        """Materials by name of region or body; a single material for all has an empty name."""
        return joined_names(self.material)

    def __setattr__(self, name: str, value: object) -> None:
        """Raises AttributeError once the simulator is built,
        because device data would not follow a change.
        """
        if getattr(self, "_built", False):
            raise AttributeError(
                f"cannot set {name}: a simulator is constant; "
                "dataclasses.replace makes another one."
            )
        object.__setattr__(self, name, value)

    def tensor(self, values: object) -> torch.Tensor:
        """Returns values with the simulator's device and dtype."""
        return self._equations.tensor(values)

    def prepare(self, parameters: Parameters | Constants | None = None) -> Constants:
        """Computes stiffness, mass and weight from parameters.

        Pass the result to `step` to do so only once.

        Args:
            parameters: values that replace the defaults, by name: numbers, (M,) tensors with one
                value per element (or chamber), (B, 1) with one per environment, or (B, M). Prepared
                constants are returned unchanged.

        Raises:
            InputError: an unknown name, a value out of range, or a wrong number of values.
        """
        return self._equations.prepare(parameters)

    def workspace(self, batch: int) -> Workspace:
        """Returns the calling thread's buffers for a batch size (`EquationsOfMotion.workspace`)."""
        return self._equations.workspace(batch)

    def rest_state(self, batch: int = 1) -> State:
        """Returns the undeformed body at rest, for a batch of one or more environments."""
        return self._equations.rest_state(batch)

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

        If the state has the positions at the end of the last step, the solver starts from an
        extrapolation of the last steps; otherwise the result is that of a new simulator.

        Args:
            state: state at the start.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).
            near: (B, N, 3) predicted positions at the end of the step, such as those of a motion
                with similar parameters; they affect the result only within the solver's tolerance
                [m].

        Returns:
            The new state, differentiable, with the solver's report and the reaction at fixed
            vertices.

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: the solver failed, if `SolverSettings.on_failure` is ``raise``.
        """
        if near is not None:
            check_tensor("near", near, tuple(state.q.shape), "m", "vertex", state.q)
        new = self._time_step(state, inputs, parameters).solve(near)
        check_converged(self.settings, new.report, new.q)
        return new

    def _time_step(
        self, state: State, inputs: Inputs | None, parameters: Parameters | Constants | None
    ) -> TimeStep:
        """Returns a time step, or raises InputError if state, inputs or parameters do not fit."""
        return TimeStep(self._equations, state, *self._equations.checked(state, inputs, parameters))

    def remember(
        self, state: State, q: torch.Tensor, constants: Constants, inputs: Inputs | None = None
    ) -> State:
        """Returns a state at given positions, with the memory variables
        after a step to these positions.

        Args:
            state: state at the start of the step.
            q: (B, N, 3) positions at its end [m].
            constants: constants from `prepare`.
            inputs: inputs during the step.
        """
        step = TimeStep(self._equations, state, inputs or Inputs(), constants).step
        return State(
            q, state.v, memory=self.energies.end_step(step, self.method.solution_for(state, q), q)
        )

    def contacts(
        self,
        state: State,
        after: State,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> dict[str, ContactForces]:
        """Returns gaps, forces, slides and sticking at the end of a step, differentiable.

        Contact is with ``obstacles`` and between ``surfaces``, ``NAME_obstacles`` of the body NAME
        of a scene.

        Args:
            state: state at the start of the step.
            after: state at its end.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).

        Raises:
            InputError: wrong shapes, or values that are not finite.
        """
        problem = self._time_step(state, inputs, parameters)
        with problem.workspace.potential.lock:
            return self.energies.contacts(problem.step, after.q)

    def reaction(
        self,
        state: State | Motion,
        at: str | SymmetryPlane | ArrayLike | None = None,
        before: State | None = None,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> Reaction:
        """Returns what holds a body in the step or equilibrium that led to a state, differentiable.

        Args:
            state: state from `step` or `static_equilibrium`, or a motion from `rollout`, of which
                it is for every step.
            at: fixed vertices: a region of the mesh or a body of a scene, with vertices that it
                shares with others, or numbers; a symmetry plane, without fixed vertices in it;
                None: all of these; or an obstacle.
            before: for an obstacle, the state at the start of the step; None: the state is an
                equilibrium.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).

        Raises:
            InputError: no step led to the state, or nothing holds the body there.
        """
        if isinstance(at, str) and isinstance(state, State) and at in self.energies.obstacle_names:
            contacts = self.contacts(before or state, state, inputs, parameters).values()
            return Reaction.join(
                [contact.reaction(at) for contact in contacts if at in contact.obstacles]
            )
        if state.reaction is None:
            copied = "or it is a copy, as by `detach`: it has no reaction."
            raise InputError(
                f"no step of a body with fixed vertices or symmetry planes led to this, {copied}"
            )
        if isinstance(at, SymmetryPlane):
            return state.reaction.along(at.normal, *self.body.sliding_in(at))
        at = self.body.fixed_in(at) if isinstance(at, str) else at
        return state.reaction if at is None else state.reaction.at(at)

    def is_held(
        self,
        state: State,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> bool:
        """Returns whether loads have an equilibrium: vertices are fixed,
        or friction holds three in every environment.

        Args:
            state: positions in which vertices are pressed against obstacles.
            inputs: inputs, of which the poses of obstacles matter.
            parameters: parameters or prepared constants (`prepare`).
        """
        if len(self.fixed) or len(self.body.coordinates.sliding):
            return True
        with torch.no_grad():
            moved = replace(state, q=state.q + SHIFT)
            return friction_holds(self.contacts(state, moved, inputs, parameters).values())

    def linearise(
        self,
        state: State,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> Linearisation:
        """Returns the residual of a step and its derivative at any positions.

        Args:
            state: state at the start of the step.
            inputs: inputs during the step.
            parameters: parameters or prepared constants (`prepare`).

        Raises:
            InputError: wrong shapes, or values that are not finite.
        """
        return Linearisation(self._time_step(state, inputs, parameters))

    def static_equilibrium(
        self,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
        start: torch.Tensor | None = None,
        batch: int | None = None,
        after: State | None = None,
    ) -> State:
        """Returns the static equilibrium under gravity and constant inputs,
        differentiable like a step.

        Friction of contact makes it depend on the poses before. The state has the memory of
        contact; that of other energies is of a body long at rest.

        Args:
            inputs: constant inputs.
            parameters: parameters or prepared constants (`prepare`).
            start: (B, N, 3) initial guess [m]; the rest shape if omitted. If Newton's method does
                not converge from it in 100 iterations, loads, inputs and motion of the fixed
                vertices are increased in steps.
            batch: number of environments, if no other argument implies it.
            after: state that contact continues, of the batch or of one environment; the undeformed
                body if omitted. Friction acts against the slide since its positions, with the
                normal forces that it has there: to press a body and shear it, press first, then
                shear after that equilibrium.

        Raises:
            InputError: wrong shapes, values that are not finite, or a body that is not held
                (`is_held`) in ``after``.
            ConvergenceError: no equilibrium was found, or the body grows without bound, like an
                inflated one whose material cannot resist the pressure.

        Warns:
            ResphysWarning: linear cells that are too coarse for one of the first equilibria
                (`dynamics.mesh_error`).
        """
        inputs, constants = self._equations.fitted(inputs), self.prepare(parameters)
        state = self._equations.before_equilibrium(inputs, constants, start, batch, after)
        inputs, constants = self._equations.checked(state, inputs, constants)
        if start is not None:
            check_tensor("start", start, tuple(state.q.shape), "m", "vertex", state.q)
        if not self.is_held(state, inputs, constants):
            raise InputError(
                "a body without fixed vertices has no static equilibrium: fix some vertices, or "
                "lay it on an obstacle with friction, within the distance of contact."
            )
        balanced = StaticEquilibrium(self._equations, state, inputs, constants).solve(start)
        self._check_cells(balanced.q, constants.values)
        return balanced

    def linearise_equilibrium(
        self,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
        batch: int = 1,
    ) -> Linearisation:
        """Returns the residual of a static equilibrium and its derivative,
        as `linearise` does for a step.

        Args:
            inputs: constant inputs.
            parameters: parameters or prepared constants (`prepare`).
            batch: number of environments.

        Raises:
            InputError: wrong shapes, values that are not finite, or forces that depend on the pose
                without a potential (`EnergySet.follow_pose`), whose derivative this is not.
        """
        if self.energies.follow_pose:
            raise InputError(
                "forces of this body depend on its pose without a potential: solve its equilibria."
            )
        state = self.rest_state(batch)
        inputs, constants = self._equations.checked(state, inputs, parameters)
        return Linearisation(StaticEquilibrium(self._equations, state, inputs, constants))

    def rollout(
        self,
        state: State,
        steps: int,
        inputs: Inputs | None = None,
        parameters: Parameters | Constants | None = None,
    ) -> Motion:
        """Simulates several time steps.

        For the gradient, states and terms of each step are kept, but no factors: the adjoint of a
        step recomputes its Hessian from the final state of the step.

        Args:
            state: initial state.
            steps: number of steps T.
            inputs: inputs, constant or with a time axis.
            parameters: parameters or prepared constants (`prepare`).

        Raises:
            InputError: wrong shapes, or values that are not finite.
            ConvergenceError: as in `step`.
        """
        check_count("steps", steps)
        inputs = self._equations.fitted(inputs, state.batch)
        inputs.check_steps(steps)
        constants = self.prepare(parameters)
        self._equations.checked(state, inputs.at(0), constants)
        check = ConvergenceCheck(self.settings)

        def step(before: State, now: Inputs) -> State:
            if now is not inputs:
                self._equations.check_inputs(now, before.batch)
            return check.add(TimeStep(self._equations, before, now, constants).solve())

        states = rollout(step, state, inputs.by_step(steps), lambda reached: reached)
        check.finish()
        return Motion.of(
            states, self.body, self.time_step, obstacles=self.energies.obstacles(states, constants)
        )
