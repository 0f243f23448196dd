"""Equilibria under a force that depends on the state, such as a learned one.

They are fixed points of equilibria under constant forces, which Anderson's acceleration finds.
"""

from collections.abc import Callable
from typing import Any

import torch

from ...dynamics.simulator import Constants, Simulator
from ...io.errors import ConvergenceError
from ...stepping.inputs import Inputs
from ...stepping.state import State
from .correction import acts_of

_ITERATIONS = 50
_TOLERANCE = 1e-8  # m
_PATIENCE = 20  # iterations without progress, after which the search ends
_MEMORY = 6  # iterations that are combined
_RIDGE = 1e-12


def equilibrium_under_feedback(
    simulator: Simulator, inputs: Inputs, constants: Constants, guess: State, predict: Callable[[State, int], Any]
) -> State:
    """Returns the state of rest under constant inputs and a force (B, N, 3) [N] that depends on the state.

    It is the fixed point of equilibria under constant forces. Each iteration evaluates the force, solves the
    equilibrium under it and accelerates the sequence of positions. It ends when no position moves by more than 1e-8 m,
    or at once where the force does not depend on the positions.

    Args:
        simulator: of the body.
        inputs: constant inputs beside the force.
        constants: see `Simulator.prepare`.
        guess: initial guess.
        predict: predictor of the force, called with step zero.

    Raises:
        ConvergenceError: there is no equilibrium, or the iteration does not converge; its report says which
            environments converged, (B,).
    """
    acts, acceleration, stalled = acts_of(predict), _AndersonAcceleration(), 0
    state = solution = guess
    current: torch.Tensor | None = None
    smallest: torch.Tensor | None = None
    for number in range(_ITERATIONS):
        previous, current = current, predict(state, 0)
        if previous is not None and torch.equal(current, previous) and torch.equal(predict(solution, 0), current):
            return solution
        solution = simulator.static_equilibrium(inputs.plus(current, acts), constants, start=state.q.detach())
        change = solution.q - state.q
        size = change.detach().abs().amax((1, 2))
        done = size < _TOLERANCE
        if bool(done.all()):
            return solution
        better = smallest is None or bool(((size < smallest) & ~done).any())
        smallest = size if smallest is None else torch.minimum(size, smallest)
        stalled = 0 if better else stalled + 1
        if stalled == _PATIENCE or number == _ITERATIONS - 1:
            break
        state = State(torch.where(done[:, None, None], solution.q, acceleration.next(state.q, change)), state.v)
    assert smallest is not None
    raise ConvergenceError(
        "a pose and the force that depends on it did not settle: the force is too large to be a correction.",
        solution.q,
        smallest < _TOLERANCE,
    )


class _AndersonAcceleration:
    """Proposes the next iterate of a fixed-point iteration, for each environment separately.

    Anderson's acceleration (J. ACM 12 (1965) 547) about the iterate with the smallest change: the combination of all
    iterates that would not change if the map were linear, plus a share of the change that remains. The share is halved
    after an iterate with a larger change than the best one, and doubled after others.
    """

    def __init__(self) -> None:
        self._iterates = list[torch.Tensor]()  # (B, 3 N)
        self._changes = list[torch.Tensor]()  # (B, 3 N) of the iterates under the map
        self._share: torch.Tensor | None = None  # (B, 1)

    def next(self, q: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
        """Returns the next iterate (B, N, 3), after iterate q (B, N, 3) changed by (B, N, 3)."""
        self._iterates, self._changes = [*self._iterates, q.flatten(1)], [*self._changes, change.flatten(1)]
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
        weights = torch.linalg.solve(gram + ridge * torch.eye(gram.shape[1]).to(gram), df @ f_best[..., None])
        remaining = f_best - (df.mT @ weights)[..., 0]
        return (x_best - (dx.mT @ weights)[..., 0] + self._share * remaining).view_as(q)
