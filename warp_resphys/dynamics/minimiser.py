"""State of a minimisation on its device, and the launches that advance it; the kernels are ``kernels.minimisation``."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from ..energies.launcher import Launches, issue, warp_view
from ..energies.potential import IncrementalPotential
from ..kernels import minimisation as kernels
from ..linalg.tiled import TiledSolver
from .hessian import ExactHessian, HessianApproximation
from .recorded_factors import RecordedFactors

_COUNTS = ("phase", "wanted", "factored", "asks", "iterations", "since", "made", "halvings", "stalls")
_SUMS = ("step", "slope", "energy", "scale", "relative", "smallest", "rounding", "force", "stiffness")
_NUDGES = 7  # random draws of rounding units


class Summary(NamedTuple):
    """Counts of environments that the host acts on."""

    active: int  # neither converged nor failed
    aiming: int  # need a direction
    wanting: int  # need a factor before the direction
    asking: int  # measure the rounding of their residual


class Minimiser:
    """Buffers and launches of one batch.

    Args:
        potential: minimised at its positions.
        hessian: gives the factor for the directions.
        dtype: of pairs and right-hand sides.
        memory: pairs that L-BFGS keeps; 0 for Newton's method.
        relative_tolerance: residual over balancing forces at which an environment has converged.
        absolute_tolerance: residual at which an environment has converged in any case [N].
        epsilon: of the states' type.
        max_iterations: directions after which an environment fails.
        refactor_after: directions of a solve above which the next solve gets a new factor; three times as many give a
            new factor at once. 0 for a new factor at every iterate, None for never.
    """

    def __init__(
        self,
        potential: IncrementalPotential,
        hessian: HessianApproximation,
        dtype: torch.dtype,
        memory: int,
        relative_tolerance: float,
        absolute_tolerance: float,
        epsilon: float,
        max_iterations: int,
        refactor_after: int | None,
    ) -> None:
        p, b, n = potential, potential.batch, potential.n_vertices
        self._potential, self._hessian = p, hessian
        self._counts = {name: torch.zeros(b, device=p.device, dtype=torch.int32) for name in _COUNTS}
        self._sums = {name: p.zeros() for name in _SUMS}
        self._gradient, self._direction, origin = (p.zeros(n, 3) for _ in range(3))
        self._right = torch.zeros(b, len(hessian.vertex_at), 3, device=p.device, dtype=dtype)
        summary = torch.zeros(len(Summary._fields), device=p.device, dtype=torch.int32)
        # Where the host reads it: the same memory on a CPU.
        self._summary, self._seen = summary, summary if p.device.type == "cpu" else summary.cpu().pin_memory()
        self._shown = self._seen.numpy()

        double = dtype == torch.float64
        own = kernels.minimisation_kernels(wp.float64 if double else wp.float32)
        vector = wp.vec3d if double else wp.vec3f
        progress, pairs = kernels.SolverProgress(), own.Pairs()
        evaluation, tolerances = kernels.Evaluation(), kernels.Tolerances()
        for name, values in self._counts.items():
            setattr(progress, name, warp_view(values, wp.int32))
        for name, values in self._sums.items():
            setattr(progress, name, warp_view(values, wp.float64))
        places = max(memory, 1)
        self._renews = refactor_after is not None
        self._recent = [torch.zeros(b, device=p.device, dtype=torch.int32) for _ in range(3)]
        self._pair_counts = torch.zeros(b, device=p.device, dtype=torch.int32)
        pairs.count = warp_view(self._pair_counts, wp.int32)
        pairs.last = wp.zeros(b, dtype=int, device=str(p.device))
        pairs.s, pairs.y = (
            warp_view(torch.zeros(b, places, n, 3, device=p.device, dtype=dtype), vector) for _ in range(2)
        )
        pairs.r = warp_view(p.zeros(places, places), wp.float64)
        pairs.a, pairs.b = (warp_view(p.zeros(places), wp.float64) for _ in range(2))
        evaluation.energy, evaluation.size = warp_view(p.energy, wp.float64), warp_view(p.energy_size, wp.float64)
        evaluation.balance, evaluation.norm = warp_view(p.balance, wp.float64), warp_view(p.residual_norm, wp.float64)
        evaluation.residual = warp_view(p.residual, wp.vec3d)
        tolerances.relative, tolerances.absolute = wp.float64(relative_tolerance), wp.float64(absolute_tolerance)
        tolerances.epsilon, tolerances.max_iterations = wp.float64(epsilon), max_iterations
        tolerances.refactor_after = kernels.NEVER if refactor_after is None else refactor_after

        history = kernels.History()
        history.stored, history.newest, history.order = (warp_view(values, wp.int32) for values in self._recent)
        history.start, history.correction = warp_view(p.zeros(n, 3), wp.vec3d), warp_view(p.zeros(3, n, 3), wp.vec3d)

        positions, gradient = warp_view(p.positions, wp.vec3d), warp_view(self._gradient, wp.vec3d)
        direction, origin_view = warp_view(self._direction, wp.vec3d), warp_view(origin, wp.vec3d)
        right, vertex_at = warp_view(self._right, vector), p.upload(hessian.vertex_at.astype(np.int32), int)
        loads = [warp_view(p.terms.force, wp.vec3d), warp_view(p.stiffness, wp.float64)]
        beginning = [*loads, positions, tolerances, origin_view, progress, history]
        begin = p.record_blocks(kernels.begin, b, beginning, [])
        chosen = [warp_view(flags, wp.int32) for flags in (p.tangent_active, p.clamp)]
        self._choose = p.record(kernels.choose, (b,), [progress, *chosen, pairs.count], [])
        aiming = [progress, pairs, vertex_at, gradient]
        self._project = p.record_blocks(own.project, b, aiming, [right])
        aim = p.record_blocks(own.aim, b, [*aiming, right, positions], [origin_view, direction])
        clamped = warp_view(hessian.clamped, wp.bool)
        judging = [int(memory > 0), tolerances, warp_view(p.inertia, wp.float64), evaluation, origin_view, direction]
        judging += [clamped, positions, gradient, progress, pairs, history]
        accept = p.record_blocks(own.accept, b, judging, [])
        seen = [warp_view(summary, wp.int32), warp_view(p.active, wp.int32)]
        summarise = p.record_blocks(kernels.summarise, 1, [progress], seen)
        judge = [*p.evaluation, accept, summarise]
        self._begin, self._aim, self._go_on = p.capture(begin, *judge), p.capture(aim, *judge), p.capture(*judge)
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (_NUDGES, n, 3))
        kept = warp_view(p.zeros(n, 3), wp.vec3d)
        nudge = p.record_blocks(kernels.nudge, b, [progress, p.upload(signs, wp.vec3d), positions], [kept])
        compare = p.record_blocks(
            kernels.compare, b, [progress, kept, gradient, evaluation.residual], [positions, history]
        )
        self._compare = p.capture(nudge, *p.evaluation, compare, summarise)
        self._parts = SimpleNamespace(begin=begin, aim=aim, judge=judge)
        self._loop: Launches | None = None
        if self._runs_on_device:
            self._record_loop()

    @property
    def _runs_on_device(self) -> bool:
        """Whether factors need no host code and a graph may contain a loop (CUDA 12.4 and later)."""
        h, p = self._hessian, self._potential
        able = p.device.type == "cpu" or bool(wp.is_conditional_graph_supported())
        return isinstance(h, ExactHessian) and isinstance(h.linear, TiledSolver) and not p.couples_cells and able

    def _record_loop(self) -> None:
        p, h, parts = self._potential, self._hessian, self._parts
        assert isinstance(h, ExactHessian)
        assert isinstance(h.linear, TiledSolver)
        factors = RecordedFactors(p, h.assembly, h.linear, h.clamped, self._right)
        conditions = (warp_view(self._summary[k : k + 1], wp.int32) for k in range(len(Summary._fields)))
        active, aiming, wanting, asking = conditions

        def factorise() -> None:
            issue(self._choose)
            factors.factorise()

        def aim() -> None:
            issue(self._project)
            factors.solve()
            issue(parts.aim)

        def advance() -> None:
            wp.capture_if(wanting, factorise)
            wp.capture_if(aiming, aim)
            issue(*parts.judge)
            wp.capture_if(asking, lambda: issue(self._compare))

        def solve() -> None:
            issue(parts.begin, *parts.judge)
            wp.capture_while(active, advance)

        commands = [parts.begin, *parts.judge, self._choose, self._project, parts.aim, self._compare]
        self._loop = p.capture_calls(solve, [*commands, *factors.commands])

    def minimise(self, start: torch.Tensor, follows: torch.Tensor | None = None) -> None:
        """Minimises the potential; on a GPU with tiled factors, without waiting for the end.

        Args:
            start: (B, N, 3) positions to which inertia alone would lead [m].
            follows: (B,) environments that continue the last step: their start is extrapolated from the last solutions,
                and factor and pairs are kept. None for none. A factor that is never renewed is kept for all, without
                pairs.
        """
        p = self._potential
        for values in self._recent[0], self._pair_counts, *((self._counts["factored"],) if self._renews else ()):
            if follows is None:
                values.zero_()
            else:
                values.mul_(follows)
        if not self._renews:  # Pairs from the end of a long solve do not help the next one.
            self._pair_counts.zero_()
        if self._loop is not None:
            p.positions.copy_(start)
            p.launch(self._loop)
            p.active.fill_(1)
            return
        if not self._hessian.ready():
            self._counts["factored"].zero_()
        try:
            state = self.begin(start)
            while state.active:
                if state.wanting:
                    self.refactor(state)
                state = self.advance(state)
        finally:
            p.active.fill_(1)

    def begin(self, start: torch.Tensor) -> Summary:
        """Evaluates the potential at a start (B, N, 3) [m]."""
        p = self._potential
        p.positions.copy_(start)
        p.launch(self._begin)
        return self._look()

    def advance(self, state: Summary) -> Summary:
        """Evaluates one trial of every environment: the first along a new direction, or the next of a line search."""
        p = self._potential
        if state.aiming:
            p.launch(self._project)
            self._hessian.solve_in_place(self._right)
            p.launch(self._aim)
        else:
            p.launch(self._go_on)
        return self._look()

    def refactor(self, state: Summary) -> None:
        """Factorises for the environments that need it, at their iterates."""
        p = self._potential
        p.launch(self._choose)
        everyone = state.wanting == p.batch
        self._hessian.refactor(p.clamp.bool(), None if everyone else p.tangent_active.bool())

    def outcome(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns (B,) iterations, last residual over balancing forces, convergence flags and factorisations."""
        counts = self._counts
        converged = counts["phase"] == kernels.DONE
        return counts["iterations"].long(), self._sums["relative"].clone(), converged, counts["made"].long()

    def _look(self) -> Summary:
        state = self._read()
        if state.asking:
            self._potential.launch(self._compare)
            state = self._read()
        return state

    def _read(self) -> Summary:
        if self._seen is not self._summary:
            self._seen.copy_(self._summary)
        return Summary._make(self._shown.tolist())
