"""Sparse Cholesky by Pardiso, for compact bodies on x86 processors,
with one analysis for many factors.
"""

import ctypes
import importlib.metadata
import os
import sys
from functools import cache
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from .linear_solver import CorrectedFactor, Factor, Indices, LinearSolver, Mask, SeparateFactors

_ANALYSIS, _FACTOR, _SOLVE, _RELEASE = 11, 22, 33, -1  # phases
_NO_MEMORY = -2  # error
_PERTURBED = 13  # place of the number of pivots that were made larger
_DEFINITE: Final = 2  # kind of symmetric matrices that are positive definite

Values = NDArray[np.floating[Any]]


class PardisoSolver(LinearSolver):
    """Pardiso (Schenk and Gaertner 2004) of Intel's oneMKL, in an order by nested dissection.

    A factor costs as much as some fifty solutions, and the analysis of the pattern, made once, a
    third of it: factors are kept for long. A solution takes as long as reading the factor from
    memory, and half as long in single precision.
    """

    keeps_factors = True

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        i, j = self._entries(rows, cols)
        keep = ~((rows == cols)[:, None] & (i < j))
        row, column = np.minimum(i, j)[keep], np.maximum(i, j)[keep]
        order = np.lexsort((column, row))
        self.address = np.full(keep.shape, -1, dtype=np.int32)
        self.address[keep] = np.argsort(order)
        self.n_values = len(order)
        starts = np.searchsorted(row[order], np.arange(self.n + 1))
        # CSR of the upper triangle
        self._rows = (starts.astype(np.int32), column[order].astype(np.int32))
        self._rooms: dict[tuple[object, ...], _Room] = {}
        # Environments that once had no factor in float32.
        self._needs_double: set[tuple[int, int]] = set()

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        def factorise(number: int, entries: torch.Tensor) -> _System | None:
            return self._system((len(values), number), entries)

        return _Systems(self, values, factorise, idle, before)

    @override
    def direction_factor(
        self,
        values: torch.Tensor,
        columns: torch.Tensor | None = None,
        idle: torch.Tensor | None = None,
        before: Factor | None = None,
    ) -> Factor:
        if columns is not None:  # Rounding errors along C would be amplified.
            return self.factor(values, columns, idle, before)
        kept = before.factor if isinstance(before, CorrectedFactor) else before

        def factorise(number: int, entries: torch.Tensor) -> _System | None:
            environment = (len(values), number)
            if environment not in self._needs_double:
                system = self._system(environment, entries.float())
                if system:
                    return system
                if entries.dtype == torch.float32:
                    return None
            system = self._system(environment, entries)
            if system is not None:
                self._needs_double.add(environment)
            return system

        return _Systems(self, values, factorise, idle, None if idle is None else kept)

    def _system(self, environment: tuple[int, int], entries: torch.Tensor) -> "_System | None":
        """Returns the factorised matrix of an environment's values, or None if it has no factor."""
        values = entries.detach().clone().numpy()
        key = (*environment, entries.dtype)
        if key not in self._rooms:
            self._rooms[key] = _Room(self._rows, values)
        system = _System(self._rooms[key], values)
        return system if system.factorise() else None


class _Systems(SeparateFactors):
    @override
    def _overwrite(self, factor: "_System", rows: torch.Tensor) -> None:
        factor.solve(rows.detach())


class _System:
    """A matrix of values (n_values,), and the room of its factor until the next matrix takes it."""

    def __init__(self, room: "_Room", values: Values) -> None:
        self._room, self._values = room, values
        self._stamp = 0

    def factorise(self) -> bool:
        """Returns whether there is a factor."""
        succeeds = self._room.factorise(self._values)
        self._stamp = self._room.stamp
        return succeeds

    def solve(self, rows: torch.Tensor) -> None:
        """Overwrites right-hand sides (m, n) with the solutions."""
        if self._stamp != self._room.stamp:
            self.factorise()
        right = rows.numpy().astype(self._values.dtype, copy=False)
        self._room.call(_SOLVE, self._values, right)
        if right.dtype != rows.numpy().dtype:
            rows.copy_(torch.from_numpy(right))


class _Room:
    """Pardiso's analysis of a pattern and room for one factor.

    Args:
        pattern: starts (n + 1,) and columns (n_values,) of the upper triangle's rows.
        values: (n_values,) of a matrix.

    Attributes:
        stamp: number of factorisations.
    """

    def __init__(self, pattern: tuple[NDArray[np.int32], ...], values: Values) -> None:
        self._pattern, self.stamp = pattern, 0
        # A factor by another number than the analysis may crash.
        self._threads = torch.get_num_threads()
        self._internal, self._options = np.zeros(64, dtype=np.int64), np.zeros(64, dtype=np.int32)
        # Own options; METIS; solutions overwrite; pivots; precision; from zero. Threads on two
        # levels (23) gave wrong factors without an error up to oneMKL 2026.0, where one replaced
        # another.
        options = {0: 1, 1: 2, 5: 1, 9: 8, 27: values.dtype == np.float32, 34: 1}
        for place, value in options.items():
            self._options[place] = value
        self.call(_ANALYSIS, values)

    def __del__(self) -> None:
        if not sys.is_finalizing():
            self.call(_RELEASE)

    def factorise(self, values: Values) -> bool:
        """Returns whether the matrix of values (n_values,) has a factor,
        without a pivot that was made larger.
        """
        self.stamp += 1
        finite = np.isfinite(values.sum())
        return bool(finite and self.call(_FACTOR, values) == 0 and self._options[_PERTURBED] == 0)

    def call(self, phase: int, values: Values | None = None, right: Values | None = None) -> int:
        """Runs a phase on contiguous arrays, and returns Pardiso's error, zero for none.

        Args:
            phase: its number.
            values: (n_values,) entries of the matrix.
            right: (m, n) right-hand sides, which the solutions overwrite.

        Raises:
            MemoryError: there is not enough memory.
            RuntimeError: a phase fails, other than the factorisation of a matrix without a factor.
        """
        unknowns, error = len(self._pattern[0]) - 1, ctypes.c_int32(0)
        count = 1 if right is None else right.size // unknowns
        room = None if right is None else np.empty_like(right)
        *head, sides, silent = (
            ctypes.byref(ctypes.c_int32(n)) for n in (1, 1, _DEFINITE, phase, unknowns, count, 0)
        )
        arrays = [self._internal, values, *self._pattern, self._options, right, room]
        internal, matrix, starts, columns, options, rhs, solution = (
            None if array is None else array.ctypes.data_as(ctypes.c_void_p) for array in arrays
        )
        library = mkl()
        library.MKL_Set_Num_Threads_Local(self._threads)
        outcome = (options, silent, rhs, solution, ctypes.byref(error))
        library.pardiso(internal, *head, matrix, starts, columns, None, sides, *outcome)
        library.MKL_Set_Num_Threads_Local(0)
        if error.value == _NO_MEMORY:
            raise MemoryError(
                f"a factor of {unknowns} unknowns needs more memory "
                "than there is: take larger cells."
            )
        if error.value and phase != _FACTOR:
            raise RuntimeError(f"Pardiso fails with error {error.value} in phase {phase}.")
        return error.value


@cache
def mkl() -> Any:
    """Returns oneMKL's library.

    Raises:
        ModuleNotFoundError: the package ``mkl`` is not installed.
    """
    try:
        files = importlib.metadata.files("mkl") or []
        path = next(file for file in files if file.name.startswith(("libmkl_rt", "mkl_rt")))
    except (importlib.metadata.PackageNotFoundError, StopIteration):
        raise ModuleNotFoundError("the package mkl is not installed") from None
    # Idle threads of its OpenMP would take cores from others.
    os.environ.setdefault("KMP_BLOCKTIME", "0")
    return ctypes.CDLL(str(path.locate()))


@cache
def has_pardiso() -> bool:
    """Whether this machine has Pardiso."""
    try:
        mkl()
    except (ModuleNotFoundError, OSError):
        return False
    return True
