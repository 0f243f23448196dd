"""The barrier and the smoothed friction of contact on tensors (equations in `energies.contact`)."""

import torch


def barrier_pressure(d: torch.Tensor, reach: float) -> torch.Tensor:
    """Returns the pressure of the barrier over its stiffness, -B'(d / D), at distances d > 0, with the reach D [m]."""
    s = (d / reach).clamp_max(1.0)
    return 2.0 * (s - 1.0) * s.log() + (s - 1.0).square() / s


def friction_over_slide(u: torch.Tensor, slip: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the sizes y (...) of slides u (..., 3) [m], and f'(y) / y [1/m] of friction.

    Args:
        u: slides; derivatives at zero are those of the smooth limit.
        slip: slide at which friction is fully developed [m].
    """
    square, tiny = u.square().sum(-1), torch.finfo(u.dtype).tiny
    y = torch.where(square > 0.0, square.clamp_min(tiny).sqrt(), 0.0)
    return y, torch.where(y < slip, (2.0 - y / slip) / slip, 1.0 / y.clamp_min(tiny))
