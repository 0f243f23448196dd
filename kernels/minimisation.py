"""State machine of the minimisations of a batch, on the device.

One block of threads works on one environment. Every environment has its own phase, so that none
waits for the line search of another:

==============  ==============================================================================
START           the starting point is evaluated next
NEED_DIRECTION  next: `lbfgs.project`, a solve with the matrix of the global step,
                `lbfgs.set_direction`
LINE_SEARCH     the positions are a trial, which is evaluated next and tested by
                `line_search.accept`
DONE            the environment has converged
FAILED          the environment has not converged and gets no further step
==============  ==============================================================================

A solve begins at an extrapolation. The correction of a step is its solution less the position where
inertia alone would lead; it is extrapolated by one step with the polynomial through the last
corrections: none, a constant, a line or a parabola.
"""

import warp as wp

from .constants import ONE
from .reductions import block_sum

wp.set_module_options({"enable_backward": False})

START, NEED_DIRECTION, LINE_SEARCH, DONE, FAILED = (wp.constant(k) for k in range(5))
FACTOR, CLAMPED_FACTOR = wp.constant(1), wp.constant(2)  # requests
NEVER = wp.constant(2**28)  # a number of iterations that no solve reaches
STALLS_BEFORE_CHECK = wp.constant(3)
STALLS_BETWEEN_CHECKS = wp.constant(16)  # a single perturbation may happen to change little

INFINITE = wp.constant(wp.float64(float("inf")))
# A higher order, which amplifies fast modes, is used only if it reduces the squared error to this
# fraction.
IMPROVEMENT = wp.constant(wp.float64(0.1))


@wp.struct
class SolverProgress:
    """State of the solver, (B) each."""

    phase: wp.array[int]
    request: wp.array[int]  # 0, FACTOR or CLAMPED_FACTOR: needed before the next direction
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
    rounding: wp.array[wp.float64]  # measured error of the residual, infinite before that [N]
    force: wp.array[wp.float64]  # norm of the loads [N]
    stiffness: wp.array[wp.float64]  # sum over all points [J]


@wp.struct
class LineSearch:
    """Iterate and line search of every environment; all fields are (B, N)."""

    positions: wp.array2d[wp.vec3d]  # of the next evaluation: the iterate or a trial [m]
    origin: wp.array2d[wp.vec3d]  # start of the line search [m]
    direction: wp.array2d[wp.vec3d]  # zero at fixed vertices [m]
    gradient: wp.array2d[wp.vec3d]  # residual at the origin, or at an accepted trial [N]


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
    """Stores the correction of a solution, and selects the order
    whose extrapolation was closest to it.
    """
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


@wp.kernel
def begin(
    tolerances: Tolerances,
    force: wp.array2d[wp.vec3d],  # (B, N) [N]
    stiffness: wp.array[wp.float64],  # (B) sum over the solids' points [J]
    progress_out: SolverProgress,
    search_out: LineSearch,  # positions are where inertia alone leads, and become the start
    history_out: History,
):
    """Sets the extrapolated starting point, and sums the quantities
    that stay constant during this solve.
    """
    b, lane = wp.tid()
    square = wp.float64(0.0)
    count = history_out.stored[b]
    if progress_out.phase[b] != DONE:  # The last solve failed.
        count = 0
    order = wp.min(history_out.order[b], count)
    for i in range(lane, force.shape[1], wp.block_dim()):
        square += wp.dot(force[b, i], force[b, i])
        start = search_out.positions[b, i]
        history_out.start[b, i] = start
        start = start + extrapolated(history_out, b, i, order)
        search_out.positions[b, i] = start
        search_out.origin[b, i] = start
    square = block_sum(square)
    if lane == 0:
        history_out.stored[b] = count
        progress_out.phase[b] = START
        progress_out.request[b] = 0
        if progress_out.factored[b] == 0 or progress_out.iterations[b] > tolerances.refactor_after:
            progress_out.request[b] = FACTOR
        progress_out.check_rounding[b] = 0
        progress_out.iterations[b] = 0
        progress_out.since_factor[b] = 0
        progress_out.factorisations[b] = 0
        progress_out.stalls[b] = 0
        progress_out.energy[b] = INFINITE
        progress_out.smallest_norm[b] = INFINITE
        progress_out.rounding[b] = INFINITE
        progress_out.force[b] = wp.sqrt(square)
        progress_out.stiffness[b] = stiffness[b]


@wp.kernel
def select_for_factorisation(
    progress_out: SolverProgress,
    pairs_out: wp.array[int],
    active_out: wp.array[int],
    clamp_out: wp.array[int],
):
    """Selects the environments to factorise next, clamped or not,
    and deletes their L-BFGS pairs.
    """
    b = wp.tid()
    request = progress_out.request[b]
    selected = progress_out.phase[b] == NEED_DIRECTION and request > 0
    active_out[b] = int(selected)
    clamp_out[b] = int(selected and request == CLAMPED_FACTOR)
    if selected:
        progress_out.request[b] = 0
        progress_out.factored[b] = 1
        progress_out.since_factor[b] = 0
        progress_out.factorisations[b] += 1
        pairs_out[b] = 0


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
def request_clamped(active: wp.array[int], clamp_out: wp.array[int], count_out: wp.array[int]):
    """Requests clamping for all active environments, and counts them.

    Launched as a single block.
    """
    _, lane = wp.tid()
    count = wp.float64(0.0)
    for b in range(lane, active.shape[0], wp.block_dim()):
        if active[b] != 0:
            clamp_out[b] = 1
            count += ONE
    count = block_sum(count)
    if lane == 0:
        count_out[0] = int(count)


@wp.kernel
def summarise(progress: SolverProgress, summary_out: wp.array[int], active_out: wp.array[int]):
    """Counts environments for the host, and sets (B) which need a further evaluation.

    Launched as a single block.
    """
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
    active = block_sum(active)
    directions = block_sum(directions)
    factors = block_sum(factors)
    checks = block_sum(checks)
    if lane == 0:
        summary_out[0] = int(active)
        summary_out[1] = int(directions)
        summary_out[2] = int(factors)
        summary_out[3] = int(checks)


@wp.func
def begin_search(progress: SolverProgress, slope: wp.float64, b: int):
    """Begins a line search with the whole direction."""
    progress.phase[b] = LINE_SEARCH
    progress.iterations[b] += 1
    progress.since_factor[b] += 1
    progress.halvings[b] = 0
    progress.step[b] = ONE
    progress.slope[b] = slope


@wp.func
def may_be_rounding(progress: SolverProgress, b: int, norm: wp.float64, stalls: int) -> bool:
    """Returns whether to measure the rounding error of a stalled residual:
    once, and again every few stalls.
    """
    stuck = progress.iterations[b] >= STALLS_BEFORE_CHECK and stalls >= STALLS_BEFORE_CHECK
    return stuck and (norm <= progress.rounding[b] or stalls % STALLS_BETWEEN_CHECKS == 0)


@wp.func
def abandon_search(
    progress: SolverProgress, tolerances: Tolerances, clamped: wp.array[wp.bool], b: int
):
    """Ends a failed line search: requests a new factor, then a clamped one,
    before the environment counts as failed.
    """
    progress.phase[b] = NEED_DIRECTION
    progress.stalls[b] += 1
    norm = progress.relative[b] * wp.max(progress.scale[b], tolerances.absolute)
    if may_be_rounding(progress, b, norm, progress.stalls[b]):
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
def accept_trial(
    progress: SolverProgress,
    tolerances: Tolerances,
    evaluation: Evaluation,
    scale: wp.float64,
    stalls: int,
    flat: wp.float64,  # decrease of the energy within rounding [J]
    converged: bool,
    b: int,
):
    """Makes an accepted trial the iterate: stores its evaluation and the next phase."""
    norm = evaluation.norm[b]
    relative = norm / wp.max(scale, tolerances.absolute)
    is_flat = progress.energy[b] - evaluation.energy[b] <= flat
    progress.check_rounding[b] = int(
        may_be_rounding(progress, b, norm, stalls) and is_flat and not converged
    )
    progress.stalls[b] = stalls
    progress.energy[b] = evaluation.energy[b]
    progress.scale[b] = scale
    progress.relative[b] = relative
    progress.smallest_norm[b] = wp.min(norm, progress.smallest_norm[b])
    progress.phase[b] = NEED_DIRECTION
    if progress.since_factor[b] >= 3 * tolerances.refactor_after:
        progress.request[b] = FACTOR
    if converged:
        progress.phase[b] = DONE
    elif not wp.isfinite(relative) or progress.iterations[b] >= tolerances.max_iterations:
        progress.phase[b] = FAILED


@wp.kernel
def allow_all(share_out: wp.array[wp.float64]):
    """Allows the whole step."""
    share_out[wp.tid()] = ONE


@wp.kernel
def shorten_start(
    share: wp.array[wp.float64],  # (B) allowed share of the way from the feasible positions
    free: wp.array[wp.float64],  # (N) zero at fixed vertices, which keep their positions
    feasible: wp.array2d[wp.vec3d],  # (B, N) positions without penetration [m]
    search_out: LineSearch,
):
    """Draws a start back towards feasible positions."""
    b, i = wp.tid()
    if share[b] < ONE and free[i] > wp.float64(0.0):
        x = feasible[b, i] + share[b] * (search_out.positions[b, i] - feasible[b, i])
        search_out.positions[b, i] = x
        search_out.origin[b, i] = x


@wp.kernel
def shorten_step(share: wp.array[wp.float64], progress_out: SolverProgress, search_out: LineSearch):
    """Shortens the first trial of a line search."""
    b, lane = wp.tid()
    if progress_out.phase[b] != LINE_SEARCH or progress_out.halvings[b] > 0:
        return
    s = share[b]
    if s < ONE:
        for i in range(lane, search_out.positions.shape[1], wp.block_dim()):
            search_out.positions[b, i] = search_out.origin[b, i] + s * search_out.direction[b, i]
        if lane == 0:
            progress_out.step[b] = s
