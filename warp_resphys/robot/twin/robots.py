"""Protocol of the robots that a twin can follow; `Robot` has these methods, and imports this package."""

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csc_array

from ...dynamics.simulator import Simulator
from ...stepping.constants import Constants
from ..description import Description
from ..inputs import RobotInput
from ..state import RobotState


class Steppable(Protocol):
    """A robot that is stepped; `Robot` documents the members."""

    description: Description
    simulator: Simulator
    time_step: float
    labels: tuple[str, ...]
    inputs: dict[str, RobotInput]
    parameters: dict[str, torch.Tensor]
    constants: Constants

    @property
    def is_data_driven(self) -> bool:
        """Whether a network replaces the simulator."""

    def with_parameters(self, **parameters: torch.Tensor | float) -> "Steppable":
        """Returns the robot with other parameters."""

    def state(self, q: torch.Tensor, v: torch.Tensor | None = None) -> RobotState:
        """Returns a state of given positions, with a history of zero inputs."""

    def begin(self, batch: int = 1, **inputs: Any) -> RobotState:
        """Returns the equilibrium without the learned force."""

    def settle(self, batch: int = 1, **inputs: Any) -> RobotState:
        """Returns the equilibrium with the learned force."""

    def step(self, state: RobotState, **inputs: Any) -> RobotState:
        """Returns the state after a step."""

    def observe(self, state: RobotState) -> torch.Tensor:
        """Returns the markers (B, M, 3) [m]."""

    def linearised(self, state: RobotState, **inputs: Any) -> tuple[csc_array, csc_array, NDArray[np.int64]]:
        """Returns the Hessian of a step, the inertia in it, and the free vertices."""
