"""Green strain at the points of a solid, and its derivative by the positions."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ..kernels import solid as kernels
from .base import Term
from .launcher import warp_view

_KEPT = 3  # strains


class StrainTerm(Term):
    """A term of a solid, with the Green strain at its points."""

    def strain(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the Green strain (B, P, 3, 3) at positions (B, N, 3)."""
        return self._strain(positions)

    @cached_property
    def _strain(self) -> Callable[[torch.Tensor], torch.Tensor]:
        """`strain`, recorded at its first use.

        On a CPU, the last results serve again, and must not be changed in place: with branches of Prony, a step needs
        the strain at its end, where the next one begins, and BDF2 looks back by two steps.
        """
        own = self.launcher
        at, out = own.zeros(self.sets[0].n_vertices, 3), own.zeros(self.n_points, 3, 3)
        view = warp_view(at, wp.vec3d)
        commands = [
            own.record(
                kernels.strain,
                (own.batch, s.n_points),
                [s.nodes, s.gradients, s.points_per_cell, view],
                [warp_view(out[:, s.own], wp.mat33d)],
            )
            for s in self.sets
        ]
        recorded = own.capture(*commands)

        known = list[tuple[torch.Tensor, torch.Tensor]]()

        def strain(positions: torch.Tensor) -> torch.Tensor:
            at.copy_(positions)
            # A comparison waits for a GPU, and tensors of inference mode would have no gradient later.
            keeps = at.device.type == "cpu" and not torch.is_inference_mode_enabled()
            for number, (place, strains) in enumerate(known if keeps else ()):
                if torch.equal(place, at):
                    known.append(known.pop(number))
                    return strains.detach()
            own.launch(recorded)
            if keeps:
                known[:] = [*known[1 - _KEPT :], (at.clone(), out.clone())]
                return known[-1][1].detach()
            return out.clone()

        return strain

    def strain_adjoint(self, positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        """Returns the vector-Jacobian product (B, N, 3) of `strain` with (B, P, 3, 3)."""
        return self._strain_adjoint(positions, adjoint)

    @cached_property
    def _strain_adjoint(self) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        """`strain_adjoint`, recorded at its first use."""
        own = self.launcher
        at, out = own.zeros(self.sets[0].n_vertices, 3), own.zeros(self.sets[0].n_vertices, 3)
        along, stress = own.zeros(self.n_points, 3, 3), own.zeros(self.n_points, 3, 3)
        place, commands = warp_view(at, wp.vec3d), []
        for s in self.sets:
            direction, view = (warp_view(values[:, s.own], wp.mat33d) for values in (along, stress))
            inputs = [s.nodes, s.gradients, s.points_per_cell, place, direction]
            commands.append(own.record(kernels.strain_adjoint, (own.batch, s.n_points), inputs, [view]))
            commands.append(own.gather(s, view, out))
        recorded = own.capture(*commands)

        def product(positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
            at.copy_(positions)
            along.copy_(adjoint)
            out.zero_()
            own.launch(recorded)
            return out.clone()

        return product


class GreenStrain(torch.autograd.Function):
    """Green strain E = (F^T F - I) / 2 at every point, from (B, N, 3) to (B, P, 3, 3)."""

    @override
    @staticmethod
    def forward(ctx: Any, term: StrainTerm, positions: torch.Tensor) -> torch.Tensor:
        ctx.term = term
        ctx.save_for_backward(positions)
        return term.strain(positions)

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        (positions,) = ctx.saved_tensors
        return None, ctx.term.strain_adjoint(positions.to(gradient.dtype), gradient)
