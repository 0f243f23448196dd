"""Factors of the Hessian that launches alone make and use: for a solve without a word from the host."""

import torch
import warp as wp

from ..energies.launcher import issue, warp_view
from ..energies.potential import IncrementalPotential
from ..kernels import minimisation
from ..linalg.tiled import TiledSolver
from .assembly import HessianAssembly


class RecordedFactors:
    """What `hessian.ExactHessian` does for the host, clamped where the Hessian is indefinite, as launches.

    Args:
        potential: whose Hessian it is, without `low rank <IncrementalPotential.low_rank>`. `factorise` works on the
            environments of its ``tangent_active``, and leaves in it none but those whose factor is not finite.
        assembly: of the Hessian in the solver's layout.
        linear: the solver.
        clamped: (B,) those whose factor is that of such a matrix.
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
        asked = [warp_view(flags, wp.int32) for flags in (p.tangent_active, p.clamp)]
        mark = p.record(minimisation.mark, (b,), asked, [warp_view(clamped, wp.bool)])
        made = linear.record_factor(assembly.values, p.tangent_active, clamped)
        self._factorise = [mark, p.tangent_launches, made.clear, assembly.launches, made.factor, made.check]
        self._repeat = p.record_blocks(minimisation.repeat, 1, asked, [self._again])
        self._solve = linear.record_solve(assembly.values, right.flatten(1))
        self.commands = [*self._factorise, self._repeat, self._solve]

    def factorise(self) -> None:
        """Makes the launches of a factorisation at the potential's positions, and of a clamped one where it failed.

        Factors of what is not positive definite even so are not finite.
        """
        issue(*self._factorise, self._repeat)
        wp.capture_if(self._again, lambda: issue(*self._factorise))

    def solve(self) -> None:
        """Makes the launches of a solve."""
        issue(self._solve)
