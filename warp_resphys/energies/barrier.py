"""The barrier and the smoothed friction of contact on tensors (equations in `energies.contact`)."""

from typing import Any

import torch
from typing_extensions import override

from ..stepping.adjoints import AdjointFunction, first_derivatives


def barrier_pressure(d: torch.Tensor, reach: float) -> torch.Tensor:
    """Returns the pressure of the barrier over its stiffness, -B'(d / D), at distances d > 0, with the reach D [m]."""
    pressure: torch.Tensor = _Pressure.apply(d, reach)
    return pressure


class _Pressure(AdjointFunction):
    """The pressure of the barrier, whose derivative is computed with it."""

    @override
    @staticmethod
    def forward(ctx: Any, d: torch.Tensor, reach: float) -> torch.Tensor:
        s = (d / reach).clamp_max(1.0)
        log, below = s.log(), (s - 1.0) / s
        ctx.save_for_backward(d, (2.0 * log + below * (4.0 - below)) / reach)
        return (s - 1.0) * (2.0 * log + below)

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, slope: torch.Tensor) -> tuple[torch.Tensor, None]:
        _, derivative = ctx.saved_tensors
        return slope * derivative, None


def friction_over_slide(u: torch.Tensor, slip: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the sizes y (...) of slides u (..., 3) [m], and f'(y) / y [1/m] of friction.

    Args:
        u: slides; derivatives at zero are those of the smooth limit.
        slip: slide at which friction is fully developed [m].
    """
    square, tiny = u.square().sum(-1), torch.finfo(u.dtype).tiny
    y = torch.where(square > 0.0, square.clamp_min(tiny).sqrt(), 0.0)
    return y, torch.where(y < slip, (2.0 - y / slip) / slip, 1.0 / y.clamp_min(tiny))
