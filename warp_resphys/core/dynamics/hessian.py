"""The matrix of the global step: a Hessian, or the constant matrix of projective dynamics."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..energies.potential import IncrementalPotential
from ..energies.term import PairTangents
from ..linalg.coupling import CouplingSolver
from ..linalg.linear_solver import Factor, LinearSolver
from .assembly import BlockPattern, HessianAssembly
from .kept_factor import Corotation, KeptFactor
from .pair_couplings import PairCouplings


class HessianApproximation(ABC):
    """A factorised approximation of the potential's Hessian.

    Attributes:
        clamped: (B,) environments whose matrix is positive definite by clamping or by construction;
            if a line search fails with it, the solve has failed.
        vertex_at: (F,) free vertices in the order of the right-hand sides of `solve_in_place`.
    """

    clamped: torch.Tensor
    vertex_at: NDArray[np.int64]

    @abstractmethod
    def ready(self) -> bool:
        """Whether there is a factor that can be used for the current terms."""

    @abstractmethod
    def refactor(
        self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None
    ) -> None:
        """Factorises at the potential's positions.

        Args:
            clamp: (B,) environments with eigenvalues clamped; None: no environment.
            active: (B,) environments that get a new factor; the others keep theirs, if any. None:
                all.
        """

    @abstractmethod
    def adapt(self) -> None:
        """Adapts the last factors to the potential's positions, if that is cheap."""

    @abstractmethod
    def solve_in_place(self, right: torch.Tensor, needed: torch.Tensor) -> None:
        """Overwrites residuals (B, F, 3) [N] at the free vertices,
        ordered as `vertex_at`, with displacements [m].

        Args:
            right: the residuals.
            needed: (B,) environments whose displacements are used.
        """


class ExactHessian(HessianApproximation):
    """The exact Hessian, clamped to positive eigenvalues in environments where it is indefinite.

    Args:
        potential: the potential.
        pattern: block structure of the Hessian.
        linear: solver for that pattern with blocks of 3.

    Attributes:
        linear: the solver.
        assembly: assembly in the solver's layout.
        exact: whether factors are in float64.
        kept: solves by the factor of an earlier state, or None where energies couple vertices of
            many cells, and for linear solvers whose factors are cheap.
        couplings: second derivatives of pairs as matrices of the unknowns.
    """

    def __init__(
        self, potential: IncrementalPotential, pattern: BlockPattern, linear: LinearSolver
    ) -> None:
        self._potential, self.linear = potential, linear
        self.exact = linear.dtype == torch.float64
        self.assembly = HessianAssembly(potential, linear, pattern)
        self._dofs = pattern.unknowns(potential.device)
        self._factor: Factor | None = None
        self.clamped = torch.zeros(potential.batch, dtype=torch.bool, device=potential.device)
        self.vertex_at = pattern.free[linear.order]
        self._coupled: CouplingSolver | None = None
        rotates = linear.keeps_factors and not potential.has_pairs
        self._corotation = Corotation(potential, self.vertex_at) if rotates else None
        self.kept: KeptFactor | None = None
        if self._corotation is not None and not potential.couples_cells:
            self.kept = KeptFactor(potential, self.assembly, linear, self._corotation)
        self.couplings = PairCouplings(potential, pattern.free)

    @override
    def ready(self) -> bool:
        return self._factor is not None

    @override
    def refactor(
        self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None
    ) -> None:
        clamp = torch.zeros_like(self.clamped) if clamp is None else clamp
        self.clamped.copy_(clamp if active is None else torch.where(active, clamp, self.clamped))
        self._factorise(active)
        assert self._factor is not None
        if not self._factor.failed.any():
            return
        failed = torch.as_tensor(self._factor.failed, device=self.clamped.device) & ~self.clamped
        failed = failed if active is None else failed & active
        if bool(failed.any()):
            self.clamped |= failed
            self._factorise(failed)

    def _factorise(self, active: torch.Tensor | None) -> None:
        self._potential.update_tangent(self.clamped, active)
        values, columns = self.assembly(), self._columns()
        factor = self.linear.factor if self._potential.has_pairs else self.linear.direction_factor
        self._factor = factor(
            values, columns=columns, idle=None if active is None else ~active, before=self._factor
        )
        if self._corotation is not None:
            self._corotation.record(active)
        if self._coupled is not None:
            self._coupled.forget(active)

    def _columns(self) -> torch.Tensor | None:
        """Returns the low-rank correction of the potential at the unknowns."""
        columns = self._potential.low_rank
        return None if columns is None else columns[:, self._dofs].to(self.linear.dtype)

    def refactor_exact(self) -> None:
        """Factorises the Hessian without clamping, for `solve`."""
        self.clamped.zero_()
        self._potential.update_tangent()
        self._factor = self.linear.factor(self.assembly(), columns=self._columns())
        if self._factor.failed.any():
            self._factor = self.linear.pivoted(self.assembly(), self._factor, self._columns())
        if self._coupled is not None:
            self._coupled.forget()

    @override
    def adapt(self) -> None:
        if self._corotation is not None:
            self._corotation.update()

    @override
    def solve_in_place(self, right: torch.Tensor, needed: torch.Tensor) -> None:
        if self._factor is None:
            raise RuntimeError("refactor before solve")
        if self._corotation is None:
            self._factor.solve_in_place(right.flatten(1))
        else:
            self._corotation.solve_in_place(self._factor, right)
        if self._potential.has_pairs:
            self._correct(
                self._potential.pair_tangents(True, needed),
                right.flatten(1)[:, :, None],
                self.linear.dofs,
            )

    def _correct(self, parts: Sequence[PairTangents], x: torch.Tensor, order: torch.Tensor) -> None:
        """Adds the coupling of pairs to solutions (B, n, k) without it."""
        couplings = self.couplings(parts)
        if not couplings:
            return
        if self._coupled is None:
            self._coupled = CouplingSolver(len(x), x.shape[1], x)
        assert self._factor is not None
        self._coupled.correct(self._factor, couplings, x, order)

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Returns solutions (B, 3 N, m) for right-hand sides (B, 3 N, m),
        zero at fixed vertices.
        """
        if self._factor is None:
            raise RuntimeError("refactor before solve")
        out = torch.zeros_like(right)
        x = self._factor.solve(right[:, self._dofs].to(self.linear.dtype))
        if self._potential.has_pairs:
            self._correct(
                self._potential.last_pair_tangents, x, torch.arange(x.shape[1], device=x.device)
            )
        out[:, self._dofs] = x.to(right.dtype)
        return out


class ProjectiveHessian(HessianApproximation):
    """Inertia plus ``(2 mu + lambda) V G G^T`` at every point of the solid,
    identical for each coordinate.

    Fibres and tendons contribute their stiffness, pressure does not contribute.

    This is the Hessian of the distances to fixed projections (Bouaziz et al. 2014, equation 10). It
    does not depend on the positions: a factor is valid until inertia or stiffness change, for the
    whole batch if these are shared.
    """

    def __init__(
        self, potential: IncrementalPotential, pattern: BlockPattern, linear: LinearSolver
    ) -> None:
        self._potential = potential
        self._pattern = pattern
        self._linear = linear
        self.vertex_at = pattern.free
        self._address = torch.as_tensor(
            linear.address[:, 0], device=potential.device, dtype=torch.int64
        )
        # (C, Q, pairs) of the gradients of every node pair a >= c of a cell
        self._products = list[torch.Tensor]()
        for gradients in (s.source.gradients for s in potential.sets):
            a, c = np.tril_indices(gradients.shape[2])
            products = np.einsum("cqpi,cqpi->cqp", gradients[:, :, a], gradients[:, :, c])
            self._products.append(
                torch.as_tensor(products, device=potential.device, dtype=torch.float64)
            )
        self._key: tuple[torch.Tensor, ...] | None = None
        self.clamped = torch.ones(potential.batch, dtype=torch.bool, device=potential.device)
        self._factor: Factor | None = None

    def _terms(self) -> tuple[torch.Tensor, ...]:
        p = self._potential
        curvatures = ((term.curvature(), term.sets) for term in p.energies)
        return p.terms.inertia, *(
            values[:, s.in_energy] for values, sets in curvatures for s in sets
        )

    @override
    def ready(self) -> bool:
        return self._key is not None and all(map(torch.equal, self._key, self._terms()))

    @override
    def refactor(
        self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None
    ) -> None:
        del clamp, active  # The matrix is positive definite and the same for later steps.
        self._key = tuple(t.clone() for t in self._terms())
        inertia, *weights = (t[:1] if bool((t == t[:1]).all()) else t for t in self._key)
        batch = max(len(t) for t in (inertia, *weights))
        parts = []
        for products, weight in zip(self._products, weights, strict=True):
            w = weight.expand(batch, -1).reshape(batch, *products.shape[:2])
            parts.append(torch.einsum("bcq,cqp->bcp", w, products).reshape(batch, -1))
        blocks = torch.cat(parts, dim=1)
        source = torch.as_tensor(self._pattern.contribution, device=blocks.device)
        source = torch.where(source < 0, -1 - source, source)
        counts = torch.as_tensor(np.diff(self._pattern.start), device=blocks.device)
        # Sums in a fixed order, unlike index_add_ on a GPU.
        sums = torch.segment_reduce(
            blocks[:, source].mT.contiguous(), "sum", lengths=counts, axis=0
        )
        values = torch.zeros(batch, self._linear.n_values, device=blocks.device, dtype=blocks.dtype)
        values[:, self._address] = sums.mT
        diagonal = torch.as_tensor(self._pattern.rows == self._pattern.cols, device=blocks.device)
        vertex = torch.as_tensor(self._pattern.diagonal_vertex, device=blocks.device)[diagonal]
        values[:, self._address[diagonal]] += inertia[:, vertex]
        self._factor = self._linear.direction_factor(values.to(self._linear.dtype))

    @override
    def adapt(self) -> None:
        """Does nothing, as the matrix does not depend on the positions."""

    @override
    def solve_in_place(self, right: torch.Tensor, needed: torch.Tensor) -> None:
        del needed
        if self._factor is None:
            raise RuntimeError("refactor before solve")
        right.copy_(self._factor.solve(right))
