"""Backtracking line search of a batch, the convergence test
of accepted trials, and rounding errors.

Below the rounding errors of residual and state a minimisation makes no progress.
"""

from typing import Any

import warp as wp

from .constants import HALF, ONE, ZERO
from .lbfgs import add_pair, lbfgs_kernels
from .minimisation import (
    DONE,
    INFINITE,
    LINE_SEARCH,
    START,
    Evaluation,
    History,
    LineSearch,
    SolverProgress,
    Tolerances,
    abandon_search,
    accept_trial,
    record_solution,
)
from .modules import generated, named_module
from .reductions import block_max, block_sum

wp.set_module_options({"enable_backward": False})

ARMIJO = wp.constant(wp.float64(1e-4))
MAX_HALVINGS = wp.constant(25)
# Rounding error of a sum of energies with cancellation, per unit of stiffness and of energy.
ENERGY_ROUNDING = wp.constant(wp.float64(8.0 * 2.0**-52))


ROUNDING_UNIT = wp.constant(wp.float64(2.0**-52))


@wp.kernel
def perturb(
    progress: SolverProgress,
    signs: wp.array2d[wp.vec3d],  # (draws, N) random signs
    positions_out: wp.array2d[wp.vec3d],  # (B, N) [m]
    kept_out: wp.array2d[wp.vec3d],  # (B, N) copy of the unperturbed positions [m]
):
    """Moves every coordinate by one rounding unit of the largest coordinate,
    where rounding is to be checked.

    The largest coordinate counts because deformation gradients sum over coordinates of all sizes.
    """
    b, lane = wp.tid()
    if progress.check_rounding[b] == 0:
        return
    size = wp.float64(0.0)
    for i in range(lane, positions_out.shape[1], wp.block_dim()):
        kept_out[b, i] = positions_out[b, i]
        size = wp.max(size, wp.max(wp.abs(positions_out[b, i])))
    unit = ROUNDING_UNIT * block_max(size)
    draw = progress.iterations[b] % signs.shape[0]
    for i in range(lane, positions_out.shape[1], wp.block_dim()):
        positions_out[b, i] = positions_out[b, i] + unit * signs[draw, i]


@wp.kernel
def check_rounding(
    kept: wp.array2d[wp.vec3d],  # (B, N) positions before `perturb` [m]
    residual: wp.array2d[wp.vec3d],  # (B, N) residual after `perturb` [N]
    progress_out: SolverProgress,
    search_out: LineSearch,  # its positions are restored
    history_out: History,
):
    """Marks an environment as converged if its residual is not larger
    than its change by the perturbation.
    """
    b, lane = wp.tid()
    if progress_out.check_rounding[b] == 0:
        return
    rounding = progress_out.rounding[b]
    change, size = wp.float64(0.0), wp.float64(0.0)
    for i in range(lane, search_out.positions.shape[1], wp.block_dim()):
        moved = residual[b, i] - search_out.gradient[b, i]
        change += wp.dot(moved, moved)
        size += wp.dot(search_out.gradient[b, i], search_out.gradient[b, i])
        search_out.positions[b, i] = kept[b, i]
    change, size = wp.sqrt(block_sum(change)), wp.sqrt(block_sum(size))
    if rounding < INFINITE:
        change = wp.max(change, rounding)
    if size <= change:
        record_solution(history_out, search_out.positions, b, lane)
    if lane == 0:
        progress_out.check_rounding[b] = 0
        progress_out.rounding[b] = change
        if size <= change:
            progress_out.phase[b] = DONE


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
    """Returns whether the first step without loads, and the forces after it,
    are within the rounding of the state.
    """
    if iterations != 1 or progress.force[b] != wp.float64(0.0):
        return False
    moved, size = wp.float64(0.0), wp.float64(0.0)
    square = wp.float64(0.0)
    for i in range(lane, inertia.shape[1], wp.block_dim()):
        for c in range(3):
            moved = wp.max(moved, wp.abs(search.direction[b, i][c]))
            size = wp.max(size, wp.abs(search.positions[b, i][c]))
        square += inertia[b, i] * inertia[b, i]
    moved, size = block_max(moved), block_max(size)
    square = block_sum(square)
    rounding = tolerances.epsilon * size
    return moved <= rounding and scale <= wp.float64(2.0) * rounding * wp.sqrt(square)


@wp.func
def decreases_enough(
    before: wp.float64,
    energy: wp.float64,
    rounding: wp.float64,
    step: wp.float64,
    slope: wp.float64,
    after: wp.float64,
) -> bool:
    """Returns whether Armijo's condition holds or, within rounding,
    the approximate Wolfe condition.

    Hager and Zhang (2005). ``slope`` and ``after`` are slopes of the energy along the direction,
    before and after.
    """
    if energy <= before + ARMIJO * step * slope:
        return True
    if not wp.isfinite(energy):
        return False
    return energy <= before + rounding and after <= (wp.float64(2.0) * ARMIJO - ONE) * slope


@wp.func
def backtrack(
    tolerances: Tolerances,
    inertia: wp.array2d[wp.float64],
    clamped: wp.array[wp.bool],
    progress: SolverProgress,
    search: LineSearch,
    history: History,
    step: wp.float64,
    halvings: int,
    b: int,
    lane: int,
):
    """Takes a trial of half the step.

    After the last one, goes back to the origin and abandons the search.
    """
    half = HALF * step
    ends = halvings + 1 >= MAX_HALVINGS
    if ends:
        half = wp.float64(0.0)
    for i in range(lane, inertia.shape[1], wp.block_dim()):
        search.positions[b, i] = search.origin[b, i] + half * search.direction[b, i]
    at_rest = False
    if ends:
        scale = progress.scale[b]
        at_rest = within_rounding(
            progress, tolerances, inertia, search, scale, progress.iterations[b], b, lane
        )
    if lane == 0:
        progress.step[b] = half
        progress.halvings[b] = halvings + 1
        if at_rest:
            progress.phase[b] = DONE
            history.stored[b] = 0
        elif ends:
            abandon_search(progress, tolerances, clamped, b)


@generated
def accept_kernel(scalar: Any) -> Any:
    """Returns the kernel that tests a trial, for pairs of type ``wp.float64`` or ``wp.float32``."""
    pairs_type = lbfgs_kernels(scalar).Pairs

    @wp.kernel(module=named_module(f"line_search.{scalar.__name__}"))
    def accept(
        keeps_pairs: int,  # 1: L-BFGS pairs are stored
        tolerances: Tolerances,
        inertia: wp.array2d[wp.float64],  # (B, N) [N/m]
        evaluation: Evaluation,  # at the positions
        clamped: wp.array[wp.bool],  # (B) whether the matrix of the global step is clamped
        progress_out: SolverProgress,
        search_out: LineSearch,
        pairs_out: pairs_type,
        history_out: History,
    ):
        """Accepts a trial that decreases the energy enough, or halves the step.

        Tests convergence.
        """
        b, lane = wp.tid()
        phase = progress_out.phase[b]
        if phase != START and phase != LINE_SEARCH:
            return
        energy = evaluation.energy[b]
        norm = evaluation.norm[b]
        before = progress_out.energy[b]
        flat = ENERGY_ROUNDING * (
            progress_out.stiffness[b] + wp.float64(100.0) * evaluation.size[b]
        )
        iterations = progress_out.iterations[b]
        stalls = progress_out.stalls[b]
        if phase == LINE_SEARCH:
            step = progress_out.step[b]
            slope = progress_out.slope[b]
            halvings = progress_out.halvings[b]
            after = wp.float64(0.0)
            for i in range(lane, inertia.shape[1], wp.block_dim()):
                after += wp.dot(evaluation.residual[b, i], search_out.direction[b, i])
            if not decreases_enough(before, energy, flat, step, slope, block_sum(after)):
                backtrack(
                    tolerances,
                    inertia,
                    clamped,
                    progress_out,
                    search_out,
                    history_out,
                    step,
                    halvings,
                    b,
                    lane,
                )
                return
            if keeps_pairs == 1:
                add_pair(pairs_out, b, lane, step, search_out, evaluation.residual)
        for i in range(lane, inertia.shape[1], wp.block_dim()):
            search_out.gradient[b, i] = evaluation.residual[b, i]
        scale = evaluation.balance[b] + progress_out.force[b]
        stalls += 1
        if norm < HALF * progress_out.smallest_norm[b]:
            stalls = 0
        done = norm <= tolerances.relative * scale or norm <= tolerances.absolute
        done = done and norm + scale < INFINITE
        done = done or within_rounding(
            progress_out, tolerances, inertia, search_out, scale, iterations, b, lane
        )
        # A barrier: every thread has read the values of this environment before they are written.
        block_max(ZERO)
        if done:
            record_solution(history_out, search_out.positions, b, lane)
        if lane == 0:
            accept_trial(progress_out, tolerances, evaluation, scale, stalls, flat, done, b)

    return accept
