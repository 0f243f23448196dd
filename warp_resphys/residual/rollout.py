"""Closed loop: the simulator with a force that a network predicts from its state."""

from collections.abc import Callable

import torch

from ..integrator import State
from ..simulator import Simulator


def closed_loop(
    simulator: Simulator,
    predict: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
    start: State,
    steps: int,
    on_step: Callable[[], None] = lambda: None,
) -> torch.Tensor:
    """Rolls a hybrid simulator out.

    An environment in which the solver fails, or whose state is no longer finite, has diverged: it stands still at rest
    from there on, and its positions are NaN in the result.

    Args:
        simulator: one that counts failures rather than raising them.
        predict: (B, N, 3) residual force [N] of positions and velocities.
        start: initial state.
        steps: T.
        on_step: called after each step.

    Returns:
        (B, T + 1, N, 3) positions [m].
    """
    tensors = simulator.prepare()
    state = start
    lost = torch.zeros(start.batch, dtype=torch.bool, device=start.q.device)
    rest = simulator.rest_state(start.batch)
    positions = [start.q]
    with torch.no_grad():
        for _ in range(steps):
            force = predict(state.q, state.v)
            lost |= ~torch.isfinite(force).flatten(1).all(1)
            force = torch.where(lost[:, None, None], 0.0, force)
            state, report = simulator.step(_reset(state, lost, rest), force, material=tensors)
            lost |= ~report.converged | ~torch.isfinite(state.q).flatten(1).all(1)
            positions.append(torch.where(lost[:, None, None], torch.nan, state.q))
            state = _reset(state, lost, rest)
            on_step()
    return torch.stack(positions, dim=1)


def _reset(state: State, lost: torch.Tensor, rest: State) -> State:
    """The state with its lost environments at rest."""
    if not bool(lost.any()):
        return state
    where = lost[:, None, None]
    back = state.previous
    if back is not None:
        back = (torch.where(where, rest.q, back[0]), torch.where(where, rest.v, back[1]))
    return State(torch.where(where, rest.q, state.q), torch.where(where, rest.v, state.v), back)
