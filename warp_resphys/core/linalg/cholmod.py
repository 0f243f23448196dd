"""Sparse Cholesky by CHOLMOD or SuperLU, one environment at a time:
for wide bands where there is no Pardiso.
"""

import ctypes
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from threading import Lock
from typing import Any, Final

import numpy as np
import torch
from typing_extensions import override

from .linear_solver import Factor, Indices, LinearSolver, Mask, SeparateFactors, sparse_lu

_COLUMNS = 128  # most right-hand sides per call of CHOLMOD on a GPU
_STDOUT: Final = 1  # file descriptor, of the whole process
_WARNING: Final = b"CHOLMOD warning"
_printing: Final = Lock()


class SparseSolver(LinearSolver):
    """CHOLMOD by cholespy (CPU and CUDA), or SciPy's SuperLU without it.

    On a CPU a factor costs as much as some hundred solutions, so it is kept for many states.
    """

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        self.keeps_factors = self.device.type == "cpu"
        i, j = self._entries(rows, cols)
        keep = ~((rows == cols)[:, None] & (i < j))
        self.address = np.where(keep, (np.cumsum(keep) - 1).reshape(keep.shape), -1).astype(
            np.int32
        )
        self.n_values = int(keep.sum())

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        try:
            import cholespy
        except ModuleNotFoundError:  # wheels exist for some platforms only
            return _SuperLU(self, values, self._lu, idle, before)
        return _Cholmod(self, values, partial(self._cholmod, cholespy), idle, before)

    def _lu(self, number: int, values: torch.Tensor) -> Any:
        try:
            return sparse_lu(self.matrix(values), definite=True)
        except (ValueError, RuntimeError):
            return None

    def _cholmod(self, cholespy: Any, number: int, values: torch.Tensor) -> Any:
        row, column, place = (torch.as_tensor(x, device=self.device) for x in self.both_triangles)
        entries = values.detach().double()[place]
        try:
            with _without_warnings():
                return cholespy.CholeskySolverD(
                    self.n, row.int(), column.int(), entries, cholespy.MatrixType.COO
                )
        except (ValueError, RuntimeError):
            return None


class _SuperLU(SeparateFactors):
    @override
    def _overwrite(self, factor: Any, rows: torch.Tensor) -> None:
        rows.copy_(torch.from_numpy(factor.solve(rows.detach().cpu().double().numpy().T).T))


class _Cholmod(SeparateFactors):
    @override
    def _overwrite(self, factor: Any, rows: torch.Tensor) -> None:
        for part in rows.split(_COLUMNS):
            right = part.double().mT.contiguous()
            solution = torch.empty_like(right)
            factor.solve(right, solution)
            part.copy_(solution.mT)


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Leaves out warnings that CHOLMOD prints by C, for which cholespy has no option.

    Other output comes at the end.

    Processes that are started meanwhile lose their output. On Windows, whose C libraries do not
    share their buffers, nothing is left out.
    """
    if os.name == "nt":
        yield
        return
    flush = ctypes.CDLL(None).fflush
    with _printing, tempfile.TemporaryFile() as file:
        flush(None)
        before = os.dup(_STDOUT)
        os.dup2(file.fileno(), _STDOUT)
        try:
            yield
        finally:
            flush(None)
            os.dup2(before, _STDOUT)
            os.close(before)
            file.seek(0)
            if kept := b"".join(line for line in file if not line.startswith(_WARNING)):
                os.write(_STDOUT, kept)
