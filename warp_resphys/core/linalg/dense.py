"""Batched dense Cholesky: for the smallest compact bodies on a GPU."""

import numpy as np
import torch
from typing_extensions import override

from .linear_solver import Factor, Indices, LinearSolver, Mask


class DenseSolver(LinearSolver):
    """Batched dense Cholesky in torch, on any device."""

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        i, j = self._entries(rows, cols)
        self.address = (np.maximum(i, j) * self.n + np.minimum(i, j)).astype(np.int32)
        self.address[(rows == cols)[:, None] & (i < j)] = -1
        self.n_values = self.n * self.n

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        factor = DenseFactor(values.reshape(-1, self.n, self.n))
        if idle is not None and isinstance(before, DenseFactor):
            factor.keep(before, idle)
        return factor


class DenseFactor(Factor):
    """Factors of symmetric matrices, from their lower triangles (B, n, n)."""

    def __init__(self, lower: torch.Tensor) -> None:
        self._cholesky, info = torch.linalg.cholesky_ex(lower)
        self.failed = info.cpu().numpy() != 0
        if self.failed.any():
            self._cholesky[info != 0] = torch.nan

    def keep(self, before: "DenseFactor", idle: torch.Tensor) -> None:
        """Replaces the Cholesky factors of idle matrices (B,) by those of an earlier factor."""
        self._cholesky = torch.where(idle[:, None, None], before._cholesky, self._cholesky)
        self.failed = np.where(idle.cpu().numpy(), before.failed, self.failed)

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        b, n, m = rhs.shape
        shared = len(self.failed) == 1 and b > 1
        columns = rhs.permute(1, 0, 2).reshape(1, n, b * m) if shared else rhs
        solution = torch.cholesky_solve(columns, self._cholesky)
        return solution.reshape(n, b, m).permute(1, 0, 2) if shared else solution
