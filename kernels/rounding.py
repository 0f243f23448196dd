"""Rounding errors of the residual and the state, below which a minimisation makes no progress."""

import warp as wp

from .extrapolation import INFINITE, History, record_solution
from .minimisation import DONE, LineSearch, SolverProgress, Tolerances
from .reductions import block_max, block_sum

wp.set_module_options({"enable_backward": False})

ROUNDING_UNIT = wp.constant(wp.float64(2.0**-52))


@wp.kernel
def perturb(
    progress: SolverProgress,
    signs: wp.array2d[wp.vec3d],  # (draws, N) random signs
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    kept_out: wp.array2d[wp.vec3d],  # (B, N) copy of the unperturbed positions [m]
):
    """Moves every coordinate by one rounding unit of the largest coordinate, where rounding is to be checked.

    The largest coordinate counts because deformation gradients sum over coordinates of all sizes.
    """
    b, lane = wp.tid()
    if progress.check_rounding[b] == 0:
        return
    size = wp.float64(0.0)
    for i in range(lane, positions.shape[1], wp.block_dim()):
        kept_out[b, i] = positions[b, i]
        size = wp.max(size, wp.max(wp.abs(positions[b, i])))
    unit = ROUNDING_UNIT * block_max(size)
    draw = progress.iterations[b] % signs.shape[0]
    for i in range(lane, positions.shape[1], wp.block_dim()):
        positions[b, i] = positions[b, i] + unit * signs[draw, i]


@wp.kernel
def check_rounding(
    progress: SolverProgress,
    kept: wp.array2d[wp.vec3d],  # (B, N) positions before `perturb` [m]
    residual: wp.array2d[wp.vec3d],  # (B, N) residual after `perturb` [N]
    search: LineSearch,  # its positions are restored
    history: History,
):
    """Marks an environment as converged if its residual is not larger than its change by the perturbation."""
    b, lane = wp.tid()
    if progress.check_rounding[b] == 0:
        return
    rounding = progress.rounding[b]
    change, size = wp.float64(0.0), wp.float64(0.0)
    for i in range(lane, search.positions.shape[1], wp.block_dim()):
        moved = residual[b, i] - search.gradient[b, i]
        change += wp.dot(moved, moved)
        size += wp.dot(search.gradient[b, i], search.gradient[b, i])
        search.positions[b, i] = kept[b, i]
    change, size = wp.sqrt(block_sum(change)), wp.sqrt(block_sum(size))
    if rounding < INFINITE:
        change = wp.max(change, rounding)
    if size <= change:
        record_solution(history, search.positions, b, lane)
    if lane == 0:
        progress.check_rounding[b] = 0
        progress.rounding[b] = change
        if size <= change:
            progress.phase[b] = DONE


@wp.func
def within_rounding(
    progress: SolverProgress,
    tolerances: Tolerances,
    inertia: wp.array2d[wp.float64],
    search: LineSearch,
    scale: wp.float64,
    iterations: int,
    b: int,
    lane: int,
) -> bool:
    """Whether the first step without loads, and the balancing forces after it, are within the rounding of the state."""
    if iterations != 1 or progress.force[b] != wp.float64(0.0):
        return False
    moved, size, square = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for i in range(lane, inertia.shape[1], wp.block_dim()):
        for c in range(3):
            moved = wp.max(moved, wp.abs(search.direction[b, i][c]))
            size = wp.max(size, wp.abs(search.positions[b, i][c]))
        square += inertia[b, i] * inertia[b, i]
    moved, size, square = block_max(moved), block_max(size), block_sum(square)
    rounding = tolerances.epsilon * size
    return moved <= rounding and scale <= wp.float64(2.0) * rounding * wp.sqrt(square)
