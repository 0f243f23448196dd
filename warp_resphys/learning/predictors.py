"""Trained models as predictors of a roll-out, with a guard against states outside the training range."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from ..dynamics.frames import BaseFrame, VertexFrames
from ..stepping.state import State
from .networks import NextState, StateMap

_FADES = (1.25, 2.5)  # ratios of the distance from the modes to that in training, between which a force fades out
_LEAST = 1e-6  # smallest width of a range in standard deviations
_MARGIN = 0.25  # of the width of the training range, by which inputs may exceed it on either side


@dataclass(frozen=True)
class Range:
    """Bounding box of a model's standardised inputs in training, widened by a quarter of its width on every side.

    A network extrapolates badly, and a wrong force may drive the body ever further away. So the inputs of the model are
    clamped to this box, and a roll-out that leaves it is reported.

    Where the simulator alone is good beyond the training range, as with the law of its material, the force fades out
    there: over another quarter of the width beyond the box, and between one and a quarter and two and a half times the
    largest distance of a state from the network's modes in training.

    Attributes:
        low: (A,) minimum of the standardised inputs in training.
        high: (A,) maximum.
        missed: (2,) largest root mean square distance of displacements [m] and velocities [m/s] in training from the
            modes of the inputs; None: the force does not fade out.
    """

    low: torch.Tensor
    high: torch.Tensor
    missed: torch.Tensor | None = None

    @classmethod
    def of(cls, inputs: torch.Tensor, missed: torch.Tensor | None = None) -> "Range":
        """Returns the range of (S, A) standardised inputs and, for a force that fades out, (S, 2) `StateMap.missed`."""
        return cls(inputs.amin(0), inputs.amax(0), None if missed is None else missed.amax(0))

    def weight(self, inputs: torch.Tensor, missed: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the factor (B,) of a force that fades out, from unclamped inputs (B, A) and `StateMap.missed`.

        Without ``missed``, it is that of a state which is made of the network's modes.
        """
        assert self.missed is not None
        low, high = self.edges
        left = torch.maximum(low - inputs, inputs - high) / (_MARGIN * (self.high - self.low)).clamp_min(_LEAST)
        if missed is not None:
            ratio = missed / self.missed.clamp_min(1e-12)
            left = torch.cat([left, (ratio - _FADES[0]) / (_FADES[1] - _FADES[0])], 1)
        left = left.amax(1).clamp(0.0, 1.0)
        return 1.0 - left.square() * (3.0 - 2.0 * left)

    def outputs(self, network: StateMap, inputs: torch.Tensor) -> torch.Tensor:
        """Returns a network's standardised outputs (B, C) for unclamped inputs (B, A), faded out as by `weight`."""
        outputs = network.standardised(self.clamp(inputs))[0]
        if self.missed is None:
            return outputs
        nothing = network.encode_outputs(torch.zeros_like(network.rest)[None])
        return torch.lerp(nothing.to(outputs), outputs, self.weight(inputs)[:, None])

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

    def to(self, device: torch.device) -> "Range":
        """Returns the range on a device."""
        return Range(self.low.to(device), self.high.to(device), None if self.missed is None else self.missed.to(device))

    def description(self) -> dict[str, list[float]]:
        """Returns plain data for a checkpoint's metadata."""
        missed = {} if self.missed is None else {"missed": self.missed.tolist()}
        return {"low": self.low.tolist(), "high": self.high.tolist(), **missed}

    @classmethod
    def restore(cls, description: Mapping[str, Sequence[float]], like: torch.Tensor) -> "Range":
        """Returns the range of a `description`, on the device and in the precision of a tensor."""
        return cls(**{name: like.new_tensor(values) for name, values in description.items()})


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
        context, weight = self._context, None
        if context is not None:
            context = (context if context.ndim == 2 else context[min(step, len(context) - 1)]).to(like)
        inputs = self.model.encode(q.to(like), v.to(like), context)
        if self._range is not None:
            outside = self._range.excludes(inputs).to(q.device)
            if self.left_at is None:
                self.left_at = torch.full((len(q),), -1, dtype=torch.int64, device=q.device)
            self.left_at = torch.where(outside & (self.left_at < 0), step, self.left_at)
            if self._range.missed is not None:
                weight = self._range.weight(inputs, self.model.missed(q.to(like), v.to(like)).to(inputs)).to(q)
            inputs = self._range.clamp(inputs)
        outputs, self.hidden = self.model.decode(inputs, self.hidden)
        fields = [field.to(q) for field in outputs]
        if isinstance(self.model, NextState):
            return State(*(fields if self._base is None else self._base.leave(fields[0], fields[1], step + 1)))
        if weight is not None:
            fields[0] = fields[0] * weight[:, None, None]
        force = fields[0] if self._frames is None else self._frames.to_world(q, v, fields[0])
        return force if self._base is None else self._base.force_outside(force, step)
