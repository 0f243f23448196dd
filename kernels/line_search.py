"""Backtracking line search of a batch, and the convergence test of accepted trials."""

import functools
from typing import Any

import warp as wp

from .extrapolation import INFINITE, History, record_solution
from .lbfgs import lbfgs_kernels
from .minimisation import (
    DONE,
    LINE_SEARCH,
    START,
    Evaluation,
    LineSearch,
    SolverProgress,
    Tolerances,
    abandon_search,
    accept_trial,
)
from .modules import named_module
from .reductions import ZERO, block_max, block_sum
from .rounding import within_rounding

HALF, ONE = wp.float64(0.5), wp.float64(1.0)
ARMIJO = wp.constant(wp.float64(1e-4))
MAX_HALVINGS = wp.constant(25)
# Rounding error of a sum of energies with cancellation, per unit of stiffness and of energy.
ENERGY_ROUNDING = wp.constant(wp.float64(8.0 * 2.0**-52))


@wp.func
def decreases_enough(
    before: wp.float64, energy: wp.float64, rounding: wp.float64, step: wp.float64, slope: wp.float64, after: wp.float64
) -> bool:
    """Armijo's condition or, where the decrease is within rounding, the approximate Wolfe condition.

    Hager and Zhang (2005). ``slope`` and ``after`` are slopes of the energy along the direction, before and after.
    """
    if energy <= before + ARMIJO * step * slope:
        return True
    if not wp.isfinite(energy):
        return False
    return energy <= before + rounding and after <= (wp.float64(2.0) * ARMIJO - ONE) * slope


@functools.cache
def accept_kernel(scalar: Any) -> Any:
    """Returns the kernel that tests a trial, for pairs of type ``wp.float64`` or ``wp.float32``."""
    lbfgs = lbfgs_kernels(scalar)
    pairs_type, add_pair = lbfgs.Pairs, lbfgs.add_pair

    @wp.kernel(module=named_module(f"line_search.{scalar.__name__}"))
    def accept(
        keeps_pairs: int,  # 1: L-BFGS pairs are stored
        tolerances: Tolerances,
        inertia: wp.array2d[wp.float64],  # (B, N) [N/m]
        evaluation: Evaluation,  # at the positions
        clamped: wp.array[wp.bool],  # (B) whether the matrix of the global step is clamped
        search: LineSearch,
        progress: SolverProgress,
        pairs: pairs_type,
        history: History,
    ):
        """Accepts a trial that decreases the energy enough, or halves the step; tests convergence."""
        b, lane = wp.tid()
        phase = progress.phase[b]
        lanes = wp.block_dim()
        n = inertia.shape[1]
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
                after += wp.dot(evaluation.residual[b, i], search.direction[b, i])
            if not decreases_enough(before, energy, flat, step, slope, block_sum(after)):
                step = HALF * step
                given_up = halvings + 1 >= MAX_HALVINGS
                if given_up:
                    step = wp.float64(0.0)
                for i in range(lane, n, lanes):
                    search.positions[b, i] = search.origin[b, i] + step * search.direction[b, i]
                at_rest = False
                if given_up:
                    scale = progress.scale[b]
                    at_rest = within_rounding(progress, tolerances, inertia, search, scale, iterations, b, lane)
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
                add_pair(pairs, b, lane, step, search, evaluation.residual)
        for i in range(lane, n, lanes):
            search.gradient[b, i] = evaluation.residual[b, i]
        scale = evaluation.balance[b] + progress.force[b]
        stalls += 1
        if norm < HALF * progress.smallest_norm[b]:
            stalls = 0
        done = norm <= tolerances.relative * scale or norm <= tolerances.absolute
        done = done and norm + scale < INFINITE
        done = done or within_rounding(progress, tolerances, inertia, search, scale, iterations, b, lane)
        block_max(ZERO)  # A barrier: every thread has read the values of this environment before they are written.
        if done:
            record_solution(history, search.positions, b, lane)
        if lane == 0:
            accept_trial(progress, tolerances, evaluation, scale, stalls, flat, done, b)

    return accept
