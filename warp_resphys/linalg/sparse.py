"""Sparse Cholesky through CHOLMOD or SuperLU: for wide bodies, one environment after another."""

from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from typing_extensions import override

from .linear_solver import Factor, Indices, LinearSolver


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
        data = entries.detach().double().cpu().numpy()
        return scipy.sparse.csc_array((data, (self._rows, self._cols)), shape=(self.n, self.n))

    @override
    def _factorise(
        self, values: torch.Tensor, definite: bool, idle: torch.Tensor | None, before: Factor | None
    ) -> Factor:
        left_out = [False] * len(values) if idle is None else idle.tolist()
        return _SparseFactor(self, values, definite, left_out, before if isinstance(before, _SparseFactor) else None)


class _SparseFactor(Factor):
    def __init__(
        self,
        solver: SparseSolver,
        values: torch.Tensor,
        definite: bool,
        idle: list[bool],
        before: "_SparseFactor | None",
    ) -> None:
        self._device, self._dtype = solver.device, solver.dtype
        self.failed = np.zeros(len(values), dtype=bool)
        cholmod = _cholespy() if definite else None
        self._factors: list[Any] = []
        self._cholmod = cholmod is not None
        for i, entries in enumerate(solver.mirrored(values)):
            if idle[i]:
                self._factors.append(None if before is None else before._factors[i])
                self.failed[i] = before is not None and before.failed[i]
                continue
            try:
                if cholmod is not None:
                    self._factors.append(_cholmod_factor(cholmod, solver, entries))
                    continue
                self._factors.append(sparse_lu(solver.matrix(entries), definite))
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


def sparse_lu(matrix: scipy.sparse.csc_array, definite: bool) -> Any:
    """SuperLU's factor of a symmetric matrix.

    Raises:
        ValueError: it is to be positive definite, and is not.
        RuntimeError: it is singular.
    """
    lu = scipy.sparse.linalg.splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0 if definite else 1.0,
        options={"SymmetricMode": definite},
    )
    # Without pivoting a symmetric matrix is positive definite where every pivot is positive.
    if definite and not (lu.U.diagonal() > 0).all():
        raise ValueError("a pivot is not positive")
    return lu


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
