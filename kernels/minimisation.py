"""L-BFGS directions, backtracking line search and convergence tests of a batch, on the device.

One block of threads works on one environment. Every environment has its own phase, so that none waits for the line
search of another:

==============  ====================================================================================
START           the starting point is evaluated next
NEED_DIRECTION  next: `project`, a solve with the matrix of the global step, `set_direction`
LINE_SEARCH     the positions are a trial, which is evaluated next and tested by `accept`
DONE            the environment has converged
FAILED          the environment has not converged and gets no further step
==============  ====================================================================================
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .extrapolation import History, extrapolated, record_solution
from .modules import named_module
from .reductions import block_max, block_sum

wp.set_module_options({"enable_backward": False})

START, NEED_DIRECTION, LINE_SEARCH, DONE, FAILED = (wp.constant(k) for k in range(5))
FACTOR, CLAMPED_FACTOR = wp.constant(1), wp.constant(2)  # requests
NEVER = wp.constant(2**28)  # a number of iterations that no solve reaches

ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
INFINITE = wp.constant(wp.float64(float("inf")))
ARMIJO = wp.constant(wp.float64(1e-4))
MIN_CURVATURE = wp.constant(wp.float64(1e-10))
MAX_HALVINGS = wp.constant(25)
STALLS_BEFORE_CHECK = wp.constant(3)
STALLS_BETWEEN_CHECKS = wp.constant(16)  # a single perturbation may happen to change little
ROUNDING_UNIT = wp.constant(wp.float64(2.0**-52))
# Rounding error of a sum of energies with cancellation, per unit of stiffness and of energy.
ENERGY_ROUNDING = wp.constant(wp.float64(8.0 * 2.0**-52))


@wp.struct
class SolverProgress:
    """State of the solver, (B) each."""

    phase: wp.array[int]
    request: wp.array[int]  # 0, FACTOR or CLAMPED_FACTOR: factorisation needed before the next direction
    factored: wp.array[int]  # 1: a factor exists, of this solve or an earlier one
    check_rounding: wp.array[int]  # 1: measure next whether the residual is rounding error
    iterations: wp.array[int]  # directions of this solve; before its start, those of the last solve
    since_factor: wp.array[int]  # directions since the start of the solve or its last factorisation
    factorisations: wp.array[int]  # factorisations in this solve
    halvings: wp.array[int]
    stalls: wp.array[int]  # evaluations since the residual was last halved
    step: wp.array[wp.float64]  # step length, as a fraction of the direction
    slope: wp.array[wp.float64]  # slope of the energy along the direction [J]
    energy: wp.array[wp.float64]  # energy at the iterate [J]
    scale: wp.array[wp.float64]  # norm of the balancing forces at the iterate [N]
    relative: wp.array[wp.float64]  # residual over scale
    smallest_norm: wp.array[wp.float64]  # smallest norm of a residual so far [N]
    rounding: wp.array[wp.float64]  # measured rounding error of the residual, infinite before a measurement [N]
    force: wp.array[wp.float64]  # norm of the loads [N]
    stiffness: wp.array[wp.float64]  # sum over all points [J]


@wp.struct
class Evaluation:
    """The potential at the current positions, (B) each except for the residual."""

    energy: wp.array[wp.float64]  # [J]
    size: wp.array[wp.float64]  # sum of the energies' absolute values [J]
    balance: wp.array[wp.float64]  # norm of inertia less all loads [N]
    norm: wp.array[wp.float64]  # norm of the residual [N]
    residual: wp.array2d[wp.vec3d]  # (B, N) [N]


@wp.struct
class Tolerances:
    """Convergence tolerances and limits of a solve."""

    relative: wp.float64
    absolute: wp.float64  # [N]
    epsilon: wp.float64  # machine epsilon of the states' dtype
    max_iterations: int
    refactor_after: int  # iterations of a solve above which the next one starts with a new factor


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
    """Sets the extrapolated starting point, and sums the quantities that stay constant during this solve."""
    b, lane = wp.tid()
    square = wp.float64(0.0)
    count = history.stored[b]
    if progress.phase[b] != DONE:  # The last solve failed.
        count = 0
    order = wp.min(history.order[b], count)
    for i in range(lane, force.shape[1], wp.block_dim()):
        square += wp.dot(force[b, i], force[b, i])
        start = positions[b, i]
        history.start[b, i] = start
        start = start + extrapolated(history, b, i, order)
        positions[b, i] = start
        origin_out[b, i] = start
    square = block_sum(square)
    if lane == 0:
        history.stored[b] = count
        progress.phase[b] = START
        progress.request[b] = 0
        if progress.factored[b] == 0 or progress.iterations[b] > tolerances.refactor_after:
            progress.request[b] = FACTOR
        progress.check_rounding[b] = 0
        progress.iterations[b] = 0
        progress.since_factor[b] = 0
        progress.factorisations[b] = 0
        progress.stalls[b] = 0
        progress.energy[b] = INFINITE
        progress.smallest_norm[b] = INFINITE
        progress.rounding[b] = INFINITE
        progress.force[b] = wp.sqrt(square)
        progress.stiffness[b] = stiffness[b]


@wp.kernel
def select_for_factorisation(
    progress: SolverProgress, active_out: wp.array[int], clamp_out: wp.array[int], pairs: wp.array[int]
):
    """Selects the environments to factorise next, clamped or not, and deletes their L-BFGS pairs."""
    b = wp.tid()
    request = progress.request[b]
    selected = progress.phase[b] == NEED_DIRECTION and request > 0
    active_out[b] = int(selected)
    clamp_out[b] = int(selected and request == CLAMPED_FACTOR)
    if selected:
        progress.request[b] = 0
        progress.factored[b] = 1
        progress.since_factor[b] = 0
        progress.factorisations[b] += 1
        pairs[b] = 0


@wp.kernel
def mark_clamped(
    active: wp.array[int],  # (B) zero where the factor is kept
    clamp: wp.array[int],  # (B)
    clamped_out: wp.array[wp.bool],  # (B) whether the factor is of a clamped matrix
):
    """Marks the environments whose new factor is of a clamped matrix."""
    b = wp.tid()
    if active[b] != 0:
        clamped_out[b] = clamp[b] != 0


@wp.kernel
def request_clamped(active: wp.array[int], clamp: wp.array[int], count_out: wp.array[int]):
    """Requests clamping for all active environments, and counts them; launched as a single block."""
    _, lane = wp.tid()
    count = wp.float64(0.0)
    for b in range(lane, active.shape[0], wp.block_dim()):
        if active[b] != 0:
            clamp[b] = 1
            count += ONE
    count = block_sum(count)
    if lane == 0:
        count_out[0] = int(count)


@wp.kernel
def perturb(
    progress: SolverProgress,
    signs: wp.array2d[wp.vec3d],  # (draws, N) random signs
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    positions_out: wp.array2d[wp.vec3d],  # (B, N) copy of the unperturbed positions [m]
):
    """Moves every coordinate by one rounding unit of the largest coordinate, where rounding is to be checked.

    The largest coordinate counts because deformation gradients sum over coordinates of all sizes.
    """
    b, lane = wp.tid()
    if progress.check_rounding[b] == 0:
        return
    size = wp.float64(0.0)
    for i in range(lane, positions.shape[1], wp.block_dim()):
        positions_out[b, i] = positions[b, i]
        size = wp.max(size, wp.max(wp.abs(positions[b, i])))
    unit = ROUNDING_UNIT * block_max(size)
    draw = progress.iterations[b] % signs.shape[0]
    for i in range(lane, positions.shape[1], wp.block_dim()):
        positions[b, i] = positions[b, i] + unit * signs[draw, i]


@wp.kernel
def check_rounding(
    progress: SolverProgress,
    kept: wp.array2d[wp.vec3d],  # (B, N) positions before `perturb` [m]
    gradient: wp.array2d[wp.vec3d],  # (B, N) residual at these positions [N]
    residual: wp.array2d[wp.vec3d],  # (B, N) residual after `perturb` [N]
    positions: wp.array2d[wp.vec3d],  # (B, N) restored [m]
    history: History,
):
    """Marks an environment as converged if its residual is not larger than its change by the perturbation."""
    b, lane = wp.tid()
    if progress.check_rounding[b] == 0:
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
        record_solution(history, positions, b, lane)
    if lane == 0:
        progress.check_rounding[b] = 0
        progress.rounding[b] = change
        if size <= change:
            progress.phase[b] = DONE


@wp.kernel
def summarise(progress: SolverProgress, summary_out: wp.array[int], active_out: wp.array[int]):
    """Counts environments for the host, and sets (B) which need a further evaluation; launched as a single block."""
    _, lane = wp.tid()
    active, directions = wp.float64(0.0), wp.float64(0.0)
    factors, checks = wp.float64(0.0), wp.float64(0.0)
    for b in range(lane, progress.phase.shape[0], wp.block_dim()):
        checks += wp.float64(progress.check_rounding[b])
        # A rounding check needs one more evaluation, even after the last step.
        active_out[b] = int(progress.phase[b] < DONE or progress.check_rounding[b] != 0)
        if progress.phase[b] < DONE:
            active += ONE
        if progress.phase[b] == NEED_DIRECTION:
            directions += ONE
            if progress.request[b] > 0:
                factors += ONE
    active, directions, factors, checks = (
        block_sum(active),
        block_sum(directions),
        block_sum(factors),
        block_sum(checks),
    )
    if lane == 0:
        summary_out[0] = int(active)
        summary_out[1] = int(directions)
        summary_out[2] = int(factors)
        summary_out[3] = int(checks)


@wp.func
def may_be_rounding(progress: SolverProgress, b: int, norm: wp.float64, iterations: int, stalls: int) -> bool:
    """Whether to measure the rounding error of a stalled residual: once, and again every few stalls."""
    stuck = iterations >= STALLS_BEFORE_CHECK and stalls >= STALLS_BEFORE_CHECK
    return stuck and (norm <= progress.rounding[b] or stalls % STALLS_BETWEEN_CHECKS == 0)


@wp.func
def abandon_search(progress: SolverProgress, tolerances: Tolerances, clamped: wp.array[wp.bool], b: int):
    """Ends a failed line search: requests a new factor, then a clamped one, before the environment counts as failed."""
    progress.phase[b] = NEED_DIRECTION
    progress.stalls[b] += 1
    norm = progress.relative[b] * wp.max(progress.scale[b], tolerances.absolute)
    if may_be_rounding(progress, b, norm, progress.iterations[b], progress.stalls[b]):
        progress.check_rounding[b] = 1
    if progress.iterations[b] >= tolerances.max_iterations:
        progress.phase[b] = FAILED
    elif progress.factorisations[b] == 0:
        progress.request[b] = FACTOR
    elif clamped[b]:
        progress.phase[b] = FAILED
    else:
        progress.request[b] = CLAMPED_FACTOR


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
    """Whether a step and the balancing forces after it are within the rounding of the state."""
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
    """Returns kernels for pairs, right-hand sides and solutions of type ``wp.float64`` or ``wp.float32``."""
    module = named_module(f"minimisation.{scalar.__name__}")
    vector = wp.vec3d if scalar is wp.float64 else wp.vec3f

    @wp.struct
    class Pairs:
        """Last pairs of displacement s and change of residual y, and R = triu(S Y^T); ring buffers of size M."""

        count: wp.array[int]  # (B)
        last: wp.array[int]  # (B) index of the newest pair
        s: wp.array3d[vector]  # (B, M, N) [m]
        y: wp.array3d[vector]  # (B, M, N) [N]
        r: wp.array3d[wp.float64]  # (B, M, M) by place [J]
        a: wp.array2d[wp.float64]  # (B, M) coefficients of `project`, oldest pair first
        b: wp.array2d[wp.float64]  # (B, M) S g in `project`, coefficients of `set_direction`

    @wp.func(module=module)
    def place(pairs: Pairs, b: int, age: int) -> int:
        """Returns the index of a pair in the ring buffer; age 0 is the oldest."""
        m = pairs.s.shape[1]
        return (pairs.last[b] - pairs.count[b] + 1 + age + m) % m

    @wp.kernel(module=module)
    def project(
        progress: SolverProgress,
        pairs: Pairs,
        vertex_at: wp.array[int],  # (F) vertices in the order of the linear solver
        gradient: wp.array2d[wp.vec3d],  # (B, N) [N]
        right_out: wp.array2d[vector],  # (B, F) g - Y^T a, with a = R^-1 S g
    ):
        """Computes the right-hand side of the solve in compact L-BFGS form; zero where no direction is needed."""
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
        # Every thread solves the small system redundantly and writes the same values.
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
    def set_direction(
        progress: SolverProgress,
        pairs: Pairs,
        vertex_at: wp.array[int],
        gradient: wp.array2d[wp.vec3d],
        solution: wp.array2d[vector],  # (B, F) z, solution for the right-hand side of `project` [m]
        positions: wp.array2d[wp.vec3d],  # (B, N) becomes the first trial
        origin_out: wp.array2d[wp.vec3d],
        direction_out: wp.array2d[wp.vec3d],  # (B, N) -(z + S^T b), with b = R^-T (D a - Y z); zero at fixed vertices
    ):
        """Sets the direction, its slope and the first trial.

        If the slope is positive or not finite, the pairs are deleted; without pairs a new factor is requested, once.
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
                progress.since_factor[b] += 1
                progress.halvings[b] = 0
                progress.step[b] = ONE
                progress.slope[b] = slope
        elif lane == 0:
            if k > 0:
                pairs.count[b] = 0
            elif progress.factorisations[b] == 0:
                progress.request[b] = FACTOR
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
        """Stores a pair of positive curvature."""
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
        if not curvature > MIN_CURVATURE * wp.sqrt(lengths * changes):
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
        keeps_pairs: int,  # 1: L-BFGS pairs are stored
        tolerances: Tolerances,
        inertia: wp.array2d[wp.float64],  # (B, N) [N/m]
        evaluation: Evaluation,  # at the positions
        origin: wp.array2d[wp.vec3d],
        direction: wp.array2d[wp.vec3d],
        clamped: wp.array[wp.bool],  # (B) whether the matrix of the global step is clamped
        positions: wp.array2d[wp.vec3d],
        gradient: wp.array2d[wp.vec3d],  # (B, N) becomes the residual if the trial is accepted
        progress: SolverProgress,
        pairs: Pairs,
        history: History,
    ):
        """Accepts a trial that decreases the energy enough, or halves the step; tests convergence.

        Where the decrease is within rounding, the approximate Wolfe condition (Hager and Zhang 2005) decides.
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
            accepted = energy <= before + ARMIJO * step * slope
            if not accepted:
                accepted = energy <= before + flat and after <= (wp.float64(2.0) * ARMIJO - ONE) * slope
            if not accepted:
                step = HALF * step
                given_up = halvings + 1 >= MAX_HALVINGS
                if given_up:
                    step = wp.float64(0.0)
                for i in range(lane, n, lanes):
                    positions[b, i] = origin[b, i] + step * direction[b, i]
                at_rest = False
                if given_up and iterations == 1 and progress.force[b] == ZERO:
                    scale = progress.scale[b]
                    at_rest = within_rounding(tolerances, inertia, positions, direction, scale, b, lane)
                if lane == 0:
                    progress.step[b] = step
                    progress.halvings[b] = halvings + 1
                    if at_rest:
                        progress.phase[b] = DONE
                        history.stored[b] = 0
                    elif given_up:
                        abandon_search(progress, tolerances, clamped, b)
                return
            if keeps_pairs == 1:
                add_pair(pairs, b, lane, step, direction, gradient, evaluation.residual)
        for i in range(lane, n, lanes):
            gradient[b, i] = evaluation.residual[b, i]
        scale = evaluation.balance[b] + progress.force[b]
        smallest = progress.smallest_norm[b]
        stalls += 1
        if norm < HALF * smallest:
            stalls = 0
        done = norm <= tolerances.relative * scale or norm <= tolerances.absolute
        done = done and norm + scale < INFINITE
        if phase == LINE_SEARCH and iterations == 1 and progress.force[b] == ZERO:
            done = done or within_rounding(tolerances, inertia, positions, direction, scale, b, lane)
        # A barrier: every thread has read the values of this environment before they are written.
        check = block_max(ZERO)
        if may_be_rounding(progress, b, norm, iterations, stalls) and before - energy <= flat and not done:
            check = ONE
        if done:
            record_solution(history, positions, b, lane)
        if lane == 0:
            relative = norm / wp.max(scale, tolerances.absolute)
            progress.energy[b] = energy
            progress.scale[b] = scale
            progress.relative[b] = relative
            progress.smallest_norm[b] = wp.min(norm, smallest)
            progress.stalls[b] = stalls
            progress.check_rounding[b] = int(check)
            progress.phase[b] = NEED_DIRECTION
            if progress.since_factor[b] >= 3 * tolerances.refactor_after:
                progress.request[b] = FACTOR
            if done:
                progress.phase[b] = DONE
            elif not wp.isfinite(relative) or iterations >= tolerances.max_iterations:
                progress.phase[b] = FAILED

    return SimpleNamespace(project=project, set_direction=set_direction, accept=accept, Pairs=Pairs)
