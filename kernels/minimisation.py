"""L-BFGS directions, backtracking line search and convergence of a batch, decided where the data are.

One block of threads works on one environment. Every environment has its own phase, so that none waits for the line
search of another:

==============  ===============================================================================================
START           the start is evaluated next
NEED_DIRECTION  the next direction comes from `project`, a solve with the global step's matrix, and `aim`
LINE_SEARCH     the positions are a trial, which is evaluated next and accepted or halved by `accept`
DONE            the environment has converged
FAILED          the environment has not converged, and is not tried again
==============  ===============================================================================================
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .modules import named_module
from .reductions import block_max, block_sum

wp.set_module_options({"enable_backward": False})

START, NEED_DIRECTION, LINE_SEARCH, DONE, FAILED = (wp.constant(k) for k in range(5))
FACTOR, CLAMPED_FACTOR = wp.constant(1), wp.constant(2)  # requests
NEVER = wp.constant(2**28)  # iterations after which a factor is made anew

ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
INFINITE = wp.constant(wp.float64(float("inf")))
ARMIJO = wp.constant(wp.float64(1e-4))
LEAST_CURVATURE = wp.constant(wp.float64(1e-10))
MOST_HALVINGS = wp.constant(25)
STALLS = wp.constant(3)
ASKS_AGAIN = wp.constant(16)  # stalls: one nudge may happen to change little
# Factor by which a higher order, which amplifies fast modes, must reduce the squared error.
BETTER = wp.constant(wp.float64(0.1))
UNIT = wp.constant(wp.float64(2.0**-52))  # relative rounding unit
# Rounding error of a sum of energies whose terms cancel, per unit of stiffness and of energy.
ENERGY_ROUNDING = wp.constant(wp.float64(8.0 * 2.0**-52))


@wp.struct
class SolverProgress:
    """Progress of the solve in every environment: arrays of shape (B)."""

    phase: wp.array[int]
    wanted: wp.array[int]  # 0, FACTOR or CLAMPED_FACTOR, requested before the next direction
    factored: wp.array[int]  # 1 if there is a factor, of this solve or an earlier one
    asks: wp.array[int]  # 1 if the rounding error of the residual is to be measured
    iterations: wp.array[int]  # directions of this solve; before it begins, of the last one
    since: wp.array[int]  # directions since the start of the solve or its last factorisation
    made: wp.array[int]  # factorisations in this solve
    halvings: wp.array[int]
    stalls: wp.array[int]  # evaluations in a row that have not halved the residual
    step: wp.array[wp.float64]  # length, as a share of the direction
    slope: wp.array[wp.float64]  # of the energy along the direction [J]
    energy: wp.array[wp.float64]  # at the iterate [J]
    scale: wp.array[wp.float64]  # norm of the balancing forces there [N]
    relative: wp.array[wp.float64]  # residual over scale
    smallest: wp.array[wp.float64]  # norm of the residual in this solve [N]
    rounding: wp.array[wp.float64]  # norm of the residual's rounding error, infinite until measured [N]
    force: wp.array[wp.float64]  # norm of the loads [N]
    stiffness: wp.array[wp.float64]  # sum over all points [J]


@wp.struct
class Evaluation:
    """Values of the potential at the current positions: (B), and (B, N) for the residual."""

    energy: wp.array[wp.float64]  # [J]
    size: wp.array[wp.float64]  # sum of the energies' absolute values [J]
    balance: wp.array[wp.float64]  # norm of inertia less all loads [N]
    norm: wp.array[wp.float64]  # of the residual [N]
    residual: wp.array2d[wp.vec3d]  # (B, N) [N]


@wp.struct
class History:
    """Corrections of the last steps: their solutions less the starts that inertia alone gives."""

    stored: wp.array[int]  # (B) number of corrections, 0 to 3
    newest: wp.array[int]  # (B) place of the last correction in the ring
    order: wp.array[int]  # (B) number of corrections that are extrapolated to the next step
    start: wp.array2d[wp.vec3d]  # (B, N) [m]
    correction: wp.array3d[wp.vec3d]  # (B, 3, N) solution less start, a ring [m]


@wp.struct
class Tolerances:
    """When a solve has converged, and how long it may take."""

    relative: wp.float64
    absolute: wp.float64  # [N]
    epsilon: wp.float64  # of the states' type
    max_iterations: int
    refactor_after: int  # iterations of a solve above which the next one gets a new factor


@wp.func
def correction(history: History, b: int, i: int, age: int) -> wp.vec3d:
    """Correction of a vertex; age 0 is the newest [m]."""
    return history.correction[b, (history.newest[b] + 3 - age) % 3, i]


@wp.func
def extrapolated(history: History, b: int, i: int, order: int) -> wp.vec3d:
    """Correction extrapolated to the next step [m]: zero, or a constant, line or parabola through the last ones."""
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
def remember(history: History, positions: wp.array2d[wp.vec3d], b: int, lane: int):
    """Adds a solution, and chooses the order whose extrapolation would have been closest to it."""
    lanes = wp.block_dim()
    n = positions.shape[1]
    stored = history.stored[b]
    place = (history.newest[b] + 1) % 3
    best = wp.int32(0)
    least = wp.float64(INFINITE)
    for order in range(stored + 1):
        total = wp.float64(0.0)
        for i in range(lane, n, lanes):
            error = positions[b, i] - history.start[b, i] - extrapolated(history, b, i, order)
            total += wp.dot(error, error)
        total = block_sum(total)
        if total < BETTER * least:
            best = order
            least = total
    for i in range(lane, n, lanes):
        history.correction[b, place, i] = positions[b, i] - history.start[b, i]
    if lane == 0:
        history.newest[b] = place
        history.stored[b] = wp.min(stored + 1, 3)
        history.order[b] = best


@wp.kernel
def begin(
    force: wp.array2d[wp.vec3d],  # (B, N) [N]
    stiffness: wp.array[wp.float64],  # (B) sum over the solids' points [J]
    positions: wp.array2d[wp.vec3d],  # (B, N) where inertia alone would lead; becomes the start [m]
    tolerances: Tolerances,
    origin_out: wp.array2d[wp.vec3d],
    progress: SolverProgress,
    history: History,
):
    """Starts at the extrapolation of the last steps, and resets the progress of the solve."""
    b, lane = wp.tid()
    square = wp.float64(0.0)
    stored = history.stored[b]
    if progress.phase[b] != DONE:  # The solve before has failed.
        stored = 0
    order = wp.min(history.order[b], stored)
    for i in range(lane, force.shape[1], wp.block_dim()):
        square += wp.dot(force[b, i], force[b, i])
        start = positions[b, i]
        history.start[b, i] = start
        start = start + extrapolated(history, b, i, order)
        positions[b, i] = start
        origin_out[b, i] = start
    square = block_sum(square)
    if lane == 0:
        history.stored[b] = stored
        progress.phase[b] = START
        progress.wanted[b] = 0
        if progress.factored[b] == 0 or progress.iterations[b] > tolerances.refactor_after:
            progress.wanted[b] = FACTOR
        progress.asks[b] = 0
        progress.iterations[b] = 0
        progress.since[b] = 0
        progress.made[b] = 0
        progress.stalls[b] = 0
        progress.energy[b] = INFINITE
        progress.smallest[b] = INFINITE
        progress.rounding[b] = INFINITE
        progress.force[b] = wp.sqrt(square)
        progress.stiffness[b] = stiffness[b]


@wp.kernel
def choose(progress: SolverProgress, active_out: wp.array[int], clamp_out: wp.array[int], pairs: wp.array[int]):
    """Marks the environments to factorise next, and those to clamp; drops the pairs of the old factors."""
    b = wp.tid()
    wanted = progress.wanted[b]
    chosen = progress.phase[b] == NEED_DIRECTION and wanted > 0
    active_out[b] = int(chosen)
    clamp_out[b] = int(chosen and wanted == CLAMPED_FACTOR)
    if chosen:
        progress.wanted[b] = 0
        progress.factored[b] = 1
        progress.since[b] = 0
        progress.made[b] += 1
        pairs[b] = 0


@wp.kernel
def mark(
    active: wp.array[int],  # (B) zero where the factor stays
    clamp: wp.array[int],  # (B)
    clamped_out: wp.array[wp.bool],  # (B) whether the factor is that of a clamped matrix
):
    """Marks the environments whose next factor is of a clamped matrix."""
    b = wp.tid()
    if active[b] != 0:
        clamped_out[b] = clamp[b] != 0


@wp.kernel
def repeat(active: wp.array[int], clamp: wp.array[int], wanting_out: wp.array[int]):
    """Marks the environments to factorise again, clamped, and counts them; launched with one block."""
    _, lane = wp.tid()
    wanting = wp.float64(0.0)
    for b in range(lane, active.shape[0], wp.block_dim()):
        if active[b] != 0:
            clamp[b] = 1
            wanting += ONE
    wanting = block_sum(wanting)
    if lane == 0:
        wanting_out[0] = int(wanting)


@wp.kernel
def nudge(
    progress: SolverProgress,
    signs: wp.array2d[wp.vec3d],  # (draws, N) random signs
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    positions_out: wp.array2d[wp.vec3d],  # (B, N) before the move [m]
):
    """Moves the coordinates of environments that measure rounding by one rounding unit of the largest coordinate.

    Not by a unit of each coordinate: deformation gradients sum over coordinates of all sizes.
    """
    b, lane = wp.tid()
    if progress.asks[b] == 0:
        return
    size = wp.float64(0.0)
    for i in range(lane, positions.shape[1], wp.block_dim()):
        positions_out[b, i] = positions[b, i]
        size = wp.max(size, wp.max(wp.abs(positions[b, i])))
    unit = UNIT * block_max(size)
    draw = progress.iterations[b] % signs.shape[0]
    for i in range(lane, positions.shape[1], wp.block_dim()):
        positions[b, i] = positions[b, i] + unit * signs[draw, i]


@wp.kernel
def compare(
    progress: SolverProgress,
    kept: wp.array2d[wp.vec3d],  # (B, N) positions before `nudge` [m]
    gradient: wp.array2d[wp.vec3d],  # (B, N) there [N]
    residual: wp.array2d[wp.vec3d],  # (B, N) after it [N]
    positions: wp.array2d[wp.vec3d],  # (B, N) restored [m]
    history: History,
):
    """Measures the rounding error of the residual; an environment whose residual is not larger has converged."""
    b, lane = wp.tid()
    if progress.asks[b] == 0:
        return
    rounding = progress.rounding[b]
    change, size = wp.float64(0.0), wp.float64(0.0)
    for i in range(lane, positions.shape[1], wp.block_dim()):
        moved = residual[b, i] - gradient[b, i]
        change += wp.dot(moved, moved)
        size += wp.dot(gradient[b, i], gradient[b, i])
        positions[b, i] = kept[b, i]
    change, size = wp.sqrt(block_sum(change)), wp.sqrt(block_sum(size))
    if rounding < INFINITE:
        change = wp.max(change, rounding)
    if size <= change:
        remember(history, positions, b, lane)
    if lane == 0:
        progress.asks[b] = 0
        progress.rounding[b] = change
        if size <= change:
            progress.phase[b] = DONE


@wp.kernel
def summarise(progress: SolverProgress, summary_out: wp.array[int], active_out: wp.array[int]):
    """Counts for the host, see `Summary`, and (B) flags of environments to evaluate again; launched with one block."""
    _, lane = wp.tid()
    active, aiming = wp.float64(0.0), wp.float64(0.0)
    wanting, asking = wp.float64(0.0), wp.float64(0.0)
    for b in range(lane, progress.phase.shape[0], wp.block_dim()):
        asking += wp.float64(progress.asks[b])
        # An environment that measures rounding is evaluated once more, even if it has failed.
        active_out[b] = int(progress.phase[b] < DONE or progress.asks[b] != 0)
        if progress.phase[b] < DONE:
            active += ONE
        if progress.phase[b] == NEED_DIRECTION:
            aiming += ONE
            if progress.wanted[b] > 0:
                wanting += ONE
    active, aiming, wanting, asking = block_sum(active), block_sum(aiming), block_sum(wanting), block_sum(asking)
    if lane == 0:
        summary_out[0] = int(active)
        summary_out[1] = int(aiming)
        summary_out[2] = int(wanting)
        summary_out[3] = int(asking)


@wp.func
def may_be_rounding(progress: SolverProgress, b: int, norm: wp.float64, iterations: int, stalls: int) -> bool:
    """Returns whether to measure the rounding error of a residual that no longer falls: once, then every 16 stalls."""
    stuck = iterations >= STALLS and stalls >= STALLS
    return stuck and (norm <= progress.rounding[b] or stalls % ASKS_AGAIN == 0)


@wp.func
def give_up(progress: SolverProgress, tolerances: Tolerances, clamped: wp.array[wp.bool], b: int):
    """Ends a failed line search: tries a new factor, then a clamped one, before the environment fails."""
    progress.phase[b] = NEED_DIRECTION
    progress.stalls[b] += 1
    norm = progress.relative[b] * wp.max(progress.scale[b], tolerances.absolute)
    if may_be_rounding(progress, b, norm, progress.iterations[b], progress.stalls[b]):
        progress.asks[b] = 1
    if progress.iterations[b] >= tolerances.max_iterations:
        progress.phase[b] = FAILED
    elif progress.made[b] == 0:
        progress.wanted[b] = FACTOR
    elif clamped[b]:
        progress.phase[b] = FAILED
    else:
        progress.wanted[b] = CLAMPED_FACTOR


@wp.func
def within_rounding(
    tolerances: Tolerances,
    inertia: wp.array2d[wp.float64],
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],
    scale: wp.float64,
    b: int,
    lane: int,
) -> bool:
    """Returns whether a step, and the balancing forces after it, are within the rounding of the state."""
    moved, size, square = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for i in range(lane, positions.shape[1], wp.block_dim()):
        for c in range(3):
            moved = wp.max(moved, wp.abs(direction[b, i][c]))
            size = wp.max(size, wp.abs(positions[b, i][c]))
        square += inertia[b, i] * inertia[b, i]
    moved, size, square = block_max(moved), block_max(size), block_sum(square)
    rounding = tolerances.epsilon * size
    return moved <= rounding and scale <= wp.float64(2.0) * rounding * wp.sqrt(square)


@functools.cache
def minimisation_kernels(scalar: Any) -> SimpleNamespace:
    """Kernels whose pairs, right-hand sides and solutions are of a type, ``wp.float64`` or ``wp.float32``."""
    module = named_module(f"minimisation.{scalar.__name__}")
    vector = wp.vec3d if scalar is wp.float64 else wp.vec3f

    @wp.struct
    class Pairs:
        """The last pairs of displacement and change of the residual, and R = triu(S Y^T); a ring of M places."""

        count: wp.array[int]  # (B)
        last: wp.array[int]  # (B) place of the newest
        s: wp.array3d[vector]  # (B, M, N) [m]
        y: wp.array3d[vector]  # (B, M, N) [N]
        r: wp.array3d[wp.float64]  # (B, M, M) by place [J]
        a: wp.array2d[wp.float64]  # (B, M) by age, oldest first: coefficients of `project`
        b: wp.array2d[wp.float64]  # (B, M) coefficients of `aim`; holds S g in between

    @wp.func(module=module)
    def place(pairs: Pairs, b: int, age: int) -> int:
        """Place of a pair in the ring; age 0 is the oldest."""
        m = pairs.s.shape[1]
        return (pairs.last[b] - pairs.count[b] + 1 + age + m) % m

    @wp.kernel(module=module)
    def project(
        progress: SolverProgress,
        pairs: Pairs,
        vertex_at: wp.array[int],  # (F) the vertex at each place of the linear solver's order
        gradient: wp.array2d[wp.vec3d],  # (B, N) [N]
        right_out: wp.array2d[vector],  # (B, F) g - Y^T a, with a = R^-1 S g
    ):
        """Right-hand side of the solve in the compact form of L-BFGS; zero where no direction is needed."""
        b, lane = wp.tid()
        if progress.phase[b] != NEED_DIRECTION:
            for p in range(lane, vertex_at.shape[0], wp.block_dim()):
                right_out[b, p] = vector()
            return
        k = pairs.count[b]
        for i in range(k):
            total = wp.float64(0.0)
            row = pairs.s[b, place(pairs, b, i)]
            for v in range(lane, gradient.shape[1], wp.block_dim()):
                total += wp.dot(wp.vec3d(row[v]), gradient[b, v])
            pairs.b[b, i] = block_sum(total)
        # Every thread solves the small system by itself: all write the same.
        for j in range(k):
            i = k - 1 - j
            here = place(pairs, b, i)
            rest = pairs.b[b, i]
            for newer in range(i + 1, k):
                rest -= pairs.r[b, here, place(pairs, b, newer)] * pairs.a[b, newer]
            pairs.a[b, i] = rest / pairs.r[b, here, here]
        for p in range(lane, vertex_at.shape[0], wp.block_dim()):
            v = vertex_at[p]
            value = gradient[b, v]
            for i in range(k):
                value -= pairs.a[b, i] * wp.vec3d(pairs.y[b, place(pairs, b, i), v])
            right_out[b, p] = vector(value)

    @wp.kernel(module=module)
    def aim(
        progress: SolverProgress,
        pairs: Pairs,
        vertex_at: wp.array[int],
        gradient: wp.array2d[wp.vec3d],
        solution: wp.array2d[vector],  # (B, F) z, of the matrix with the right-hand side of `project` [m]
        positions: wp.array2d[wp.vec3d],  # (B, N) becomes the first trial
        origin_out: wp.array2d[wp.vec3d],
        direction_out: wp.array2d[wp.vec3d],  # (B, N) -(z + S^T b), with b = R^-T (D a - Y z); zero at fixed vertices
    ):
        """Computes the direction, its slope and the first trial.

        Where the slope is positive or not finite, the pairs are dropped; without pairs a new factor is requested, once.
        """
        b, lane = wp.tid()
        if progress.phase[b] != NEED_DIRECTION:
            return
        k = pairs.count[b]
        for i in range(k):
            total = wp.float64(0.0)
            row = pairs.y[b, place(pairs, b, i)]
            for p in range(lane, vertex_at.shape[0], wp.block_dim()):
                total += wp.dot(wp.vec3d(row[vertex_at[p]]), wp.vec3d(solution[b, p]))
            total = block_sum(total)
            here = place(pairs, b, i)
            diagonal = pairs.r[b, here, here]
            rest = diagonal * pairs.a[b, i] - total
            for older in range(i):
                rest -= pairs.r[b, place(pairs, b, older), here] * pairs.b[b, older]
            pairs.b[b, i] = rest / diagonal
        slope = wp.float64(0.0)
        for p in range(lane, vertex_at.shape[0], wp.block_dim()):
            v = vertex_at[p]
            value = wp.vec3d(solution[b, p])
            for i in range(k):
                value += pairs.b[b, i] * wp.vec3d(pairs.s[b, place(pairs, b, i), v])
            direction_out[b, v] = -value
            slope -= wp.dot(gradient[b, v], value)
        slope = block_sum(slope)
        if wp.isfinite(slope) and (slope <= ZERO or k == 0):
            for p in range(lane, vertex_at.shape[0], wp.block_dim()):
                v = vertex_at[p]
                origin_out[b, v] = positions[b, v]
                positions[b, v] = positions[b, v] + direction_out[b, v]
            if lane == 0:
                progress.phase[b] = LINE_SEARCH
                progress.iterations[b] += 1
                progress.since[b] += 1
                progress.halvings[b] = 0
                progress.step[b] = ONE
                progress.slope[b] = slope
        elif lane == 0:
            if k > 0:
                pairs.count[b] = 0
            elif progress.made[b] == 0:
                progress.wanted[b] = FACTOR
            else:
                progress.phase[b] = FAILED

    @wp.func(module=module)
    def add_pair(
        pairs: Pairs,
        b: int,
        lane: int,
        step: wp.float64,
        direction: wp.array2d[wp.vec3d],
        before: wp.array2d[wp.vec3d],
        after: wp.array2d[wp.vec3d],
    ):
        """Stores a pair if its curvature is positive."""
        m, lanes = pairs.s.shape[1], wp.block_dim()
        k = pairs.count[b]
        new = (pairs.last[b] + 1) % m
        s = pairs.s[b, new]
        y = pairs.y[b, new]
        curvature, lengths, changes = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        for v in range(lane, direction.shape[1], lanes):
            moved = step * direction[b, v]
            changed = after[b, v] - before[b, v]
            curvature += wp.dot(moved, changed)
            lengths += wp.dot(moved, moved)
            changes += wp.dot(changed, changed)
        curvature, lengths, changes = block_sum(curvature), block_sum(lengths), block_sum(changes)
        if not curvature > LEAST_CURVATURE * wp.sqrt(lengths * changes):
            return
        for v in range(lane, direction.shape[1], lanes):
            s[v] = vector(step * direction[b, v])
            y[v] = vector(after[b, v] - before[b, v])
        first = 0
        if k == m:
            first = 1
        for i in range(first, k):
            total, other = wp.float64(0.0), place(pairs, b, i)
            row = pairs.s[b, other]
            for v in range(lane, direction.shape[1], lanes):
                total += wp.dot(wp.vec3d(row[v]), wp.vec3d(y[v]))
            total = block_sum(total)
            pairs.r[b, other, new] = total
        if lane == 0:
            pairs.r[b, new, new] = curvature
            pairs.last[b] = new
            pairs.count[b] = wp.min(k + 1, m)

    @wp.kernel(module=module)
    def accept(
        remembers: int,  # 1 if pairs are stored
        tolerances: Tolerances,
        inertia: wp.array2d[wp.float64],  # (B, N) [N/m]
        evaluation: Evaluation,  # at the positions
        origin: wp.array2d[wp.vec3d],
        direction: wp.array2d[wp.vec3d],
        clamped: wp.array[wp.bool],  # (B) whether the global step's matrix is positive definite by force
        positions: wp.array2d[wp.vec3d],
        gradient: wp.array2d[wp.vec3d],  # (B, N) set to the residual where the trial is accepted
        progress: SolverProgress,
        pairs: Pairs,
        history: History,
    ):
        """Accepts a trial that decreases the energy, or its slope where the energy is down to rounding; else halves it.

        The second test is the approximate Wolfe condition of Hager and Zhang (2005).
        """
        b, lane = wp.tid()
        phase = progress.phase[b]
        lanes = wp.block_dim()
        n = positions.shape[1]
        if phase != START and phase != LINE_SEARCH:
            return
        energy = evaluation.energy[b]
        norm = evaluation.norm[b]
        before = progress.energy[b]
        flat = ENERGY_ROUNDING * (progress.stiffness[b] + wp.float64(100.0) * evaluation.size[b])
        iterations = progress.iterations[b]
        stalls = progress.stalls[b]
        if phase == LINE_SEARCH:
            step = progress.step[b]
            slope = progress.slope[b]
            halvings = progress.halvings[b]
            after = wp.float64(0.0)
            for i in range(lane, n, lanes):
                after += wp.dot(evaluation.residual[b, i], direction[b, i])
            after = block_sum(after)
            taken = energy <= before + ARMIJO * step * slope
            if not taken:
                taken = energy <= before + flat and after <= (wp.float64(2.0) * ARMIJO - ONE) * slope
            if not taken:
                step = HALF * step
                given_up = halvings + 1 >= MOST_HALVINGS
                if given_up:
                    step = wp.float64(0.0)
                for i in range(lane, n, lanes):
                    positions[b, i] = origin[b, i] + step * direction[b, i]
                rests = False
                if given_up and iterations == 1 and progress.force[b] == ZERO:
                    scale = progress.scale[b]
                    rests = within_rounding(tolerances, inertia, positions, direction, scale, b, lane)
                if lane == 0:
                    progress.step[b] = step
                    progress.halvings[b] = halvings + 1
                    if rests:
                        progress.phase[b] = DONE
                        history.stored[b] = 0
                    elif given_up:
                        give_up(progress, tolerances, clamped, b)
                return
            if remembers == 1:
                add_pair(pairs, b, lane, step, direction, gradient, evaluation.residual)
        for i in range(lane, n, lanes):
            gradient[b, i] = evaluation.residual[b, i]
        scale = evaluation.balance[b] + progress.force[b]
        smallest = progress.smallest[b]
        stalls += 1
        if norm < HALF * smallest:
            stalls = 0
        done = norm <= tolerances.relative * scale or norm <= tolerances.absolute
        done = done and norm + scale < INFINITE
        if phase == LINE_SEARCH and iterations == 1 and progress.force[b] == ZERO:
            done = done or within_rounding(tolerances, inertia, positions, direction, scale, b, lane)
        # Before the values of this environment are written, every thread has read them.
        asks = block_max(ZERO)
        if may_be_rounding(progress, b, norm, iterations, stalls) and before - energy <= flat and not done:
            asks = ONE
        if done:
            remember(history, positions, b, lane)
        if lane == 0:
            relative = norm / wp.max(scale, tolerances.absolute)
            progress.energy[b] = energy
            progress.scale[b] = scale
            progress.relative[b] = relative
            progress.smallest[b] = wp.min(norm, smallest)
            progress.stalls[b] = stalls
            progress.asks[b] = int(asks)
            progress.phase[b] = NEED_DIRECTION
            if progress.since[b] >= 3 * tolerances.refactor_after:
                progress.wanted[b] = FACTOR
            if done:
                progress.phase[b] = DONE
            elif not wp.isfinite(relative) or iterations >= tolerances.max_iterations:
                progress.phase[b] = FAILED

    return SimpleNamespace(project=project, aim=aim, accept=accept, Pairs=Pairs)
