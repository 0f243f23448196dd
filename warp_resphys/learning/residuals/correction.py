"""Closed-loop roll-outs of a simulator, a model or both.

Trained models are predictors of a roll-out, with a guard against states outside the training range.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import torch

from ...core.dynamics.frames import BaseFrame, RestOnBase, VertexFrames
from ...core.dynamics.simulator import Constants, Simulator
from ...core.stepping.inputs import Acts, Inputs
from ...core.stepping.state import State
from ...io.arrays import Brief
from ...io.errors import InputError, in_short
from ...io.safe_files import read_checkpoint, write_checkpoint
from ..scores import HeldOutTest
from .networks import NextState, ResidualForce, StateMap, restore

COROTATED: Final = "corotated"
_KINDS: Final = {ResidualForce: "residual force", NextState: "next state"}  # of checkpoints
DIVERGENCE_DISTANCE = 10.0  # body lengths from rest beyond which a roll-out has diverged

# Function of the state and the number of the step: a residual force (B, N, 3) [N] to add, or the
# next state. Where the force acts is its attribute `acts`; a plain function without it returns an
# external force.
Predictor = Callable[[State, int], torch.Tensor | State]

# Ratios of the distance from the modes to that in training, between which a force fades out.
_FADES = (1.25, 2.5)
_LEAST = 1e-6  # smallest width of a range in standard deviations
_MARGIN = 0.25  # of the width of the training range, by which inputs may exceed it on either side


class CorrectedSimulator:
    """The steps of a simulator with a learned force,
    or of a network in its place, by their numbers.

    An environment has diverged when a step fails or a vertex is further than `DIVERGENCE_DISTANCE`
    body lengths from its rest position, in the frame of the fixed vertices or, without them, of the
    body's mean motion. From then on it is `State.lost`: it stands at rest where its fixed vertices
    are, and gradients are meaningless there.

    Args:
        simulator: its solver settings must count failures rather than raise them.
        predict: residual force or, in place of the simulator, next state; None for the simulator
            alone.
        inputs: inputs of the batch, from the first step on.
        constants: constants from `Simulator.prepare` in place of the simulator's.
    """

    def __init__(
        self,
        simulator: Simulator,
        predict: Predictor | None = None,
        inputs: Inputs | None = None,
        constants: Constants | None = None,
    ) -> None:
        self.simulator, self._predict = simulator, predict
        self._inputs = Inputs() if inputs is None else inputs
        self._constants = simulator.prepare() if constants is None else constants
        self._rest = RestOnBase(simulator.body, simulator.rest_positions)

    def step(self, state: State, number: int) -> State:
        """Returns the state after the step of a number; differentiable."""
        new, failed = self._advance(state, number, state.lost)
        lost, q = state.lost | failed, new.q.detach()
        places = self._inputs.at(number).fixed_positions
        if bool((self._rest.is_near(q, places, DIVERGENCE_DISTANCE) & ~lost).all()):
            return new.with_memory({"lost": lost})
        resting = self._rest.carried(state.batch, places)
        lost = lost | ~self._rest.is_within(q, resting, DIVERGENCE_DISTANCE)
        if bool(lost.any()):
            new = replace(self.simulator.rest_state(state.batch), q=resting).where(lost, new)
        return new.with_memory({"lost": lost})

    def _advance(self, state: State, number: int, lost: torch.Tensor) -> tuple[State, torch.Tensor]:
        """Returns the next state, and which environments (B,) failed."""
        inputs = self._inputs.at(number)
        force = None
        failed = lost
        if self._predict is not None:
            predicted = self._predict(state, number)
            if isinstance(predicted, State):
                return predicted, lost
            if not isinstance(predicted, torch.Tensor) or predicted.shape[-2:] != state.q.shape[1:]:
                wanted = f"a tensor of shape {tuple(state.q.shape)} in N"
                raise InputError(
                    f"the force of step {number} is {in_short(predicted)}: it must be {wanted}."
                )
            failed = lost | ~torch.isfinite(predicted).flatten(1).all(1)
            force = torch.where(failed[:, None, None], 0.0, predicted)
        if bool(failed.any()):  # Lost environments stand at rest on their bases, without inputs.
            idle = {
                name: torch.where(failed[:, None], 0.0, value)
                for name, value in inputs.actuation.items()
            }
            inputs = inputs.replace(**idle)
        new = self.simulator.step(
            state, inputs.plus(force, acts_of(self._predict)), self._constants
        )
        return new, failed | ~new.converged


def acts_of(predict: object) -> Acts:
    """Returns where the force of a predictor acts: a function of the user's
    without `acts` is an external force.
    """
    acts: Acts = getattr(predict, "acts", "external")
    return acts


def known_positions(state: State) -> torch.Tensor:
    """Returns the positions (B, N, 3) of a state, NaN in lost environments [m]."""
    return torch.where(state.lost[:, None, None], torch.nan, state.q)


@dataclass(frozen=True)
class Range(Brief):
    """Bounding box of a model's standardised inputs in training,
    widened by a quarter of its width on every side.

    A network extrapolates badly, and a wrong force may drive the body ever further away. So the
    inputs of the model are clamped to this box, and a roll-out that leaves it is reported.

    Where the simulator alone is good beyond the training range, as with the law of its material,
    the force fades out there: over another quarter of the width beyond the box, and between one and
    a quarter and two and a half times the largest distance of a state from the network's modes in
    training.

    Attributes:
        low: (A,) minimum of the standardised inputs in training.
        high: (A,) maximum.
        missed: (2,) largest root mean square distance of displacements [m] and velocities [m/s] in
            training from the modes of the inputs; None: the force does not fade out.
    """

    low: torch.Tensor
    high: torch.Tensor
    missed: torch.Tensor | None = None

    @classmethod
    def of(cls, inputs: torch.Tensor, missed: torch.Tensor | None = None) -> "Range":
        """Returns the range of (S, A) standardised inputs and,
        for a force that fades out, (S, 2) `StateMap.missed`.
        """
        return cls(inputs.amin(0), inputs.amax(0), None if missed is None else missed.amax(0))

    def weight(self, inputs: torch.Tensor, missed: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the factor (B,) of a force that fades out,
        from unclamped inputs (B, A) and `StateMap.missed`.

        Without ``missed``, it is that of a state which is made of the network's modes.
        """
        assert self.missed is not None
        low, high = self.edges
        left = torch.maximum(low - inputs, inputs - high) / (
            _MARGIN * (self.high - self.low)
        ).clamp_min(_LEAST)
        if missed is not None:
            ratio = missed / self.missed.clamp_min(1e-12)
            left = torch.cat([left, (ratio - _FADES[0]) / (_FADES[1] - _FADES[0])], 1)
        left = left.amax(1).clamp(0.0, 1.0)
        return 1.0 - left.square() * (3.0 - 2.0 * left)

    def outputs(self, network: StateMap, inputs: torch.Tensor) -> torch.Tensor:
        """Returns a network's standardised outputs (B, C) for unclamped inputs (B, A),
        faded out as by `weight`.
        """
        outputs = network.standardised(self.clamp(inputs))
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
        return Range(
            self.low.to(device),
            self.high.to(device),
            None if self.missed is None else self.missed.to(device),
        )

    def description(self) -> dict[str, list[float]]:
        """Returns plain data for a checkpoint's metadata."""
        missed = {} if self.missed is None else {"missed": self.missed.tolist()}
        return {"low": self.low.tolist(), "high": self.high.tolist(), **missed}

    @classmethod
    def restore(cls, description: Mapping[str, Sequence[float]], like: torch.Tensor) -> "Range":
        """Returns the range of a `description`, on the device and in the precision of a tensor."""
        return cls(**{name: like.new_tensor(values) for name, values in description.items()})


class LearnedPredictor:
    """A model as a `Predictor`, on whichever device its weights are.

    Args:
        model: predicts a residual force, or the next state.
        context: inputs of the network beside the state, such as pressures: (B, A) constant, or
            (K, B, A) by step, the last one repeated past the end; None for none.
        range_: to which the network's inputs are clamped; None for no clamping.
        frames: vertex frames in which forces are predicted; None for the world's frame.
        base: moving frame of the base in which the model predicts; None where the base stands
            still.

    Attributes:
        left_at: (B,) step at which an environment left the range, -1 where it has not; None before
            the first step.
        acts: where its force acts.
    """

    def __init__(
        self,
        model: StateMap,
        context: torch.Tensor | None = None,
        range_: Range | None = None,
        frames: VertexFrames | None = None,
        base: BaseFrame | None = None,
    ) -> None:
        self.model = model
        self._context = context
        self._range = range_
        self._frames = frames
        self._base = base
        self.left_at: torch.Tensor | None = None
        self.acts = model.acts

    def __call__(self, state: State, step: int) -> torch.Tensor | State:
        """Returns the model's force (B, N, 3) [N] or next state,
        on the simulator's device and in its precision.
        """
        q, v = state.q, state.v
        like = self.model.rest
        if self._base is not None:
            q, v = self._base.enter(q, v, step)
        context, weight = self._context, None
        if context is not None:
            context = (context if context.ndim == 2 else context[min(step, len(context) - 1)]).to(
                like
            )
        inputs = self.model.encode(q.to(like), v.to(like), context)
        if self._range is not None:
            outside = self._range.excludes(inputs).to(q.device)
            if self.left_at is None:
                self.left_at = torch.full((len(q),), -1, dtype=torch.int64, device=q.device)
            self.left_at = torch.where(outside & (self.left_at < 0), step, self.left_at)
            if self._range.missed is not None:
                weight = self._range.weight(
                    inputs, self.model.missed(q.to(like), v.to(like)).to(inputs)
                ).to(q)
            inputs = self._range.clamp(inputs)
        fields = [field.to(q) for field in self.model.decode(inputs)]
        if isinstance(self.model, NextState):
            return State(
                *(
                    fields
                    if self._base is None
                    else self._base.leave(fields[0], fields[1], step + 1)
                )
            )
        if weight is not None:
            fields[0] = fields[0] * weight[:, None, None]
        force = fields[0] if self._frames is None else self._frames.to_world(q, v, fields[0])
        return force if self._base is None else self._base.force_outside(force, step)


@dataclass(frozen=True)
class Learned(Brief):
    """A trained network with the settings of its roll-outs.

    Attributes:
        network: network that predicts a residual force or the next state.
        range_: training range to which roll-outs clamp its inputs; None for no clamping.
        force_frame: frame of the predicted forces, see `force_frames`.
        training: ``kept``, the selection and error of the weights, and ``epochs``, a record of
            each.
        test: of the network on held-out trials; None: it was not tested.
    """

    network: StateMap
    range_: Range | None = None
    force_frame: str = "world"
    training: Mapping[str, Any] = field(default_factory=dict)
    test: HeldOutTest | None = None

    def to(self, device: torch.device) -> "Learned":
        """Returns the model on a device; its network moves there."""
        range_ = None if self.range_ is None else self.range_.to(device)
        return replace(self, network=self.network.to(device), range_=range_)

    @property
    def replaces_simulator(self) -> bool:
        """Whether the network predicts the next state, in place of a simulator."""
        return isinstance(self.network, NextState)

    def description(self) -> dict[str, Any]:
        """Metadata of a checkpoint besides the description of the network."""
        range_ = None if self.range_ is None else self.range_.description()
        return {"range": range_, "force_frame": self.force_frame, "test": self.test}

    def write(self, path: Path, fingerprint: str) -> None:
        """Writes a checkpoint of the network.

        Raises:
            DataFileError: the file cannot be written.
        """
        metadata = {
            **self.network.description(),
            **self.description(),
            **self.training.get("kept", {}),
        }
        metadata["fingerprint"] = fingerprint
        write_checkpoint(path, _KINDS[type(self.network)], self.network.state_dict(), metadata)

    @classmethod
    def read(cls, path: Path, network_type: type[StateMap], device: torch.device) -> "Learned":
        """Reads a checkpoint.

        Raises:
            DataFileError: the file is missing or damaged.
        """
        tensors, description = read_checkpoint(path, _KINDS[network_type])
        network = restore(network_type, tensors, description).to(device)
        limits = description["range"]
        range_ = None if limits is None else Range.restore(limits, network.linear)
        return cls(network, range_, str(description["force_frame"]), test=description.get("test"))


def force_frames(simulator: Simulator, kind: str) -> VertexFrames | None:
    """Returns the corotational frames of residual forces.

    None for forces in the world's frame (``world``).

    Raises:
        InputError: another kind.
    """
    if kind not in ("world", COROTATED):
        raise InputError(f"force_frame is {kind!r}: choose world or {COROTATED}.")
    return (
        VertexFrames(simulator.body, simulator.time_step, simulator.rest_positions)
        if kind == COROTATED
        else None
    )
