"""Initial guesses of a step, extrapolated from the corrections of the last steps.

The correction of a step is its solution less the position where inertia alone would lead. It is extrapolated by one
step with the polynomial through the last corrections: none, a constant, a line or a parabola.
"""

import warp as wp

from .reductions import block_sum

wp.set_module_options({"enable_backward": False})

INFINITE = wp.constant(wp.float64(float("inf")))
# A higher order, which amplifies fast modes, is used only if it reduces the squared error to this fraction.
IMPROVEMENT = wp.constant(wp.float64(0.1))


@wp.struct
class History:
    """Corrections of the last steps."""

    stored: wp.array[int]  # (B) number of corrections, 0 to 3
    newest: wp.array[int]  # (B) index of the last one in the ring buffer
    order: wp.array[int]  # (B) number of corrections used for the next extrapolation
    start: wp.array2d[wp.vec3d]  # (B, N) position where inertia alone leads in the current step [m]
    correction: wp.array3d[wp.vec3d]  # (B, 3, N) ring buffer of solutions less start [m]


@wp.func
def correction(history: History, b: int, i: int, age: int) -> wp.vec3d:
    """Returns a correction of vertex i; age 0 is the newest."""
    return history.correction[b, (history.newest[b] + 3 - age) % 3, i]


@wp.func
def extrapolated(history: History, b: int, i: int, order: int) -> wp.vec3d:
    """Returns the correction of vertex i extrapolated by one step; `order` corrections are used."""
    guess = wp.vec3d()
    if order == 1:
        guess = correction(history, b, i, 0)
    elif order == 2:
        guess = wp.float64(2.0) * correction(history, b, i, 0) - correction(history, b, i, 1)
    elif order == 3:
        guess = wp.float64(3.0) * (correction(history, b, i, 0) - correction(history, b, i, 1))
        guess += correction(history, b, i, 2)
    return guess


@wp.func
def record_solution(history: History, positions: wp.array2d[wp.vec3d], b: int, lane: int):
    """Stores the correction of a solution, and selects the order whose extrapolation was closest to it."""
    lanes = wp.block_dim()
    n = positions.shape[1]
    count = history.stored[b]
    place = (history.newest[b] + 1) % 3
    best = wp.int32(0)
    least = wp.float64(INFINITE)
    for order in range(count + 1):
        total = wp.float64(0.0)
        for i in range(lane, n, lanes):
            error = positions[b, i] - history.start[b, i] - extrapolated(history, b, i, order)
            total += wp.dot(error, error)
        total = block_sum(total)
        if total < IMPROVEMENT * least:
            best = order
            least = total
    for i in range(lane, n, lanes):
        history.correction[b, place, i] = positions[b, i] - history.start[b, i]
    if lane == 0:
        history.newest[b] = place
        history.stored[b] = wp.min(count + 1, 3)
        history.order[b] = best
