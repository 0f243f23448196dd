"""The implicit solve of a time step, and the state that follows from its solution."""

from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F

from ...io.errors import ConvergenceError
from ..energies.potential import StepTerms
from ..stepping.inputs import Inputs
from ..stepping.state import Constants, Reaction, SolveReport, State
from .energy_set import SimulatorStep
from .equations import EquationsOfMotion
from .equilibrium import equilibrium, reaction_of

_MOST_SETTLINGS = 100
_REMEDY = "the step does not settle: take a smaller time step or internal forces"
# Change of the positions, or of the gradient, relative to their size; or some roundings
_SETTLED = 1e-10


class TimeStep:
    """A time step from a state.

    Args:
        equations: the equations of motion.
        state: state at the start.
        inputs: inputs during the step.
        constants: constants of the energies.

    Attributes:
        workspace: the calling thread's buffers for the batch.
        step: the step as the energies see it.
    """

    _report: SolveReport  # of the last solve
    _gradient: torch.Tensor  # (B, D + R, 3) of the energies at the held vertices, at last [N]

    def __init__(
        self, equations: EquationsOfMotion, state: State, inputs: Inputs, constants: Constants
    ) -> None:
        self.equations, self.workspace = equations, equations.workspace(state.batch)
        self.step = self._begin(state, inputs, constants)

    def _begin(self, state: State, inputs: Inputs, constants: Constants) -> SimulatorStep:
        stage = self.equations.method.stage(state, self.equations.time_step)
        return SimulatorStep(state, stage, inputs, constants, self.workspace.potential.energies)

    def terms(self, *, near: torch.Tensor | None = None) -> StepTerms:
        """Returns the terms of the incremental potential, differentiable.

        Args:
            near: (B, N, 3) positions of the forces that depend on the pose; None: positions without
                forces [m].
        """
        return self.equations.energies.step_terms(self.step, near)

    def fixed_positions(self) -> torch.Tensor:
        """Returns the positions (B, D, 3) of the fixed vertices at the stage [m]."""
        now, fixed = self.step.state.q[:, self.equations.fixed], self.step.inputs.fixed_positions
        return now if fixed is None else now + self.step.stage.end * (fixed - now)

    def finish(self, x: torch.Tensor) -> State:
        """Returns the new state from the solution x (B, N, 3) of the stage."""
        step, equations = self.step, self.equations
        h = equations.time_step
        new = equations.method.finish(step.state, x, h)
        new = replace(new, memory=equations.energies.end_step(step, x, new.q))
        if step.stage.end == 1.0 or not len(equations.fixed):
            return new
        # Prescribed motions have a known velocity; extrapolation from mid-step would oscillate.
        now, fixed = step.state.q[:, equations.fixed], step.inputs.fixed_positions
        moved = torch.zeros_like(now) if fixed is None else fixed - now
        return replace(new, v=new.v.index_copy(1, equations.fixed, moved / h))

    def reaction(
        self,
        terms: StepTerms,
        x: torch.Tensor,
        gradient: torch.Tensor,
        missing: torch.Tensor | None = None,
    ) -> Reaction | None:
        """Returns the reaction at the held vertices, differentiable; None without such vertices.

        Internal forces have no part in its resultant (`fem.internal_forces`).

        Args:
            terms: of the potential.
            x: (B, N, 3) solution of the stage [m].
            gradient: (B, D + R, 3) of the energies at the held vertices there, as numbers [N].
            missing: (B, N, 3) internal force that the terms lack [N].
        """
        energies = self.equations.energies
        loads = energies.loads_at_fixed(terms, x)
        whole = replace(self.step, inputs=self.step.inputs.plus(missing, "internal"))
        internal = energies.internal_force(whole, x)
        reaction = self._at_known_velocity(reaction_of(self.workspace, terms, x, gradient, loads))
        return (
            reaction
            if reaction is None or internal is None
            else energies.internal.taken_up(reaction, internal, x)
        )

    def _at_known_velocity(self, reaction: Reaction | None) -> Reaction | None:
        """Returns the reaction with the inertia of fixed vertices,
        whose velocity V at the end is prescribed.

        The potential of a midpoint step has the acceleration 2 (V - v) / h of a vertex that moves
        by V h, as the velocity of a free vertex would then be 2 V - v at the end; that of a fixed
        one is V (`finish`).
        """
        step, fixed = self.step, self.equations.fixed
        if reaction is None or step.stage.end == 1.0:
            return reaction
        mass, inputs = step.constants.mass, step.inputs
        mass = mass if inputs.attached_mass is None else mass + inputs.attached_mass
        mass = mass[:, fixed, None]
        velocity = (reaction.places[:, : len(fixed)] - step.state.q[:, fixed]) / step.stage.step
        excess = mass * (velocity - step.state.v[:, fixed]) / self.equations.time_step
        sliding = reaction.forces.shape[1] - len(fixed)
        return replace(reaction, forces=reaction.forces - F.pad(excess, (0, 0, 0, sliding)))

    def solve(self, near: torch.Tensor | None = None) -> State:
        """Returns the new state, differentiable, whose report says whether the solve has converged.

        Args:
            near: (B, N, 3) predicted positions at the end of the step [m]; None: an extrapolation
                of the last steps.
        """
        equations, workspace = self.equations, self.workspace
        state = self.step.state
        start = (
            self.step.stage.target
            if near is None
            else equations.method.solution_for(state, near).detach()
        )
        if equations.energies.depends_on_pose(self.step):
            x = settle(self._minimised, start, _REMEDY)
            terms = self.terms(near=x)
        else:
            terms = self.terms()
            x = self._minimise(terms, start, workspace.follows(state.q))
        new = replace(
            self.finish(x), report=self._report, reaction=self.reaction(terms, x, self._gradient)
        )
        workspace.record_positions(new.q)
        return new

    def _minimise(
        self, terms: StepTerms, start: torch.Tensor, follows: torch.Tensor | None
    ) -> torch.Tensor:
        """Returns the solution (B, N, 3) [m].

        Sets its report, and the gradient at held vertices.
        """
        equations = self.equations
        arguments = equations.settings, terms, start, self.fixed_positions(), follows
        x, self._report, self._gradient = equilibrium(self.workspace, "dynamics", *arguments)
        return equations.coordinates.expand(x)

    def _minimised(self, at: torch.Tensor) -> torch.Tensor:
        """Returns the solution (B, N, 3) under forces at positions (B, N, 3),
        which stay where the solver fails [m].
        """
        x = self._minimise(self.terms(near=at), at.detach(), None)
        return torch.where(self._report.converged[:, None, None], x, at)


def settle(
    solve: Callable[[torch.Tensor], torch.Tensor], start: torch.Tensor, failure: str
) -> torch.Tensor:
    """Returns the fixed point x = solve(x), differentiable in everything
    that the function depends on.

    The gradient g by the solution fulfils g = w + (d solve / dx)^T g, for that of the loss w, and
    is found like the solution, by iteration.

    Args:
        solve: equilibrium (B, N, 3) under forces at given positions [m], near which it lies.
        start: (B, N, 3) initial guess [m].
        failure: what the error says.

    Raises:
        ConvergenceError: the iteration does not converge.
    """
    with torch.no_grad():
        x = _repeated(solve, start.detach(), failure)
    if not torch.is_grad_enabled():
        return x
    solution = solve(x)
    if not solution.requires_grad:
        return solution
    near = x.clone().requires_grad_()
    again = solve(near)

    def through(gradient: torch.Tensor) -> torch.Tensor:
        def more(total: torch.Tensor) -> torch.Tensor:
            return gradient + torch.autograd.grad(again, near, total, retain_graph=True)[0]

        return _repeated(more, gradient, failure)

    solution.register_hook(through)
    return solution


def _repeated(
    function: Callable[[torch.Tensor], torch.Tensor], x: torch.Tensor, failure: str
) -> torch.Tensor:
    """Returns the limit of repeated calls of a function, or raises ConvergenceError."""
    settled = max(_SETTLED, 16.0 * torch.finfo(x.dtype).eps)
    for _ in range(_MOST_SETTLINGS):
        previous, x = x, function(x)
        if bool((x - previous).norm() <= settled * x.norm()):
            return x
    raise ConvergenceError(f"{failure}.", x, None)
