"""Observations: differentiable maps from the vertices of a body to M measured points with D coordinates.

An observation predicts the measurement of a sensor from positions, and gives the residual of a measurement. The
simulator is compared with recordings by these two alone, in `learning.replay`, so that a new kind of sensor is one
class.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Final, Self

import torch
from typing_extensions import override


class Observation(ABC):
    """Map from positions to the measurement of a sensor; subclasses are frozen dataclasses.

    Attributes:
        unit: of the measured coordinates.
        dimension: D, number of coordinates of a measured point.
    """

    unit: ClassVar[str] = "m"
    dimension: ClassVar[int] = 3

    @abstractmethod
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the predicted measurement (B, M, D) [unit] at positions (B, N, 3) of the vertices [m].

        The B bodies may be several trials, sets of parameters and times; all are observed alike.
        """

    def residual(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Returns predicted less measured points, (..., M, D) [unit], zero where a point was not measured (NaN)."""
        seen = torch.isfinite(measured).all(-1, keepdim=True)
        return torch.where(seen, predicted - measured, 0.0)

    def transposed_jacobian(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the transposed derivative (B, 3 N, D M) of the predicted measurement by positions (B, N, 3)."""
        with torch.enable_grad():
            q = positions.detach().requires_grad_(True)
            points = self(q)
            seeds = torch.eye(points[0].numel(), device=q.device, dtype=q.dtype).view(-1, 1, *points.shape[1:])
            (rows,) = torch.autograd.grad(points, q, seeds.expand(-1, *points.shape), is_grads_batched=True)
        return rows.flatten(2).permute(1, 2, 0).contiguous()

    def to(self, like: torch.Tensor) -> Self:
        """Returns the observation on the device and in the precision of a tensor."""
        changed: dict[str, Any] = {field.name: _to(getattr(self, field.name), like) for field in fields(self)}  # type: ignore[arg-type]
        return replace(self, **changed)  # type: ignore[type-var]


@dataclass(frozen=True)
class WholeState(Observation):
    """The positions of all vertices, as a simulated laboratory knows them."""

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        return positions


WHOLE_STATE: Final = WholeState()


def _to(value: Any, like: torch.Tensor) -> Any:
    if isinstance(value, torch.Tensor):
        return value.to(like) if value.is_floating_point() else value.to(like.device)
    if isinstance(value, tuple):
        return tuple(_to(part, like) for part in value)
    return value.to(like) if hasattr(value, "to") else value
