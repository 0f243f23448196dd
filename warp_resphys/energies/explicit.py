"""Value and force of a single energy at given positions, for explicit coupling and for measurements.

In implicit coupling an energy is part of the incremental potential; in explicit coupling its force is constant during a
step. The derivative of an energy by an input is the work-conjugate quantity, such as the volume of a chamber for its
pressure.
"""

from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ..fem.elements import Points
from .base import Energy, PointSet
from .launcher import Launcher, warp_view
from .part_terms import PartTerm


class ExplicitEnergy(Launcher):
    """One energy with one value per part, differentiable by positions and values.

    Args:
        energy: the energy, such as `pressure.Pressure`.
        points: points of the energy.
        n_vertices: N.
        batch: number of environments B.
        device: device of every tensor.
    """

    def __init__(self, energy: Energy, points: Points, n_vertices: int, batch: int, device: torch.device) -> None:
        super().__init__(batch, device)
        all_points = slice(0, points.n_points)
        self._set = PointSet(self, points, n_vertices, all_points, all_points)
        term = energy.term(self, [self._set])
        assert isinstance(term, PartTerm)
        self.term, (self._value,) = term, term.shapes

    def force(self, positions: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Returns the force (B, N, 3) [N] at positions (B, N, 3) [m] for values (B, count)."""
        force: torch.Tensor = _Force.apply(self, positions, values)
        return force

    def conjugates(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns minus the derivatives of the energy by the values, (B, count): for pressure, volumes [m^3]."""
        conjugates: torch.Tensor = _Conjugates.apply(self, positions)
        return conjugates

    def evaluate(self, positions: torch.Tensor, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the energy of each part (B, count) [J] and the force (B, N, 3) [N], without gradients."""
        positions, values = positions.double(), values.double()
        s = self._set
        stress, energy = self.zeros(s.n_points, 3, s.width), self.zeros(s.n_points)
        kernel, inputs = self.term.step(s, {self._value: values.contiguous()}, self._view(positions))
        view, active = s.stress_view(stress), warp_view(self.active, wp.int32)
        step = self.record(kernel, (self.batch, s.n_points), [active, *inputs], [view, warp_view(energy, wp.float64)])
        force = torch.zeros_like(positions)
        self.launch(step, self.gather(s, view, force))
        return self.term.sum_parts(energy), force.neg_()

    def force_adjoint(
        self, positions: torch.Tensor, values: torch.Tensor, adjoint: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns vector-Jacobian products of `force` by positions, (B, N, 3), and by values, (B, count)."""
        positions, values, adjoint = positions.double(), values.double(), adjoint.double()
        s, named = self._set, {self._value: values.contiguous()}
        view = s.stress_view(self.zeros(s.n_points, 3, s.width))
        tangent = warp_view(self.zeros(s.n_points, s.blocks, 3, 3), wp.mat33d)
        masks = [warp_view(mask, wp.int32) for mask in (self.active, torch.zeros_like(self.active))]
        kernel, inputs = self.term.tangent(s, named, self._view(positions))
        out = torch.zeros_like(positions)
        self.launch(
            self.record(kernel, (self.batch, s.n_points), [*masks, *inputs], [tangent]),
            # The Hessian is symmetric, so its product is its own transpose.
            self.product(s, tangent, self._view(adjoint), view),
            self.gather(s, view, out),
        )
        slopes = self.term.adjoint(named, positions.contiguous(), adjoint.contiguous())()
        return out.neg_(), slopes[self._value]

    def _view(self, field: torch.Tensor) -> Any:
        return warp_view(field.contiguous(), wp.vec3d)


class _Conjugates(torch.autograd.Function):
    """-dE/dp of an energy linear in p; its vector-Jacobian product with w is the force for p = w."""

    @override
    @staticmethod
    def forward(ctx: Any, held: ExplicitEnergy, positions: torch.Tensor) -> torch.Tensor:
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
    def forward(ctx: Any, held: ExplicitEnergy, positions: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        ctx.held = held
        ctx.save_for_backward(positions, values)
        return held.evaluate(positions.detach(), values.detach())[1].to(positions.dtype)

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor, torch.Tensor]:
        return None, *ctx.held.force_adjoint(*ctx.saved_tensors, gradient)
