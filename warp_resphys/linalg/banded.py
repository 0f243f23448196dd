"""Banded Cholesky by LAPACK: the fastest choice for slender bodies on a CPU, up to tens of thousands of unknowns.

The routines are called through ``scipy.linalg.cython_lapack``, which releases the GIL so that other threads can run;
SciPy's Python wrappers hold it.
"""

import ctypes
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.linalg import cython_lapack
from typing_extensions import override

from .linear_solver import Factor, Indices, LinearSolver, Mask, SeparateFactors, bandwidth_reducing_order

_LETTERS = {torch.float64: "d", torch.float32: "s"}


@cache
def _routine(name: str, arguments: int) -> Any:
    capsule = cython_lapack.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    pointer = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(pointer)


class BandedCholesky:
    """In-place factorisation and solution of matrices (n, w + 1), whose row j has the entries (j, j) to (j + w, j).

    Args:
        n: number of unknowns.
        width: number of entries below the diagonal, w.
        dtype: dtype of matrices and right-hand sides.
    """

    def __init__(self, n: int, width: int, dtype: torch.dtype) -> None:
        letter = _LETTERS[dtype]
        self._factor, self._solve = _routine(f"{letter}pbtrf", 6), _routine(f"{letter}pbtrs", 9)
        self._lower, self._numbers = ctypes.c_char(b"L"), [ctypes.c_int(k) for k in (n, width, width + 1)]
        self._where = [ctypes.addressof(self._lower), *map(ctypes.addressof, self._numbers)]

    def factor(self, matrix: torch.Tensor) -> bool:
        """Overwrites a contiguous matrix with its factor; returns False if it is not positive definite."""
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
        count, size = ctypes.c_int(1 if columns.ndim == 1 else len(columns)), ctypes.c_int(columns.shape[-1])
        n, info = ctypes.addressof(size), ctypes.c_int()
        many, place = ctypes.addressof(count), columns.data_ptr()
        self._solve(lower, n, width, many, factor.data_ptr(), rows, place, n, ctypes.addressof(info))


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
        self.address = np.where(diagonal_upper, -1, j * (self.bandwidth + 1) + (i - j)).astype(np.int32)
        self.order = order
        self.blocks = _blocks(i, j, self.n)
        self.lapack = BandedCholesky(self.n, self.bandwidth, self.dtype)

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        return _Cholesky(self, values.reshape(-1, self.n, self.bandwidth + 1), self._cholesky, idle, before)

    def _cholesky(self, number: int, band: torch.Tensor) -> torch.Tensor | None:
        return band if self.lapack.factor(band) else None


class _Cholesky(SeparateFactors):
    _solver: BandedSolver

    @override
    def _overwrite(self, factor: torch.Tensor, rows: torch.Tensor, exact: bool) -> None:
        self._solver.lapack.solve(factor, rows)

    @override
    def _overwrite_units(self, factor: torch.Tensor | None, rows: torch.Tensor, places: torch.Tensor) -> None:
        if factor is None or len(self._solver.blocks) == 1:
            super()._overwrite_units(factor, rows, places)
            return
        for start, end in self._solver.blocks:  # The solution is zero in the blocks of other bodies.
            own = ((places >= start) & (places < end)).nonzero().ravel()
            if len(own):
                columns = rows[own, start:end]
                self._solver.lapack.solve(factor[start:end], columns)
                rows[own, start:end] = columns


def _blocks(i: Indices, j: Indices, n: int) -> list[tuple[int, int]]:
    """Returns the ranges of unknowns that no entry (i, j) of a matrix couples with others, as first and end."""
    reach = np.arange(n)
    np.maximum.at(reach, j.ravel(), i.ravel())
    ends = np.flatnonzero(np.maximum.accumulate(reach) == np.arange(n)) + 1
    return list(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True))
