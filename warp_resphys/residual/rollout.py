"""Closed loop: the simulator with a force that a network predicts from its state."""

from collections.abc import Callable

import torch

from ..integrator import State
from ..simulator import Simulator

FURTHEST = 10.0  # No robot moves ten times its own length from its clamp; a roll-out that does has diverged.
Predictor = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


class HybridSimulator:
    """A simulator and the force that is added to it.

    An environment in which the solver fails, or a vertex of which is further than `FURTHEST` body lengths from its rest
    position, has diverged: from then on it stands at rest, and is reported as lost.

    Args:
        simulator: one whose solver settings count failures rather than raise them.
        predict: (B, N, 3) residual force [N] of positions and velocities; None adds no force.
        lost: (B,) bool, environments that diverged before.
    """

    def __init__(self, simulator: Simulator, predict: Predictor | None, lost: torch.Tensor | None = None) -> None:
        self.simulator, self.predict, self.lost = simulator, predict, lost
        self._tensors = simulator.prepare()
        self._rest = simulator.rest_positions
        self._length = float((self._rest.amax(0) - self._rest.amin(0)).max())

    @torch.no_grad()
    def step(self, state: State) -> State:
        """Advances a batch by one step and updates ``lost``."""
        if self.lost is None:
            self.lost = torch.zeros(state.batch, dtype=torch.bool, device=state.q.device)
        force = None
        if self.predict is not None:
            force = self.predict(state.q, state.v)
            self.lost |= ~torch.isfinite(force).flatten(1).all(1)
            force = torch.where(self.lost[:, None, None], 0.0, force)
        new, report = self.simulator.step(state, force, material=self._tensors)
        distance = (new.q - self._rest).abs().flatten(1).amax(1)
        self.lost |= ~report.converged | ~(distance < FURTHEST * self._length)
        return self._reset(new) if bool(self.lost.any()) else new

    def _reset(self, state: State) -> State:
        """The state with its lost environments at rest."""
        rest, where = self.simulator.rest_state(state.batch), self._lost_mask()
        back = state.previous
        if back is not None:
            back = (torch.where(where, rest.q, back[0]), torch.where(where, rest.v, back[1]))
        return State(torch.where(where, rest.q, state.q), torch.where(where, rest.v, state.v), back)

    def _lost_mask(self) -> torch.Tensor:
        if self.lost is None:
            raise RuntimeError("step before asking what was lost")
        return self.lost[:, None, None]

    def positions(self, state: State) -> torch.Tensor:
        """(B, N, 3) positions of a state that `step` returned, NaN where lost [m]."""
        return torch.where(self._lost_mask(), torch.nan, state.q)


def closed_loop(simulator: Simulator, predict: Predictor | None, start: State, steps: int) -> torch.Tensor:
    """(B, T + 1, N, 3) positions of a hybrid roll-out [m]; NaN from where an environment diverged."""
    hybrid = HybridSimulator(simulator, predict)
    positions, state = [start.q], start
    for _ in range(steps):
        state = hybrid.step(state)
        positions.append(hybrid.positions(state))
    return torch.stack(positions, dim=1)
