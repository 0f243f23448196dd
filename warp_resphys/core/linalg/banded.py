r"""Banded Cholesky by LAPACK: the fastest choice for slender bodies on a CPU,
up to tens of thousands of unknowns.

The routines are called through ``scipy.linalg.cython_lapack``, which releases the GIL so that other
threads can run; SciPy's Python wrappers hold it.

For arrow matrices, the few nodes that couple to many others come last: the control vertices of a
rigid part couple to every vertex around it and would widen the band to the part's size. In

    [A  B^T] [x]   [f]
    [B  C  ] [y] = [g],

A is banded, A^-1 B^T is computed once per factorisation, and S = C - B A^-1 B^T is small and dense:

    y = S^-1 (g - B A^-1 f),   x = A^-1 f - A^-1 B^T y.

The matrix is positive definite if and only if A and S are. `tests/linalg/test_linear_solver.py`
compares with dense factorisations.
"""

import ctypes
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.linalg import cython_lapack
from typing_extensions import override

from .linear_solver import (
    Factor,
    Indices,
    LinearSolver,
    Mask,
    SeparateFactors,
    bandwidth_reducing_order,
)

_LETTERS = {torch.float64: "d", torch.float32: "s"}
_HUB = 4.0  # a hub has more than this many times the median number of neighbours
_MOST_HUBS = 0.1  # share of the nodes


@cache
def _routine(name: str, arguments: int) -> Any:
    capsule = cython_lapack.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = (
        ctypes.c_char_p,
        [ctypes.py_object],
    )
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    pointer = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(pointer)


class BandedCholesky:
    """In-place factorisation and solution of matrices (n, w + 1),
    whose row j has the entries (j, j) to (j + w, j).

    Args:
        n: number of unknowns.
        width: number of entries below the diagonal, w.
        dtype: dtype of matrices and right-hand sides.
    """

    def __init__(self, n: int, width: int, dtype: torch.dtype) -> None:
        letter = _LETTERS[dtype]
        self._factor, self._solve = _routine(f"{letter}pbtrf", 6), _routine(f"{letter}pbtrs", 9)
        self._lower, self._numbers = (
            ctypes.c_char(b"L"),
            [ctypes.c_int(k) for k in (n, width, width + 1)],
        )
        self._where = [ctypes.addressof(self._lower), *map(ctypes.addressof, self._numbers)]

    def factor(self, matrix: torch.Tensor) -> bool:
        """Overwrites a contiguous matrix with its factor.

        Returns False if it is not positive definite.
        """
        lower, n, width, rows = self._where
        info = ctypes.c_int()
        self._factor(lower, n, width, matrix.data_ptr(), rows, ctypes.addressof(info))
        return info.value == 0

    def solve(self, factor: torch.Tensor, columns: torch.Tensor) -> None:
        """Overwrites contiguous right-hand sides with the solutions.

        Args:
            factor: (n, w + 1), or contiguous rows of it that are coupled with no others.
            columns: (n,) or (m, n) right-hand sides of these rows.
        """
        lower, _, width, rows = self._where
        count = ctypes.c_int(1 if columns.ndim == 1 else len(columns))
        size = ctypes.c_int(columns.shape[-1])
        n, info = ctypes.addressof(size), ctypes.c_int()
        many, place = ctypes.addressof(count), columns.data_ptr()
        self._solve(
            lower, n, width, many, factor.data_ptr(), rows, place, n, ctypes.addressof(info)
        )


class BandedSolver(LinearSolver):
    """Banded Cholesky in reverse Cuthill-McKee order on the CPU, one environment at a time."""

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
        self.address = np.where(diagonal_upper, -1, j * (self.bandwidth + 1) + (i - j)).astype(
            np.int32
        )
        self.order = order
        self.blocks = _blocks(i, j, self.n)
        self.lapack = BandedCholesky(self.n, self.bandwidth, self.dtype)

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        return _Cholesky(
            self, values.reshape(-1, self.n, self.bandwidth + 1), self._cholesky, idle, before
        )

    def _cholesky(self, number: int, band: torch.Tensor) -> torch.Tensor | None:
        return band if self.lapack.factor(band) else None


class _Cholesky(SeparateFactors):
    _solver: BandedSolver

    @override
    def _overwrite(self, factor: torch.Tensor, rows: torch.Tensor) -> None:
        self._solver.lapack.solve(factor, rows)

    @override
    def _overwrite_units(
        self, factor: torch.Tensor | None, rows: torch.Tensor, places: torch.Tensor
    ) -> None:
        if factor is None or len(self._solver.blocks) == 1:
            super()._overwrite_units(factor, rows, places)
            return
        # The solution is zero in the blocks of other bodies.
        for start, end in self._solver.blocks:
            rows_here = ((places >= start) & (places < end)).nonzero().ravel()
            if len(rows_here):
                columns = rows[rows_here, start:end]
                self._solver.lapack.solve(factor[start:end], columns)
                rows[rows_here, start:end] = columns


def _blocks(i: Indices, j: Indices, n: int) -> list[tuple[int, int]]:
    """Ranges of unknowns that no entry (i, j) of a matrix couples with others, as first and end."""
    reach = np.arange(n)
    np.maximum.at(reach, j.ravel(), i.ravel())
    ends = np.flatnonzero(np.maximum.accumulate(reach) == np.arange(n)) + 1
    return list(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True))


def hubs(rows: Indices, cols: Indices, n_nodes: int) -> Indices:
    """Returns the nodes with many more neighbours than the median, ascending.

    None if there are too many of them.
    """
    apart = rows != cols
    neighbours = np.bincount(np.concatenate([rows[apart], cols[apart]]), minlength=n_nodes)
    nodes = np.flatnonzero(neighbours > _HUB * max(float(np.median(neighbours)), 1.0))
    return nodes if len(nodes) <= _MOST_HUBS * n_nodes else nodes[:0]


def banded_rest(
    rows: Indices, cols: Indices, n_nodes: int, border: Indices
) -> tuple[Indices, Indices, Indices]:
    """Returns rows and columns of the blocks outside the border,
    and the new number of each node, -1 in the border.
    """
    inside = np.ones(n_nodes, dtype=bool)
    inside[border] = False
    number = np.where(inside, np.cumsum(inside) - 1, -1)
    kept = inside[rows] & inside[cols]
    return number[rows[kept]], number[cols[kept]], number


class BorderedSolver(LinearSolver):
    """Banded Cholesky of all nodes but `hubs`, and a dense Schur complement for these.

    On the CPU.
    """

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        border = hubs(rows, cols, n_nodes)
        band_rows, band_cols, number = banded_rest(rows, cols, n_nodes, border)
        self.band = BandedSolver(
            band_rows, band_cols, n_nodes - len(border), self.block, self.device, self.dtype
        )
        k, n = self.block, self.n
        place = np.full(n_nodes, -1)
        place[border] = np.arange(len(border))
        inside = np.flatnonzero(number >= 0)
        self.address = np.empty((len(rows), k * k), dtype=np.int32)
        kept = (number[rows] >= 0) & (number[cols] >= 0)
        self.address[kept] = self.band.address
        r, c = self._entries(rows[~kept], cols[~kept])
        below = (place[rows[~kept]] >= 0)[:, None]
        hub = (
            np.where(below, place[rows[~kept]][:, None], place[cols[~kept]][:, None]) * k
            + np.where(below, r, c) % k
        )
        place = self.band.n_values + hub * n + np.where(below, c, r)
        self.address[~kept] = np.where((rows == cols)[~kept, None] & (r < c), -1, place)
        self.n_values = self.band.n_values + len(border) * k * n
        self.order = np.concatenate([inside[self.band.order], border])
        unknowns = (np.concatenate([inside, border])[:, None] * k + np.arange(k)).ravel()
        self._unknowns = torch.as_tensor(unknowns, device=self.device)
        self.band_size = n - len(border) * k

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        banded, border = values.split([self.band.n_values, self.n_values - self.band.n_values], -1)
        arrow = border.reshape(len(values), -1, self.n)[..., self._unknowns]  # (B, m, n) B and C
        cross, corner = arrow[..., : self.band_size].mT, arrow[..., self.band_size :].tril()
        corner = corner + corner.tril(-1).mT
        kept = before if isinstance(before, _Bordered) else None
        inner = self.band.factor(
            banded.clone(), idle=idle, before=None if kept is None else kept.inner
        )
        return _Bordered(self, inner, cross, corner, idle, kept)


class _Bordered(Factor):
    """Factors of A and S, and the coupling B.

    Args:
        solver: solver whose layout the matrices have.
        inner: factor of A.
        cross: (B, n - m, m) B^T.
        corner: (B, m, m) C.
        idle: (B,) matrices that keep their previous factor, if any.
        before: the previous factors.
    """

    cross: torch.Tensor
    corner: torch.Tensor

    def __init__(
        self,
        solver: BorderedSolver,
        inner: Factor,
        cross: torch.Tensor,
        corner: torch.Tensor,
        idle: Mask,
        before: "_Bordered | None",
    ) -> None:
        if idle is not None and before is not None:
            cross = torch.where(idle[:, None, None], before.cross, cross)
            corner = torch.where(idle[:, None, None], before.corner, corner)
        self.solver, self.inner = solver, inner
        self.cross, self.corner = cross, corner
        self.solved = inner.solve(cross)  # (B, n - m, m) A^-1 B^T
        schur = corner - cross.mT @ self.solved
        self._schur, info = torch.linalg.cholesky_ex(schur.nan_to_num(posinf=0.0, neginf=0.0))
        failed = info > 0
        if idle is not None and before is None:
            failed &= ~idle
        self.failed = inner.failed | failed.numpy()
        order = solver.band.dofs
        self._cross_in_order, self._solved_in_order = self.cross[:, order], self.solved[:, order]

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        f, g = rhs[:, self.solver._unknowns].split([self.solver.band_size, self.cross.shape[2]], 1)
        x = self.inner.solve(f)
        y = torch.cholesky_solve(g - self.cross.mT @ x, self._schur)
        out = torch.empty_like(rhs)
        out[:, self.solver._unknowns] = torch.cat([x - self.solved @ y, y], 1)
        return out

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        size = self.solver.band_size
        x, g = columns[:, :size].contiguous(), columns[:, size:, None]
        self.inner.solve_in_place(x)
        y = torch.cholesky_solve(g - self._cross_in_order.mT @ x[:, :, None], self._schur)
        columns[:, :size] = x - (self._solved_in_order @ y)[:, :, 0]
        columns[:, size:] = y[:, :, 0]
