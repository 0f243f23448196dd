"""The implicit solve of a time step, and the state that follows from its solution."""

from dataclasses import replace

import torch
import torch.nn.functional as F

from ..energies.potential import StepTerms
from ..stepping.inputs import Inputs
from ..stepping.state import Constants, Reaction, State
from .energy_set import SimulatorStep
from .equations import EquationsOfMotion
from .equilibrium import equilibrium, reaction_of


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

    def __init__(self, equations: EquationsOfMotion, state: State, inputs: Inputs, constants: Constants) -> None:
        self.equations, self.workspace = equations, equations.workspace(state.batch)
        self.step = self._begin(state, inputs, constants)

    def _begin(self, state: State, inputs: Inputs, constants: Constants) -> SimulatorStep:
        stage = self.equations.method.stage(state, self.equations.time_step)
        return SimulatorStep(state, stage, inputs, constants, self.workspace.potential.energies)

    def terms(self) -> StepTerms:
        """Returns the terms of the incremental potential, differentiable."""
        return self.equations.energies.step_terms(self.step)

    def fixed_positions(self) -> torch.Tensor:
        """Returns the positions (B, D, 3) of the fixed vertices at the stage [m]."""
        now, fixed = self.step.state.q[:, self.equations.fixed], self.step.inputs.fixed_positions
        return now if fixed is None else now + self.step.stage.end * (fixed - now)

    def finish(self, x: torch.Tensor) -> State:
        """Returns the new state from the solution x (B, N, 3) of the stage."""
        step, equations, h = self.step, self.equations, self.equations.time_step
        new = equations.method.finish(step.state, x, h)
        new = replace(new, memory=equations.energies.end_step(step, x, new.q))
        if step.stage.end == 1.0 or not len(equations.fixed):
            return new
        # Prescribed motions have a known velocity; extrapolation from mid-step would oscillate.
        now, fixed = step.state.q[:, equations.fixed], step.inputs.fixed_positions
        moved = torch.zeros_like(now) if fixed is None else fixed - now
        return replace(new, v=new.v.index_copy(1, equations.fixed, moved / h))

    def reaction(self, terms: StepTerms, x: torch.Tensor, gradient: torch.Tensor) -> Reaction | None:
        """Returns the reaction at the held vertices, differentiable; None without such vertices.

        Args:
            terms: of the potential.
            x: (B, N, 3) solution of the stage [m].
            gradient: (B, D + R, 3) of the energies at the held vertices there, as numbers [N].
        """
        loads = self.equations.energies.loads_at_fixed(terms, x)
        return self._at_known_velocity(reaction_of(self.workspace, terms, x, gradient, loads))

    def _at_known_velocity(self, reaction: Reaction | None) -> Reaction | None:
        """Returns the reaction with the inertia of fixed vertices, whose velocity V at the end is prescribed.

        The potential of a midpoint step has the acceleration 2 (V - v) / h of a vertex that moves by V h, as the
        velocity of a free vertex would then be 2 V - v at the end; that of a fixed one is V (`finish`).
        """
        step, fixed = self.step, self.equations.fixed
        if reaction is None or step.stage.end == 1.0:
            return reaction
        mass, inputs = step.constants.mass, step.inputs
        mass = (mass if inputs.attached_mass is None else mass + inputs.attached_mass)[:, fixed, None]
        velocity = (reaction.places[:, : len(fixed)] - step.state.q[:, fixed]) / step.stage.step
        excess = mass * (velocity - step.state.v[:, fixed]) / self.equations.time_step
        sliding = reaction.forces.shape[1] - len(fixed)
        return replace(reaction, forces=reaction.forces - F.pad(excess, (0, 0, 0, sliding)))

    def solve(self, near: torch.Tensor | None = None) -> State:
        """Returns the new state, differentiable, whose report says whether the solve has converged.

        Args:
            near: (B, N, 3) predicted positions at the end of the step [m]; None: an extrapolation of the last steps.
        """
        equations, workspace, state = self.equations, self.workspace, self.step.state
        start = self.step.stage.target if near is None else equations.method.solution_for(state, near).detach()
        terms, fixed, follows = self.terms(), self.fixed_positions(), workspace.follows(state.q)
        x, report, gradient = equilibrium(workspace, "dynamics", equations.settings, terms, start, fixed, follows)
        whole = equations.coordinates.expand(x)
        new = replace(self.finish(whole), report=report, reaction=self.reaction(terms, whole, gradient))
        workspace.record_positions(new.q)
        return new
