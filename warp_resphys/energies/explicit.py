"""Value and force of a single energy at given positions, for measurements.

The derivative of an energy by an input is the work-conjugate quantity: the volume of a chamber, for its pressure.
"""

from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ..fem.elements import Points
from ..io.errors import InputError
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

    Raises:
        InputError: an energy that depends on more than one value per part.
    """

    def __init__(self, energy: Energy, points: Points, n_vertices: int, batch: int, device: torch.device) -> None:
        super().__init__(batch, device)
        all_points = slice(0, points.n_points)
        self._set = PointSet(self, points, n_vertices, all_points, all_points)
        term = energy.term(self, [self._set])
        if not isinstance(term, PartTerm) or len(term.shapes) != 1:
            raise InputError(f"the energy with the input {energy.inputs[0].name} depends on more than that input.")
        self.term, (self._value,) = term, term.shapes

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
