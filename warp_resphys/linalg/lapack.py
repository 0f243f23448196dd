"""LAPACK's banded Cholesky, called so that other threads may run meanwhile: SciPy's wrappers keep Python's lock.

The routines are those that SciPy offers to compiled code (``scipy.linalg.cython_lapack``).
"""

import ctypes
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.linalg import cython_lapack

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
    """Factors and solutions in place, of matrices (n, w + 1) by columns: row j has the entries (j, j) to (j + w, j).

    Args:
        n: unknowns.
        width: w, entries below the diagonal.
        dtype: of matrices and right-hand sides.
    """

    def __init__(self, n: int, width: int, dtype: torch.dtype) -> None:
        letter = _LETTERS[dtype]
        self._factor, self._solve = _routine(f"{letter}pbtrf", 6), _routine(f"{letter}pbtrs", 9)
        self._lower, self._numbers = ctypes.c_char(b"L"), [ctypes.c_int(k) for k in (n, width, width + 1)]
        self._where = [ctypes.addressof(self._lower), *map(ctypes.addressof, self._numbers)]

    def factor(self, matrix: torch.Tensor) -> bool:
        """Overwrites a contiguous matrix by its factor; False where it is not positive definite."""
        lower, n, width, rows = self._where
        info = ctypes.c_int()
        self._factor(lower, n, width, matrix.data_ptr(), rows, ctypes.addressof(info))
        return info.value == 0

    def solve(self, factor: torch.Tensor, columns: torch.Tensor) -> None:
        """Overwrites contiguous right-hand sides, (n,) or (m, n), by the solutions."""
        lower, n, width, rows = self._where
        count, info = ctypes.c_int(1 if columns.ndim == 1 else len(columns)), ctypes.c_int()
        place = columns.data_ptr()
        self._solve(lower, n, width, ctypes.addressof(count), factor.data_ptr(), rows, place, n, ctypes.addressof(info))


def general_band(band: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """LAPACK's general band storage with room for pivoting, from (n, w + 1) lower symmetric storage."""
    n, w = band.shape[0], band.shape[1] - 1
    general = np.zeros((3 * w + 1, n), dtype=band.dtype, order="F")
    general[2 * w :, :] = band.T
    for k in range(1, w + 1):
        general[2 * w - k, k:] = band[: n - k, k]
    return general
