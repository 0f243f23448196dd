"""Symmetric linear systems of a batch of bodies: banded, sparse and dense factorisations behind one interface.

A solver is built once for a sparsity pattern; it says at which ``address`` of its value array each matrix entry
belongs, so that one Warp kernel assembles for every layout. ``factor`` turns a batch of value arrays into a `Factor`.

The bodies of this field are slender: with a bandwidth-reducing order, LAPACK's banded Cholesky is the cheapest choice
on a CPU up to tens of thousands of unknowns. Wide meshes go to CHOLMOD (cholespy), small ones on a GPU to batched dense
Cholesky.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg
import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController
from typing_extensions import override

from ..io.errors import InputError

LINEAR_SOLVERS = ("auto", "banded", "tiled", "dense", "sparse")
Indices = NDArray[np.int64]
_MOST_VALUES = 2**31 // 8 - 1  # Warp's strides are 32-bit numbers of bytes.


class Factor(ABC):
    """A factorised batch of matrices.

    Attributes:
        failed: (B,) bool; matrices that are not positive definite and have no factor: their solutions are not finite.
    """

    failed: NDArray[np.bool_]

    @abstractmethod
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        """Solves for (B, n, m) right-hand sides; a factor of batch 1 serves every environment of the batch."""

    def solve_in_place(self, columns: torch.Tensor) -> None:
        """Overwrites (B, n) right-hand sides, in the order of the linear solver, by their solutions."""
        columns.copy_(self.solve(columns[:, :, None])[:, :, 0])


class CorrectedFactor(Factor):
    """A factor of A + C C^T from one of A (Sherman, Morrison and Woodbury).

    Args:
        factor: of A.
        columns: (B, n, r) C.
        order: (n,) unknown at each place of the linear solver.
    """

    def __init__(self, factor: Factor, columns: torch.Tensor, order: torch.Tensor) -> None:
        self._factor, self._columns, self._order = factor, columns, order
        self.failed = factor.failed
        self._solved = factor.solve(columns)
        small = torch.eye(columns.shape[2], device=columns.device, dtype=columns.dtype) + columns.mT @ self._solved
        self._small = torch.linalg.lu_factor_ex(small)[:2]

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        found = self._factor.solve(rhs)
        return found - self._solved @ torch.linalg.lu_solve(*self._small, self._columns.mT @ found)

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._factor.solve_in_place(columns)
        along = self._columns[:, self._order].mT @ columns[:, :, None]
        columns -= (self._solved[:, self._order] @ torch.linalg.lu_solve(*self._small, along))[:, :, 0]


class LinearSolver(ABC):
    """Factorises symmetric matrices of one sparsity pattern.

    Args:
        rows: (E,) node row of each stored block, ``rows >= cols``.
        cols: (E,) node column of each stored block.
        n_nodes: rows and columns of the matrix in nodes.
        block: unknowns a node (3 for a Hessian, 1 for a projective-dynamics matrix).
        device: where values and right-hand sides live.
        dtype: their type.

    Raises:
        InputError: a matrix too large for the layout.

    Attributes:
        address: (E, block^2) place of each block's entries in the value array, -1 where not stored.
        n_values: length of the value array.
        overwrites: whether `factor` writes over the values.
        order: (n_nodes,) node at each place of its right-hand sides `in place <Factor.solve_in_place>`.
    """

    address: NDArray[np.int32]
    n_values: int
    order: Indices
    overwrites = False

    def __init__(
        self, rows: Indices, cols: Indices, n_nodes: int, block: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self.n = n_nodes * block
        self.block = block
        self.device = device
        self.dtype = dtype
        self.order = np.arange(n_nodes)
        self._lay_out(rows, cols, n_nodes)
        if self.n_values > _MOST_VALUES:
            raise InputError(
                f"a {type(self).__name__} for {self.n} unknowns needs {self.n_values:.1e} numbers, beyond the "
                f"{_MOST_VALUES:.1e} that a kernel addresses: choose solver.linear_solver=sparse."
            )

    @abstractmethod
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        """Chooses an order and sets ``address`` and ``n_values``."""

    @abstractmethod
    def factor(self, values: torch.Tensor, definite: bool = True, idle: torch.Tensor | None = None) -> Factor:
        """Factorises (B, n_values).

        Args:
            values: entries at the solver's addresses, zero elsewhere; see `overwrites`.
            definite: Cholesky, which reports matrices that are not positive definite in ``failed``; otherwise a pivoted
                factorisation that takes any regular matrix.
            idle: (B,) matrices that may be left out: nobody asks for their solutions, which may be anything.
        """

    def corrected(self, factor: Factor, columns: torch.Tensor | None) -> Factor:
        """A factor of A + C C^T with C (B, n, r), or that of A where there is no C."""
        return factor if columns is None else CorrectedFactor(factor, columns, self.unknowns)

    @property
    def unknowns(self) -> torch.Tensor:
        """(n,) unknown at each place of the right-hand sides in place."""
        dofs = (self.order[:, None] * self.block + np.arange(self.block)).ravel()
        return torch.as_tensor(dofs, device=self.device)

    def _entries(self, rows: Indices, cols: Indices) -> tuple[Indices, Indices]:
        """Scalar row and column (E, block^2) of every entry of every block, in the order of the nodes given."""
        r, c = np.divmod(np.arange(self.block**2), self.block)
        return rows[:, None] * self.block + r, cols[:, None] * self.block + c


class BandedSolver(LinearSolver):
    """LAPACK's banded Cholesky in reverse Cuthill-McKee order, on the CPU, one environment after another."""

    overwrites = True

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        order = bandwidth_reducing_order(rows, cols, n_nodes)
        place = np.empty(n_nodes, dtype=np.int64)
        place[order] = np.arange(n_nodes)
        i, j = self._entries(place[rows], place[cols])
        swap = i < j
        diagonal_upper = (rows == cols)[:, None] & swap
        i, j = np.where(swap, j, i), np.where(swap, i, j)
        self.bandwidth = int((i - j).max())
        self.n_values = self.n * (self.bandwidth + 1)
        self.address = np.where(diagonal_upper, -1, j * (self.bandwidth + 1) + (i - j)).astype(np.int32)
        self.order = order
        self._order = self.unknowns
        self._place = torch.argsort(self._order)
        self._threads = ThreadpoolController()

    @override
    def factor(self, values: torch.Tensor, definite: bool = True, idle: torch.Tensor | None = None) -> Factor:
        bands = values.reshape(-1, self.n, self.bandwidth + 1).numpy()
        with _one_thread(self._threads):
            return _BandedFactor(
                bands, self, definite, np.zeros(len(bands), dtype=bool) if idle is None else idle.numpy()
            )


def _one_thread(threads: ThreadpoolController) -> AbstractContextManager[Any]:
    """BLAS on one thread: a band is too narrow to share, and threads that wait for one another cost milliseconds."""
    return threads.limit(limits=1, user_api="blas")


class _BandedFactor(Factor):
    def __init__(self, bands: NDArray[Any], solver: BandedSolver, definite: bool, idle: NDArray[np.bool_]) -> None:
        self._order, self._place = solver._order, solver._place
        self._definite = definite
        self.failed = np.zeros(len(bands), dtype=bool)
        self._factors: list[Any] = []
        (factorise,) = scipy.linalg.get_lapack_funcs(("pbtrf" if definite else "gbtrf",), (bands,))
        self._width = bands.shape[2] - 1
        (self._solve,) = scipy.linalg.get_lapack_funcs(("pbtrs" if definite else "gbtrs",), (bands,))
        for i, band in enumerate(bands):
            if idle[i]:
                self._factors.append(None)
                continue
            if definite:
                factor, info = factorise(band.T, lower=1, overwrite_ab=1)
                self._factors.append(factor)
            else:
                lu, pivots, info = factorise(_general_band(band), self._width, self._width, overwrite_ab=1)
                self._factors.append((lu, pivots))
            if info != 0:
                self.failed[i] = True
                (factor if definite else lu).fill(np.nan)

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        shared = len(self._factors) == 1
        ordered = rhs[:, self._order]
        # LAPACK wants columns: (groups, columns, n) in memory is (n, columns) in Fortran order.
        columns = ordered.transpose(1, 2).reshape((1, b * m, n) if shared else (b, m, n)).contiguous().numpy()
        # Triangular solves with a band run on one thread in any case.
        for factor, block in zip(self._factors, columns, strict=True):
            if factor is not None:
                self._overwrite(factor, block.T)
        solved = torch.from_numpy(columns).reshape(b, m, n).transpose(1, 2)
        return solved[:, self._place]

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        each = columns.numpy()[:, None] if len(self._factors) > 1 else columns.numpy()[None]
        for factor, block in zip(self._factors, each, strict=True):
            if factor is not None:
                self._overwrite(factor, block.T)

    def _overwrite(self, factor: Any, columns: NDArray[Any]) -> None:
        """Overwrites (n, columns) in Fortran order."""
        w = self._width
        if self._definite:
            solution, _ = self._solve(factor, columns, lower=1, overwrite_b=1)
        else:
            solution, _ = self._solve(factor[0], w, w, columns, factor[1], overwrite_b=1)
        if solution is not columns and not np.may_share_memory(solution, columns):
            columns[:] = solution


def _general_band(band: NDArray[Any]) -> NDArray[Any]:
    """LAPACK's general band storage with room for pivoting, from (n, w + 1) lower symmetric storage."""
    n, w = band.shape[0], band.shape[1] - 1
    general = np.zeros((3 * w + 1, n), dtype=band.dtype, order="F")
    general[2 * w :, :] = band.T
    for k in range(1, w + 1):
        general[2 * w - k, k:] = band[: n - k, k]
    return general


class DenseSolver(LinearSolver):
    """Batched dense Cholesky in torch, on any device."""

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        i, j = self._entries(rows, cols)
        self.address = (np.maximum(i, j) * self.n + np.minimum(i, j)).astype(np.int32)
        self.address[(rows == cols)[:, None] & (i < j)] = -1
        self.n_values = self.n * self.n

    @override
    def factor(self, values: torch.Tensor, definite: bool = True, idle: torch.Tensor | None = None) -> Factor:
        return DenseFactor(values.reshape(-1, self.n, self.n), definite)


class DenseFactor(Factor):
    """Of lower triangles (B, n, n), which it may overwrite."""

    def __init__(self, lower: torch.Tensor, definite: bool) -> None:
        self._definite = definite
        if definite:
            self._cholesky, info = torch.linalg.cholesky_ex(lower)
        else:
            full = lower.tril() + lower.tril(-1).mT
            self._lu, self._pivots, info = torch.linalg.lu_factor_ex(full)
        self.failed = info.cpu().numpy() != 0
        if self.failed.any():
            (self._cholesky if definite else self._lu)[info != 0] = torch.nan

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        columns = rhs
        shared = len(self.failed) == 1 and b > 1
        if shared:
            columns = rhs.permute(1, 0, 2).reshape(1, n, b * m)
        if self._definite:
            solution = torch.cholesky_solve(columns, self._cholesky)
        else:
            solution = torch.linalg.lu_solve(self._lu, self._pivots, columns)
        return solution.reshape(n, b, m).permute(1, 0, 2) if shared else solution


class SparseSolver(LinearSolver):
    """CHOLMOD through cholespy (CPU and CUDA); SciPy's SuperLU for indefinite matrices and where cholespy is absent."""

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        i, j = self._entries(rows, cols)
        keep = ~((rows == cols)[:, None] & (i < j))
        self.address = np.where(keep, (np.cumsum(keep) - 1).reshape(keep.shape), -1).astype(np.int32)
        lower, upper = np.maximum(i, j)[keep], np.minimum(i, j)[keep]
        self.n_values = len(lower)
        self._off = lower != upper
        self._rows, self._cols = np.append(lower, upper[self._off]), np.append(upper, lower[self._off])

    def mirrored(self, values: torch.Tensor) -> torch.Tensor:
        """(B, E') entries of both triangles from (B, n_values)."""
        return torch.cat([values, values[:, torch.as_tensor(self._off, device=values.device)]], dim=1)

    def matrix(self, entries: torch.Tensor) -> scipy.sparse.csc_array:
        """(n, n) the matrix of one environment's `mirrored` entries (E',)."""
        data = entries.detach().cpu().numpy()
        return scipy.sparse.csc_array((data, (self._rows, self._cols)), shape=(self.n, self.n))

    @override
    def factor(self, values: torch.Tensor, definite: bool = True, idle: torch.Tensor | None = None) -> Factor:
        return _SparseFactor(self, values, definite)


class _SparseFactor(Factor):
    def __init__(self, solver: SparseSolver, values: torch.Tensor, definite: bool) -> None:
        self._device, self._dtype = solver.device, solver.dtype
        self.failed = np.zeros(len(values), dtype=bool)
        cholmod = _cholespy() if definite else None
        self._factors: list[Any] = []
        self._cholmod = cholmod is not None
        for i, entries in enumerate(solver.mirrored(values)):
            try:
                if cholmod is not None:
                    self._factors.append(_cholmod_factor(cholmod, solver, entries))
                    continue
                lu = scipy.sparse.linalg.splu(
                    solver.matrix(entries),
                    permc_spec="MMD_AT_PLUS_A",
                    diag_pivot_thresh=0.0 if definite else 1.0,
                    options={"SymmetricMode": definite},
                )
                # Without pivoting a symmetric matrix is positive definite where every pivot is positive.
                if definite and not (lu.U.diagonal() > 0).all():
                    raise ValueError("a pivot is not positive")
                self._factors.append(lu)
            except (ValueError, RuntimeError):
                self.failed[i] = True
                self._factors.append(None)

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        shared = len(self._factors) == 1
        columns = rhs.permute(1, 0, 2).reshape(1, n, b * m) if shared else rhs
        solutions = []
        for factor, right in zip(self._factors, columns, strict=True):
            if factor is None:
                solution = torch.full_like(right, torch.nan)
            elif self._cholmod:
                right = right.to(torch.float64).contiguous()
                solution = torch.empty_like(right)
                # CHOLMOD's GPU solve takes at most 128 columns at once.
                for first in range(0, right.shape[1], 128):
                    part = right[:, first : first + 128].contiguous()
                    out = torch.empty_like(part)
                    factor.solve(part, out)
                    solution[:, first : first + 128] = out
            else:
                solution = torch.from_numpy(factor.solve(right.detach().cpu().numpy().astype(np.float64)))
            solutions.append(solution.to(self._device, self._dtype))
        stacked = torch.stack(solutions)
        return stacked.reshape(n, b, m).permute(1, 0, 2) if shared else stacked


def _cholespy() -> Any:
    """The cholespy module, or None where it is not installed (it has no wheel for every platform)."""
    try:
        import cholespy
    except ModuleNotFoundError:
        return None
    return cholespy


def _cholmod_factor(cholmod: Any, solver: SparseSolver, entries: torch.Tensor) -> Any:
    i, j = (torch.as_tensor(x, dtype=torch.int32, device=solver.device) for x in (solver._rows, solver._cols))
    return cholmod.CholeskySolverD(solver.n, i, j, entries.detach().to(torch.float64), cholmod.MatrixType.COO)


def bandwidth_reducing_order(rows: Indices, cols: Indices, n_nodes: int) -> Indices:
    """(n_nodes,) node at each place, in the given order or reverse Cuthill-McKee's: whichever band is smaller."""
    i, j = np.concatenate([rows, cols]), np.concatenate([cols, rows])
    graph = scipy.sparse.csr_array((np.ones(len(i), dtype=np.int8), (i, j)), shape=(n_nodes, n_nodes))
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True).astype(np.int64)
    place = np.empty(n_nodes, dtype=np.int64)
    place[order] = np.arange(n_nodes)
    if np.abs(place[rows] - place[cols]).max(initial=0) < np.abs(rows - cols).max(initial=0):
        return order
    return np.arange(n_nodes)


def make_linear_solver(
    name: str,
    rows: Indices,
    cols: Indices,
    n_nodes: int,
    block: int,
    device: torch.device,
    dtype: torch.dtype,
) -> LinearSolver:
    """Builds the named solver; ``auto`` takes the cheapest for the pattern and device.

    Raises:
        InputError: an unknown name, or a banded solver on a GPU.
    """
    if name not in LINEAR_SOLVERS:
        raise InputError(f"linear_solver is {name!r}: choose one of {', '.join(LINEAR_SOLVERS)}.")
    if name == "banded" and device.type != "cpu":
        raise InputError("linear_solver=banded runs on the CPU alone: choose dense, sparse or auto on a GPU.")
    if name == "auto":
        name = _cheapest(rows, cols, n_nodes, block, device)
    from .tiled_solver import TiledSolver

    solvers: dict[str, Callable[..., LinearSolver]] = {
        "banded": BandedSolver,
        "tiled": TiledSolver,
        "dense": DenseSolver,
        "sparse": SparseSolver,
    }
    return solvers[name](rows, cols, n_nodes, block, device, dtype)


def _cheapest(rows: Indices, cols: Indices, n_nodes: int, block: int, device: torch.device) -> str:
    """Dense up to 4,000 unknowns on a GPU; banded on a CPU, unless the band is so wide that CHOLMOD fills in less."""
    if device.type != "cpu":
        return "dense" if n_nodes * block <= 4000 else "sparse"
    order = bandwidth_reducing_order(rows, cols, n_nodes)
    place = np.argsort(order)
    bandwidth = block * int(np.abs(place[rows] - place[cols]).max(initial=0) + 1)
    return "banded" if bandwidth <= 600 else "sparse"
