"""Banded Cholesky by blocks of threads: for batches of slender bodies on a GPU, each with a factor of its own."""

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ..kernels.tiled_cholesky import tiled_kernels
from .dense import DenseFactor
from .linear_solver import Factor, Indices, LinearSolver, bandwidth_reducing_order

TILE = 16  # rows and columns of a tile
BLOCK = 64  # threads that share a matrix


class TiledSolver(LinearSolver):
    """Cholesky in tiles over a band, in reverse Cuthill-McKee order, on any device; see ``kernels.tiled_cholesky``.

    What is not positive definite, and has to be solved all the same, is solved as a dense matrix.
    """

    overwrites = True

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        self.order = bandwidth_reducing_order(rows, cols, n_nodes)
        place = np.empty(n_nodes, dtype=np.int64)
        place[self.order] = np.arange(n_nodes)
        i, j = self._entries(place[rows], place[cols])
        upper = (rows == cols)[:, None] & (i < j)
        i, j = np.maximum(i, j), np.minimum(i, j)
        self.width = int(np.ceil((i - j).max() / TILE))
        tiles, columns = -(-self.n // TILE), (self.width + 1) * TILE
        self.shape = (tiles * TILE, columns)
        self.n_values = tiles * TILE * columns
        self.address = np.where(upper, -1, i * columns + (j // TILE - i // TILE + self.width) * TILE + j % TILE)
        self.address = self.address.astype(np.int32)
        rest = np.arange(self.n, tiles * TILE)
        self._padding = torch.as_tensor(rest * columns + self.width * TILE + rest % TILE, device=self.device)
        self._diagonal = torch.as_tensor(
            np.arange(self.n) * columns + self.width * TILE + np.arange(self.n) % TILE, device=self.device
        )
        self.dofs = self.unknowns
        self.places = torch.argsort(self.dofs)
        self.scalar = wp.float64 if self.dtype == torch.float64 else wp.float32
        self.kernels = tiled_kernels(TILE, self.width, self.scalar)

    @override
    def _factorise(
        self, values: torch.Tensor, definite: bool, idle: torch.Tensor | None, before: Factor | None
    ) -> Factor:
        values[:, self._padding] = 1.0
        if not definite:
            return _Reordered(DenseFactor(self._dense(values), definite=False), self)
        idle = torch.zeros(len(values), device=values.device, dtype=torch.bool) if idle is None else idle
        self.launch(self.kernels.factor, (len(values),), idle, values.view(-1, *self.shape))
        return _TiledFactor(values, self)

    def failed(self, values: torch.Tensor) -> NDArray[np.bool_]:
        """(B,) matrices whose factor has a pivot that is not positive."""
        failed: NDArray[np.bool_] = (~(values[:, self._diagonal] > 0.0).all(1)).cpu().numpy()
        return failed

    def launch(self, kernel: Any, blocks: tuple[int, ...], *arrays: torch.Tensor) -> None:
        """Launches on torch's stream."""
        views = [wp.from_torch(each, requires_grad=False) for each in arrays]
        stream = None
        if self.device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        wp.launch_tiled(kernel, dim=list(blocks), inputs=views, block_dim=BLOCK, device=str(self.device), stream=stream)

    def _dense(self, values: torch.Tensor) -> torch.Tensor:
        """(B, n, n) lower triangles."""
        i = np.arange(self.n)[:, None]
        j = (i // TILE - self.width) * TILE + np.arange(self.shape[1])
        inside = torch.as_tensor((j >= 0) & (j <= i), device=self.device)
        dense = torch.zeros(len(values), self.n, self.n, device=self.device, dtype=self.dtype)
        band = values.view(-1, *self.shape)[:, : self.n]
        rows, columns = inside.nonzero(as_tuple=True)
        dense[:, rows, torch.as_tensor(j, device=self.device)[inside]] = band[:, rows, columns]
        return dense


class _TiledFactor(Factor):
    def __init__(self, values: torch.Tensor, solver: TiledSolver) -> None:
        self._bands, self._solver = values.view(-1, *solver.shape), solver
        self.failed = solver.failed(values)
        if self.failed.any():
            values[torch.as_tensor(self.failed, device=values.device)] = torch.nan

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        columns = rhs[:, self._solver.dofs].mT.contiguous()
        self._sweep(columns)
        return columns.mT[:, self._solver.places]

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._sweep(columns[:, None])

    def _sweep(self, columns: torch.Tensor) -> None:
        self._solver.launch(self._solver.kernels.solve, columns.shape[:2], self._bands, columns)


class _Reordered(Factor):
    """A factor in the solver's order."""

    def __init__(self, factor: Factor, solver: TiledSolver) -> None:
        self._factor, self._solver, self.failed = factor, solver, factor.failed

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        return self._factor.solve(rhs[:, self._solver.dofs])[:, self._solver.places]

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._factor.solve_in_place(columns)
