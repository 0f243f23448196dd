"""Linear solvers by name, and the cheapest one for a sparsity pattern and a device.

Soft robots are slender: with a bandwidth-reducing order, LAPACK's banded Cholesky is the cheapest
on a CPU up to tens of thousands of unknowns, and a tiled one on a GPU. Compact bodies use Pardiso
on a CPU, or CHOLMOD (cholespy) where it is not installed and on a GPU; the smallest bodies on a GPU
use batched dense Cholesky.

Seconds of a factor and of a solution in float64, at nu 0.45, on two cores of an AMD EPYC:

=============================  ========  ===========  ============  ===========
body                           unknowns  banded       Pardiso       CHOLMOD
=============================  ========  ===========  ============  ===========
cube of 8-node hexahedra       4,752     0.10, 0.002  0.07, 0.002   0.38, 0.006
cube of 10-node tetrahedra     34,914    66, 0.7                    12, 0.04
cube of 10-node tetrahedra     86,490                 2.4, 0.04
beam of 8-node hexahedra       91,368                 1.1, 0.03     104, 0.3
=============================  ========  ===========  ============  ===========
"""

from typing import get_args

import torch

from ...io.errors import InputError
from ...kernels.tiled_cholesky import TILE
from .banded import BandedSolver, BorderedSolver, banded_rest, hubs
from .cholmod import SparseSolver
from .dense import DenseSolver
from .linear_solver import Indices, LinearSolver, bandwidth
from .pardiso import PardisoSolver, has_pardiso
from .solver_names import LinearSolverName
from .tiled import TiledSolver

LINEAR_SOLVERS: tuple[LinearSolverName, ...] = get_args(LinearSolverName)
# Multiplications of a banded factor on a CPU above which CHOLMOD is cheaper
MAX_BANDED_FLOPS = 4e10
MAX_SMALL_FLOPS = 5e8  # multiplications of a banded factor up to which no other one is cheaper
COMPACT = 30  # squared bandwidth over unknowns from which Pardiso is cheaper than a banded factor
BORDER_FLOPS = 44  # of an unknown beside a band, in multiplications of a banded factor
MAX_TILED_BANDWIDTH = 600  # unknowns above which the tiles of a band hold mostly fill on a GPU
MAX_DENSE_UNKNOWNS = 4000  # unknowns


def make_linear_solver(
    name: str,
    rows: Indices,
    cols: Indices,
    n_nodes: int,
    block: int,
    device: torch.device,
    dtype: torch.dtype,
) -> LinearSolver:
    """Returns the named solver; ``auto`` selects the cheapest for the pattern and the device.

    Raises:
        InputError: an unknown name, Pardiso on a GPU, or Pardiso where it is not installed.
    """
    if name not in LINEAR_SOLVERS:
        raise InputError(f"linear_solver is {name!r}: choose one of {', '.join(LINEAR_SOLVERS)}.")
    if name == "pardiso" and device.type != "cpu":
        raise InputError(
            "linear_solver=pardiso runs on the CPU alone: "
            "choose banded, dense, sparse or auto on a GPU."
        )
    if name == "pardiso" and not has_pardiso():
        raise InputError(
            "linear_solver=pardiso needs the package mkl, "
            "for x86 processors: pip install mkl, or take auto."
        )
    kinds: dict[str, type[LinearSolver]] = {
        "tiled": TiledSolver,
        "dense": DenseSolver,
        "sparse": SparseSolver,
        "pardiso": PardisoSolver,
    }
    kind = kinds.get(name) or _cheapest(
        rows, cols, n_nodes, block, device, is_banded=name == "banded"
    )
    return kind(rows, cols, n_nodes, block, device, dtype)


def _cheapest(
    rows: Indices, cols: Indices, n_nodes: int, block: int, device: torch.device, is_banded: bool
) -> type[LinearSolver]:
    """Returns the cheapest solver by memory and operations, of all or of the banded ones.

    A band of width w takes n w numbers and n w^2 operations, a border of m unknowns 4 n w m more,
    each of which takes eleven times as long (measured on 87 unknowns beside a band of 1,161). A
    dense matrix takes n^2 numbers and n^3 / 3 operations; for wide bands a sparse factor has less
    fill-in. The limits on a CPU are measured, those on a GPU are estimates from these counts.
    """
    unknowns, width = n_nodes * block, block * bandwidth(rows, cols, n_nodes)
    if device.type != "cpu":
        if is_banded or width + 2 * TILE <= min(unknowns // 2, MAX_TILED_BANDWIDTH):
            return TiledSolver
        return DenseSolver if unknowns <= MAX_DENSE_UNKNOWNS else SparseSolver
    kind: type[LinearSolver] = BandedSolver
    cost = unknowns * width**2
    border = hubs(rows, cols, n_nodes)
    if len(border):
        rest = block * bandwidth(
            *banded_rest(rows, cols, n_nodes, border)[:2], n_nodes - len(border)
        )
        bordered = unknowns * rest * (rest + BORDER_FLOPS * block * len(border))
        kind, cost = (BorderedSolver, bordered) if bordered < cost else (kind, cost)
    if (
        not is_banded
        and cost > max(MAX_SMALL_FLOPS, min(COMPACT * unknowns**2, MAX_BANDED_FLOPS))
        and has_pardiso()
    ):
        return PardisoSolver
    return kind if is_banded or cost <= MAX_BANDED_FLOPS else SparseSolver
