"""Value and force of one energy in a given state, for explicit coupling: the force is held during a step.

The implicit coupling of an energy is part of the incremental potential. The derivative of an energy by an input is the
input's conjugate quantity, such as the volume of a chamber for its pressure.
"""

from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ..fem.elements import Points
from .base import Energy, PartTerm, PointSet
from .launcher import Launcher, warp_view


class HeldEnergy(Launcher):
    """One energy of a body with a value for each of its parts, differentiable by positions and values.

    Args:
        energy: such as `pressure.Pressure`.
        points: of the energy.
        n_vertices: N.
        batch: environments B.
        device: of every tensor.
    """

    def __init__(self, energy: Energy, points: Points, n_vertices: int, batch: int, device: torch.device) -> None:
        super().__init__(batch, device)
        everything = slice(0, points.n_points)
        self._set = PointSet(self, points, n_vertices, everything, everything)
        term = energy.term(self, [self._set])
        assert isinstance(term, PartTerm)
        self.term = term

    def force(self, positions: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Returns the force (B, N, 3) [N] at positions (B, N, 3) [m] for values (B, count)."""
        force: torch.Tensor = _Force.apply(self, positions, values)
        return force

    def conjugates(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns minus the derivatives (B, count) of the energy by the values: volumes [m^3] for pressures."""
        conjugates: torch.Tensor = _Conjugates.apply(self, positions)
        return conjugates

    def evaluate(self, positions: torch.Tensor, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the energy of every part (B, count) [J] and the force (B, N, 3) [N], without gradients."""
        positions, values = positions.double(), values.double()
        s = self._set
        stress, energy = self.zeros(s.n_points, 3, s.width), self.zeros(s.n_points)
        kernel, inputs = self.term.step(s, {self.term.value: values.contiguous()}, self._view(positions))
        view, active = s.stress_view(stress), warp_view(self.active, wp.int32)
        step = self.record(kernel, (self.batch, s.n_points), [active, *inputs], [view, warp_view(energy, wp.float64)])
        force = torch.zeros_like(positions)
        self.launch(step, self.gather(s, view, force))
        return self.term.sum_parts(energy), force.neg_()

    def force_adjoint(
        self, positions: torch.Tensor, values: torch.Tensor, adjoint: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Transposed derivatives of `force` by positions and values, applied to (B, N, 3): (B, N, 3) and (B, count)."""
        positions, values, adjoint = positions.double(), values.double(), adjoint.double()
        s, held = self._set, {self.term.value: values.contiguous()}
        view = s.stress_view(self.zeros(s.n_points, 3, s.width))
        tangent = warp_view(self.zeros(s.n_points, s.blocks, 3, 3), wp.mat33d)
        masks = [warp_view(flags, wp.int32) for flags in (self.active, torch.zeros_like(self.active))]
        kernel, inputs = self.term.tangent(s, held, self._view(positions))
        out = torch.zeros_like(positions)
        self.launch(
            self.record(kernel, (self.batch, s.n_points), [*masks, *inputs], [tangent]),
            # The second derivative of an energy is symmetric: it is its own transpose.
            self.product(s, tangent, self._view(adjoint), view),
            self.gather(s, view, out),
        )
        slopes = self.term.adjoint(held, positions.contiguous(), adjoint.contiguous())()
        return out.neg_(), slopes[self.term.value]

    def _view(self, field: torch.Tensor) -> Any:
        return warp_view(field.contiguous(), wp.vec3d)


class _Conjugates(torch.autograd.Function):
    """-dE/dp of an energy that is linear in p: for a loss with gradient w, the gradient by x is the force at p = w."""

    @override
    @staticmethod
    def forward(ctx: Any, held: HeldEnergy, positions: torch.Tensor) -> torch.Tensor:
        ctx.held = held
        ctx.save_for_backward(positions)
        volumes = -held.evaluate(positions.detach(), held.zeros(held.term.count) + 1.0)[0]
        return volumes.to(positions.dtype)

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        (positions,) = ctx.saved_tensors
        return None, ctx.held.evaluate(positions, gradient)[1]


class _Force(torch.autograd.Function):
    """-dE/dx."""

    @override
    @staticmethod
    def forward(ctx: Any, held: HeldEnergy, positions: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        ctx.held = held
        ctx.save_for_backward(positions, values)
        return held.evaluate(positions.detach(), values.detach())[1].to(positions.dtype)

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor, torch.Tensor]:
        return None, *ctx.held.force_adjoint(*ctx.saved_tensors, gradient)
