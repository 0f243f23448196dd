"""What acts on a robot, by name: numbers, lists, arrays and tensors as values of its parts, checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import torch
from numpy.typing import ArrayLike

from ..dynamics.simulator import Simulator
from ..energies.base import Energy
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
    """Something that acts on a robot.

    Attributes:
        name: by which it is given.
        unit: of its values.
        parts: what has a value each, such as the chambers.
        low: (C,) the least value of each part in the experiment's trials; None where these have none.
        high: (C,) the greatest.
        quantity: with the range that a simulation takes.
    """

    name: str
    unit: str
    parts: tuple[str, ...]
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    quantity: Quantity = _UNLIMITED

    @property
    def is_driven(self) -> bool:
        """Whether it is what an actuator is told."""
        return self.quantity not in (_UNLIMITED, PAYLOAD)


def inputs_of(simulator: Simulator, description: Description) -> dict[str, RobotInput]:
    """What acts on a robot, by name; beside it, an external force may."""
    found = {}
    for energy in (each for each in simulator.body.energies if isinstance(each, Energy)):
        for quantity in (each for each in energy.inputs if each != PAYLOAD):
            low, high = description.seen.get(quantity.name, (None, None))
            found[quantity.name] = RobotInput(quantity.name, quantity.unit, energy.names, low, high, quantity)
    if description.payload_at is not None:
        found[PAYLOAD.name] = RobotInput(PAYLOAD.name, PAYLOAD.unit, ("payload",), quantity=PAYLOAD)
    if len(simulator.fixed):
        found[BASE] = RobotInput(BASE, "m, rad", _POSE)
    return found


class InputReader:
    """Brings what is given for a robot's inputs into shape.

    Args:
        known: the inputs, by name.
        simulator: on whose device and in whose type they are to be.
    """

    def __init__(self, known: Mapping[str, RobotInput], simulator: Simulator) -> None:
        self._known, self._simulator = known, simulator

    def read(self, name: str, value: Given, batch: int) -> torch.Tensor:
        """(B, C) values of an input during a step, or (B, N, 3) of the external force.

        Raises:
            InputError: an unknown input or part, values of another shape, or out of range.
        """
        if name == FORCE:
            return self.field(value, FORCE).expand(batch, -1, -1)
        if name not in self._known:
            raise InputError(f"there is no input {name!r}: the robot has {listed([*self._known, FORCE])}.")
        known = self._known[name]
        parts = known.parts
        if isinstance(value, Mapping):
            odd = [part for part in value if part not in parts]
            if odd:
                raise InputError(f"{name} has no part {odd[0]!r}: it has {listed(parts)}.")
            value = [float(value.get(part, 0.0)) for part in parts]
        found = self._tensor(value, name)
        found = found[..., None] if len(parts) == 1 and (found.ndim == 0 or found.shape[-1] != 1) else found
        found = found[None] if found.ndim == 1 else found
        if found.ndim != 2 or found.shape[1] != len(parts) or len(found) not in (1, batch):
            raise InputError(
                f"{name} has shape {tuple(found.shape)}: give ({len(parts)},) values in {known.unit}, one for each of "
                f"{listed(parts)}, or as many for each of the {batch} environments."
            )
        if math.isfinite(known.quantity.lower) or math.isfinite(known.quantity.upper):
            known.quantity.check(found)
        if not bool(torch.isfinite(found).all()):
            raise InputError(f"{name} is not finite: check what computes it.")
        return found.expand(batch, -1)

    def is_series(self, name: str, value: Given) -> bool:
        """Whether there is a value for each step."""
        if isinstance(value, Mapping):
            return False
        return self._tensor(value, name).ndim >= (3 if name == FORCE else 2)

    def series(self, name: str, value: Given, batch: int) -> torch.Tensor:
        """(1 or T, B, C) values of an input; see `read`."""
        if isinstance(value, Mapping) or not self.is_series(name, value):
            return self.read(name, value, batch)[None]
        return torch.stack([self.read(name, each, batch) for each in self._tensor(value, name)])

    def field(self, values: Any, name: str) -> torch.Tensor:
        """(B, N, 3) of (N, 3) or (B, N, 3).

        Raises:
            InputError: another shape.
        """
        found = self._tensor(values, name)
        found = found[None] if found.ndim == 2 else found
        wanted = (self._simulator.body.n_vertices, 3)
        if found.ndim != 3 or tuple(found.shape[1:]) != wanted:
            raise InputError(f"{name} has shape {tuple(found.shape)}: give {wanted}, or as many for each environment.")
        return found

    def _tensor(self, value: Any, name: str) -> torch.Tensor:
        try:
            return self._simulator.tensor(value)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"{name} is {value!r}: it must be numbers, or an array or a tensor of them.") from None
