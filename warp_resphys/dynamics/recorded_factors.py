"""Factors of the Hessian that recorded launches make and use, for a solve without the host."""

import torch
import warp as wp

from ..energies.launcher import issue, warp_view
from ..energies.potential import IncrementalPotential
from ..kernels import minimisation
from ..linalg.tiled import TiledSolver
from .assembly import HessianAssembly


class RecordedFactors:
    """Recorded launches that factorise the exact Hessian and solve with it, clamped where it is indefinite.

    Args:
        potential: gives the Hessian, without `low rank <IncrementalPotential.low_rank>`. `factorise` works on the
            environments of its ``tangent_active``, and then leaves marked those whose factor is not finite.
        assembly: assembly of the Hessian in the solver's layout.
        linear: the solver.
        clamped: (B,) environments whose factor is of a clamped matrix.
        right: (B, F, 3) residuals [N] that `solve` overwrites by displacements [m], in the order of the solver.

    Attributes:
        commands: all launches.
    """

    def __init__(
        self,
        potential: IncrementalPotential,
        assembly: HessianAssembly,
        linear: TiledSolver,
        clamped: torch.Tensor,
        right: torch.Tensor,
    ) -> None:
        p, b = potential, potential.batch
        self._again = warp_view(torch.zeros(1, dtype=torch.int32, device=p.device), wp.int32)
        marks = [warp_view(flags, wp.int32) for flags in (p.tangent_active, p.clamp)]
        mark = p.record(minimisation.mark, (b,), marks, [warp_view(clamped, wp.bool)])
        made = linear.record_factor(assembly.values, p.tangent_active, clamped)
        self._factorise = [mark, p.tangent_launches, made.clear, assembly.launches, made.factor, made.check]
        self._repeat = p.record_blocks(minimisation.repeat, 1, marks, [self._again])
        self._solve = linear.record_solve(assembly.values, right.flatten(1))
        self.commands = [*self._factorise, self._repeat, self._solve]

    def factorise(self) -> None:
        """Factorises at the potential's positions, and again with a clamped Hessian where that failed.

        Factors of a matrix that is not positive definite even when clamped are not finite.
        """
        issue(*self._factorise, self._repeat)
        wp.capture_if(self._again, lambda: issue(*self._factorise))

    def solve(self) -> None:
        """Overwrites the residuals by displacements."""
        issue(self._solve)
