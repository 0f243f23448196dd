"""What energies need that depends on where a step starts, and what they carry on to the next."""

from typing import Any, Protocol

import torch

from .constants import Constants
from .inputs import Inputs
from .integrator import ImplicitStage, State


class StepPart(Protocol):
    """An energy over steps."""

    def values(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants
    ) -> dict[str, torch.Tensor]:
        """What its term needs of a step from a state."""

    def still(self, batch: int) -> dict[str, torch.Tensor]:
        """What it needs where nothing moves."""

    def load(self, inputs: Inputs, constants: Constants, batch: int, static: bool) -> torch.Tensor | None:
        """(1 or B, N, 3) a force that does not depend on where the body is [N], in equilibria or in steps."""

    def after(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor
    ) -> dict[str, Any]:
        """The fields of the state that a step leads to whose solve has the solution x (B, N, 3) [m]."""
