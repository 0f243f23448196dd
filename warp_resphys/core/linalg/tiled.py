"""Tiled banded Cholesky: for batches of slender bodies on a GPU,
one block of threads per matrix.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ...kernels.modules import RecordedLaunch, launch_stream, shareable
from ...kernels.tiled_cholesky import BLOCK, TILE, tiled_kernels
from .linear_solver import Factor, Indices, LinearSolver, Mask, bandwidth_reducing_order


class TiledSolver(LinearSolver):
    """Banded Cholesky in tiles (``kernels.tiled_cholesky``),
    in reverse Cuthill-McKee order, on any device.
    """

    overwrites = True

    @override
    def _lay_out(self, rows: Indices, cols: Indices, n_nodes: int) -> None:
        self.order = bandwidth_reducing_order(rows, cols, n_nodes)
        place = np.argsort(self.order)
        i, j = self._entries(place[rows], place[cols])
        upper = (rows == cols)[:, None] & (i < j)
        i, j = np.maximum(i, j), np.minimum(i, j)
        self.width = int(np.ceil((i - j).max() / TILE))
        tiles, columns = -(-self.n // TILE), (self.width + 1) * TILE
        self.shape = (tiles * TILE, columns)
        self.n_values = tiles * TILE * columns
        self.address = np.where(
            upper, -1, i * columns + (j // TILE - i // TILE + self.width) * TILE + j % TILE
        )
        self.address = self.address.astype(np.int32)
        rest = np.arange(self.n, tiles * TILE)
        self._padding = torch.as_tensor(
            rest * columns + self.width * TILE + rest % TILE, device=self.device
        )
        self._diagonal = torch.as_tensor(
            np.arange(self.n) * columns + self.width * TILE + np.arange(self.n) % TILE,
            device=self.device,
        )
        self.scalar = wp.float64 if self.dtype == torch.float64 else wp.float32
        self.kernels = tiled_kernels(self.scalar)

    @override
    def _factorise(self, values: torch.Tensor, idle: Mask, before: Factor | None) -> Factor:
        values[:, self._padding] = 1.0
        active = torch.ones(len(values), device=values.device, dtype=torch.int32)
        if idle is not None:
            active.masked_fill_(idle, 0)
        self.launch(self.kernels.factor, (len(values),), active, values.view(-1, *self.shape))
        return _TiledFactor(values, self)

    def failed(self, values: torch.Tensor) -> NDArray[np.bool_]:
        """Returns (B,) whether a factor has a pivot that is not positive."""
        failed: NDArray[np.bool_] = (~(values[:, self._diagonal] > 0.0).all(1)).cpu().numpy()
        return failed

    def launch(self, kernel: Any, blocks: tuple[int, ...], *arrays: torch.Tensor) -> None:
        """Launches a kernel on torch's stream."""
        self._record(kernel, blocks, *arrays).launch(launch_stream(self.device))

    def _record(self, kernel: Any, blocks: tuple[int, ...], *arrays: torch.Tensor) -> Any:
        views = [wp.from_torch(array, requires_grad=False) for array in arrays]
        options = {"block_dim": BLOCK, "device": str(self.device), "record_cmd": True}
        with shareable():
            return RecordedLaunch(
                wp.launch_tiled(kernel, dim=list(blocks), inputs=views, **options)
            )

    def record_factor(
        self, values: torch.Tensor, active: torch.Tensor, clamped: torch.Tensor
    ) -> SimpleNamespace:
        """Returns recorded launches of ``clear``, ``factor`` and ``check``
        (``kernels.tiled_cholesky``).

        Args:
            values: (B, n_values), assembled between ``clear`` and ``factor``, overwritten by the
                factors.
            active: (B,) zero for matrices to skip; ``check`` leaves one only where an unclamped
                matrix failed.
            clamped: (B,) matrices with clamped eigenvalues; their factors are NaN if they fail.
        """
        batch, unit = len(values), torch.zeros(self.n_values, device=self.device, dtype=self.dtype)
        unit[self._padding] = 1.0
        tiles = values.view(-1, *self.shape)
        return SimpleNamespace(
            clear=self._record(self.kernels.clear, (batch,), active, unit, values),
            factor=self._record(self.kernels.factor, (batch,), active, tiles),
            check=self._record(self.kernels.check, (batch,), clamped, active, tiles),
        )

    def record_solve(self, factors: torch.Tensor, columns: torch.Tensor) -> Any:
        """Returns the recorded launch that overwrites (B, n) right-hand sides,
        in the solver's order.
        """
        return self._record(
            self.kernels.solve, (len(columns), 1), factors.view(-1, *self.shape), columns[:, None]
        )


class _TiledFactor(Factor):
    def __init__(self, values: torch.Tensor, solver: TiledSolver) -> None:
        self._bands, self.solver = values.view(-1, *solver.shape), solver
        self.failed = solver.failed(values)
        if self.failed.any():
            values[torch.as_tensor(self.failed, device=values.device)] = torch.nan

    @override
    def solve(self, rhs: torch.Tensor) -> torch.Tensor:
        columns = rhs[:, self.solver.dofs].mT.contiguous()
        self._sweep(columns)
        return columns.mT[:, self.solver.places]

    @override
    def solve_in_place(self, columns: torch.Tensor) -> None:
        self._sweep(columns[:, None])

    def _sweep(self, columns: torch.Tensor) -> None:
        self.solver.launch(self.solver.kernels.solve, columns.shape[:2], self._bands, columns)
