"""Numbers that a simulation depends on: their names, units and ranges."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..io.errors import InputError

Parameter = float | Sequence[float] | NDArray[np.float64] | torch.Tensor


@dataclass(frozen=True)
class Quantity:
    """A number that a simulation depends on."""

    name: str  # by which parameters and inputs are given
    unit: str  # of its values
    lower: float = -np.inf  # all values are greater
    upper: float = np.inf  # all values are less
    closed: bool = False  # whether `lower` itself is allowed
    # what there may be a value each of, such as ``element`` or ``chamber``; without it, only environments
    per: str = ""
    shape: tuple[int, ...] = ()  # of one value that is an array, such as a network's weights; then without `per`
    typical: float = 1.0  # about how large it is: an input, or a parameter that may be anything
    words: str = ""  # what an input is called in a sentence, and
    shown_unit: str = ""  # the unit in which people read it,
    shown_factor: float = 1.0  # of which this many make one of `unit`

    def shown(self, value: float) -> str:
        """A value as people read it."""
        return f"{self.shown_factor * value:.4g} {self.shown_unit}"

    @property
    def plural(self) -> str:
        """What several of it are called."""
        return f"{self.words}{'es' if self.words.endswith('s') else 's'}"

    @property
    def wanted(self) -> str:
        """Its range in words."""
        unit = f", in {self.unit}" if self.unit else ""
        if self.lower == 0.0 and np.isinf(self.upper):
            return ("zero or more" if self.closed else "positive") + unit
        ends = [f"greater than {self.lower:g}"] if np.isfinite(self.lower) else []
        ends += [f"less than {self.upper:g}"] if np.isfinite(self.upper) else []
        return (" and ".join(ends) or "finite") + unit

    def varied(self, value: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """A value within the range for every x, and the given one for zero.

        At first it changes by a factor exp(x), or by x times its size or `typical` where it may be anything.
        """
        if np.isfinite(self.lower) and np.isfinite(self.upper):
            width = self.upper - self.lower
            return self.lower + width * torch.sigmoid(torch.logit((value - self.lower) / width) + x)
        if np.isfinite(self.lower):
            return self.lower + (value - self.lower) * torch.exp(x)
        return value + value.abs().amax().clamp_min(self.typical) * x

    def check(self, value: Any) -> None:
        """Refuses a value out of range.

        Raises:
            InputError: it is no number or array of numbers, or one of them is out of range.
        """
        try:
            values = torch.as_tensor(value, dtype=torch.float64).detach().cpu()
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"{self.name} is {value!r}: it must be a number, {self.wanted}.") from None
        inside = (values >= self.lower if self.closed else values > self.lower) & (values < self.upper)
        inside &= torch.isfinite(values)
        if self.shape and tuple(values.shape) != self.shape and tuple(values.shape[1:]) != self.shape:
            raise InputError(
                f"{self.name} has shape {tuple(values.shape)}: it must be {self.shape}, or (B, *{self.shape}) with one "
                "for each environment."
            )
        if not self.shape and (values.numel() == 0 or values.ndim > 2):
            raise InputError(
                f"{self.name} has shape {tuple(values.shape)}: give a number, (M,), (B, 1) or (B, M) values."
            )
        if not bool(inside.all()):
            wrong = values[~inside].flatten()[0].item()
            raise InputError(f"{self.name} is {wrong:g}: it must be {self.wanted}.")

    def shaped(self, values: torch.Tensor) -> torch.Tensor:
        """Returns a number, (n,), (B, 1) or (B, n) values as (1 or B, 1 or n), an array as (1 or B, *shape).

        Keeps the autograd graph.
        """
        if self.shape:
            return values if values.ndim > len(self.shape) else values[None]
        if not self.per:
            return values.reshape(-1, 1)
        return values.reshape(1, -1) if values.ndim < 2 else values
