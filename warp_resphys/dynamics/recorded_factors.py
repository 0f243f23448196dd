"""Factorisation of the Hessian by recorded launches alone, for solves without synchronisation with the host."""

import torch
import warp as wp

from ..energies.launcher import issue, warp_view
from ..energies.potential import IncrementalPotential
from ..kernels import minimisation
from ..linalg.tiled import TiledSolver
from .assembly import HessianAssembly


class RecordedFactors:
    """`hessian.ExactHessian` as recorded launches, with clamping where the Hessian is indefinite.

    Args:
        potential: potential without `low_rank` columns. `factorise` works on the environments in its
            ``tangent_active``, and leaves only those set whose factor is not finite.
        assembly: assembly of the Hessian in the solver's layout.
        linear: the solver.
        clamped: (B,) environments whose factor is of a clamped matrix.
        right: (B, F, 3) residuals [N] that `solve` overwrites with displacements [m], in the order of the solver.

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
        masks = [warp_view(mask, wp.int32) for mask in (p.tangent_active, p.clamp)]
        mark = p.record(minimisation.mark_clamped, (b,), masks, [warp_view(clamped, wp.bool)])
        solver = linear.record_factor(assembly.values, p.tangent_active, clamped)
        self._factorise = [mark, p.tangent_launches, solver.clear, assembly.launches, solver.factor, solver.check]
        self._repeat = p.record_blocks(minimisation.request_clamped, 1, masks, [self._again])
        self._solve = linear.record_solve(assembly.values, right.flatten(1))
        self.commands = [*self._factorise, self._repeat, self._solve]

    def factorise(self) -> None:
        """Launches a factorisation at the potential's positions, and a clamped one where it failed.

        Factors are not finite where the clamped matrix is not positive definite either.
        """
        issue(*self._factorise, self._repeat)
        wp.capture_if(self._again, lambda: issue(*self._factorise))

    def solve(self) -> None:
        """Launches a solve."""
        issue(self._solve)
