"""Exports learned forces with torch.export, for other simulators and for runtimes without this package."""

import io
from collections.abc import Sequence
from itertools import compress
from pathlib import Path
from typing import Final

import torch
from torch import nn

from ..dynamics.frames import VertexFrames
from ..io.atomic import atomic_path
from ..io.errors import InputError
from ..learning.networks import RecurrentMLP, StateMap
from ..learning.predictors import Range
from .robot import Robot

SUFFIX: Final = ".pt2"
_EXAMPLES: Final = 2  # batch size with which the program is traced; it accepts any
_MOVEMENT: Final = (*(f"velocity {a} [m/s]" for a in "xyz"), *(f"rate of rotation {a} [rad/s]" for a in "xyz"))


class _Program(nn.Module):
    """One step of `LearnedPredictor` as a function of tensors."""

    def __init__(self, network: StateMap, range_: Range | None, frames: VertexFrames | None) -> None:
        super().__init__()
        self.network, self._range, self._frames = network, range_, frames

    def forward(
        self,
        q: torch.Tensor,
        v: torch.Tensor,
        conditions: torch.Tensor | None = None,
        hidden: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """Returns force, or next state, and next hidden state, with the arguments of `export_network`'s program."""
        inputs = self.network.encode(q, v, conditions)
        weight = None
        if self._range is not None:
            if self._range.missed is not None:
                weight = self._range.weight(inputs, self.network.missed(q, v).to(inputs)).to(q)
            inputs = self._range.clamp(inputs)
        fields, later = self.network.decode(inputs, hidden)
        outputs = [field.to(q.dtype) for field in fields]
        if weight is not None:
            outputs[0] = outputs[0] * weight[:, None, None]
        if self._frames is not None:
            outputs = [self._frames.to_world(q, v, outputs[0])]
        return (*outputs, *(() if later is None else (later,)))


def export_network(robot: Robot, path: str | Path) -> Path:
    """Writes a robot's network as a program that `torch.export.load` opens, for any batch size.

    Its arguments are q (B, N, 3) [m] and v (B, N, 3) [m/s]; the conditions (B, A) that `condition_names` lists, if the
    network takes any; and the hidden state (B, H), zero at the start, if it is recurrent. It returns the residual force
    (B, N, 3) [N] in the world frame (the data-driven model: the next q and v), and the next hidden state. Inputs are
    clipped to the training range, beyond which a force on an identified law fades out, as in `Robot.step`. A moving
    base is not included: give states in the base's frame.

    Args:
        robot: with a learned force.
        path: of the ``.pt2`` file.

    Raises:
        InputError: the robot has no network, or the path another extension.
        DataFileError: the file cannot be written.
    """
    place, learned = Path(path).expanduser(), robot.description.learned
    if place.suffix != SUFFIX:
        raise InputError(f"{place} does not end in {SUFFIX}: give such a name.")
    if learned is None:
        raise InputError(f"the model {robot.description.model!r} has no network to export: choose a learned model.")
    network, q = learned.network, robot.simulator.rest_positions.repeat(_EXAMPLES, 1, 1)
    arguments: list[torch.Tensor | None] = [q, torch.zeros_like(q), None, None]
    if network.actuation is not None:
        arguments[2] = q.new_zeros(_EXAMPLES, network.actuation.size)
    if isinstance(network.network, RecurrentMLP):
        assert network.recurrent is not None
        arguments[3] = torch.zeros(_EXAMPLES, network.recurrent).to(network.linear)
    batch = torch.export.Dim("batch")
    shapes = tuple(None if argument is None else {0: batch} for argument in arguments)
    with torch.no_grad():
        program = _Program(network, learned.range_, robot.frames).eval()
        exported = torch.export.export(program, tuple(arguments), dynamic_shapes=shapes)
    content = io.BytesIO()
    torch.export.save(exported, content)
    with atomic_path(place) as partial:
        partial.write_bytes(content.getvalue())
    return place


def condition_names(robot: Robot) -> Sequence[str]:
    """Returns the names of the A inputs that a robot's network takes beside the state, in order."""
    description, names = robot.description, list[str]()
    if description.payload_at is not None and description.sees_payload:
        names.append("payload [kg]")
    for taken in [taken for name, taken in robot.inputs.items() if name in description.seen]:
        parts = [f"{taken.name} {part} [{taken.unit}]" for part in taken.parts]
        names += parts + [f"mean of {part} over {seconds:g} s" for seconds in description.filters for part in parts]
    if description.told_of_base is not None:
        base = [f"{when} {what}" for when in ("during", "before") for what in _MOVEMENT]
        base += [f"gravity {axis}" for axis in "xyz"]
        names += compress(base, description.told_of_base)
    return names
