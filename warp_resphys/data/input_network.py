"""Networks that change the inputs of a body: the residual in its actuators."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, Self

import numpy as np
import torch

Array = Any  # of NumPy or torch

_LEAST_DISTANCE: Final = 1e-3  # between centres, of the largest input
_LEAST_VARIANCE: Final = 1e-3  # of a value in the training, of the square of the largest input
# Square of the Mahalanobis distance over the largest one of the training, from which it fades.
_REACH: Final = 2.0
_JITTER: Final = 1e-6  # added to the variance of the process, 1, at the centres


class InputNetwork(torch.nn.Module):
    """The change of an input (C,) of a body beyond its identified response x: f(x, means of x).

    f is the mean of Gaussian processes, one for each part, that are zero under no input: inputs
    that have long been zero are not changed. Their kernel k(a, b) = exp(-|a - b|^2 / 2) has the
    largest input of the training as its unit. f is a sum of k about N centres (Rasmussen and
    Williams 2006, section 8.3.1). It starts as zero. Away from the values of the training, it fades
    with the Mahalanobis distance d from their mean, by min(1, 2 d_max^2 / d^2).

    Args:
        filters: F time constants of the exponential means [s].
        unit: largest input [unit of the input].
        centres: (N, C (1 + F)) inputs and means, over the unit.
        mean: (C (1 + F),) of the training, over the unit.
        precision: (C (1 + F), C (1 + F)) inverse covariance over 2 d_max^2, twice the largest d^2
            of the training.
        basis: (N, N) functions with which weights of unit variance give the process, from kernels
            about the centres.
    """

    def __init__(
        self,
        filters: Sequence[float],
        unit: float,
        centres: torch.Tensor,
        mean: torch.Tensor,
        precision: torch.Tensor,
        basis: torch.Tensor,
    ) -> None:
        super().__init__()
        self.filters, self.unit = tuple(filters), unit
        self.parts = centres.shape[1] // (1 + len(filters))
        for name, x in {
            "centres": centres,
            "mean": mean,
            "precision": precision,
            "basis": basis,
        }.items():
            self.register_buffer(name, x.double())
        self.weights = torch.nn.Parameter(self.basis.new_zeros(len(centres), self.parts))

    centres: torch.Tensor
    mean: torch.Tensor
    precision: torch.Tensor
    basis: torch.Tensor

    @classmethod
    def of_training(cls, values: torch.Tensor, filters: Sequence[float], most: int) -> Self:
        """Returns a network without an effect.

        Args:
            values: (S, C (1 + F)) inputs and their means in the training [unit of the input].
            filters: F time constants of the means [s].
            most: number of centres, at most: values that are far from zero and each other.
        """
        values = values.double()
        unit = float(values.abs().max()) or 1.0
        values = values / unit
        chosen, distances = list[int](), values.norm(dim=1)
        while len(chosen) < most and (not chosen or float(distances.max()) > _LEAST_DISTANCE):
            chosen.append(int(distances.argmax()))
            distances = torch.minimum(distances, (values - values[chosen[-1]]).norm(dim=1))
        centres, away = values[chosen], values - values.mean(0)
        one = torch.eye(values.shape[1]).to(values)
        precision = torch.linalg.inv(away.T @ away / len(values) + _LEAST_VARIANCE * one)
        precision = precision / (_REACH * ((away @ precision) * away).sum(1).max().clamp_min(1.0))
        covariance = _kernel(centres, centres)
        covariance.diagonal().add_(_JITTER)
        basis = torch.linalg.inv(torch.linalg.cholesky(covariance)).T
        return cls(filters, unit, centres, values.mean(0), precision, basis)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Returns what is added to an input (..., C),
        for the input and its means (..., C (1 + F)).
        """
        x = values.to(self.centres) / self.unit
        away = x - self.mean
        beyond = ((away @ self.precision) * away).sum(-1, keepdim=True).clamp_min(1.0)
        return (self.unit / beyond * (_kernel(x, self.centres) @ (self.basis @ self.weights))).to(
            values
        )

    def added(self, values: Array) -> Array:
        """Returns what is added, as `forward`, for NumPy arrays, too."""
        if isinstance(values, torch.Tensor):
            return self(values)
        with torch.no_grad():
            return (
                self(torch.as_tensor(np.asarray(values), device=self.centres.device)).cpu().numpy()
            )

    def plain(self) -> dict[str, Any]:
        """Returns all that defines the network as plain data."""
        values = {"centres": self.centres, "mean": self.mean, "precision": self.precision}
        values |= {"coefficients": (self.basis @ self.weights).detach()}
        return {
            "filters": [*self.filters],
            "unit": self.unit,
            **{name: x.tolist() for name, x in values.items()},
        }

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Self:
        """Returns the network of `plain`."""
        tensors = {
            name: torch.tensor(x, dtype=torch.float64)
            for name, x in plain.items()
            if isinstance(x, list)
        }
        coefficients, filters = tensors.pop("coefficients"), tensors.pop("filters").tolist()
        network = cls(
            filters,
            plain["unit"],
            **tensors,
            basis=torch.eye(len(coefficients), dtype=torch.float64),
        )
        network.load_state_dict({**network.state_dict(), "weights": coefficients})
        return network.eval().requires_grad_(False)


def _kernel(x: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """(..., N) covariance of values (..., P) and centres (N, P)
    of a process of unit variance that is zero at zero.
    """
    squares, of_centres = x.square().sum(-1, keepdim=True), centres.square().sum(-1)
    return torch.exp(x @ centres.T - 0.5 * (squares + of_centres)) - torch.exp(
        -0.5 * (squares + of_centres)
    )


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
