"""Networks that change the inputs of a body: the residual in its actuators."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch

Array = Any  # of NumPy or torch

_MARGIN = 0.25  # of the width of the training range, by which values may exceed it on either side


class InputNetwork(torch.nn.Module):
    """The change of an input (C,) of a body beyond its identified response x: f(x, means of x) - f(0, 0).

    f has a linear part and a hidden layer, and begins as zero. Its values are clamped to zero and the range of the
    training, widened by a quarter on either side. Inputs that have long been zero are not changed.

    Args:
        low: (C (1 + F),) least inputs and means in the training [unit of the input].
        high: (C (1 + F),) greatest ones.
        filters: F time constants of the exponential means [s].
        width: of the hidden layer.
    """

    def __init__(self, low: torch.Tensor, high: torch.Tensor, filters: Sequence[float], width: int) -> None:
        super().__init__()
        self.filters, values = tuple(filters), len(low)
        self.parts = values // (1 + len(self.filters))
        self.register_buffer("low", low.double().clamp_max(0.0))
        self.register_buffer("high", high.double().clamp_min(0.0))
        self.unit = float(torch.maximum(self.low.abs(), self.high.abs()).max()) or 1.0
        self.linear = torch.nn.Linear(values, self.parts, bias=False, dtype=torch.float64)
        self.hidden = torch.nn.Linear(values, width, dtype=torch.float64)
        self.out = torch.nn.Linear(width, self.parts, bias=False, dtype=torch.float64)
        for layer in (self.linear, self.out):
            torch.nn.init.zeros_(layer.weight)

    low: torch.Tensor
    high: torch.Tensor

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Returns what is added to an input (..., C), for the input and its means (..., C (1 + F))."""
        margin = _MARGIN * (self.high - self.low)
        x = values.to(self.low).clamp(self.low - margin, self.high + margin) / self.unit
        bent = torch.tanh(self.hidden(x)) - torch.tanh(self.hidden.bias)
        return (self.unit * (self.linear(x) + self.out(bent))).to(values)

    def added(self, values: Array) -> Array:
        """Returns what is added, as `forward`, for NumPy arrays, too."""
        if isinstance(values, torch.Tensor):
            return self(values)
        with torch.no_grad():
            return self(torch.as_tensor(np.asarray(values), device=self.low.device)).cpu().numpy()

    def plain(self) -> dict[str, Any]:
        """Returns all that defines the network as plain data."""
        return {"filters": [*self.filters], **{name: values.tolist() for name, values in self.state_dict().items()}}

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Self:
        """Returns the network of `plain`."""
        values = {name: torch.tensor(x, dtype=torch.float64) for name, x in plain.items() if name != "filters"}
        network = cls(values["low"], values["high"], plain["filters"], len(values["hidden.bias"]))
        network.load_state_dict(values)
        return network.eval().requires_grad_(False)


class Actuator(torch.nn.Module):
    """Networks by the names of the inputs that they change, which are trained together."""

    def __init__(self, networks: Mapping[str, InputNetwork]) -> None:
        super().__init__()
        self.network = torch.nn.ModuleDict(networks)

    @property
    def inputs(self) -> dict[str, InputNetwork]:
        """The networks by input."""
        networks: Any = self.network.items()
        return dict(networks)
