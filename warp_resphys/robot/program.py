"""Learned forces as programs of torch.export: for other simulators, and for runtimes without this package."""

import io
from collections.abc import Sequence
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
_EXAMPLES: Final = 2  # environments with which the program is traced; it takes any number
_MOVEMENT: Final = (*(f"velocity {a} [m/s]" for a in "xyz"), *(f"rate of rotation {a} [rad/s]" for a in "xyz"))


class _Program(nn.Module):
    """What `LearnedPredictor` does in a step, as one function of tensors."""

    def __init__(self, network: StateMap, range_: Range | None, frames: VertexFrames | None) -> None:
        super().__init__()
        self.network, self._range, self._frames = network, range_, frames

    def forward(
        self, q: torch.Tensor, v: torch.Tensor, told: torch.Tensor | None = None, hidden: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, ...]:
        """Force, or the next state, and the next hidden state; the arguments are those that `export_network` names."""
        inputs = self.network.encode(q, v, told)
        if self._range is not None:
            inputs = self._range.hold(inputs)
        fields, later = self.network.decode(inputs, hidden)
        found = [field.to(q.dtype) for field in fields]
        if self._frames is not None:
            found = [self._frames.to_world(q, v, found[0])]
        return (*found, *(() if later is None else (later,)))


def export_network(robot: Robot, path: str | Path) -> Path:
    """Writes what a robot has learned as a program that `torch.export.load` opens, for any number of environments.

    It takes q (B, N, 3) [m] and v (B, N, 3) [m/s]; if the network is told of inputs, these (B, A) as `told_names` lists
    them; and if it is recurrent, its hidden state (B, H), zero at the start. It gives the residual force (B, N, 3) [N]
    in the world (of the data-driven model the next q and v), and the next hidden state. What leaves the range of the
    training is held at its edge, as in `Robot.step`. A base that moves is not in it: give states in the base's frame.

    Args:
        robot: with a learned force.
        path: of the ``.pt2`` file.

    Raises:
        InputError: the robot has learned nothing, or another extension.
        DataFileError: it cannot be written.
    """
    place, learned = Path(path).expanduser(), robot.description.learned
    if place.suffix != SUFFIX:
        raise InputError(f"{place} does not end in {SUFFIX}: give such a name.")
    if learned is None:
        raise InputError(f"the model {robot.description.model!r} is a simulator alone: it has learned nothing.")
    network, q = learned.network, robot.simulator.rest_positions.repeat(_EXAMPLES, 1, 1)
    arguments: list[torch.Tensor | None] = [q, torch.zeros_like(q), None, None]
    if network.actuation is not None:
        arguments[2] = q.new_zeros(_EXAMPLES, network.actuation.size)
    if isinstance(network.network, RecurrentMLP):
        assert network.recurrent is not None
        arguments[3] = torch.zeros(_EXAMPLES, network.recurrent).to(network.linear)
    batch = torch.export.Dim("batch")
    shapes = tuple(None if each is None else {0: batch} for each in arguments)
    with torch.no_grad():
        program = _Program(network, learned.range_, robot.frames).eval()
        exported = torch.export.export(program, tuple(arguments), dynamic_shapes=shapes)
    content = io.BytesIO()
    torch.export.save(exported, content)
    with atomic_path(place) as partial:
        partial.write_bytes(content.getvalue())
    return place


def told_names(robot: Robot) -> Sequence[str]:
    """The A numbers that a robot's network is told beside the state, in their order."""
    known, found = robot.description, list[str]()
    if known.payload_at is not None and known.sees_payload:
        found.append("payload [kg]")
    for each in (robot.inputs[name] for name in robot.driven if name in known.seen):
        own = [f"{each.name} {part} [{each.unit}]" for part in each.parts]
        found += own + [f"mean of {name} over {seconds:g} s" for seconds in known.filters for name in own]
    if known.told_of_base is not None:
        parts = [f"{when} {what}" for when in ("during", "before") for what in _MOVEMENT]
        parts += [f"gravity {axis}" for axis in "xyz"]
        found += [name for name, told in zip(parts, known.told_of_base, strict=True) if told]
    return found
