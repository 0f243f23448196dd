"""Parameters and inputs of a simulation: names, units and valid ranges."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...io.errors import InputError

Parameter = float | Sequence[float] | NDArray[np.float64] | torch.Tensor


@dataclass(frozen=True)
class Quantity:
    """A parameter or an input of a simulation."""

    name: str  # key under which parameters and inputs are passed
    unit: str  # SI unit of the values
    lower: float = -np.inf  # exclusive lower bound, inclusive if `closed`
    upper: float = np.inf  # exclusive upper bound
    closed: bool = False  # whether `lower` itself is allowed
    per: str = ""  # ``element``, ``chamber`` and the like, with a value for each; empty: per body
    shape: tuple[int, ...] = ()  # of an array-valued quantity, such as a direction; excludes `per`
    typical: float = 1.0  # order of magnitude of an input, or of a parameter without bounds
    words: str = ""  # name of an input in a sentence
    shown_unit: str = ""  # unit of displayed values
    shown_factor: float = 1.0  # number of `shown_unit` in one `unit`

    def __float__(self) -> float:
        """Raises InputError, as a quantity is no number."""
        raise InputError(
            f"{self.name} is declared here, with its unit and range: "
            "its value is in `defaults`, by name."
        )

    def shown(self, value: float) -> str:
        """Returns a value as text, in the displayed unit."""
        return f"{self.shown_factor * value:.4g} {self.shown_unit}"

    @property
    def plural(self) -> str:
        """Plural of `words`."""
        return f"{self.words}{'es' if self.words.endswith('s') else 's'}"

    @property
    def valid_range(self) -> str:
        """The valid range in words, with the unit."""
        unit = f", in {self.unit}" if self.unit else ""
        if self.lower == 0.0 and np.isinf(self.upper):
            return ("zero or more" if self.closed else "positive") + unit
        ends = [f"greater than {self.lower:g}"] if np.isfinite(self.lower) else []
        ends += [f"less than {self.upper:g}"] if np.isfinite(self.upper) else []
        return (" and ".join(ends) or "finite") + unit

    def varied(self, value: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Returns a value within the range for every x, and `value` itself for x = 0.

        Near x = 0 a bounded value changes by the factor exp(x), an unbounded one by x times its
        size or `typical`.
        """
        if np.isfinite(self.lower) and np.isfinite(self.upper):
            width = self.upper - self.lower
            return self.lower + width * torch.sigmoid(torch.logit((value - self.lower) / width) + x)
        if np.isfinite(self.lower):
            return self.lower + (value - self.lower) * torch.exp(x)
        return value + value.abs().amax().clamp_min(self.typical) * x

    def check(self, value: Any) -> None:
        """Raises InputError unless a value is a number
        or an array of numbers, all within the range.
        """
        try:
            values = torch.as_tensor(value, dtype=torch.float64).detach().cpu()
        except (TypeError, ValueError, RuntimeError):
            raise InputError(
                f"{self.name} is {value!r}: it must be a number, {self.valid_range}."
            ) from None
        inside = (values >= self.lower if self.closed else values > self.lower) & (
            values < self.upper
        )
        inside &= torch.isfinite(values)
        if (
            self.shape
            and tuple(values.shape) != self.shape
            and tuple(values.shape[1:]) != self.shape
        ):
            raise InputError(
                f"{self.name} has shape {tuple(values.shape)}: it must be {self.shape}, or (B, "
                f"*{self.shape}) with one for each environment."
            )
        if not self.shape and (values.numel() == 0 or values.ndim > 2):
            raise InputError(
                f"{self.name} has shape {tuple(values.shape)}: "
                "give a number, (M,), (B, 1) or (B, M) values."
            )
        if not bool(inside.all()):
            wrong = values[~inside].flatten()[0].item()
            raise InputError(f"{self.name} is {wrong:g}: it must be {self.valid_range}.")

    def shaped(self, values: torch.Tensor) -> torch.Tensor:
        """Returns a number, (n,), (B, 1) or (B, n) values as (1 or B, 1 or n),
        an array as (1 or B, *shape).

        Keeps the autograd graph.
        """
        if self.shape:
            return values if values.ndim > len(self.shape) else values[None]
        if not self.per:
            return values.reshape(-1, 1)
        return values.reshape(1, -1) if values.ndim < 2 else values


def parameter(
    default: Any, name: str, unit: str, lower: float = 0.0, *, kw_only: bool = False, **more: Any
) -> Any:
    """Returns a field of a dataclass that holds the value of a parameter.

    Args:
        default: value of an omitted argument; ``dataclasses.MISSING`` without one.
        name: of the `Quantity`, like the following.
        unit: unit of the values.
        lower: exclusive lower bound, inclusive with ``closed=True``; ``-numpy.inf`` for any number.
        kw_only: whether the argument is keyword-only.
        more: other fields of the quantity.
    """
    return field(
        default=default, kw_only=kw_only, metadata={"quantity": Quantity(name, unit, lower, **more)}
    )


def quantities_of(kind: Any) -> dict[str, Quantity]:
    """Returns the quantities of a class's fields that are made by `parameter`, by field."""
    known = getattr(kind, "__dataclass_fields__", {})
    return {
        name: item.metadata["quantity"]
        for name, item in known.items()
        if "quantity" in item.metadata
    }
