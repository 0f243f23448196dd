"""Masses and energy values computed from the simulator's parameters, once per roll-out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from ..io.errors import InputError


@dataclass(frozen=True)
class Mass:
    """Differentiable vertex masses of one energy or of a whole body."""

    inertia: torch.Tensor  # (1 or B, N) [kg]
    weight: torch.Tensor  # (1 or B, N) mass that gravity acts on [kg]
    damping: torch.Tensor  # (1 or B, 1 or N) alpha of the force -alpha m v [1/s]

    @classmethod
    def sum(cls, masses: "Sequence[Mass]") -> "Mass":
        """Returns the total mass of several solids; damping at a shared vertex is the mean weighted by mass."""
        inertia, weight, damping = (
            torch.stack(torch.broadcast_tensors(*terms)).sum(0)
            for terms in zip(*((m.inertia, m.weight, m.damping * m.inertia) for m in masses), strict=True)
        )
        return cls(inertia, weight, damping / torch.where(inertia > 0.0, inertia, 1.0))


@dataclass(frozen=True)
class Constants:
    """Differentiable tensors that stay constant during a roll-out."""

    mass: torch.Tensor  # (1 or B, N) [kg]
    load_mass: torch.Tensor  # (1 or B, N) mass that gravity acts on [kg]
    gravity: torch.Tensor  # (1 or B, 3) [m/s^2]
    mass_damping: torch.Tensor  # (1 or B, 1 or N) [1/s]
    # values of the energies by name; None where an optional term is switched off
    values: Mapping[str, torch.Tensor | None]

    @property
    def batch(self) -> int:
        """Number of environments with values of their own; 1 where all environments share them."""
        return max(map(len, self._tensors))

    @property
    def _tensors(self) -> tuple[torch.Tensor, ...]:
        values = (value for value in self.values.values() if value is not None)
        return (self.mass, self.gravity, self.mass_damping, *values)

    def value(self, name: str) -> torch.Tensor:
        """Returns a value that is never None, such as an energy's parameter."""
        value = self.values[name]
        assert value is not None
        return value

    def check_batch(self, batch: int) -> None:
        """Raises InputError unless every constant has one value or one per environment."""
        for tensor in self._tensors:
            if len(tensor) not in (1, batch):
                raise InputError(
                    f"a material parameter has values for {len(tensor)} environments, but the state has {batch}."
                )
