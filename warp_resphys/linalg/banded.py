"""LAPACK's banded Cholesky: the cheapest for slender bodies on a CPU, up to tens of thousands of unknowns."""

from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController
from typing_extensions import override

from .linear_solver import Factor, Indices, LinearSolver, bandwidth_reducing_order


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
