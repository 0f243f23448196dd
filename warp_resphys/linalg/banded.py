"""LAPACK's banded Cholesky: the cheapest for slender bodies on a CPU, up to tens of thousands of unknowns."""

from abc import abstractmethod
from typing import Any

import numpy as np
import scipy.linalg
import torch
from typing_extensions import override

from .lapack import BandedCholesky, general_band
from .linear_solver import Factor, Indices, LinearSolver, bandwidth_reducing_order


class BandedSolver(LinearSolver):
    """LAPACK's banded Cholesky in reverse Cuthill-McKee order, on the CPU, one environment after another."""

    overwrites = True

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        order = bandwidth_reducing_order(rows, cols, n_nodes)
        place = np.argsort(order)
        i, j = self._entries(place[rows], place[cols])
        swap = i < j
        diagonal_upper = (rows == cols)[:, None] & swap
        i, j = np.where(swap, j, i), np.where(swap, i, j)
        self.bandwidth = int((i - j).max())
        self.n_values = self.n * (self.bandwidth + 1)
        self.address = np.where(diagonal_upper, -1, j * (self.bandwidth + 1) + (i - j)).astype(np.int32)
        self.order = order
        self.dofs = self.unknowns
        self.places = torch.argsort(self.dofs)
        self.lapack = BandedCholesky(self.n, self.bandwidth, self.dtype)

    @override
    def _factorise(
        self, values: torch.Tensor, definite: bool, idle: torch.Tensor | None, before: Factor | None
    ) -> Factor:
        bands = values.reshape(-1, self.n, self.bandwidth + 1)
        left_out = [False] * len(bands) if idle is None else idle.tolist()
        kind = _BandedCholesky if definite else _BandedLU
        return kind(self, bands, left_out, before if isinstance(before, kind) else None)


class _BandedFactor(Factor):
    """One factor an environment, or None.

    Args:
        solver: with the order.
        bands: (B or 1, n, w + 1) matrices.
        idle: those that keep a factor, or have none.
        before: the factor they keep.
    """

    def __init__(
        self, solver: BandedSolver, bands: torch.Tensor, idle: list[bool], before: "_BandedFactor | None"
    ) -> None:
        self._solver, self._shared = solver, len(bands) == 1
        self.failed = np.zeros(len(bands), dtype=bool)
        self._factors: list[Any] = [None] * len(bands)
        for i, band in enumerate(bands):
            if not idle[i]:
                self._factors[i], self.failed[i] = self._factorise(band)
            elif before is not None:
                self._factors[i], self.failed[i] = before._factors[i], before.failed[i]

    @abstractmethod
    def _factorise(self, band: torch.Tensor) -> tuple[Any, bool]:
        """The factor of a matrix, which it may overwrite, and whether there is none: it is not a number then."""

    @abstractmethod
    def _overwrite(self, factor: Any, columns: torch.Tensor) -> None:
        """Solves for contiguous (m, n) right-hand sides."""

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        ordered = rhs[:, self._solver.dofs].mT
        # Solved for one environment at a time, or for all of them at once.
        columns = ordered.reshape((1, b * m, n) if self._shared else (b, m, n)).contiguous()
        self._solve_each(columns)
        return columns.view(b, m, n).mT[:, self._solver.places]

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._solve_each(columns[None] if self._shared else columns[:, None])

    def _solve_each(self, columns: torch.Tensor) -> None:
        for factor, block in zip(self._factors, columns, strict=True):
            if factor is not None:
                self._overwrite(factor, block)


class _BandedCholesky(_BandedFactor):
    @override
    def _factorise(self, band: torch.Tensor) -> tuple[Any, bool]:
        definite = self._solver.lapack.factor(band)
        if not definite:
            band.fill_(torch.nan)
        return band, not definite

    @override
    def _overwrite(self, factor: torch.Tensor, columns: torch.Tensor) -> None:
        self._solver.lapack.solve(factor, columns)


class _BandedLU(_BandedFactor):
    @override
    def _factorise(self, band: torch.Tensor) -> tuple[Any, bool]:
        matrix, w = general_band(band.numpy()), self._solver.bandwidth
        (factorise,) = scipy.linalg.get_lapack_funcs(("gbtrf",), (matrix,))
        lu, pivots, info = factorise(matrix, w, w, overwrite_ab=1)
        if info != 0:
            lu.fill(np.nan)
        return (lu, pivots), info != 0

    @override
    def _overwrite(self, factor: tuple[Any, Any], columns: torch.Tensor) -> None:
        (lu, pivots), w = factor, self._solver.bandwidth
        (solve,) = scipy.linalg.get_lapack_funcs(("gbtrs",), (lu,))
        solved, _ = solve(lu, w, w, columns.numpy().T, pivots)
        columns.copy_(torch.from_numpy(solved.T))
