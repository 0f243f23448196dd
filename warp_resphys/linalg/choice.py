"""Which linear solver: by name, or the cheapest for a pattern and a device.

The bodies of this field are slender: with a bandwidth-reducing order, LAPACK's banded Cholesky is the cheapest choice
on a CPU up to tens of thousands of unknowns, and one in tiles on a GPU. Larger bodies go to multigrid on a CPU and to
CHOLMOD (cholespy) on a GPU, the smallest on a GPU to batched dense Cholesky.
"""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from ..io.errors import InputError
from ..kernels.tiled_cholesky import TILE
from .banded import BandedSolver
from .dense import DenseSolver
from .linear_solver import Indices, LinearSolver, bandwidth_reducing_order
from .multigrid import MultigridSolver
from .sparse import SparseSolver
from .tiled import TiledSolver

LinearSolverName = Literal["auto", "banded", "tiled", "dense", "sparse", "multigrid"]
LINEAR_SOLVERS: tuple[LinearSolverName, ...] = get_args(LinearSolverName)
MAX_BANDED_FLOPS = 4e10  # multiplications of a banded factor on a CPU, beyond which multigrid is the cheaper one
MAX_TILED_BANDWIDTH = 600  # unknowns, beyond which tiles of a band hold mostly fill on a GPU
MAX_DENSE_UNKNOWNS = 4000  # unknowns


def make_linear_solver(
    name: str,
    rows: Indices,
    cols: Indices,
    n_nodes: int,
    block: int,
    device: torch.device,
    dtype: torch.dtype,
    positions: NDArray[np.float64] | None = None,
) -> LinearSolver:
    """Builds the named solver; ``auto`` takes the cheapest for the pattern and device.

    Raises:
        InputError: an unknown name, or a banded solver on a GPU.
    """
    if name not in LINEAR_SOLVERS:
        raise InputError(f"linear_solver is {name!r}: choose one of {', '.join(LINEAR_SOLVERS)}.")
    if name == "banded" and device.type != "cpu":
        raise InputError("linear_solver=banded runs on the CPU alone: choose tiled, dense, sparse or auto on a GPU.")
    if name == "auto":
        name = _cheapest(rows, cols, n_nodes, block, device)
    solvers: dict[str, Callable[..., LinearSolver]] = {
        "banded": BandedSolver,
        "tiled": TiledSolver,
        "dense": DenseSolver,
        "sparse": SparseSolver,
        "multigrid": MultigridSolver,
    }
    return solvers[name](rows, cols, n_nodes, block, device, dtype, positions)


def _cheapest(rows: Indices, cols: Indices, n_nodes: int, block: int, device: torch.device) -> str:
    """By what a factor takes of memory, and by the operations that a wide band costs.

    A band of width w takes n w numbers and n w^2 operations, dense n^2 and n^3 / 3; where the band is wide, a sparse
    factor fills in less. The limit on a CPU was measured (``warp-resphys benchmark sizes``); those on a GPU are
    arithmetic.
    """
    order = bandwidth_reducing_order(rows, cols, n_nodes)
    place = np.argsort(order)
    bandwidth = block * int(np.abs(place[rows] - place[cols]).max(initial=0) + 1)
    unknowns = n_nodes * block
    if device.type == "cpu":
        return "banded" if unknowns * bandwidth**2 <= MAX_BANDED_FLOPS else "multigrid"
    if bandwidth + 2 * TILE <= min(unknowns // 2, MAX_TILED_BANDWIDTH):
        return "tiled"
    return "dense" if unknowns <= MAX_DENSE_UNKNOWNS else "sparse"
