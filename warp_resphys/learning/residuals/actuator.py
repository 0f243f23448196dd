"""The actuator that is learned: networks that change the inputs of a body."""

from collections.abc import Mapping
from typing import Any

import torch

from ...data.input_network import InputNetwork


class Actuator(torch.nn.Module):
    """Networks by the names of the inputs that they change."""

    def __init__(self, networks: Mapping[str, InputNetwork]) -> None:
        super().__init__()
        self.network = torch.nn.ModuleDict(networks)

    @property
    def inputs(self) -> dict[str, InputNetwork]:
        """The networks by input."""
        networks: Any = self.network.items()
        return dict(networks)
