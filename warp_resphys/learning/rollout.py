"""Closed loop: a model, with or without the simulator, rolled out from its own states."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from typing_extensions import override

from ..dynamics.integrator import State
from ..dynamics.simulator import MaterialTensors, Simulator

FURTHEST = 10.0  # No robot moves ten times its own length from its clamp; a roll-out that does has diverged.
ForcePredictor = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
StatePredictor = Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


class Rollout(ABC):
    """Steps a batch, and keeps an eye on environments that diverge.

    An environment in which a step fails, or a vertex of which is further than `FURTHEST` body lengths from its rest
    position, has diverged: from then on it stands at rest, and is reported as lost.

    Args:
        simulator: of the body.
        lost: (B,) bool, environments that diverged before.
    """

    def __init__(self, simulator: Simulator, lost: torch.Tensor | None = None) -> None:
        self.simulator = simulator
        self._lost = lost
        self._rest = simulator.rest_positions
        self._length = float((self._rest.amax(0) - self._rest.amin(0)).max())

    @abstractmethod
    def _advance(self, state: State, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        """The next state, and which environments (B,) failed."""

    @torch.no_grad()
    def step(self, state: State) -> State:
        """Advances a batch by one step, without gradients."""
        return self.differentiable_step(state)

    def differentiable_step(self, state: State) -> State:
        """Advances a batch by one step; gradients are meaningless where an environment is lost."""
        lost = self.lost(state)
        new, failed = self._advance(state, lost)
        distance = (new.q - self._rest).abs().flatten(1).amax(1)
        self._lost = lost | failed | ~(distance < FURTHEST * self._length)
        return self._reset(new, self._lost) if bool(self._lost.any()) else new

    def _reset(self, state: State, lost: torch.Tensor) -> State:
        """The state with its lost environments at rest."""
        rest, where = self.simulator.rest_state(state.batch), lost[:, None, None]
        back = state.previous
        if back is not None:
            back = (torch.where(where, rest.q, back[0]), torch.where(where, rest.v, back[1]))
        return State(torch.where(where, rest.q, state.q), torch.where(where, rest.v, state.v), back)

    def lost(self, state: State) -> torch.Tensor:
        """(B,) bool, environments that have diverged."""
        return torch.zeros(state.batch, dtype=torch.bool, device=state.q.device) if self._lost is None else self._lost

    def positions(self, state: State) -> torch.Tensor:
        """(B, N, 3) positions of the last state, NaN where lost [m]."""
        return state.q if self._lost is None else torch.where(self._lost[:, None, None], torch.nan, state.q)


class HybridRollout(Rollout):
    """A simulator and the force that is added to it.

    Args:
        simulator: one whose solver settings count failures rather than raise them.
        predict: (B, N, 3) residual force [N] of positions and velocities; None adds no force.
        lost: (B,) bool, environments that diverged before.
        tensors: other constants than the simulator's, such as other weights in every environment.
    """

    def __init__(
        self,
        simulator: Simulator,
        predict: ForcePredictor | None,
        lost: torch.Tensor | None = None,
        tensors: MaterialTensors | None = None,
    ) -> None:
        super().__init__(simulator, lost)
        self._predict = predict
        self._tensors = simulator.prepare() if tensors is None else tensors

    @override
    def _advance(self, state: State, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        force, failed = None, lost
        if self._predict is not None:
            force = self._predict(state.q, state.v)
            failed = lost | ~torch.isfinite(force).flatten(1).all(1)
            force = torch.where(failed[:, None, None], 0.0, force)
        new, report = self.simulator.step(state, force, material=self._tensors)
        return new, failed | ~report.converged


class DataDrivenRollout(Rollout):
    """A model that predicts the next state by itself.

    Args:
        simulator: of the body; it does not simulate here.
        predict: next positions [m] and velocities [m/s] of positions and velocities.
        lost: (B,) bool, environments that diverged before.
    """

    def __init__(self, simulator: Simulator, predict: StatePredictor, lost: torch.Tensor | None = None) -> None:
        super().__init__(simulator, lost)
        self._predict = predict

    @override
    def _advance(self, state: State, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        return State(*self._predict(state.q, state.v)), lost


def closed_loop(rollout: Rollout, start: State, steps: int) -> torch.Tensor:
    """(B, T + 1, N, 3) positions of a roll-out [m]; NaN from where an environment diverged."""
    positions, state = [start.q], start
    for _ in range(steps):
        state = rollout.step(state)
        positions.append(rollout.positions(state))
    return torch.stack(positions, dim=1)
