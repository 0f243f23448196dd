"""A network of sines of linear maps, which is smooth (Sitzmann et al., NeurIPS 2020)."""

import torch
from torch import nn

from warp_resphys.io.settings import Natural, Positive


class Sines(nn.Module):
    """Maps (S, inputs) to (S, outputs) by one hidden layer of sines.

    Args:
        inputs: of a sample.
        outputs: of a sample.
        width: of the layer.
        frequency: factor of the inputs of the sines.
    """

    def __init__(
        self, inputs: int, outputs: int, width: Natural = 16, frequency: Positive = 1.0
    ) -> None:
        super().__init__()
        self.first, self.last, self.frequency = (
            nn.Linear(inputs, width),
            nn.Linear(width, outputs),
            frequency,
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Maps standardised inputs to standardised outputs."""
        return self.last(torch.sin(self.frequency * self.first(x)))
