"""Chambers in a given state: their volumes, and the force of a pressure that is held while the body moves on.

The implicit coupling of pressure is part of the incremental potential; this is the explicit one, and a gauge.
"""

from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ..fem.body import Body
from ..io.errors import InputError
from ..kernels.elasticity import elasticity_kernels
from ..kernels.surface import surface_kernels
from ..kernels.tangent import tangent_kernels
from .launcher import Launcher, warp_view
from .terms import Pressure


class ChamberPressure(Launcher):
    """Volumes and forces of a body's chambers, differentiable.

    Args:
        body: with chambers.
        batch: environments B.
        device: of every tensor.
        dtype: of every tensor.

    Raises:
        InputError: the body has no chambers.
    """

    def __init__(self, body: Body, batch: int, device: torch.device, dtype: torch.dtype) -> None:
        super().__init__(batch, device, dtype)
        if body.pressure_points is None:
            raise InputError("the body has no chambers: find them with chambers.find_chambers, or name their surfaces.")
        self._n_vertices = body.n_vertices
        self._points = Pressure(self, body.pressure_points, body.n_vertices, slice(0, body.pressure_points.n_points))

    def volumes(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, C) enclosed volumes [m^3] at positions (B, N, 3) [m]."""
        volumes: torch.Tensor = _Volumes.apply(self, positions)
        return volumes

    def force(self, positions: torch.Tensor, pressure: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) force p dV/dx [N] of gauge pressures (B, C) [Pa] at positions (B, N, 3) [m]."""
        force: torch.Tensor = _Force.apply(self, positions, pressure)
        return force

    def _view(self, field: torch.Tensor) -> Any:
        return warp_view(field.contiguous(), self.vec3)

    def enclosed(self, positions: torch.Tensor) -> torch.Tensor:
        """As `volumes`, without a gradient."""
        s, out = self._points, self.zeros(self._points.n_points)
        inputs = [s.nodes, s.gradients, s.weights, s.points_per_cell, self._view(positions)]
        kernel = surface_kernels(self.scalar).volume
        self.launch(self.record(kernel, (self.batch, s.n_points), inputs, [warp_view(out, self.scalar)]))
        return s.by_chamber(out)

    def push(self, positions: torch.Tensor, pressure: torch.Tensor) -> torch.Tensor:
        """As `force`, without a gradient."""
        s = self._points
        stress, energy = self.zeros(s.n_points, 3, 3), self.zeros(s.n_points)
        inputs = s.arguments(pressure.contiguous(), self._view(positions))
        outputs = [warp_view(stress, self.mat33), warp_view(energy, self.scalar)]
        step = self.record(surface_kernels(self.scalar).pressure_step, (self.batch, s.n_points), inputs, outputs)
        return self._gathered(stress, step)

    def push_adjoint(
        self, positions: torch.Tensor, pressure: torch.Tensor, adjoint: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Transposed derivatives of `push` by positions and pressure, applied to (B, N, 3): (B, N, 3) and (B, C)."""
        s, dim = self._points, (self.batch, self._points.n_points)
        blocks, stress = self.zeros(s.n_points, 6, 3, 3), self.zeros(s.n_points, 3, 3)
        all_of_it = torch.zeros(self.batch, device=self.device, dtype=torch.int32)
        inputs = [*s.arguments(pressure.contiguous(), self._view(positions)), warp_view(all_of_it, wp.int32)]
        tangent = warp_view(blocks, self.mat33)
        product = [s.nodes, s.gradients, s.points_per_cell, tangent, self._view(adjoint)]
        # The second derivative of p V is symmetric: it is its own transpose.
        by_positions = self._gathered(
            stress,
            self.record(surface_kernels(self.scalar).pressure_tangent, dim, inputs, [tangent]),
            self.record(tangent_kernels(self.scalar).tangent_product, dim, product, [warp_view(stress, self.mat33)]),
        )
        return by_positions, s.parameter_adjoint(positions.contiguous(), adjoint)

    def _gathered(self, stress: torch.Tensor, *commands: Any) -> torch.Tensor:
        """(B, N, 3) forces of the stress that commands leave."""
        s, out = self._points, self.zeros(self._n_vertices, 3)
        inputs = [s.nodes, s.gradients, s.points_per_cell, s.start, s.incident, warp_view(stress, self.mat33)]
        kernel, dim = elasticity_kernels(self.scalar).gather, (self.batch, self._n_vertices)
        self.launch(*commands, self.record(kernel, dim, inputs, [warp_view(out, self.vec3)]))
        return out.neg_()


class _Volumes(torch.autograd.Function):
    """V(x). A loss with the derivatives w by V has the gradient w dV/dx, the force of pressures w."""

    @override
    @staticmethod
    def forward(ctx: Any, chambers: ChamberPressure, positions: torch.Tensor) -> torch.Tensor:
        ctx.chambers = chambers
        ctx.save_for_backward(positions)
        return chambers.enclosed(positions.detach())

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        (positions,) = ctx.saved_tensors
        return None, ctx.chambers.push(positions, gradient)


class _Force(torch.autograd.Function):
    """p dV/dx."""

    @override
    @staticmethod
    def forward(ctx: Any, chambers: ChamberPressure, positions: torch.Tensor, pressure: torch.Tensor) -> torch.Tensor:
        ctx.chambers = chambers
        ctx.save_for_backward(positions, pressure)
        return chambers.push(positions.detach(), pressure.detach())

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor, torch.Tensor]:
        return None, *ctx.chambers.push_adjoint(*ctx.saved_tensors, gradient)
