"""What sensors show of a body: a differentiable map from its vertices to M measured points of D numbers each.

An observation gives what a sensor would show of positions, and how far that is from what it did show. The simulator is
compared with recordings by these two alone, in `learning.replay`, so that an observation of another kind is one class.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Final, Self

import torch
from typing_extensions import override


class Observation(ABC):
    """What a sensor shows of a body; subclasses are frozen dataclasses.

    Attributes:
        unit: of what is measured.
        dimension: D, numbers of a measured point.
    """

    unit: ClassVar[str] = "m"
    dimension: ClassVar[int] = 3

    @abstractmethod
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns what the sensor shows, (B, M, D) [unit], of positions (B, N, 3) [m] of the vertices."""

    def residual(self, shown: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Returns shown less measured points, (..., M, D) [unit], zero where a point was not measured (NaN)."""
        seen = torch.isfinite(measured).all(-1, keepdim=True)
        return torch.where(seen, shown - measured, 0.0)

    def transposed_jacobian(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns (B, 3 N, D M), the transposed derivative of what is shown by positions (B, N, 3)."""
        with torch.enable_grad():
            q = positions.detach().requires_grad_(True)
            shown = self(q)
            seeds = torch.eye(shown[0].numel(), device=q.device, dtype=q.dtype).view(-1, 1, *shown.shape[1:])
            (rows,) = torch.autograd.grad(shown, q, seeds.expand(-1, *shown.shape), is_grads_batched=True)
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
