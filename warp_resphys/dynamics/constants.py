"""What a body's parameters come to, once a roll-out."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from ..io.errors import InputError


@dataclass(frozen=True)
class Constants:
    """What parameters make of a body: differentiable tensors, computed once a roll-out."""

    mass: torch.Tensor  # (1 or B, N) [kg]
    load_mass: torch.Tensor  # (1 or B, N) what gravity acts on [kg]
    gravity: torch.Tensor  # (1 or B, 3) [m/s^2]
    mass_damping: torch.Tensor  # (1 or B, 1) [1/s]
    stiffness_damping: torch.Tensor  # (1 or B,) [s]
    damped: bool  # whether stiffness damping acts at all
    prony_ratio: torch.Tensor  # (1 or B, K) moduli of the Prony branches over mu
    prony_time: torch.Tensor  # (1 or B, K) their relaxation times [s]
    relaxes: bool  # whether the branches act at all
    values: Mapping[str, torch.Tensor]  # what the energies need of them, by name

    @property
    def batch(self) -> int:
        """Environments that they are for; 1 where they are the same for all."""
        return max(map(len, self._tensors))

    @property
    def _tensors(self) -> tuple[torch.Tensor, ...]:
        common = (self.mass, self.gravity, self.mass_damping, self.stiffness_damping)
        return (*common, self.prony_ratio, self.prony_time, *self.values.values())

    def check_batch(self, batch: int) -> None:
        """Refuses constants of another number of environments.

        Raises:
            InputError: some constant has neither one value nor one for each environment.
        """
        for tensor in self._tensors:
            if len(tensor) not in (1, batch):
                raise InputError(
                    f"a material parameter has values for {len(tensor)} environments, but the state has {batch}."
                )
