"""State of a minimisation on its device, and the kernel launches that advance it
(``kernels.minimisation``).
"""

from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from ...kernels import line_search
from ...kernels import minimisation as kernels
from ...kernels.lbfgs import lbfgs_kernels
from ..energies.launcher import CapturedGraph, issue, struct_of, warp_view
from ..energies.potential import IncrementalPotential
from ..linalg.tiled import TiledSolver
from ..stepping.state import SolveReport
from .hessian import ExactHessian, HessianApproximation

_PERTURBATIONS = 7  # random sign patterns for rounding checks


class Summary(NamedTuple):
    """Numbers of environments in a batch."""

    active: int  # not converged or failed yet
    directions: int  # in need of a direction
    factors: int  # in need of a factorisation before that
    checks: int  # with a residual that may be rounding error


class _Iterates:
    """Structs of the kernels on the memory of tensors:
    the current iterate of every environment, and its past.

    Args:
        potential: potential to minimise.
        dtype: dtype of L-BFGS pairs.
        memory: number of pairs.

    Attributes:
        fields: fields of `progress` by name, (B,) each.
        corrections: (B,) number of stored corrections of earlier steps.
        pair_count: (B,) number of stored pairs.
    """

    def __init__(self, potential: IncrementalPotential, dtype: torch.dtype, memory: int) -> None:
        p, n = potential, potential.n_vertices
        kinds = {
            name: wp.dtype_to_torch(v.type.dtype) for name, v in kernels.SolverProgress.vars.items()
        }
        self.fields = {
            name: torch.zeros(p.batch, device=p.device, dtype=kind) for name, kind in kinds.items()
        }
        self.progress = struct_of(kernels.SolverProgress, **self.fields)
        fields = {name: p.zeros(n, 3) for name in ("origin", "direction", "gradient")}
        self.search = struct_of(kernels.LineSearch, positions=p.positions, **fields)
        sums = {
            "energy": p.energy,
            "size": p.energy_size,
            "balance": p.balance,
            "norm": p.residual_norm,
        }
        self.evaluation = struct_of(kernels.Evaluation, **sums, residual=p.residual)

        counts = torch.zeros(5, p.batch, device=p.device, dtype=torch.int32).unbind()
        self.corrections, newest, order, self.pair_count, last = counts
        start, correction = p.zeros(n, 3), p.zeros(3, n, 3)
        past = {"stored": self.corrections, "newest": newest, "order": order}
        self.history = struct_of(kernels.History, **past, start=start, correction=correction)
        s, y = (torch.zeros(p.batch, memory, n, 3, device=p.device, dtype=dtype) for _ in range(2))
        places = {"count": self.pair_count, "last": last, "r": p.zeros(memory, memory)}
        pairs = lbfgs_kernels(_scalar(dtype)).Pairs
        self.pairs = struct_of(pairs, **places, s=s, y=y, a=p.zeros(memory), b=p.zeros(memory))


def _scalar(dtype: torch.dtype) -> Any:
    return wp.float64 if dtype == torch.float64 else wp.float32


class Minimiser:
    """Minimises the potential of a batch repeatedly, with factor and buffers kept between solves.

    Args:
        potential: potential to minimise, which holds the positions.
        hessian: matrix of the global step.
        dtype: dtype of L-BFGS pairs and right-hand sides.
        memory: number of L-BFGS pairs; 0 for Newton's method.
        tolerances: a ``kernels.minimisation.Tolerances``. After `refactor_after` directions the
            next solve starts with a new factor, and three times as many force a new factor within a
            solve; 0: always.
    """

    def __init__(
        self,
        potential: IncrementalPotential,
        hessian: HessianApproximation,
        dtype: torch.dtype,
        memory: int,
        tolerances: Any,
    ) -> None:
        p = self._potential = potential
        self.hessian, self._tolerances = hessian, tolerances
        self._refactors = tolerances.refactor_after != kernels.NEVER
        self._right = torch.zeros(p.batch, len(hessian.vertex_at), 3, device=p.device, dtype=dtype)
        summary = torch.zeros(len(Summary._fields), device=p.device, dtype=torch.int32)
        # A copy on the host; on a CPU the same memory.
        self._summary, self._seen = (
            summary,
            summary if p.device.type == "cpu" else summary.cpu().pin_memory(),
        )
        self._shown = self._seen.numpy()
        self._now = _Iterates(p, dtype, max(memory, 1))
        self._masks = [warp_view(mask, wp.int32) for mask in (p.tangent_active, p.clamp)]
        self._record_directions()
        self._record_evaluation(int(memory > 0))
        self._loop = self._record_loop() if self._runs_on_device else None

    def _record_directions(self) -> None:
        """Records the start of a solve, the choice of environments
        to factorise, and new directions.
        """
        p, now = self._potential, self._now
        b = p.batch
        lbfgs = lbfgs_kernels(_scalar(self._right.dtype))
        right = warp_view(self._right, wp.vec3d if self._right.dtype == torch.float64 else wp.vec3f)
        vertex_at = p.upload(self.hessian.vertex_at.astype(np.int32), int)
        inputs = [
            self._tolerances,
            warp_view(p.terms.force, wp.vec3d),
            warp_view(p.stiffness, wp.float64),
        ]
        begin = p.record_blocks(kernels.begin, b, inputs, [now.progress, now.search, now.history])
        outputs = [now.progress, now.pairs.count, *self._masks]
        self._select = p.record(kernels.select_for_factorisation, (b,), [], outputs)
        self._project = p.record_blocks(
            lbfgs.project, b, [vertex_at, now.progress, now.search], [now.pairs, right]
        )
        outputs = [now.progress, now.search, now.pairs]
        set_direction = p.record_blocks(lbfgs.set_direction, b, [vertex_at, right], outputs)
        shorten_start, shorten_step = self._record_bounds()
        self._starts, self._trials = [begin, *shorten_start], [set_direction, *shorten_step]

    def _record_bounds(self) -> tuple[list[Any], list[Any]]:
        """Returns launches that shorten a start and a first trial to where the energy is finite."""
        p, now = self._potential, self._now
        if p.feasible is None:
            return [], []
        share = warp_view(p.zeros(), wp.float64)
        allow = p.record(kernels.allow_all, (p.batch,), [], [share])
        feasible, free = warp_view(p.feasible, wp.vec3d), warp_view(p.free_mask, wp.float64)
        start = p.record(
            kernels.shorten_start, (p.batch, p.n_vertices), [share, free, feasible], [now.search]
        )
        step = p.record_blocks(kernels.shorten_step, p.batch, [share], [now.progress, now.search])
        return (
            [allow, *p.bounds(feasible, now.search.positions, share), start],
            [allow, *p.bounds(now.search.origin, now.search.positions, share), step],
        )

    def _record_evaluation(self, stores_pairs: int) -> None:
        """Records the evaluation and the test of a trial,
        and the check whether a residual is rounding error.
        """
        p, now = self._potential, self._now
        b, n = p.batch, p.n_vertices
        inputs = [stores_pairs, self._tolerances, warp_view(p.inertia, wp.float64), now.evaluation]
        inputs.append(warp_view(self.hessian.clamped, wp.bool))
        outputs = [now.progress, now.search, now.pairs, now.history]
        accept = p.record_blocks(
            line_search.accept_kernel(_scalar(self._right.dtype)), b, inputs, outputs
        )
        seen = [warp_view(self._summary, wp.int32), warp_view(p.active, wp.int32)]
        summarise = p.record_blocks(kernels.summarise, 1, [now.progress], seen)
        self._evaluation = [*p.evaluation, accept, summarise]
        self._begin = p.capture(*self._starts, *self._evaluation)
        self._first_trial = p.capture(*self._trials, *self._evaluation)
        self._next_trial = p.capture(*self._evaluation)
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_PERTURBATIONS, n, 3))
        kept = warp_view(p.zeros(n, 3), wp.vec3d)
        inputs = [now.progress, p.upload(signs, wp.vec3d)]
        perturb = p.record_blocks(line_search.perturb, b, inputs, [now.search.positions, kept])
        outputs = [now.progress, now.search, now.history]
        check = p.record_blocks(
            line_search.check_rounding, b, [kept, now.evaluation.residual], outputs
        )
        self._check_rounding = p.capture(perturb, *p.evaluation, check, summarise)

    @property
    def _runs_on_device(self) -> bool:
        """Whether a solve can be one graph of launches,
        with a loop and the factorisations (CUDA 12.4 and later).
        """
        h, p = self.hessian, self._potential
        loops = p.device.type == "cpu" or bool(wp.is_conditional_graph_supported())
        return (
            isinstance(h, ExactHessian)
            and isinstance(h.linear, TiledSolver)
            and not p.couples_cells
            and loops
        )

    def _record_loop(self) -> CapturedGraph:
        """Returns a whole solve as one graph."""
        p, h = self._potential, self.hessian
        assert isinstance(h, ExactHessian)
        assert isinstance(h.linear, TiledSolver)
        # The factorisation works on the environments in `tangent_active`, and leaves only those set
        # whose factor is not finite, to be factorised again with clamping; with that it is not
        # finite where it fails.
        again = warp_view(torch.zeros(1, dtype=torch.int32, device=p.device), wp.int32)
        mark = p.record(
            kernels.mark_clamped, (p.batch,), self._masks, [warp_view(h.clamped, wp.bool)]
        )
        solver = h.linear.record_factor(h.assembly.values, p.tangent_active, h.clamped)
        factors = [
            mark,
            p.tangent_launches,
            solver.clear,
            h.assembly.launches,
            solver.factor,
            solver.check,
        ]
        repeat = p.record_blocks(
            kernels.request_clamped, 1, self._masks[:1], [self._masks[1], again]
        )
        solve_factor = h.linear.record_solve(h.assembly.values, self._right.flatten(1))
        conditions = (
            warp_view(self._summary[k : k + 1], wp.int32) for k in range(len(Summary._fields))
        )
        active, directions, requests, checks = conditions

        def factorise() -> None:
            issue(self._select, *factors, repeat)
            wp.capture_if(again, lambda: issue(*factors))

        def set_direction() -> None:
            issue(self._project, solve_factor, *self._trials)

        def advance() -> None:
            wp.capture_if(requests, factorise)
            wp.capture_if(directions, set_direction)
            issue(*self._evaluation)
            wp.capture_if(checks, lambda: issue(self._check_rounding))

        def solve() -> None:
            issue(self._begin)
            wp.capture_while(active, advance)

        commands = [self._begin, self._select, self._project, *self._trials]
        return p.capture_calls(
            solve, [*commands, self._check_rounding, *factors, repeat, solve_factor]
        )

    def solve(self, start: torch.Tensor, follows: torch.Tensor | None = None) -> SolveReport:
        """Minimises the potential, whose ``positions`` are then the solution.

        With tiled factors without host on a GPU.

        Args:
            start: (B, N, 3) where inertia alone would lead, or any initial guess [m].
            follows: (B,) environments in which this step follows the last solved one: their
                starting point is extrapolated, and factor and pairs are kept. None: no environment.
                Results of the others do not depend on earlier solves. The constant factor of
                projective dynamics is always kept, its pairs are not.
        """
        p, now = self._potential, self._now
        kept = [
            now.corrections,
            now.pair_count,
            *([now.fields["factored"]] if self._refactors else []),
        ]
        for counts in kept:
            if follows is None:
                counts.zero_()
            else:
                counts.mul_(follows)
        if not self._refactors:
            # The last pairs of a long solve are of little use for the next one.
            now.pair_count.zero_()
        try:
            if self._loop is None:
                self._solve_from_host(start)
            else:
                p.positions.copy_(start)
                p.launch(self._loop)
        finally:
            p.active.fill_(1)
        fields = now.fields
        iterations, factorisations = fields["iterations"].long(), fields["factorisations"].long()
        return SolveReport(
            iterations, fields["relative"].clone(), fields["phase"] == kernels.DONE, factorisations
        )

    def _solve_from_host(self, start: torch.Tensor) -> None:
        if not self.hessian.ready():
            self._now.fields["factored"].zero_()
        state = self.begin(start)
        if state.directions > state.factors:
            self.hessian.adapt()
        while state.active:
            if state.factors:
                self.refactor(state)
            if state.directions:
                self._potential.on_direction()
            state = self.advance(state)

    def begin(self, start: torch.Tensor) -> Summary:
        """Evaluates the potential at a start (B, N, 3) [m]."""
        p = self._potential
        p.positions.copy_(start)
        p.launch(self._begin)
        return self._check_and_read()

    def advance(self, state: Summary) -> Summary:
        """Evaluates the next trial of every active environment,
        along a new direction where one is needed.
        """
        p = self._potential
        if state.directions:
            p.launch(self._project)
            self.hessian.solve_in_place(
                self._right, self._now.fields["phase"] == kernels.NEED_DIRECTION
            )
            p.launch(self._first_trial)
        else:
            p.launch(self._next_trial)
        return self._check_and_read()

    def refactor(self, state: Summary) -> None:
        """Factorises at the iterates of the environments that need it."""
        p = self._potential
        p.launch(self._select)
        all_environments = state.factors == p.batch
        self.hessian.refactor(p.clamp.bool(), None if all_environments else p.tangent_active.bool())

    def _check_and_read(self) -> Summary:
        state = self._read()
        if state.checks:
            self._potential.launch(self._check_rounding)
            state = self._read()
        return state

    def _read(self) -> Summary:
        if self._seen is not self._summary:
            self._seen.copy_(self._summary)
        return Summary._make(self._shown.tolist())
