"""Closed loop of a body that pressure drives, and a watch on whether it stays where the training was."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from typing_extensions import override

from ..dynamics.frames import VertexFrames
from ..dynamics.integrator import State
from ..dynamics.simulator import MaterialTensors, Simulator
from .networks import StateMap
from .rollout import Rollout

# Fields of positions, velocities and what the network is told of the pressures.
Predictor = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], list[torch.Tensor]]

_MARGIN = 0.25  # of the width of the training range, by which a roll-out may exceed it on either side


@dataclass(frozen=True)
class Drive:
    """What drives a batch, step by step.

    Attributes:
        pressure: (B, K, C) gauge pressure in each chamber during each step [Pa].
        inputs: (B, K, A) what the networks are told of it (`actuation.remembered`).
    """

    pressure: torch.Tensor
    inputs: torch.Tensor


class DrivenHybridRollout(Rollout):
    """A simulator under pressure, and the force that is added to it.

    Args:
        simulator: one whose solver settings count failures rather than raise them.
        predict: the residual force [N]; None adds no force.
        drive: the pressures.
        tensors: other constants than the simulator's.
    """

    def __init__(
        self,
        simulator: Simulator,
        predict: Predictor | None,
        drive: Drive,
        tensors: MaterialTensors | None = None,
    ) -> None:
        super().__init__(simulator)
        self._predict, self._drive, self._step = predict, drive, 0
        self._tensors = simulator.prepare() if tensors is None else tensors

    @override
    def _advance(self, state: State, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        force, failed, k = None, lost, self._step
        self._step += 1
        if self._predict is not None:
            (force,) = self._predict(state.q, state.v, self._drive.inputs[:, k])
            failed = lost | ~torch.isfinite(force).flatten(1).all(1)
            force = torch.where(failed[:, None, None], 0.0, force)
        # An environment that is lost stands at rest: its chambers must not drive it on.
        pressure = torch.where(failed[:, None], 0.0, self._drive.pressure[:, k])
        new, report = self.simulator.step(state, force, material=self._tensors, pressure=pressure)
        return new, failed | ~report.converged


class DrivenDataRollout(Rollout):
    """A model that predicts the next state by itself, from the state and the pressures.

    Args:
        simulator: of the body; it does not simulate here.
        predict: next positions [m] and velocities [m/s].
        drive: the pressures.
    """

    def __init__(self, simulator: Simulator, predict: Predictor, drive: Drive) -> None:
        super().__init__(simulator)
        self._predict, self._drive, self._step = predict, drive, 0

    @override
    def _advance(self, state: State, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        inputs = self._drive.inputs[:, self._step]
        self._step += 1
        q, v = self._predict(state.q, state.v, inputs)
        return State(q, v), lost


class Range:
    """The box that a model's standardised inputs fill in training, and a quarter of its width around it.

    A network says little about what it never saw, and what it says there may drive a body on for good. So the model is
    told of no more than that, and a roll-out that goes further is to be reported.

    Args:
        low: (A,) of the standardised inputs.
        high: (A,).
    """

    def __init__(self, low: torch.Tensor, high: torch.Tensor) -> None:
        self.low, self.high = low, high

    @classmethod
    def of(cls, inputs: torch.Tensor) -> "Range":
        """The box of (S, A) standardised inputs."""
        return cls(inputs.amin(0), inputs.amax(0))

    def hold(self, inputs: torch.Tensor) -> torch.Tensor:
        """(B, A) standardised inputs, those outside at the edge."""
        return inputs.clamp(*self._edges())

    def left(self, inputs: torch.Tensor) -> torch.Tensor:
        """(B,) bool, whether (B, A) standardised inputs are outside."""
        low, high = self._edges()
        return ((inputs < low) | (inputs > high)).any(1)

    def _edges(self) -> tuple[torch.Tensor, torch.Tensor]:
        margin = _MARGIN * (self.high - self.low)
        return self.low - margin, self.high + margin

    def description(self) -> dict[str, list[float]]:
        """Plain data, for a checkpoint's metadata."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    @classmethod
    def restore(cls, description: Mapping[str, Sequence[float]], like: torch.Tensor) -> "Range":
        """From `description`, on the device and in the type of a tensor."""
        return cls(like.new_tensor(description["low"]), like.new_tensor(description["high"]))


class WatchedModel:
    """A model as a predictor that is held in the range of its training, and when each environment first left it.

    Args:
        model: that predicts.
        range_: of its inputs in training.
        frames: with which what it predicts turns; None if it does not.

    Attributes:
        left_at: (B,) step at which an environment left the range, -1 where it has not; None before the first step.
    """

    def __init__(self, model: StateMap, range_: Range, frames: VertexFrames | None = None) -> None:
        self.model, self._range, self._frames, self._step = model, range_, frames, 0
        self.left_at: torch.Tensor | None = None

    @torch.no_grad()
    def __call__(self, q: torch.Tensor, v: torch.Tensor, actuation: torch.Tensor) -> list[torch.Tensor]:
        """The model's fields (B, N, 3) for a state and (B, A) inputs, on the simulator's device."""
        like = self.model.rest
        state = [t.to(like.device, like.dtype) for t in (q, v, actuation)]
        if self.left_at is None:
            self.left_at = torch.full((len(q),), -1, dtype=torch.int64, device=q.device)
        inputs = self.model.encode(*state)
        outside = self._range.left(inputs).to(q.device)
        self.left_at = torch.where(outside & (self.left_at < 0), self._step, self.left_at)
        self._step += 1
        fields = [field.to(q.device, q.dtype) for field in self.model.decode(self._range.hold(inputs))]
        return fields if self._frames is None else [self._frames.to_world(q, v, field) for field in fields]
