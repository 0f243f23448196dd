"""Mass, weight and the energies' values that follow from a simulator's parameters, computed once a roll-out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from ..io.errors import InputError


def sum_of(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns the sum of tensors that broadcast."""
    return torch.stack(torch.broadcast_tensors(*tensors)).sum(0)


@dataclass(frozen=True)
class Mass:
    """Mass at the vertices, of one energy or of a whole body; differentiable."""

    inertia: torch.Tensor  # (1 or B, N) [kg]
    weight: torch.Tensor  # (1 or B, N) what gravity acts on [kg]
    damping: torch.Tensor  # (1 or B, 1 or N) alpha of the force -alpha m v [1/s]

    @classmethod
    def joined(cls, masses: "Sequence[Mass]") -> "Mass":
        """Returns the sum of the masses of several solids, with the mean of their damping at a vertex they share."""
        inertia, weight = (sum_of([getattr(mass, name) for mass in masses]) for name in ("inertia", "weight"))
        damping = sum_of([mass.damping * mass.inertia for mass in masses])
        return cls(inertia, weight, damping / torch.where(inertia > 0.0, inertia, 1.0))


@dataclass(frozen=True)
class Constants:
    """Differentiable tensors that stay the same during a roll-out."""

    mass: torch.Tensor  # (1 or B, N) [kg]
    load_mass: torch.Tensor  # (1 or B, N) what gravity acts on [kg]
    gravity: torch.Tensor  # (1 or B, 3) [m/s^2]
    mass_damping: torch.Tensor  # (1 or B, 1 or N) [1/s]
    # of the energies, by name; None for what does not act
    values: Mapping[str, torch.Tensor | None]

    @property
    def batch(self) -> int:
        """Environments that the tensors are for; 1 where all have the same."""
        return max(map(len, self._tensors))

    @property
    def _tensors(self) -> tuple[torch.Tensor, ...]:
        values = (value for value in self.values.values() if value is not None)
        return (self.mass, self.gravity, self.mass_damping, *values)

    def value(self, name: str) -> torch.Tensor:
        """Returns a value that is always there, such as an energy's own parameter."""
        value = self.values[name]
        assert value is not None
        return value

    def check_batch(self, batch: int) -> None:
        """Refuses constants of another number of environments.

        Raises:
            InputError: a constant has neither one value nor one per environment.
        """
        for tensor in self._tensors:
            if len(tensor) not in (1, batch):
                raise InputError(
                    f"a material parameter has values for {len(tensor)} environments, but the state has {batch}."
                )
