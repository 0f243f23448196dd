"""Linear solvers by name, and the cheapest one for a sparsity pattern and a device.

Soft robots are slender: with a bandwidth-reducing order, LAPACK's banded Cholesky is the cheapest on a CPU up to tens
of thousands of unknowns, and a tiled one on a GPU. Compact bodies use Pardiso on a CPU, or multigrid where it is not
installed, and CHOLMOD (cholespy) on a GPU; the smallest bodies on a GPU use batched dense Cholesky.
"""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..io.errors import InputError
from ..kernels.tiled_cholesky import TILE
from .banded import BandedSolver, BorderedSolver, banded_rest, hubs
from .linear_solver import Factor, Indices, LinearSolver, Mask, bandwidth
from .multigrid import MultigridSolver
from .pardiso import PardisoSolver, SparseSolver, has_pardiso
from .tiled import TiledSolver

LinearSolverName = Literal["auto", "banded", "bordered", "tiled", "dense", "sparse", "multigrid", "pardiso"]
LINEAR_SOLVERS: tuple[LinearSolverName, ...] = get_args(LinearSolverName)
MAX_BANDED_FLOPS = 4e10  # multiplications of a banded factor on a CPU above which multigrid is cheaper
MAX_SMALL_FLOPS = 5e8  # multiplications of a banded factor up to which no other one is cheaper
COMPACT = 30  # squared bandwidth over unknowns from which Pardiso is cheaper than a banded factor
MAX_PARDISO_UNKNOWNS = 80_000  # unknowns above which its factor takes too much time and memory
BORDER_FLOPS = 44  # of an unknown beside a band, in multiplications of a banded factor
MAX_TILED_BANDWIDTH = 600  # unknowns above which the tiles of a band hold mostly fill on a GPU
MAX_DENSE_UNKNOWNS = 4000  # unknowns


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


def make_linear_solver(
    name: str,
    rows: Indices,
    cols: Indices,
    n_nodes: int,
    block: int,
    device: torch.device,
    dtype: torch.dtype,
    positions: NDArray[np.float64] | None = None,
    direct: bool = False,
    keeps: bool = True,
) -> LinearSolver:
    """Returns the named solver; ``auto`` selects the cheapest for the pattern and the device.

    With `direct` it selects none that iterates, which would be dear for many right-hand sides of a factor; and without
    `keeps`, for a new factor at every iterate, multigrid rather than Pardiso.

    Raises:
        InputError: an unknown name, a solver of CPUs on a GPU, or one that is not installed.
    """
    if name not in LINEAR_SOLVERS:
        raise InputError(f"linear_solver is {name!r}: choose one of {', '.join(LINEAR_SOLVERS)}.")
    if name in ("banded", "bordered", "pardiso") and device.type != "cpu":
        raise InputError(f"linear_solver={name} runs on the CPU alone: choose tiled, dense, sparse or auto on a GPU.")
    if name == "pardiso" and not has_pardiso():
        raise InputError(
            "linear_solver=pardiso needs the package mkl, for x86 processors: pip install mkl, or take auto."
        )
    if name == "auto":
        name = _cheapest(rows, cols, n_nodes, block, device, keeps or direct)
        name = "sparse" if direct and name == "multigrid" else name
    solvers: dict[str, Callable[..., LinearSolver]] = {
        "banded": BandedSolver,
        "bordered": BorderedSolver,
        "tiled": TiledSolver,
        "dense": DenseSolver,
        "sparse": SparseSolver,
        "multigrid": MultigridSolver,
        "pardiso": PardisoSolver,
    }
    return solvers[name](rows, cols, n_nodes, block, device, dtype, positions)


def _cheapest(rows: Indices, cols: Indices, n_nodes: int, block: int, device: torch.device, keeps: bool) -> str:
    """Returns the name of the cheapest solver by memory and operations.

    A band of width w takes n w numbers and n w^2 operations, a border of m unknowns 4 n w m more, each of which takes
    eleven times as long (measured on 87 unknowns beside a band of 1,161). A dense matrix takes n^2 numbers and n^3 / 3
    operations; for wide bands a sparse factor has less fill-in. The limit on a CPU is measured (``python
    scripts/benchmark.py sizes``), those on a GPU are estimates from these counts.
    """
    unknowns, width = n_nodes * block, block * bandwidth(rows, cols, n_nodes)
    if device.type == "cpu":
        costs = {"banded": unknowns * width**2}
        if len(border := hubs(rows, cols, n_nodes)):
            rest = block * bandwidth(*banded_rest(rows, cols, n_nodes, border)[:2], n_nodes - len(border))
            costs["bordered"] = unknowns * rest * (rest + BORDER_FLOPS * block * len(border))
        name = min(costs, key=lambda solver: costs[solver])
        compact = costs[name] > max(MAX_SMALL_FLOPS, min(COMPACT * unknowns**2, MAX_BANDED_FLOPS))
        if compact and keeps and unknowns <= MAX_PARDISO_UNKNOWNS and has_pardiso():
            return "pardiso"
        return name if costs[name] <= MAX_BANDED_FLOPS else "multigrid"
    if width + 2 * TILE <= min(unknowns // 2, MAX_TILED_BANDWIDTH):
        return "tiled"
    return "dense" if unknowns <= MAX_DENSE_UNKNOWNS else "sparse"
