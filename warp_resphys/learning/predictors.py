"""Trained models as predictors of a roll-out, and a watch on whether it stays where the training was."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from ..dynamics.frames import BaseFrame, VertexFrames
from ..stepping.state import State
from .networks import NextState, StateMap

_MARGIN = 0.25  # of the width of the training range, by which a roll-out may exceed it on either side


@dataclass(frozen=True)
class Range:
    """The box that a model's standardised inputs fill in training, and a quarter of its width around it.

    A network says little about what it never saw, and what it says there may drive a body on for good. So the model is
    told of no more than that, and a roll-out that goes further is to be reported.

    Attributes:
        low: (A,) of the standardised inputs.
        high: (A,).
    """

    low: torch.Tensor
    high: torch.Tensor

    @classmethod
    def of(cls, inputs: torch.Tensor) -> "Range":
        """The box of (S, A) standardised inputs."""
        return cls(inputs.amin(0), inputs.amax(0))

    def hold(self, inputs: torch.Tensor) -> torch.Tensor:
        """(B, A) standardised inputs, those outside at the edge."""
        return inputs.clamp(*self.edges)

    def left(self, inputs: torch.Tensor) -> torch.Tensor:
        """(B,) bool, whether (B, A) standardised inputs are outside."""
        low, high = self.edges
        return ((inputs < low) | (inputs > high)).any(1)

    @property
    def edges(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(A,) each: the least and the largest inputs that the model is told."""
        margin = _MARGIN * (self.high - self.low)
        return self.low - margin, self.high + margin

    def description(self) -> dict[str, list[float]]:
        """Plain data, for a checkpoint's metadata."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    @classmethod
    def restore(cls, description: Mapping[str, Sequence[float]], like: torch.Tensor) -> "Range":
        """From `description`, on the device and in the type of a tensor."""
        return cls(like.new_tensor(description["low"]), like.new_tensor(description["high"]))


class LearnedPredictor:
    """A model as a predictor, wherever its weights are: see `rollout.Predictor`.

    Args:
        model: that predicts a residual force, or the next state.
        told: what the model is told of the inputs: (B, A) throughout, or (K, B, A) during each step, past
            the end the last; None for nothing.
        range_: of its inputs in training, in which it is held; None for no guard.
        frames: with which its forces turn; None if they do not.
        base: in whose frame it predicts; None where that stands still.

    Attributes:
        left_at: (B,) step at which an environment left the range, -1 where it has not; None before the first step.
        hidden: (B, H) state of a recurrent network, which goes with the roll-out; None before the first step.
    """

    def __init__(
        self,
        model: StateMap,
        told: torch.Tensor | None = None,
        range_: Range | None = None,
        frames: VertexFrames | None = None,
        base: BaseFrame | None = None,
    ) -> None:
        self.model, self._told, self._range, self._frames, self._base = model, told, range_, frames, base
        self.left_at: torch.Tensor | None = None
        self.hidden: torch.Tensor | None = None

    def __call__(self, state: State, step: int) -> torch.Tensor | State:
        """The model's force (B, N, 3) [N], or the next state, on the simulator's device and in its type."""
        q, v, like = state.q, state.v, self.model.rest
        if self._base is not None:
            q, v = self._base.enter(q, v, step)
        told = self._told
        if told is not None and told.ndim == 3:
            told = told[min(step, len(told) - 1)]
        parts = [None if t is None else t.to(like.device, like.dtype) for t in (q, v, told)]
        assert parts[0] is not None
        assert parts[1] is not None
        inputs = self.model.encode(parts[0], parts[1], parts[2])
        if self._range is not None:
            outside = self._range.left(inputs).to(q.device)
            if self.left_at is None:
                self.left_at = torch.full((len(q),), -1, dtype=torch.int64, device=q.device)
            self.left_at = torch.where(outside & (self.left_at < 0), step, self.left_at)
            inputs = self._range.hold(inputs)
        found, self.hidden = self.model.decode(inputs, self.hidden)
        fields = [field.to(q.device, q.dtype) for field in found]
        if isinstance(self.model, NextState):
            return State(*(fields if self._base is None else self._base.leave(fields[0], fields[1], step + 1)))
        force = fields[0] if self._frames is None else self._frames.to_world(q, v, fields[0])
        return force if self._base is None else self._base.force_outside(force, step)
