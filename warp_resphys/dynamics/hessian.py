"""The matrix of the global step: a Hessian, or the constant matrix of projective dynamics."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ..energies.launcher import warp_view
from ..energies.potential import IncrementalPotential
from ..energies.term import PairTangents
from ..io.errors import InputError
from ..kernels.hessian_blocks import sum_blocks
from ..linalg.conjugate_gradients import conjugate_gradients
from ..linalg.coupling import Coupling, CouplingSolver, VertexCouplings, coordinates
from ..linalg.linear_solver import Factor, LinearSolver, numbered
from .assembly import BlockPattern, HessianAssembly
from .corotation import Corotation

_MOST_VALUES = 2**31 - 1  # Warp's offsets here are 32-bit.
_EXACT = 1e-12  # relative accuracy of solutions by the factor of an earlier state
_MOST_ITERATIONS = 40  # of such a solution
_FACTOR = 25  # iterations that take as long as a new factor
_ROUNDED = 8  # Numbers of vertices with couplings are rounded up to multiples of it.


class HessianApproximation(ABC):
    """A factorised approximation of the potential's Hessian.

    Attributes:
        clamped: (B,) environments whose matrix is positive definite by clamping or by construction; if a line search
            fails with it, the solve has failed.
        vertex_at: (F,) free vertices in the order of the right-hand sides of `solve_in_place`.
    """

    clamped: torch.Tensor
    vertex_at: NDArray[np.int64]

    @abstractmethod
    def ready(self) -> bool:
        """Whether there is a factor that can be used for the current terms."""

    @abstractmethod
    def refactor(self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None) -> None:
        """Factorises at the potential's positions.

        Args:
            clamp: (B,) environments with eigenvalues clamped; None: no environment.
            active: (B,) environments that get a new factor; the others keep theirs, if any. None: all.
        """

    @abstractmethod
    def adapt(self) -> None:
        """Adapts the last factors to the potential's positions, if that is cheap."""

    @abstractmethod
    def solve_in_place(self, right: torch.Tensor, needed: torch.Tensor) -> None:
        """Overwrites residuals (B, F, 3) [N] at the free vertices, ordered as `vertex_at`, with displacements [m].

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
    """

    def __init__(self, potential: IncrementalPotential, pattern: BlockPattern, linear: LinearSolver) -> None:
        self._potential, self.linear = potential, linear
        self.exact = linear.dtype == torch.float64
        self.assembly = HessianAssembly(potential, linear, pattern)
        self._dofs = pattern.unknowns(potential.device)
        self._factor: Factor | None = None
        self.clamped = torch.zeros(potential.batch, dtype=torch.bool, device=potential.device)
        self.vertex_at = pattern.free[linear.order]
        self._order = torch.as_tensor(self.vertex_at, device=potential.device)
        self._coupled: CouplingSolver | None = None
        rotates = linear.keeps_factors and not potential.has_pairs
        self._corotation = Corotation(potential, self.vertex_at) if rotates else None
        self._kept: Factor | None = None  # factor of `solve_with_kept_factor`
        self._solutions, self._iterations = 0, 0  # with it; the factor counts as `_FACTOR` iterations
        # Numbers of the free and, behind them, the dependent vertices; -1 for fixed ones.
        free, depends = torch.as_tensor(pattern.free, device=potential.device), potential.coordinates
        self._vertices = torch.cat([free, depends.dependent])
        self._place = torch.full((potential.n_vertices,), -1, device=potential.device)
        self._place[self._vertices] = torch.arange(len(self._vertices), device=potential.device)
        self._reduction: VertexCouplings | None = None
        if depends.depends:
            weights = depends.weights
            place = self._place[depends.controls].masked_fill(weights == 0.0, -1)
            own = torch.full((len(free), place.shape[1]), -1, device=potential.device)
            own[:, 0] = self._place[free]
            self._reduction = VertexCouplings(torch.cat([own, place]), torch.cat([(own >= 0).to(weights), weights]))

    @override
    def ready(self) -> bool:
        return self._factor is not None

    @override
    def refactor(self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None) -> None:
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
        self._factor = factor(values, columns=columns, idle=None if active is None else ~active, before=self._factor)
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

    @property
    def keeps_factor(self) -> bool:
        """Whether a factor may serve several states (`solve_with_kept_factor`)."""
        return self._corotation is not None and not self._potential.couples_cells

    def solve_with_kept_factor(self, rights: Sequence[torch.Tensor]) -> list[torch.Tensor] | None:
        """Returns solutions (B, N, 3) for right-hand sides by conjugate gradients with the factor of an earlier state.

        Their last digits depend on which factor that is, and so on earlier solutions. The factor is replaced where the
        iterations do not converge, and after a solution that took longer than the mean of all with this factor,
        including the time of the factor: later replacement would increase that mean.

        Returns:
            None if the Hessian is not positive definite, or without `keeps_factor`: where energies couple vertices of
            many cells, and for linear solvers whose factors are cheap.
        """
        if self._corotation is None or self._potential.couples_cells:
            return None
        self._potential.update_tangent()
        self._corotation.update()
        solutions = []
        for right in rights:
            size = right.flatten(1).norm(dim=1)[:, None, None]
            size = torch.where(size > 0.0, size, 1.0)  # residuals are rounded to float32
            solution = self._solved_with_kept_factor(right / size, self._corotation)
            if solution is None:
                return None
            solutions.append(solution * size)
        return solutions

    def _solved_with_kept_factor(self, right: torch.Tensor, corotation: Corotation) -> torch.Tensor | None:
        p = self._potential

        def product(x: torch.Tensor) -> torch.Tensor:
            return p.restrict(p.stiffness_product(x) + p.inertia[..., None] * x)

        def precondition(x: torch.Tensor) -> torch.Tensor:
            own = x[:, self._order]
            self.solve_in_place(own, self.clamped)
            return torch.zeros_like(x).index_copy_(1, self._order, own)

        for renews in [True] if self._kept is None else [False, True]:
            if renews:
                self._kept = self.linear.direction_factor(self.assembly())
                if self._kept.failed.any():
                    break
                corotation.record()
                self._solutions, self._iterations = 0, _FACTOR
            self._factor = self._kept
            iterate = conjugate_gradients(product, precondition, right, _EXACT, _MOST_ITERATIONS)
            if bool(iterate.converged.all()):
                self._solutions += 1
                self._iterations += iterate.iterations
                if iterate.iterations * self._solutions > self._iterations:
                    self._kept = None
                return iterate.x
        self._kept = None
        return None

    @override
    def adapt(self) -> None:
        if self._corotation is not None:
            self._corotation.update()

    @override
    def solve_in_place(self, right: torch.Tensor, needed: torch.Tensor) -> None:
        if self._factor is None:
            raise RuntimeError("refactor before solve")
        if self._corotation is not None:
            self._corotation.rotate_back(right)
        self._factor.solve_in_place(right.flatten(1))
        if self._corotation is not None:
            self._corotation.rotate(right)
        if self._potential.has_pairs:
            self._correct(self._potential.pair_tangents(True, needed), right.flatten(1)[:, :, None], self.linear.dofs)

    def _correct(self, parts: Sequence[PairTangents], x: torch.Tensor, order: torch.Tensor) -> None:
        """Adds the coupling of pairs to solutions (B, n, k) without it."""
        couplings = self.couplings(parts)
        if not couplings:
            return
        if self._coupled is None:
            self._coupled = CouplingSolver(len(x), x.shape[1], x)
        assert self._factor is not None
        self._coupled.correct(self._factor, couplings, x, order)

    def couplings(self, parts: Sequence[PairTangents]) -> list[Coupling]:
        """Returns second derivatives of pairs as matrices of the unknowns, one for every environment with pairs."""
        if not parts:
            return []
        environment = torch.cat([part.environment for part in parts])
        nodes = self._place[torch.cat([part.nodes for part in parts])]
        blocks = torch.cat([part.blocks for part in parts])
        device, total = nodes.device, len(self._vertices)
        keys, local = torch.where(nodes < 0, -1, environment[:, None] * total + nodes).unique(return_inverse=True)
        fixed = int((keys < 0).sum())  # all fixed vertices have one key
        keys, local = keys[fixed:], local - fixed
        if not len(keys):
            return []
        row = keys // total
        count, at = numbered(row, self._potential.batch)
        # A size that depends on the environment alone, so that on a CPU it is bit for bit what it is in another batch.
        sizes = -(-count // _ROUNDED) * _ROUNDED
        order = sizes.argsort(stable=True)
        squares = (3 * sizes[order]) ** 2
        first = torch.empty_like(sizes)
        first[order] = squares.cumsum(0) - squares
        rows = torch.stack([first[row], 3 * sizes[row], at], 1)
        columns = torch.where(local < 0, -1, at[local.clamp_min(0)])
        values = self._summed(blocks, local, rows, columns, int(squares.sum()))
        vertices = torch.full((len(sizes), int(sizes.max())), -1, device=device)
        vertices[row, at] = keys % total
        out, done = list[Coupling](), 0
        for size, number in zip(*(x.tolist() for x in sizes.unique(return_counts=True)), strict=True):
            own, m = order[sizes[order] == size], 3 * size
            if size:
                matrices = values[done : done + number * m * m].view(number, m, m)
                if self._reduction is None:
                    out.append(Coupling(own, coordinates(vertices[own, :size]), matrices))
                else:
                    out += self._reduction.reduced(own, vertices[own, :size], matrices)
                done += number * m * m
        return out

    def _summed(
        self, blocks: torch.Tensor, local: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor, size: int
    ) -> torch.Tensor:
        """Returns the values of the matrices (``kernels.hessian_blocks.sum_blocks``).

        Args:
            blocks: (A, 12, 12) second derivatives of pairs.
            local: (A, 4) rows of their vertices, negative for those that are left out.
            rows: (R, 3) first value, size and number in its matrix, of every row.
            columns: (A, 4) numbers of their vertices in the matrices.
            size: number of values.

        Raises:
            InputError: more values than a kernel addresses.
        """
        if size > _MOST_VALUES:
            raise InputError(
                f"the matrices of contact have {size:.1e} numbers, beyond the {_MOST_VALUES:.1e} that a kernel "
                "addresses: take fewer environments, or coarser surfaces."
            )
        launcher, values = self._potential, blocks.new_zeros(size)
        entry = local.ravel().argsort(stable=True)
        start = torch.searchsorted(local.ravel()[entry], torch.arange(len(rows) + 1, device=local.device))
        arrays = [(start, wp.int32), (entry, wp.int32), (rows, wp.vec3i), (columns, wp.vec4i)]
        inputs = [warp_view(array.to(torch.int32), kind) for array, kind in arrays]
        inputs.append(warp_view(blocks, wp.float64))
        launcher.launch(launcher.record(sum_blocks, (len(rows),), inputs, [warp_view(values, wp.float64)]))
        return values

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Returns solutions (B, 3 N, m) for right-hand sides (B, 3 N, m), zero at fixed vertices."""
        if self._factor is None:
            raise RuntimeError("refactor before solve")
        out = torch.zeros_like(right)
        x = self._factor.solve(right[:, self._dofs].to(self.linear.dtype))
        if self._potential.has_pairs:
            self._correct(self._potential.last_pair_tangents, x, torch.arange(x.shape[1], device=x.device))
        out[:, self._dofs] = x.to(right.dtype)
        return out


class ProjectiveHessian(HessianApproximation):
    """Inertia plus ``(2 mu + lambda) V G G^T`` at every point of the solid, identical for each coordinate.

    Fibres and tendons contribute their stiffness, pressure does not contribute.

    This is the Hessian of the distances to fixed projections (Bouaziz et al. 2014, equation 10). It does not depend on
    the positions: a factor is valid until inertia or stiffness change, for the whole batch if these are shared.
    """

    def __init__(self, potential: IncrementalPotential, pattern: BlockPattern, linear: LinearSolver) -> None:
        self._potential, self._pattern, self._linear = potential, pattern, linear
        self.vertex_at = pattern.free
        self._address = torch.as_tensor(linear.address[:, 0], device=potential.device, dtype=torch.int64)
        self._products = list[torch.Tensor]()  # (C, Q, pairs) of the gradients of every node pair a >= c of a cell
        for gradients in (s.source.gradients for s in potential.sets):
            a, c = np.tril_indices(gradients.shape[2])
            products = np.einsum("cqpi,cqpi->cqp", gradients[:, :, a], gradients[:, :, c])
            self._products.append(torch.as_tensor(products, device=potential.device, dtype=torch.float64))
        self._key: tuple[torch.Tensor, ...] | None = None
        self.clamped = torch.ones(potential.batch, dtype=torch.bool, device=potential.device)
        self._factor: Factor | None = None

    def _terms(self) -> tuple[torch.Tensor, ...]:
        p = self._potential
        curvatures = ((term.curvature(), term.sets) for term in p.energies)
        return p.terms.inertia, *(values[:, s.in_energy] for values, sets in curvatures for s in sets)

    @override
    def ready(self) -> bool:
        terms = self._terms()
        return self._key is not None and all(map(torch.equal, self._key, terms))

    @override
    def refactor(self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None) -> None:
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
        sums = torch.segment_reduce(blocks[:, source].mT.contiguous(), "sum", lengths=counts, axis=0)
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
