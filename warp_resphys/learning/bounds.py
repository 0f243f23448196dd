"""Ranges of the parameters to identify, as fractions from 0 to 1, and their normal priors."""

import math
from dataclasses import dataclass

import torch

from ..io.errors import InputError


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a parameter: a normal distribution, of its logarithm where that is searched."""

    mean: float  # in the parameter's unit
    deviation: float  # standard deviation, in the parameter's unit


@dataclass(frozen=True)
class Bounds:
    """The range of a parameter."""

    lower: float  # in the parameter's unit
    upper: float  # in the parameter's unit
    logarithmic: bool = False  # whether it is searched on a logarithmic scale
    prior: Prior | None = None

    def __post_init__(self) -> None:
        """Checks the range.

        Raises:
            InputError: an empty or infinite range, or a logarithmic one that is not positive.
        """
        if not (math.isfinite(self.lower) and math.isfinite(self.upper) and self.lower < self.upper):
            raise InputError(f"the bounds {self.lower:g} and {self.upper:g} leave no range: the first must be smaller.")
        if self.logarithmic and not self.lower > 0.0:
            raise InputError(f"a logarithmic range from {self.lower:g}: its lower bound must be positive.")
        if self.prior is not None and not self.lower <= self.prior.mean <= self.upper:
            raise InputError(
                f"the prior has the mean {self.prior.mean:g}, outside of the range from {self.lower:g} to "
                f"{self.upper:g}: widen the range, or correct the prior."
            )

    def unit_prior(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the prior, as fractions of the range; None without a prior."""
        if self.prior is None:
            return None
        mean = self.to_unit(self.prior.mean)
        return mean, self.prior.deviation / self.slope(mean)

    def to_unit(self, value: float) -> float:
        """Returns a value as a fraction of the range, 0 to 1."""
        low, high, x = (math.log(v) if self.logarithmic else v for v in (self.lower, self.upper, value))
        return (x - low) / (high - low)

    def from_unit(self, unit: torch.Tensor) -> torch.Tensor:
        """Returns the values at fractions of the range; differentiable."""
        if self.logarithmic:
            return self.lower * torch.exp(unit * math.log(self.upper / self.lower))
        return self.lower + unit * (self.upper - self.lower)

    def slope(self, unit: float) -> float:
        """Derivative of the value by its fraction of the range."""
        if self.logarithmic:
            return self.lower * (self.upper / self.lower) ** unit * math.log(self.upper / self.lower)
        return self.upper - self.lower
