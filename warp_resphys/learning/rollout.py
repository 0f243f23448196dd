"""Closed-loop roll-outs of a simulator, a model or both."""

from collections.abc import Callable

import torch

from ..dynamics.simulator import Constants, Simulator
from ..stepping.inputs import Inputs
from ..stepping.state import State

DIVERGENCE_DISTANCE = 10.0  # body lengths from rest beyond which a roll-out has diverged

# Function of the state and the number of the step: a residual force (B, N, 3) [N] to add, or the next state.
Predictor = Callable[[State, int], torch.Tensor | State]


class Rollout:
    """Steps a batch and detects environments that diverge.

    An environment has diverged when a step fails or a vertex is further than `DIVERGENCE_DISTANCE` body lengths from
    its rest position: from then on it stands at rest and is reported as lost.

    Args:
        simulator: its solver settings must count failures rather than raise them.
        predict: residual force or, in place of the simulator, next state; None for the simulator alone.
        inputs: of the batch, from the first step on.
        constants: in place of the simulator's own.

    Attributes:
        done: number of steps made.
    """

    def __init__(
        self,
        simulator: Simulator,
        predict: Predictor | None = None,
        inputs: Inputs | None = None,
        constants: Constants | None = None,
    ) -> None:
        self.simulator, self._predict, self.done = simulator, predict, 0
        self._lost: torch.Tensor | None = None
        self._inputs = Inputs() if inputs is None else inputs
        self._constants = simulator.prepare() if constants is None else constants
        self._rest = simulator.rest_positions
        self._length = float((self._rest.amax(0) - self._rest.amin(0)).max())

    def resume(self, lost: torch.Tensor, done: int) -> None:
        """Continues after a number of steps, in which environments (B,) were lost."""
        self._lost, self.done = lost, done

    @torch.no_grad()
    def step(self, state: State) -> State:
        """Advances a batch by one step, without gradients."""
        return self.differentiable_step(state)

    def differentiable_step(self, state: State) -> State:
        """Advances a batch by one step; gradients are meaningless where an environment is lost."""
        lost = self.lost(state)
        new, failed = self._advance(state, lost)
        self.done += 1
        distance = (new.q - self._rest).abs().flatten(1).amax(1)
        self._lost = lost | failed | ~(distance < DIVERGENCE_DISTANCE * self._length)
        return self._reset(new, self._lost) if bool(self._lost.any()) else new

    def _advance(self, state: State, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        """Returns the next state, and which environments (B,) failed."""
        inputs, force, failed = self._inputs.at(self.done), None, lost
        if self._predict is not None:
            predicted = self._predict(state, self.done)
            if isinstance(predicted, State):
                return predicted, lost
            failed = lost | ~torch.isfinite(predicted).flatten(1).all(1)
            force = torch.where(failed[:, None, None], 0.0, predicted)
        if bool(failed.any()):  # Lost environments stand at rest, without inputs.
            rest = self._rest[self.simulator.fixed]
            idle = {name: torch.where(failed[:, None], 0.0, value) for name, value in inputs.actuation.items()}
            if inputs.fixed_positions is not None:
                idle["fixed_positions"] = torch.where(failed[:, None, None], rest, inputs.fixed_positions)
            inputs = inputs.replace(**idle)
        new, report = self.simulator.step(state, inputs.plus(force), self._constants)
        return new, failed | ~report.converged

    def _reset(self, state: State, lost: torch.Tensor) -> State:
        """Returns the state with its lost environments at rest."""
        rest = dict.fromkeys(("q", "previous_q"), self._rest)

        def masked(name: str, value: torch.Tensor) -> torch.Tensor:
            where = lost.view(-1, *[1] * (value.ndim - 1))
            return torch.where(where, rest.get(name, value.new_zeros(())), value)

        return State.from_tensors({name: masked(name, value) for name, value in state.tensors().items()})

    def lost(self, state: State) -> torch.Tensor:
        """Which environments have diverged, (B,) bool."""
        return torch.zeros(state.batch, dtype=torch.bool, device=state.q.device) if self._lost is None else self._lost

    def positions(self, state: State) -> torch.Tensor:
        """Positions (B, N, 3) of a state, NaN in lost environments [m]."""
        return state.q if self._lost is None else torch.where(self._lost[:, None, None], torch.nan, state.q)


def closed_loop(rollout: Rollout, start: State, steps: int) -> torch.Tensor:
    """Returns positions (B, T + 1, N, 3) of a roll-out [m]; NaN from the step where an environment diverged."""
    positions, state = [start.q], start
    for _ in range(steps):
        state = rollout.step(state)
        positions.append(rollout.positions(state))
    return torch.stack(positions, dim=1)
