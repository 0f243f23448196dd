"""Inputs of a robot by name: checked values, given as numbers, lists, arrays, tensors or by part."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import torch
from numpy.typing import ArrayLike

from ..dynamics.simulator import Simulator
from ..energies.base import Energy
from ..energies.contact import MOTION
from ..energies.strings import PAYLOAD
from ..io.errors import InputError, listed
from ..stepping.quantity import Quantity
from .description import Description

BASE: Final = "base"
FORCE: Final = "external_force"
_POSE: Final = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
_UNLIMITED: Final = Quantity("", "")
Given = ArrayLike | torch.Tensor | Mapping[str, float]


@dataclass(frozen=True)
class RobotInput:
    """An input of a robot.

    Attributes:
        name: keyword of the input in `Robot.step`.
        unit: of its values.
        parts: names of its C values, such as the chambers.
        low: (C,) least values in the experiment's trials; None if the trials lack the input.
        high: (C,) greatest values in the experiment's trials.
        quantity: with the range that a simulation accepts.
    """

    name: str
    unit: str
    parts: tuple[str, ...]
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    quantity: Quantity = _UNLIMITED

    @property
    def is_driven(self) -> bool:
        """Whether it is the command of an actuator."""
        return self.is_taken and self.quantity not in MOTION

    @property
    def is_taken(self) -> bool:
        """Whether an energy of the body takes it: the command of an actuator, or the motion of an obstacle."""
        return self.quantity not in (_UNLIMITED, PAYLOAD)


def inputs_of(simulator: Simulator, description: Description) -> dict[str, RobotInput]:
    """Returns the inputs of a robot by name, except the external force."""
    inputs = {}
    for energy in [energy for energy in simulator.body.energies if isinstance(energy, Energy)]:
        for quantity in [quantity for quantity in energy.inputs if quantity != PAYLOAD]:
            low, high = description.seen.get(quantity.name, (None, None))
            inputs[quantity.name] = RobotInput(quantity.name, quantity.unit, energy.names, low, high, quantity)
    if description.payload_at is not None:
        inputs[PAYLOAD.name] = RobotInput(PAYLOAD.name, PAYLOAD.unit, ("payload",), quantity=PAYLOAD)
    if len(simulator.fixed):
        inputs[BASE] = RobotInput(BASE, "m, rad", _POSE)
    return inputs


class InputReader:
    """Converts values of a robot's inputs to tensors, and checks them.

    Args:
        inputs: by name.
        simulator: whose device and type the tensors get.
    """

    def __init__(self, inputs: Mapping[str, RobotInput], simulator: Simulator) -> None:
        self._inputs, self._simulator = inputs, simulator

    def read(self, name: str, value: Given, batch: int) -> torch.Tensor:
        """Returns the values (B, C) of an input during a step, or (B, N, 3) of the external force.

        Raises:
            InputError: an unknown input or part, values of another shape, or out of range.
        """
        if name == FORCE:
            return self.field(value, FORCE).expand(batch, -1, -1)
        if name not in self._inputs:
            raise InputError(f"there is no input {name!r}: the robot has {listed([*self._inputs, FORCE])}.")
        declared = self._inputs[name]
        parts = declared.parts
        if isinstance(value, Mapping):
            unknown = [part for part in value if part not in parts]
            if unknown:
                raise InputError(f"{name} has no part {unknown[0]!r}: it has {listed(parts)}.")
            value = [float(value.get(part, 0.0)) for part in parts]
        values = self._tensor(value, name)
        values = values[..., None] if len(parts) == 1 and (values.ndim == 0 or values.shape[-1] != 1) else values
        values = values[None] if values.ndim == 1 else values
        if values.ndim != 2 or values.shape[1] != len(parts) or len(values) not in (1, batch):
            raise InputError(
                f"{name} has shape {tuple(values.shape)}: give ({len(parts)},) values in {declared.unit}, one for each "
                f"of {listed(parts)}, or ({batch}, {len(parts)}) for the {batch} environments."
            )
        if math.isfinite(declared.quantity.lower) or math.isfinite(declared.quantity.upper):
            declared.quantity.check(values)
        if not bool(torch.isfinite(values).all()):
            raise InputError(f"{name} has values that are not finite: check how they are computed.")
        return values.expand(batch, -1)

    def is_series(self, name: str, value: Given) -> bool:
        """Whether the input has a value for each step."""
        if isinstance(value, Mapping):
            return False
        return self._tensor(value, name).ndim >= (3 if name == FORCE else 2)

    def series(self, name: str, value: Given, batch: int) -> torch.Tensor:
        """Returns the values (1, B, C) of a constant input or (T, B, C) of a series; raises the errors of `read`."""
        if isinstance(value, Mapping) or not self.is_series(name, value):
            return self.read(name, value, batch)[None]
        return torch.stack([self.read(name, now, batch) for now in self._tensor(value, name)])

    def field(self, values: Any, name: str) -> torch.Tensor:
        """Returns vectors of the vertices (B, N, 3), given as (N, 3) or (B, N, 3).

        Raises:
            InputError: another shape.
        """
        field = self._tensor(values, name)
        field = field[None] if field.ndim == 2 else field
        wanted = (self._simulator.body.n_vertices, 3)
        if field.ndim != 3 or tuple(field.shape[1:]) != wanted:
            raise InputError(f"{name} has shape {tuple(field.shape)}: give {wanted}, or one such array an environment.")
        return field

    def _tensor(self, value: Any, name: str) -> torch.Tensor:
        try:
            return self._simulator.tensor(value)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise InputError(f"{name} is {value!r}: give numbers, or an array or a tensor of numbers.") from None
