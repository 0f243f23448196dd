"""The barrier and the smoothed friction of contact on tensors,
and contact forces (equations in `obstacle_contact`).
"""

from dataclasses import dataclass
from typing import Any

import torch
from typing_extensions import override

from ....io.errors import InputError
from ...stepping.adjoints import AdjointFunction, first_derivatives
from ...stepping.state import Reaction


def barrier_pressure(d: torch.Tensor, reach: float) -> torch.Tensor:
    """Returns the pressure of the barrier over its stiffness, -B'(d / D),
    at distances d > 0, with the reach D [m].
    """
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


@dataclass(frozen=True)
class ContactForces:
    """Contact at the end of a step, for every vertex of the surface
    and every obstacle, differentiable.

    That between surfaces has no axis of obstacles, and is with the nearest others.

    Attributes:
        obstacles: names of the O obstacles; none for contact between surfaces.
        vertices: (P,) vertices of the surface.
        gap: (B, P, O) distances [m].
        normal: (B, P, O, 3) forces of the barrier on the vertices [N].
        friction: (B, P, O, 3) forces of friction on them [N].
        slide: (B, P, O) size of the velocity of sliding at the end of the step, times the effective
            step h_e [m]: for implicit Euler the slide in the step, for BDF2 not, whose h_e is two
            thirds of a step.
        sticks: (B, P, O) whether a vertex that is pressed against an obstacle slides less than
            friction needs to be fully developed.
        places: (B, P, 3) positions of the vertices [m].
    """

    obstacles: tuple[str, ...]
    vertices: torch.Tensor
    gap: torch.Tensor
    normal: torch.Tensor
    friction: torch.Tensor
    slide: torch.Tensor
    sticks: torch.Tensor
    places: torch.Tensor

    def reaction(self, obstacle: str | None = None) -> Reaction:
        """Returns the forces of the barrier and friction on the surface, of one obstacle or of all.

        Raises:
            InputError: no obstacle of that name.
        """
        forces = self.normal + self.friction
        if obstacle is not None:
            if obstacle not in self.obstacles:
                known = (
                    f"choose one of {', '.join(self.obstacles)}"
                    if self.obstacles
                    else "bodies touch one another here"
                )
                raise InputError(f"there is no obstacle {obstacle!r}: {known}.")
            forces = forces[:, :, self.obstacles.index(obstacle)]
        elif self.obstacles:
            forces = forces.sum(2)
        return Reaction(self.vertices, forces, self.places)
