"""Trained models as predictors of a roll-out, with a guard against states outside the training range."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from ..dynamics.frames import BaseFrame, VertexFrames
from ..stepping.state import State
from .networks import NextState, StateMap

_MARGIN = 0.25  # of the width of the training range, by which inputs may exceed it on either side


@dataclass(frozen=True)
class Range:
    """Bounding box of a model's standardised inputs in training, widened by a quarter of its width on every side.

    A network extrapolates badly, and a wrong force may drive the body ever further away. So the inputs of the model are
    clamped to this box, and a roll-out that leaves it is reported.

    Attributes:
        low: (A,) minimum of the standardised inputs in training.
        high: (A,) maximum.
    """

    low: torch.Tensor
    high: torch.Tensor

    @classmethod
    def of(cls, inputs: torch.Tensor) -> "Range":
        """Returns the range of (S, A) standardised inputs."""
        return cls(inputs.amin(0), inputs.amax(0))

    def clamp(self, inputs: torch.Tensor) -> torch.Tensor:
        """Returns standardised inputs (B, A), clamped to the widened box."""
        return inputs.clamp(*self.edges)

    def excludes(self, inputs: torch.Tensor) -> torch.Tensor:
        """Returns whether standardised inputs (B, A) are outside of the widened box, (B,) bool."""
        low, high = self.edges
        return ((inputs < low) | (inputs > high)).any(1)

    @property
    def edges(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Lower and upper corner of the widened box, (A,) each."""
        margin = _MARGIN * (self.high - self.low)
        return self.low - margin, self.high + margin

    def description(self) -> dict[str, list[float]]:
        """Returns plain data for a checkpoint's metadata."""
        return {"low": self.low.tolist(), "high": self.high.tolist()}

    @classmethod
    def restore(cls, description: Mapping[str, Sequence[float]], like: torch.Tensor) -> "Range":
        """Returns the range of a `description`, on the device and in the precision of a tensor."""
        return cls(like.new_tensor(description["low"]), like.new_tensor(description["high"]))


class LearnedPredictor:
    """A model as a `rollout.Predictor`, on whichever device its weights are.

    Args:
        model: predicts a residual force, or the next state.
        context: inputs of the network beside the state, such as pressures: (B, A) constant, or (K, B, A) by step, the
            last one repeated past the end; None for none.
        range_: to which the network's inputs are clamped; None for no clamping.
        frames: vertex frames in which forces are predicted; None for the world's frame.
        base: moving frame of the base in which the model predicts; None where the base stands still.

    Attributes:
        left_at: (B,) step at which an environment left the range, -1 where it has not; None before the first step.
        hidden: (B, H) hidden state of a recurrent network; None before the first step.
    """

    def __init__(
        self,
        model: StateMap,
        context: torch.Tensor | None = None,
        range_: Range | None = None,
        frames: VertexFrames | None = None,
        base: BaseFrame | None = None,
    ) -> None:
        self.model, self._context, self._range, self._frames, self._base = model, context, range_, frames, base
        self.left_at: torch.Tensor | None = None
        self.hidden: torch.Tensor | None = None

    def __call__(self, state: State, step: int) -> torch.Tensor | State:
        """Returns the model's force (B, N, 3) [N] or next state, on the simulator's device and in its precision."""
        q, v, like = state.q, state.v, self.model.rest
        if self._base is not None:
            q, v = self._base.enter(q, v, step)
        context = self._context
        if context is not None:
            context = (context if context.ndim == 2 else context[min(step, len(context) - 1)]).to(like)
        inputs = self.model.encode(q.to(like), v.to(like), context)
        if self._range is not None:
            outside = self._range.excludes(inputs).to(q.device)
            if self.left_at is None:
                self.left_at = torch.full((len(q),), -1, dtype=torch.int64, device=q.device)
            self.left_at = torch.where(outside & (self.left_at < 0), step, self.left_at)
            inputs = self._range.clamp(inputs)
        outputs, self.hidden = self.model.decode(inputs, self.hidden)
        fields = [field.to(q) for field in outputs]
        if isinstance(self.model, NextState):
            return State(*(fields if self._base is None else self._base.leave(fields[0], fields[1], step + 1)))
        force = fields[0] if self._frames is None else self._frames.to_world(q, v, fields[0])
        return force if self._base is None else self._base.force_outside(force, step)
