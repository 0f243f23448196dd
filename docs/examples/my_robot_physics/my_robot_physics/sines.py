"""A network of sines of linear maps, which is smooth (Sitzmann et al., NeurIPS 2020)."""

import torch
from torch import nn

from warp_resphys.io.settings import Natural, Positive, setting
from warp_resphys.settings.extensions import CoreSettings


class Sines(nn.Module):
    """Maps (S, inputs) to (S, outputs) by one hidden layer of sines."""

    def __init__(self, inputs: int, outputs: int, width: int, frequency: float) -> None:
        super().__init__()
        self.first, self.last, self.frequency = nn.Linear(inputs, width), nn.Linear(width, outputs), frequency

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Maps standardised inputs to standardised outputs."""
        return self.last(torch.sin(self.frequency * self.first(x)))


class SineSettings(CoreSettings):
    """A hidden layer of sines."""

    width: Natural = setting(16, "of the layer")
    frequency: Positive = setting(1.0, "factor of the inputs of the sines")

    def build(self, inputs: int, outputs: int) -> Sines:
        """Returns an untrained network."""
        return Sines(inputs, outputs, self.width, self.frequency)
