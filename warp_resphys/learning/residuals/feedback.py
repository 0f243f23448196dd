"""Equilibria under a force that depends on the state, such as a learned one.

They are fixed points of equilibria under constant forces, which Anderson's acceleration finds.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ...core.dynamics.simulator import Constants, Simulator
from ...core.stepping.inputs import Inputs
from ...core.stepping.state import State
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError
from .correction import acts_of

log = logging.getLogger(__name__)

_ITERATIONS = 50
# Change of positions at which the iteration ends [m].
_AIMS = {torch.float64: 1e-11, torch.float32: 1e-8}
_TOLERANCE = 1e-8  # change of positions that is enough where they come no closer [m]
_PATIENCE = (
    20  # iterations without progress, after which the search ends; of positions that rest, a few
)
_MEMORY = 6  # iterations that are combined
_RIDGE = 1e-12
_MOST_STEPS = 300  # of a motion after which a body must nearly rest
_RESTS = 1e-6  # motion in a step of a body that nearly rests [m]
_SETTLED = 1e-9  # relative residual of a gradient


def equilibrium_under_feedback(
    simulator: Simulator,
    inputs: Inputs,
    constants: Constants,
    guess: State,
    predict: Callable[[State, int], Any],
) -> State:
    """Returns the state of rest under constant inputs and a force (B, N, 3) [N]
    that depends on the state.

    It is the fixed point of equilibria under constant forces. Each iteration evaluates the force,
    solves the equilibrium under it and accelerates the sequence of positions. It ends when no
    position moves by more than 1e-11 m, in single precision 1e-8 m, or at once where the force does
    not depend on the positions. Where the iteration stalls, the body first moves until it nearly
    rests.

    For a loss with the gradient w by the fixed point x = S(x), that by what S depends on besides x
    is that of S for g = w + (dS/dx)^T g.

    Args:
        simulator: of the body.
        inputs: constant inputs beside the force.
        constants: see `Simulator.prepare`.
        guess: initial guess.
        predict: predictor of the force, called with step zero.

    Raises:
        ConvergenceError: there is no equilibrium, or none is found; the report says which
            environments rest, (B,).
    """
    problem = _Feedback(simulator, inputs, constants, predict)
    with torch.no_grad():
        found, rests = problem.iterate(guess)
        if not bool(rests.all()):
            try:
                found, rests = problem.iterate(problem.relaxed(found))
            except ConvergenceError:
                log.debug(
                    "the body does not come to rest: a step or an equilibrium on the way failed"
                )
    if not bool(rests.all()):
        count = f"{int((~rests).sum())} of {len(rests)} poses"
        raise ConvergenceError(
            f"{count} and the force that depends on them did not settle: the force is too large "
            "to be a correction.",
            found.q,
            rests,
        )
    if not torch.is_grad_enabled():
        return found
    solution = problem.solve(found.detach())
    if not solution.q.requires_grad:
        return solution
    near = found.q.clone().requires_grad_()
    again = problem.solve(State(near, found.v)).q

    def through(gradient: torch.Tensor) -> torch.Tensor:
        return problem.adjoint(gradient, near, again)

    solution.q.register_hook(through)
    return problem.solve(State(solution.q, found.v))


class _Feedback:
    """Equilibria under forces of given states (arguments: `equilibrium_under_feedback`)."""

    def __init__(
        self,
        simulator: Simulator,
        inputs: Inputs,
        constants: Constants,
        predict: Callable[[State, int], Any],
    ) -> None:
        self._simulator = simulator
        self._inputs = inputs
        self._constants = constants
        self._predict, self._acts = predict, acts_of(predict)
        self._aim = _AIMS[simulator.dtype]

    def solve(self, state: State) -> State:
        """Returns the equilibrium under the force in a state."""
        return self._under(self._predict(state, 0), state)

    def _under(self, force: torch.Tensor, state: State) -> State:
        """Returns the equilibrium under a force (B, N, 3) [N], near a state."""
        acting = self._inputs.plus(force, self._acts)
        return self._simulator.static_equilibrium(acting, self._constants, start=state.q.detach())

    def iterate(self, state: State) -> tuple[State, torch.Tensor]:
        """Returns the equilibria that changed least in the iteration,
        and (B,) bool, which environments rest there.
        """
        acceleration, stalled = _AndersonAcceleration(), 0
        best = solution = state
        smallest = state.q.new_full((state.batch,), torch.inf)
        current: torch.Tensor | None = None
        for _ in range(_ITERATIONS):
            previous, current = current, self._predict(state, 0)
            constant = previous is not None and torch.equal(current, previous)
            if constant and torch.equal(self._predict(solution, 0), current):
                return solution, torch.ones_like(smallest, dtype=torch.bool)
            solution = self._under(current, state)
            change = solution.q - state.q
            size = change.abs().amax((1, 2))
            closer = size < smallest
            best, smallest = solution.where(closer, best), torch.minimum(size, smallest)
            stalled = 0 if bool((closer & (size >= self._aim)).any()) else stalled + 1
            rests = smallest < _TOLERANCE
            patience = _PATIENCE // 5 if bool(rests.all()) else _PATIENCE
            if bool((smallest < self._aim).all()) or stalled >= patience:
                break
            state = State(acceleration.next(state.q, change), state.v)
        return best, smallest < _TOLERANCE

    def relaxed(self, state: State) -> State:
        """Returns the state in which the body rests
        after moving under the force, or the last one.
        """
        moving = replace(self._simulator, integrator="implicit_euler")
        state = State(state.q, torch.zeros_like(state.q))
        for number in range(_MOST_STEPS):
            before, force = state.q, self._predict(state, 0)
            state = moving.step(state, self._inputs.plus(force, self._acts), self._constants)
            still = float((state.q - before).abs().max()) < _RESTS
            if number and still:
                break
        return State(state.q, torch.zeros_like(state.q))

    @staticmethod
    def adjoint(gradient: torch.Tensor, near: torch.Tensor, again: torch.Tensor) -> torch.Tensor:
        """Returns g = w + (dS/dx)^T g (B, N, 3), for w (B, N, 3) and S(x) at x,
        by GMRES, as S depends on few modes.
        """
        from scipy.sparse.linalg import LinearOperator, gmres

        def product(values: FloatArray) -> FloatArray:
            total = torch.as_tensor(values).to(near).view_as(near)
            (back,) = torch.autograd.grad(again, near, total, retain_graph=True)
            return (total - back).flatten().double().cpu().numpy()

        right = gradient.detach().flatten().double().cpu().numpy()
        matrix = LinearOperator((right.size, right.size), matvec=product, dtype=np.float64)
        found, unsettled = gmres(
            matrix, right, right, rtol=_SETTLED, restart=_ITERATIONS, maxiter=4
        )
        if unsettled:
            raise ConvergenceError(
                "the gradient of a pose and its force did not settle.", near.detach(), None
            )
        return torch.as_tensor(found).to(near).view_as(near)


class _AndersonAcceleration:
    """Proposes the next iterate of a fixed-point iteration, for each environment separately.

    Anderson's acceleration (J. ACM 12 (1965) 547) about the iterate with the smallest change: the
    combination of all iterates that would not change if the map were linear, plus a share of the
    change that remains. The share is halved after an iterate with a larger change than the best
    one, and doubled after others.
    """

    def __init__(self) -> None:
        self._iterates = list[torch.Tensor]()  # (B, 3 N)
        self._changes = list[torch.Tensor]()  # (B, 3 N) of the iterates under the map
        self._share: torch.Tensor | None = None  # (B, 1)

    def next(self, q: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
        """Returns the next iterate (B, N, 3), after iterate q (B, N, 3) changed by (B, N, 3)."""
        self._iterates, self._changes = (
            [*self._iterates, q.flatten(1)],
            [*self._changes, change.flatten(1)],
        )
        x, f = torch.stack(self._iterates), torch.stack(self._changes)  # (m, B, 3 N)
        size = f.norm(dim=2)
        best = size.argmin(0)
        worse = (best < len(x) - 1)[:, None]
        share = torch.ones_like(x[0, :, :1]) if self._share is None else self._share
        self._share = torch.where(worse, 0.5 * share, (2.0 * share).clamp_max(1.0))
        rows = torch.arange(x.shape[1], device=x.device)
        x_best, f_best = x[best, rows], f[best, rows]
        if len(x) == 1:
            return (x_best + f_best).view_as(q)
        if len(x) > _MEMORY:  # Drop the worst iterate of each environment.
            kept = size.argsort(0)[:_MEMORY].sort(0).values[..., None].expand(-1, -1, x.shape[2])
            x, f = x.gather(0, kept), f.gather(0, kept)
            self._iterates, self._changes = list(x.unbind()), list(f.unbind())
        dx, df = (x - x_best).swapaxes(0, 1), (f - f_best).swapaxes(0, 1)  # (B, m, 3 N)
        gram = df @ df.mT
        trace = torch.diagonal(gram, dim1=1, dim2=2).sum(1)
        ridge = torch.where(trace > 0.0, _RIDGE * trace, 1.0)[:, None, None]
        weights = torch.linalg.solve(
            gram + ridge * torch.eye(gram.shape[1]).to(gram), df @ f_best[..., None]
        )
        remaining = f_best - (df.mT @ weights)[..., 0]
        return (x_best - (dx.mT @ weights)[..., 0] + self._share * remaining).view_as(q)
