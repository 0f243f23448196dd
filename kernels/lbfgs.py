"""L-BFGS directions of a batch in compact form (Byrd, Nocedal and Schnabel 1994),
with the matrix of the global step.

Without pairs, a direction is that of the matrix alone. ``pairs`` is a struct `Pairs` of either
type.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from .constants import ZERO
from .minimisation import FACTOR, FAILED, NEED_DIRECTION, LineSearch, SolverProgress, begin_search
from .modules import generated, named_module
from .reductions import block_sum

MIN_CURVATURE = wp.constant(wp.float64(1e-10))


@wp.func
def place(pairs: Any, b: int, age: int) -> int:
    """Returns the index of a pair in the ring buffer; age 0 is the oldest."""
    m = pairs.s.shape[1]
    return (pairs.last[b] - pairs.count[b] + 1 + age + m) % m


@wp.func
def substitute_backward(pairs: Any, b: int, k: int):
    """Solves R a = S g for k pairs; every thread does, and writes the same values."""
    for j in range(k):
        i = k - 1 - j
        here = place(pairs, b, i)
        rest = pairs.b[b, i]
        for newer in range(i + 1, k):
            rest -= pairs.r[b, here, place(pairs, b, newer)] * pairs.a[b, newer]
        pairs.a[b, i] = rest / pairs.r[b, here, here]


@wp.func
def substitute_forward(pairs: Any, b: int, i: int, product: wp.float64):
    """Solves row i of R^T b = D a - Y z after rows before it, from the product, row i of Y z."""
    here = place(pairs, b, i)
    diagonal = pairs.r[b, here, here]
    rest = diagonal * pairs.a[b, i] - product
    for older in range(i):
        rest -= pairs.r[b, place(pairs, b, older), here] * pairs.b[b, older]
    pairs.b[b, i] = rest / diagonal


@wp.func
def direction_and_slope(
    vertex_at: wp.array[int],
    solution: wp.array2d[Any],
    search: LineSearch,
    pairs: Any,
    b: int,
    lane: int,
) -> wp.float64:
    """Writes the direction -(z + S^T b), with b = R^-T (D a - Y z), and returns its slope."""
    k = pairs.count[b]
    for i in range(k):
        total = wp.float64(0.0)
        row = pairs.y[b, place(pairs, b, i)]
        for p in range(lane, vertex_at.shape[0], wp.block_dim()):
            total += wp.dot(wp.vec3d(row[vertex_at[p]]), wp.vec3d(solution[b, p]))
        substitute_forward(pairs, b, i, block_sum(total))
    slope = wp.float64(0.0)
    for p in range(lane, vertex_at.shape[0], wp.block_dim()):
        v = vertex_at[p]
        value = wp.vec3d(solution[b, p])
        for i in range(k):
            value += pairs.b[b, i] * wp.vec3d(pairs.s[b, place(pairs, b, i), v])
        search.direction[b, v] = -value
        slope -= wp.dot(search.gradient[b, v], value)
    return block_sum(slope)


@wp.func
def add_pair(
    pairs: Any, b: int, lane: int, step: wp.float64, search: LineSearch, after: wp.array2d[wp.vec3d]
):
    """Stores a pair of positive curvature, from the residual after a step."""
    m, n = pairs.s.shape[1], after.shape[1]
    lanes = wp.block_dim()
    k = pairs.count[b]
    new = (pairs.last[b] + 1) % m
    s, y = pairs.s[b, new], pairs.y[b, new]
    curvature = wp.float64(0.0)
    lengths, changes = wp.float64(0.0), wp.float64(0.0)
    for v in range(lane, n, lanes):
        moved = step * search.direction[b, v]
        changed = after[b, v] - search.gradient[b, v]
        curvature += wp.dot(moved, changed)
        lengths += wp.dot(moved, moved)
        changes += wp.dot(changed, changed)
    curvature = block_sum(curvature)
    lengths, changes = block_sum(lengths), block_sum(changes)
    if not curvature > MIN_CURVATURE * wp.sqrt(lengths * changes):
        return
    for v in range(lane, n, lanes):
        s[v] = s.dtype(step * search.direction[b, v])
        y[v] = y.dtype(after[b, v] - search.gradient[b, v])
    for i in range(wp.where(k == m, 1, 0), k):
        total, other = wp.float64(0.0), place(pairs, b, i)
        row = pairs.s[b, other]
        for v in range(lane, n, lanes):
            total += wp.dot(wp.vec3d(row[v]), wp.vec3d(y[v]))
        total = block_sum(total)
        pairs.r[b, other, new] = total
    if lane == 0:
        pairs.r[b, new, new] = curvature
        pairs.last[b] = new
        pairs.count[b] = wp.min(k + 1, m)


@generated
def lbfgs_kernels(scalar: Any) -> SimpleNamespace:
    """Returns kernels for pairs, right-hand sides and solutions
    of type ``wp.float64`` or ``wp.float32``.
    """
    module = named_module(f"lbfgs.{scalar.__name__}")
    vector = wp.vec3d if scalar is wp.float64 else wp.vec3f

    @wp.struct
    class Pairs:
        """Last pairs of displacement s and change of residual y, and R = triu(S Y^T).

        Ring buffers of size M.
        """

        count: wp.array[int]  # (B)
        last: wp.array[int]  # (B) index of the newest pair
        s: wp.array3d[vector]  # (B, M, N) [m]
        y: wp.array3d[vector]  # (B, M, N) [N]
        r: wp.array3d[wp.float64]  # (B, M, M) by place [J]
        a: wp.array2d[wp.float64]  # (B, M) coefficients of `project`, oldest pair first
        b: wp.array2d[wp.float64]  # (B, M) S g in `project`, coefficients of `set_direction`

    @wp.kernel(module=module)
    def project(
        vertex_at: wp.array[int],  # (F) vertices in the order of the linear solver
        progress: SolverProgress,
        search: LineSearch,
        pairs_out: Pairs,
        right_out: wp.array2d[vector],  # (B, F) g - Y^T a, with a = R^-1 S g
    ):
        """Computes the right-hand side of the solve in compact L-BFGS form.

        Zero where no direction is needed.
        """
        b, lane = wp.tid()
        if progress.phase[b] != NEED_DIRECTION:
            for p in range(lane, vertex_at.shape[0], wp.block_dim()):
                right_out[b, p] = vector()
            return
        k = pairs_out.count[b]
        for i in range(k):
            total = wp.float64(0.0)
            row = pairs_out.s[b, place(pairs_out, b, i)]
            for v in range(lane, search.gradient.shape[1], wp.block_dim()):
                total += wp.dot(wp.vec3d(row[v]), search.gradient[b, v])
            pairs_out.b[b, i] = block_sum(total)
        substitute_backward(pairs_out, b, k)
        for p in range(lane, vertex_at.shape[0], wp.block_dim()):
            v = vertex_at[p]
            value = search.gradient[b, v]
            for i in range(k):
                value -= pairs_out.a[b, i] * wp.vec3d(pairs_out.y[b, place(pairs_out, b, i), v])
            right_out[b, p] = vector(value)

    return SimpleNamespace(
        project=project, set_direction=_set_direction(Pairs, vector, module), Pairs=Pairs
    )


def _set_direction(pairs_type: Any, vector: Any, module: wp.Module) -> Any:
    """Returns the kernel that begins a line search."""

    @wp.kernel(module=module)
    def set_direction(
        vertex_at: wp.array[int],
        solution: wp.array2d[vector],  # (B, F) z, solution for the right-hand side of `project` [m]
        progress_out: SolverProgress,
        search_out: LineSearch,
        pairs_out: pairs_type,
    ):
        """Sets the direction, its slope and the first trial.

        If the slope is positive or not finite, the pairs are deleted; without pairs a new factor is
        requested, once.
        """
        b, lane = wp.tid()
        if progress_out.phase[b] != NEED_DIRECTION:
            return
        k = pairs_out.count[b]
        slope = direction_and_slope(vertex_at, solution, search_out, pairs_out, b, lane)
        if wp.isfinite(slope) and (slope <= ZERO or k == 0):
            for p in range(lane, vertex_at.shape[0], wp.block_dim()):
                v = vertex_at[p]
                search_out.origin[b, v] = search_out.positions[b, v]
                search_out.positions[b, v] = search_out.positions[b, v] + search_out.direction[b, v]
            if lane == 0:
                begin_search(progress_out, slope, b)
        elif lane == 0:
            if k > 0:
                pairs_out.count[b] = 0
            elif progress_out.factorisations[b] == 0:
                progress_out.request[b] = FACTOR
            else:
                progress_out.phase[b] = FAILED

    return set_direction
