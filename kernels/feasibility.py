"""Bounds of the steps of a minimisation, so that no iterate penetrates an obstacle."""

import warp as wp

from .minimisation import LINE_SEARCH, LineSearch, SolverProgress

wp.set_module_options({"enable_backward": False})

ONE = wp.float64(1.0)


@wp.kernel
def allow_all(share_out: wp.array[wp.float64]):
    """The whole step is allowed."""
    share_out[wp.tid()] = ONE


@wp.kernel
def shorten_start(
    share: wp.array[wp.float64],  # (B) allowed share of the way from the feasible positions
    free: wp.array[wp.float64],  # (N) zero at fixed vertices, which keep their positions
    feasible: wp.array2d[wp.vec3d],  # (B, N) positions without penetration [m]
    search: LineSearch,
):
    """Draws a start back towards feasible positions."""
    b, i = wp.tid()
    if share[b] < ONE and free[i] > wp.float64(0.0):
        x = feasible[b, i] + share[b] * (search.positions[b, i] - feasible[b, i])
        search.positions[b, i] = x
        search.origin[b, i] = x


@wp.kernel
def shorten_step(progress: SolverProgress, share: wp.array[wp.float64], search: LineSearch):
    """Shortens the first trial of a line search."""
    b, lane = wp.tid()
    if progress.phase[b] != LINE_SEARCH or progress.halvings[b] > 0:
        return
    s = share[b]
    if s < ONE:
        for i in range(lane, search.positions.shape[1], wp.block_dim()):
            search.positions[b, i] = search.origin[b, i] + s * search.direction[b, i]
        if lane == 0:
            progress.step[b] = s
