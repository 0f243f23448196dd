"""State of a minimisation on its device, and the kernel launches that advance it (``kernels.minimisation``)."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from ..energies.launcher import CapturedGraph, issue, struct_of, warp_view
from ..energies.potential import IncrementalPotential
from ..kernels import line_search
from ..kernels import minimisation as kernels
from ..kernels.lbfgs import lbfgs_kernels
from ..linalg.tiled import TiledSolver
from .hessian import ExactHessian, HessianApproximation

_PERTURBATIONS = 7  # random sign patterns for rounding checks


class Summary(NamedTuple):
    """Numbers of environments in a batch."""

    active: int  # not converged or failed yet
    directions: int  # in need of a direction
    factors: int  # in need of a factorisation before that
    checks: int  # with a residual that may be rounding error


class Minimiser:
    """Buffers and launches of one batch.

    Args:
        potential: potential to minimise, which holds the positions.
        hessian: matrix of the global step.
        dtype: dtype of L-BFGS pairs and right-hand sides.
        memory: number of L-BFGS pairs; 0 for Newton's method.
        tolerances: a ``kernels.minimisation.Tolerances``. After `refactor_after` directions the next solve starts with
            a new factor, and three times as many force a new factor within a solve; 0: always.
    """

    def __init__(
        self,
        potential: IncrementalPotential,
        hessian: HessianApproximation,
        dtype: torch.dtype,
        memory: int,
        tolerances: Any,
    ) -> None:
        p, b, n = potential, potential.batch, potential.n_vertices
        self._potential, self._hessian = p, hessian
        self._right = torch.zeros(b, len(hessian.vertex_at), 3, device=p.device, dtype=dtype)
        summary = torch.zeros(len(Summary._fields), device=p.device, dtype=torch.int32)
        # A copy on the host; on a CPU the same memory.
        self._summary, self._seen = summary, summary if p.device.type == "cpu" else summary.cpu().pin_memory()
        self._shown = self._seen.numpy()

        scalar, vector = (wp.float64, wp.vec3d) if dtype == torch.float64 else (wp.float32, wp.vec3f)
        own, size = lbfgs_kernels(scalar), max(memory, 1)
        self._progress = {
            name: torch.zeros(b, device=p.device, dtype=wp.dtype_to_torch(variable.type.dtype))
            for name, variable in kernels.SolverProgress.vars.items()
        }
        progress = struct_of(kernels.SolverProgress, **self._progress)
        self._refactors = tolerances.refactor_after != kernels.NEVER
        *self._history_counts, self._pair_counts, last = (
            torch.zeros(b, device=p.device, dtype=torch.int32) for _ in range(5)
        )
        s, y = (torch.zeros(b, size, n, 3, device=p.device, dtype=dtype) for _ in range(2))
        places = {"count": self._pair_counts, "last": last, "r": p.zeros(size, size)}
        pairs = struct_of(own.Pairs, **places, s=s, y=y, a=p.zeros(size), b=p.zeros(size))
        sums = {"energy": p.energy, "size": p.energy_size, "balance": p.balance, "norm": p.residual_norm}
        evaluation = struct_of(kernels.Evaluation, **sums, residual=p.residual)
        counts = dict(zip(("stored", "newest", "order"), self._history_counts, strict=True))
        history = struct_of(kernels.History, **counts, start=p.zeros(n, 3), correction=p.zeros(3, n, 3))
        fields = {name: p.zeros(n, 3) for name in ("origin", "direction", "gradient")}
        search = struct_of(kernels.LineSearch, positions=p.positions, **fields)
        right, vertex_at = warp_view(self._right, vector), p.upload(hessian.vertex_at.astype(np.int32), int)
        loads = [warp_view(p.terms.force, wp.vec3d), warp_view(p.stiffness, wp.float64)]
        begin = p.record_blocks(kernels.begin, b, [tolerances, *loads], [progress, search, history])
        masks = [warp_view(mask, wp.int32) for mask in (p.tangent_active, p.clamp)]
        self._select = p.record(kernels.select_for_factorisation, (b,), [], [progress, pairs.count, *masks])
        self._project = p.record_blocks(own.project, b, [vertex_at, progress, search], [pairs, right])
        set_direction = p.record_blocks(own.set_direction, b, [vertex_at, right], [progress, search, pairs])
        inputs = [int(memory > 0), tolerances, warp_view(p.inertia, wp.float64), evaluation]
        inputs += [warp_view(hessian.clamped, wp.bool)]
        accept = p.record_blocks(line_search.accept_kernel(scalar), b, inputs, [progress, search, pairs, history])
        seen = [warp_view(summary, wp.int32), warp_view(p.active, wp.int32)]
        summarise = p.record_blocks(kernels.summarise, 1, [progress], seen)
        evaluate = [*p.evaluation, accept, summarise]
        shorten_start, shorten_step = self._record_bounds(progress, search)
        start, first_trial = [begin, *shorten_start], [set_direction, *shorten_step]
        self._begin, self._evaluate = p.capture(*start, *evaluate), p.capture(*evaluate)
        self._first_trial = p.capture(*first_trial, *evaluate)
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_PERTURBATIONS, n, 3))
        kept, drawn = warp_view(p.zeros(n, 3), wp.vec3d), p.upload(signs, wp.vec3d)
        perturb = p.record_blocks(line_search.perturb, b, [progress, drawn], [search.positions, kept])
        compared = [kept, evaluation.residual]
        check = p.record_blocks(line_search.check_rounding, b, compared, [progress, search, history])
        self._check_rounding = p.capture(perturb, *p.evaluation, check, summarise)
        self._parts = SimpleNamespace(begin=start, set_direction=first_trial, evaluate=evaluate)
        self._loop: CapturedGraph | None = None
        if self._runs_on_device:
            self._record_loop()

    def _record_bounds(self, progress: Any, search: Any) -> tuple[list[Any], list[Any]]:
        """Returns launches that shorten a start and a first trial to where the energy is finite."""
        p, feasible = self._potential, self._potential.feasible
        if feasible is None:
            return [], []
        share = warp_view(p.zeros(), wp.float64)
        allow = p.record(kernels.allow_all, (p.batch,), [], [share])
        given, free = warp_view(feasible, wp.vec3d), warp_view(p.free_mask, wp.float64)
        start = p.record(kernels.shorten_start, (p.batch, p.n_vertices), [share, free, given], [search])
        step = p.record_blocks(kernels.shorten_step, p.batch, [share], [progress, search])
        return (
            [allow, *p.bounds(given, search.positions, share), start],
            [allow, *p.bounds(search.origin, search.positions, share), step],
        )

    @property
    def _runs_on_device(self) -> bool:
        """Whether a solve can be one graph of launches, with a loop and the factorisations (CUDA 12.4 and later)."""
        h, p = self._hessian, self._potential
        loops = p.device.type == "cpu" or bool(wp.is_conditional_graph_supported())
        return isinstance(h, ExactHessian) and isinstance(h.linear, TiledSolver) and not p.couples_cells and loops

    def _record_loop(self) -> None:
        p, h, parts = self._potential, self._hessian, self._parts
        assert isinstance(h, ExactHessian)
        assert isinstance(h.linear, TiledSolver)
        # The factorisation works on the environments in `tangent_active`, and leaves only those set whose factor is not
        # finite, to be factorised again with clamping; with that it is not finite where it fails.
        again = warp_view(torch.zeros(1, dtype=torch.int32, device=p.device), wp.int32)
        masks = [warp_view(mask, wp.int32) for mask in (p.tangent_active, p.clamp)]
        mark = p.record(kernels.mark_clamped, (p.batch,), masks, [warp_view(h.clamped, wp.bool)])
        solver = h.linear.record_factor(h.assembly.values, p.tangent_active, h.clamped)
        factors = [mark, p.tangent_launches, solver.clear, h.assembly.launches, solver.factor, solver.check]
        repeat = p.record_blocks(kernels.request_clamped, 1, masks[:1], [masks[1], again])
        solve_factor = h.linear.record_solve(h.assembly.values, self._right.flatten(1))
        conditions = (warp_view(self._summary[k : k + 1], wp.int32) for k in range(len(Summary._fields)))
        active, directions, requests, checks = conditions

        def factorise() -> None:
            issue(self._select, *factors, repeat)
            wp.capture_if(again, lambda: issue(*factors))

        def set_direction() -> None:
            issue(self._project, solve_factor, *parts.set_direction)

        def advance() -> None:
            wp.capture_if(requests, factorise)
            wp.capture_if(directions, set_direction)
            issue(*parts.evaluate)
            wp.capture_if(checks, lambda: issue(self._check_rounding))

        def solve() -> None:
            issue(*parts.begin, *parts.evaluate)
            wp.capture_while(active, advance)

        commands = [*parts.begin, *parts.evaluate, self._select, self._project, *parts.set_direction]
        self._loop = p.capture_calls(solve, [*commands, self._check_rounding, *factors, repeat, solve_factor])

    def minimise(self, start: torch.Tensor, follows: torch.Tensor | None = None) -> None:
        """Minimises the potential; on a GPU with tiled factors, without synchronisation.

        Args:
            start: (B, N, 3) where inertia alone would lead [m].
            follows: (B,) environments that continue from the last solution: their starting point is extrapolated, and
                factor and pairs are kept. None: no environment. The constant factor of projective dynamics is always
                kept, its pairs are not.
        """
        p = self._potential
        kept = [self._history_counts[0], self._pair_counts, *([self._progress["factored"]] if self._refactors else [])]
        for counts in kept:
            if follows is None:
                counts.zero_()
            else:
                counts.mul_(follows)
        if not self._refactors:  # The last pairs of a long solve are of little use for the next one.
            self._pair_counts.zero_()
        if self._loop is not None:
            p.positions.copy_(start)
            p.launch(self._loop)
            p.active.fill_(1)
            return
        if not self._hessian.ready():
            self._progress["factored"].zero_()
        try:
            state = self.begin(start)
            if state.directions > state.factors:
                self._hessian.adapt()
            while state.active:
                if state.factors:
                    self.refactor(state)
                if state.directions:
                    p.on_direction()
                state = self.advance(state)
        finally:
            p.active.fill_(1)

    def begin(self, start: torch.Tensor) -> Summary:
        """Evaluates the potential at a start (B, N, 3) [m]."""
        p = self._potential
        p.positions.copy_(start)
        p.launch(self._begin)
        return self._check_and_read()

    def advance(self, state: Summary) -> Summary:
        """Evaluates the next trial of every active environment, along a new direction where one is needed."""
        p = self._potential
        if state.directions:
            p.launch(self._project)
            self._hessian.solve_in_place(self._right, self._progress["phase"] == kernels.NEED_DIRECTION)
            p.launch(self._first_trial)
        else:
            p.launch(self._evaluate)
        return self._check_and_read()

    def refactor(self, state: Summary) -> None:
        """Factorises at the iterates of the environments that need it."""
        p = self._potential
        p.launch(self._select)
        all_environments = state.factors == p.batch
        self._hessian.refactor(p.clamp.bool(), None if all_environments else p.tangent_active.bool())

    def outcome(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns directions, last residual over balancing forces, convergence and factorisations, (B,) each."""
        state = self._progress
        converged = state["phase"] == kernels.DONE
        return state["iterations"].long(), state["relative"].clone(), converged, state["factorisations"].long()

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
