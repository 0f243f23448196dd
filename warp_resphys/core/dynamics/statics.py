"""Static equilibria, under gradually increasing loads
where Newton's method does not converge under all of them.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import torch
from typing_extensions import override

from ...io.errors import ConvergenceError
from ...io.progress import QUIET_SECONDS, Progress
from ..energies.contact.barrier import ContactForces
from ..energies.potential import IncrementalPotential, StepTerms
from ..stepping.inputs import Inputs
from ..stepping.state import Constants, SolveReport, State
from .energy_set import SimulatorStep
from .equilibrium import equilibrium
from .nonlinear_solver import check_converged
from .time_step import TimeStep, settle

log = logging.getLogger(__name__)

_MOST_ITERATIONS = 100  # of Newton's method; a few suffice from a good start
SHIFT = 1e-6  # m, along every axis, against which friction acts that is to hold a body
_HELD_BY = 3  # vertices with friction, against all displacements and turns
_MOST_LENGTHS = 100.0  # largest displacement, in lengths of the body
_REMEDY = "the equilibrium does not settle: lower the friction, the tension or the internal forces"
_EXACT = 1e-10  # relative tolerance of an equilibrium, whose reactions balance its loads as exactly
_LEAST_SHARE = 1.0 / 64.0  # smallest load increment, as a fraction of the loads

Solve = Callable[[float, torch.Tensor], tuple[torch.Tensor, SolveReport]]


class StaticEquilibrium(TimeStep):
    """A static equilibrium under constant inputs after a state:
    a step without end, in which inertia has no part.
    """

    @override
    def _begin(self, state: State, inputs: Inputs, constants: Constants) -> SimulatorStep:
        return SimulatorStep.endless(state, inputs, constants, self.workspace.potential.energies)

    @override
    def terms(self, share: float = 1.0, *, near: torch.Tensor | None = None) -> StepTerms:
        """Returns the terms of the potential under a share of the loads.

        Args:
            share: of the loads and the inputs.
            near: (B, N, 3) positions of the forces that depend on the pose without a potential;
                None: without them [m].
        """
        return self.equations.energies.rest_terms(self.step, share, near)

    @override
    def fixed_positions(self, share: float = 1.0) -> torch.Tensor:
        """Returns the positions (B, D, 3) of the fixed vertices
        after a share of their motion from the rest shape.
        """
        equations, moved = self.equations, self.step.inputs.fixed_positions
        clamp = equations.rest_positions[equations.fixed].expand(self.step.state.batch, -1, -1)
        return clamp if moved is None else torch.lerp(clamp, moved, share)

    @override
    def finish(self, x: torch.Tensor) -> State:
        return State(
            x, torch.zeros_like(x), memory=self.equations.energies.end_step(self.step, x, x)
        )

    def _solved(self, x: torch.Tensor) -> State:
        """Returns the state of the last `_balance`, with its reaction."""
        terms = self.terms(near=x if self._follows_pose else None)
        return replace(self.finish(x), reaction=self.reaction(terms, x, self._gradient))

    @override
    def solve(self, near: torch.Tensor | None = None) -> State:
        """Returns the state in equilibrium, differentiable.

        Args:
            near: (B, N, 3) initial guess [m]; None: the state before.

        Raises:
            ConvergenceError: no equilibrium was found, or the body grows without bound.
        """
        equations, state = self.equations, self.step.state
        limited = equations.settings.max_iterations < _MOST_ITERATIONS
        rest = equations.rest_positions.expand_as(state.q)
        guess = (state.q if near is None else near).detach()
        if not self._follows_pose:
            return self._solved(find_equilibrium(self._balance, rest, guess, limited))
        try:
            x = find_equilibrium(partial(self._balance, near=guess), rest, guess, limited)
        except ConvergenceError:  # The guess is far away.
            x = find_equilibrium(self._balance, rest, guess, limited)
        return self._solved(settle(lambda at: self._balance(1.0, at.detach(), at)[0], x, _REMEDY))

    @property
    def _follows_pose(self) -> bool:
        energies = self.equations.energies
        return energies.follow_pose or energies.depends_on_pose(self.step)

    def _balance(
        self, share: float, start: torch.Tensor, near: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, SolveReport]:
        """Returns the equilibrium (B, N, 3) [m] under a share of loads,
        inputs and the motion of the fixed vertices.
        """
        equations, workspace = self.equations, self.workspace
        most = min(equations.settings.max_iterations, _MOST_ITERATIONS)
        settings = equations.settings.changed(
            name="newton", on_failure="raise", max_iterations=most
        )
        if equations.rest_positions.dtype == torch.float64:
            # Newton's method gets there in about one iteration more.
            settings = settings.changed(relative_tolerance=min(settings.relative_tolerance, _EXACT))
        terms, fixed = self.terms(share, near=near), self.fixed_positions(share)
        with _progress_of(workspace.parts[0][1].potential, share, most):
            x, report, self._gradient = equilibrium(
                workspace, "statics", settings, terms, start, fixed
            )
        check_converged(settings, report, x)
        return equations.coordinates.expand(x), report


def friction_holds(contacts: Iterable[ContactForces]) -> bool:
    """Returns whether friction with obstacles holds three vertices
    or more in every environment, after a `SHIFT`.
    """
    rubbing = [contact.friction != 0.0 for contact in contacts if contact.obstacles]
    return any(bool((vertices.any(-1).any(-1).sum(-1) >= _HELD_BY).all()) for vertices in rubbing)


@contextmanager
def _progress_of(potential: IncrementalPotential, share: float, most: int) -> Iterator[None]:
    """Shows the iterations of a solve that takes longer than two seconds,
    with the residual over balancing forces.

    Args:
        potential: that is minimised.
        share: of the loads.
        most: number of iterations after which the solve fails.
    """
    under = "" if share == 1.0 else f" under {share:.0%} of the loads"
    before = potential.on_direction
    with Progress(
        f"static equilibrium{under}", most, "iterations at most", after=QUIET_SECONDS
    ) as progress:

        def advance() -> None:
            progress.advance(residual=float((potential.residual_norm / potential.balance).max()))

        potential.on_direction = advance
        try:
            yield
        finally:
            potential.on_direction = before


def find_equilibrium(
    solve: Solve, rest: torch.Tensor, start: torch.Tensor, limited: bool
) -> torch.Tensor:
    """Returns the equilibrium (B, N, 3) under all loads, differentiable [m].

    Args:
        solve: returns the equilibrium under a fraction of the loads, from an initial guess.
        rest: (B, N, 3) equilibrium without loads [m].
        start: (B, N, 3) initial guess [m].
        limited: whether a configured limit of iterations may be the cause of a failure.

    Raises:
        ConvergenceError: no equilibrium was found, or the body grows without bound.
    """
    try:
        x, report = solve(1.0, start)
    except ConvergenceError as error:
        log.debug("the equilibrium is computed under gradually increasing loads: %s", error)
        with torch.no_grad():
            near = _ramp_loads(solve, rest, error if limited else None)
        x, report = solve(1.0, near)
    length = float((rest[0].amax(0) - rest[0].amin(0)).max())
    grown = ~((x.detach() - rest).abs().flatten(1).amax(1) < _MOST_LENGTHS * length)
    if bool(grown.any()):
        raise ConvergenceError(
            f"{int(grown.sum())} of {len(x)} bodies have no equilibrium under these loads: they "
            f"grow to more than {_MOST_LENGTHS:g} times their size; lower the loads, or take a "
            "stiffer material.",
            x.detach(),
            replace(report, converged=report.converged & ~grown),
        )
    return x


def _ramp_loads(solve: Solve, rest: torch.Tensor, limit: ConvergenceError | None) -> torch.Tensor:
    """Returns the equilibrium (B, N, 3) reached by increasing the loads
    from zero in steps, or raises ``limit``.
    """
    done, step = 0.0, 0.5
    x = rest
    while done < 1.0:
        share = min(done + step, 1.0)
        try:
            x, _ = solve(share, x)
        except ConvergenceError as error:
            step *= 0.5
            if step < _LEAST_SHARE and limit is not None:
                raise limit from None
            if step < _LEAST_SHARE:
                raise ConvergenceError(
                    "no equilibrium was found: under growing loads it is lost beyond "
                    f"{100.0 * done:.0f} % of them; lower the loads, or take a stiffer material.",
                    x,
                    error.report,
                ) from None
        else:
            done = share
    return x
