"""Sparse Cholesky by CHOLMOD or SuperLU, for wide bodies, one environment at a time."""

from functools import partial
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from typing_extensions import override

from .linear_solver import Factor, Indices, LinearSolver, Mask, SeparateFactors
from .quiet import without_warnings_of_cholmod

_COLUMNS = 128  # most right-hand sides per call of CHOLMOD on a GPU


class SparseSolver(LinearSolver):
    """CHOLMOD by cholespy (CPU and CUDA); SciPy's SuperLU for indefinite matrices and without cholespy."""

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
        """Returns the entries (B, E') of both triangles from values (B, n_values) of the lower one."""
        return torch.cat([values, values[:, torch.as_tensor(self._off, device=values.device)]], dim=1)

    def matrix(self, entries: torch.Tensor) -> scipy.sparse.csc_array:
        """Returns the matrix (n, n) of one environment from its `mirrored` entries (E',)."""
        data = entries.detach().double().cpu().numpy()
        return scipy.sparse.csc_array((data, (self._rows, self._cols)), shape=(self.n, self.n))

    @override
    def _factorise(self, values: torch.Tensor, definite: bool, idle: Mask, before: Factor | None) -> Factor:
        entries = self.mirrored(values)
        cholespy = _cholespy() if definite else None
        if cholespy is not None:
            return _Cholmod(self, entries, partial(self._cholmod, cholespy), idle, before)
        return _SuperLU(self, entries, partial(self._lu, definite), idle, before)

    def _lu(self, definite: bool, number: int, entries: torch.Tensor) -> Any:
        try:
            return sparse_lu(self.matrix(entries), definite)
        except (ValueError, RuntimeError):
            return None

    def _cholmod(self, cholespy: Any, number: int, entries: torch.Tensor) -> Any:
        i, j = (torch.as_tensor(x, dtype=torch.int32, device=self.device) for x in (self._rows, self._cols))
        try:
            with without_warnings_of_cholmod():
                return cholespy.CholeskySolverD(self.n, i, j, entries.detach().double(), cholespy.MatrixType.COO)
        except (ValueError, RuntimeError):
            return None


class _SuperLU(SeparateFactors):
    @override
    def _overwrite(self, factor: Any, rows: torch.Tensor, exact: bool) -> None:
        rows.copy_(torch.from_numpy(factor.solve(rows.detach().cpu().double().numpy().T).T))


class _Cholmod(SeparateFactors):
    @override
    def _overwrite(self, factor: Any, rows: torch.Tensor, exact: bool) -> None:
        for part in rows.split(_COLUMNS):
            right = part.double().mT.contiguous()
            solution = torch.empty_like(right)
            factor.solve(right, solution)
            part.copy_(solution.mT)


def sparse_lu(matrix: scipy.sparse.csc_array, definite: bool) -> Any:
    """Returns SuperLU's factor of a symmetric matrix.

    Raises:
        ValueError: `definite` is set, but the matrix is not positive definite.
        RuntimeError: the matrix is singular.
    """
    lu = scipy.sparse.linalg.splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0 if definite else 1.0,
        options={"SymmetricMode": definite},
    )
    # Without pivoting, a symmetric matrix is positive definite if and only if all pivots are positive.
    if definite and not (lu.U.diagonal() > 0).all():
        raise ValueError("a pivot is not positive")
    return lu


def _cholespy() -> Any:
    """Returns the cholespy module, or None if it is not installed (wheels exist for some platforms only)."""
    try:
        import cholespy
    except ModuleNotFoundError:
        return None
    return cholespy
