"""Solutions with the factor of an earlier state, and when to make a new one.

The Hessian H of a state is solved by conjugate gradients, preconditioned with the factor of an earlier Hessian that has
rotated with the body (`corotation`). A factor takes as long as some 25 iterations. With k solutions of n_1, ..., n_k
iterations since the last factor, a solution costs (25 + n_1 + ... + n_k) / k iterations on average, which falls as long
as the last one is below this mean: the factor is replaced as soon as it is not.
"""

from collections.abc import Sequence
from typing import Final

import torch

from ..energies.potential import IncrementalPotential
from ..linalg.conjugate_gradients import conjugate_gradients
from ..linalg.linear_solver import Factor, LinearSolver
from .assembly import HessianAssembly
from .corotation import Corotation

_EXACT: Final = 1e-12  # relative accuracy
_MOST_ITERATIONS: Final = 40
_FACTOR: Final = 25  # iterations that take as long as a new factor


class KeptFactor:
    """A factor that serves the Hessians of several states.

    Args:
        potential: the potential, at whose positions Hessians are solved.
        assembly: assembly of the Hessian.
        linear: linear solver of the factor.
        corotation: rotations of the vertices since the factor.
    """

    def __init__(
        self, potential: IncrementalPotential, assembly: HessianAssembly, linear: LinearSolver, corotation: Corotation
    ) -> None:
        self._potential, self._assembly, self._linear = potential, assembly, linear
        self._corotation = corotation
        self._factor: Factor | None = None
        self._solutions = self._iterations = 0  # with this factor, which counts as `_FACTOR` iterations

    def solve(self, rights: Sequence[torch.Tensor]) -> list[torch.Tensor] | None:
        """Returns solutions (B, N, 3) for right-hand sides, or None if the Hessian is not positive definite.

        Their last digits depend on which factor is kept, and so on earlier solutions.
        """
        self._potential.update_tangent()
        self._corotation.update()
        solutions = []
        for right in rights:
            size = right.flatten(1).norm(dim=1)[:, None, None]
            size = torch.where(size > 0.0, size, 1.0)  # residuals are rounded to float32
            solution = self._solved(right / size)
            if solution is None:
                return None
            solutions.append(solution * size)
        return solutions

    def _solved(self, right: torch.Tensor) -> torch.Tensor | None:
        for renews in (True,) if self._factor is None else (False, True):
            if renews and not self._renew():
                return None
            iterate = conjugate_gradients(self._product, self._precondition, right, _EXACT, _MOST_ITERATIONS)
            if bool(iterate.converged.all()):
                self._solutions += 1
                self._iterations += iterate.iterations
                if iterate.iterations * self._solutions > self._iterations:
                    self._factor = None
                return iterate.x
        self._factor = None
        return None

    def _renew(self) -> bool:
        """Returns whether the Hessian has a factor, which is kept."""
        factor = self._linear.direction_factor(self._assembly())
        self._factor = None if factor.failed.any() else factor
        self._corotation.record()
        self._solutions, self._iterations = 0, _FACTOR
        return self._factor is not None

    def _product(self, x: torch.Tensor) -> torch.Tensor:
        p = self._potential
        return p.restrict(p.stiffness_product(x) + p.inertia[..., None] * x)

    def _precondition(self, x: torch.Tensor) -> torch.Tensor:
        assert self._factor is not None
        unknowns = x[:, self._corotation.vertices]
        self._corotation.solve_in_place(self._factor, unknowns)
        return torch.zeros_like(x).index_copy_(1, self._corotation.vertices, unknowns)
