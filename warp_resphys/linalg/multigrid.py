"""Conjugate gradients preconditioned by algebraic multigrid: for large bodies, at a cost linear in their size."""

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import torch
from typing_extensions import override

from ..io.arrays import FloatArray
from .conjugate_gradients import Iterate, conjugate_gradients
from .linear_solver import Factor, Indices, Mask, SeparateFactors, sparse_lu
from .pardiso import SparseSolver

_COARSEST = 400  # largest number of unknowns of the coarsest level, which has a dense factor
_DEGREE = 3  # degree of the smoother's polynomial
_SMOOTHED = 20.0  # ratio of the largest to the smallest eigenvalue that the smoother damps
_POWER_STEPS, _MARGIN = 15, 1.1  # power iterations for the largest eigenvalue, and safety factor of the estimate
_MOST_ITERATIONS = 1000
_WEAR, _FEW = (
    1.5,
    6,
)  # a cycle is stale once solves take 1.5 times its first number of iterations (counted as 6 or more)
DIRECTION = 1e-2  # relative accuracy of a descent direction
EXACT = 1e-12  # relative accuracy of a solution


class MultigridSolver(SparseSolver):
    """Conjugate gradients with a V-cycle of smoothed aggregation (Vanek, Mandel and Brezina 1996) by PyAMG.

    The coarse spaces contain the rigid-body motions, the near-null space of elasticity; the smoother is a Chebyshev
    polynomial of the block-Jacobi iteration (Adams, Brezina, Hu and Tuminaro 2003). The cycle consists of sparse
    products, available on any device, and a dense factor of a few hundred unknowns.

    `Factor.solve` is accurate to 1e-12; `Factor.solve_in_place`, which gives directions for a line search, to 1e-2
    unless there is a low-rank correction. A matrix whose coarsest level or diagonal blocks are not positive definite
    counts as failed.
    """

    iterates = True

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        super()._lay_out(rows, cols, n_nodes)
        numbers = self.matrix(torch.arange(1.0, self.n_values + 1.0, dtype=torch.float64))
        blocks = scipy.sparse.bsr_array(numbers, blocksize=(self.block, self.block))
        blocks.sort_indices()
        self._blocks = _Layout(blocks, self.device)
        self._scalars = _Layout(blocks.tocsr(), self.device)
        self._near_null = _rigid_motions(self.positions, self.block, n_nodes)
        self._cycles: dict[tuple[int, int], _Cycle] = {}

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        return _Preconditioned(self, values.double(), partial(self._system, len(values)), idle, before)

    def _system(self, batch: int, number: int, entries: torch.Tensor) -> "_System | None":
        """Returns an environment's system from its values (n_values,), or None if it is seen to be indefinite."""
        environment = (batch, number)
        if not bool(torch.isfinite(entries).all()):
            return None
        cycle = self._cycles.get(environment)
        if cycle is None or cycle.stale:
            at, columns, starts = self._blocks.source, self._blocks.columns, self._blocks.starts
            parts = (entries[at].cpu().numpy(), columns, starts)
            hierarchy = _hierarchy(scipy.sparse.bsr_array(parts, shape=(self.n, self.n)), self._near_null)
            try:
                cycle = self._cycles[environment] = _Cycle(hierarchy, self.device)
            except torch.linalg.LinAlgError:
                self._cycles.pop(environment, None)
                return None
        return _System(_of_rows(self._scalars.indices, entries[self._scalars.source], (self.n, self.n)), cycle)


class _Layout:
    """Index arrays of a sparse matrix and the source of its entries, which `places` holds as indices plus one."""

    def __init__(self, places: Any, device: torch.device) -> None:
        self.starts, self.columns = places.indptr, places.indices
        self.source = torch.as_tensor(places.data.astype(np.int64) - 1, device=device)
        self.indices = [torch.as_tensor(i.astype(np.int32), device=device) for i in (self.starts, self.columns)]


class _Preconditioned(SeparateFactors):
    """One preconditioned system per matrix."""

    approximate = True

    @override
    def _overwrite(self, factor: "_System", rows: torch.Tensor, exact: bool) -> None:
        right = rows.double()
        rows.copy_(factor.solve(right) if exact else factor.direction(right))


class _System:
    """A matrix with a V-cycle, built for it or for an earlier matrix."""

    def __init__(self, matrix: torch.Tensor, cycle: "_Cycle") -> None:
        self._matrix, self.cycle = matrix, cycle
        self._lu: Any = None

    def direction(self, right: torch.Tensor) -> torch.Tensor:
        """Returns approximate solutions (m, n) for right-hand sides (m, n), all descent directions."""
        return self._iterate(right, DIRECTION).x

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Returns solutions (m, n) for (m, n) right-hand sides, by a sparse factor if the iterations do not converge.

        Solutions of a singular matrix are NaN.
        """
        if self._lu is None:
            iterate = self._iterate(right, EXACT)
            if bool(iterate.converged.all()):
                return iterate.x
            matrix = self._matrix.cpu()
            parts = (matrix.values().numpy(), matrix.col_indices().numpy(), matrix.crow_indices().numpy())
            try:
                self._lu = sparse_lu(scipy.sparse.csr_array(parts, shape=matrix.shape).tocsc(), definite=False)
            except RuntimeError:
                return torch.full_like(right, torch.nan)
        columns = self._lu.solve(np.ascontiguousarray(right.cpu().numpy().T))
        return torch.as_tensor(columns.T, device=right.device)

    def _iterate(self, right: torch.Tensor, tolerance: float) -> Iterate:
        matrix, cycle = self._matrix, self.cycle
        iterate = conjugate_gradients(lambda x: _times(matrix, x), cycle.apply, right, tolerance, _MOST_ITERATIONS)
        cycle.note(iterate.iterations, tolerance)
        return iterate


class _Level(NamedTuple):
    """A level of the hierarchy: its matrix, its smoother, and the transfer to the next level."""

    matrix: torch.Tensor  # (n, n) sparse
    inverse: torch.Tensor  # (n / k, k, k) inverse diagonal blocks
    largest: float  # largest eigenvalue of the block-Jacobi iteration
    prolongation: torch.Tensor  # (n, n') sparse
    restriction: torch.Tensor  # (n', n) sparse, its transpose


class _Cycle:
    """A V-cycle of a matrix, reused for later matrices until it is stale.

    Raises:
        torch.linalg.LinAlgError: the coarsest level or a diagonal block is not positive definite.

    Attributes:
        stale: whether the number of iterations has grown so much that a new cycle pays off.
    """

    def __init__(self, hierarchy: Any, device: torch.device) -> None:
        *finer, coarsest = hierarchy.levels
        self._levels = [_level(level, device) for level in finer]
        self._coarsest = torch.linalg.cholesky(torch.as_tensor(coarsest.A.toarray(), device=device))
        self._first_iterations: dict[float, int] = {}
        self.stale = not finer  # A single level is exact for this matrix only, and cheap to rebuild.

    def note(self, iterations: int, tolerance: float) -> None:
        """Records the iterations of a solve, and marks the cycle as stale if there are too many."""
        self.stale |= iterations > _WEAR * self._first_iterations.setdefault(tolerance, max(iterations, _FEW))

    def apply(self, right: torch.Tensor, k: int = 0) -> torch.Tensor:
        """Returns (m, n) results of the cycle from level k on, starting from zero, for (m, n) right-hand sides."""
        if k == len(self._levels):
            return torch.cholesky_solve(right.mT, self._coarsest).mT
        level = self._levels[k]
        x = _smooth(level, right)
        coarse = self.apply(_times(level.restriction, right - _times(level.matrix, x)), k + 1)
        x = x + _times(level.prolongation, coarse)
        return x + _smooth(level, right - _times(level.matrix, x))


def _times(matrix: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Returns the products (m, n') of a matrix (n', n) with vectors (m, n)."""
    return (matrix @ x[0])[None] if len(x) == 1 else (matrix @ x.mT).mT


def _smooth(level: _Level, right: torch.Tensor) -> torch.Tensor:
    """Applies a Chebyshev polynomial of the block-Jacobi iteration to (m, n), from zero (Saad 2003, algorithm 12.1)."""
    least = level.largest / _SMOOTHED
    middle, half = 0.5 * (level.largest + least), 0.5 * (level.largest - least)
    ratio = middle / half
    rho = 1.0 / ratio
    residual = right
    step = _block_diagonal(level.inverse, residual) / middle
    x = step
    for _ in range(_DEGREE - 1):
        residual = residual - _times(level.matrix, step)
        new_rho = 1.0 / (2.0 * ratio - rho)
        step = new_rho * rho * step + (2.0 * new_rho / half) * _block_diagonal(level.inverse, residual)
        x, rho = x + step, new_rho
    return x


def _block_diagonal(blocks: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Returns the products (m, n) of diagonal blocks (n / k, k, k) with vectors (m, n)."""
    return (blocks @ x.view(len(x), -1, blocks.shape[1], 1)).view_as(x)


def _level(level: Any, device: torch.device) -> _Level:
    """Converts a level of PyAMG to torch and estimates its largest eigenvalue."""
    a = level.A
    row = np.repeat(np.arange(len(a.indptr) - 1), np.diff(a.indptr))
    blocks = torch.as_tensor(a.data[row == a.indices], device=device)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(blocks))
    matrix = _sparse(a, device)
    # A smooth start has too little of the largest eigenvector, and the smoother would not be positive definite.
    x = torch.as_tensor(np.random.default_rng(0).standard_normal((1, a.shape[0])), device=device)
    for _ in range(_POWER_STEPS):
        x = _block_diagonal(inverse, _times(matrix, x / torch.linalg.vector_norm(x)))
    largest = _MARGIN * float(torch.linalg.vector_norm(x))
    return _Level(matrix, inverse, largest, _sparse(level.P, device), _sparse(level.P.T, device))


def _sparse(matrix: Any, device: torch.device) -> torch.Tensor:
    """Converts a SciPy matrix to a torch CSR matrix with 32-bit indices, as sparse libraries need."""
    rows = scipy.sparse.csr_array(matrix)
    indices = [torch.as_tensor(i.astype(np.int32), device=device) for i in (rows.indptr, rows.indices)]
    return _of_rows(indices, torch.as_tensor(rows.data, device=device), rows.shape)


def _of_rows(indices: Sequence[torch.Tensor], values: torch.Tensor, shape: tuple[int, int]) -> torch.Tensor:
    """Builds a torch CSR matrix from row starts and columns, and its entries."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        starts, columns = indices
        return torch.sparse_csr_tensor(starts, columns, values, size=shape, check_invariants=False)


def _hierarchy(matrix: scipy.sparse.bsr_array, near_null: FloatArray) -> Any:
    """Builds PyAMG's levels deterministically: row-wise weights instead of a randomised eigenvalue estimate."""
    from pyamg.aggregation import smoothed_aggregation_solver

    return smoothed_aggregation_solver(
        matrix,
        B=near_null,
        strength=("symmetric", {"theta": 0.0}),
        smooth=("jacobi", {"omega": 4.0 / 3.0, "weighting": "local"}),
        presmoother=None,
        postsmoother=None,
        improve_candidates=None,
        max_coarse=_COARSEST // near_null.shape[1],  # nodes with that many unknowns each
        max_levels=20,
    )


def _rigid_motions(positions: FloatArray | None, block: int, n_nodes: int) -> FloatArray:
    """Returns translations (n, k), or (n, 6) translations and rotations for three unknowns per node with positions."""
    translations = np.tile(np.eye(block), (n_nodes, 1))
    if positions is None or block != 3:
        return translations
    arm = positions - positions.mean(axis=0)
    arm = arm / np.abs(arm).max()
    return np.hstack([translations, np.cross(np.eye(3)[None], arm[:, None]).transpose(0, 2, 1).reshape(-1, 3)])
