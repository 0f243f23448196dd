"""Differentiable minimisation of an incremental potential, with an implicit adjoint."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import torch
import warp as wp
from torch.autograd import forward_ad
from typing_extensions import override

from ..energies.body_energies import PlacedEnergy
from ..energies.launcher import BLOCK, lasting
from ..energies.potential import IncrementalPotential, StepTerms
from ..energies.solid import Solid
from ..fem.coordinates import Coordinates
from ..io.errors import ConvergenceError
from ..io.kernel_cache import start_quietly
from ..kernels import hessian_blocks, line_search, minimisation, points, reductions
from ..kernels.lbfgs import lbfgs_kernels
from ..kernels.modules import compile_together
from ..linalg.choice import make_linear_solver
from ..linalg.linear_solver import LinearSolver
from ..linalg.threads import in_threads, threads_for
from ..stepping.adjoints import AdjointFunction, first_derivatives
from ..stepping.state import SolveReport
from .assembly import BlockPattern
from .hessian import ExactHessian
from .nonlinear_solver import NonlinearSolver, SolverSettings

T = TypeVar("T")
Shard = tuple[slice, "Workspace"]
Names = tuple[tuple[int, str], ...]  # number of an energy, and name of a value of its term

_REFINEMENTS = 8  # iterations of an adjoint solve with a float32 factor before a float64 factor is used
_LEAST_WAY, _MOST_PARTS = 1e-2, 32  # of the way of fixed vertices that bodies bar: a part of it, and their number
_REFINED, _ACCEPTED = 1e-12, 1e-9  # relative residuals: target, and limit if rounding prevents the target


def _kernels(energies: Sequence[PlacedEnergy], device: torch.device, dtype: torch.dtype) -> list[Any]:
    """Returns a kernel of every module that a solve launches, but those of energies that are not materials."""
    scalar = wp.float64 if dtype == torch.float64 else wp.float32
    solids = [placed.energy for placed in energies if isinstance(placed.energy, Solid)]
    return [
        *(points.gather_cells, points.gather_kernels(3).gather, reductions.masked_norm),
        *(solid.kernel(device) for solid in solids),
        *(
            hessian_blocks.cell_blocks,
            hessian_blocks.scatter_kernel(scalar),
            minimisation.begin,
            lbfgs_kernels(scalar).project,
        ),
        *(line_search.perturb, line_search.accept_kernel(scalar)),
    ]


class Workspace:
    """Buffers, launches and factors for one batch size of a body.

    Args:
        energies: energies of the body.
        coordinates: map from control vertices to all vertices.
        fixed: (D,) fixed vertices, on the device.
        pattern: block structure of the Hessian.
        batch: number of environments.
        device: device of every buffer.
        dtype: dtype of states and factors; the potential is evaluated in float64.

    Attributes:
        shards: slices of the batch with a workspace each, if several threads share it, else empty.
    """

    def __init__(
        self,
        energies: Sequence[PlacedEnergy],
        coordinates: Coordinates,
        fixed: torch.Tensor,
        pattern: BlockPattern,
        batch: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.fixed = fixed
        eliminated = torch.as_tensor(np.setdiff1d(np.arange(coordinates.n_vertices), pattern.free), device=device)
        start_quietly()
        compile_together(_kernels(energies, device, dtype), device, BLOCK)
        self.potential = IncrementalPotential(energies, coordinates, eliminated, batch, device)
        self.pattern, self.dtype = pattern, dtype
        self._cache: dict[Any, Any] = {}
        self.shards: list[Shard] = []
        self._last: torch.Tensor | None = None

    @property
    def parts(self) -> "list[Shard]":
        """The shards, or the whole batch."""
        return self.shards or [(slice(None), self)]

    def record_positions(self, q: torch.Tensor) -> None:
        """Stores the positions (B, N, 3) at the end of a time step, for `follows`."""
        self._last = q.detach()

    def follows(self, q: torch.Tensor) -> torch.Tensor | None:
        """Returns (B,) whether positions are those at the end of the last time step; None before the first step."""
        return None if self._last is None else (q.detach() == self._last).flatten(1).all(1)

    def cached(self, key: Hashable, make: Callable[[], T]) -> T:
        """Returns an object of this batch, made at the first use of its key, for use outside of inference mode too."""
        if key not in self._cache:
            with lasting():
                self._cache[key] = make()
        value: T = self._cache[key]
        return value

    def solver(self, purpose: str, settings: SolverSettings) -> NonlinearSolver:
        """Returns the nonlinear solver for a purpose (dynamics, statics), with its own factor."""
        return self.cached(
            (purpose, settings), lambda: NonlinearSolver(self.potential, self.pattern, settings, self.dtype)
        )

    def hessian(self, linear_solver: str, dtype: torch.dtype = torch.float64) -> ExactHessian:
        """Returns the exact Hessian, for adjoint solves."""
        return self.cached(
            (linear_solver, dtype),
            lambda: ExactHessian(self.potential, self.pattern, self.linear_solver(linear_solver, dtype)),
        )

    def linear_solver(self, name: str, dtype: torch.dtype = torch.float64) -> LinearSolver:
        """Returns a new linear solver for the Hessian."""
        p, k = self.potential, self.pattern
        return make_linear_solver(name, k.rows, k.cols, len(k.free), 3, p.device, dtype)


def equilibrium(
    workspace: Workspace,
    purpose: str,
    settings: SolverSettings,
    terms: StepTerms,
    start: torch.Tensor,
    fixed_positions: torch.Tensor,
    follows: torch.Tensor | None = None,
) -> tuple[torch.Tensor, SolveReport]:
    """Returns the minimiser (B, N, 3) of a step's potential, differentiable in the terms and fixed positions.

    Args:
        workspace: workspace of the batch.
        purpose: ``dynamics`` or ``statics`` (`Workspace.solver`).
        settings: settings of the solver.
        terms: terms of the step.
        start: (B, N, 3) initial guess [m], without gradient; it affects the result only within the tolerance.
        fixed_positions: (B, D, 3) positions of the fixed vertices [m].
        follows: passed to `NonlinearSolver.solve`.

    Returns:
        The last iterate, and the solver's report, which says whether it converged (`check_converged`).
    """
    solve = _Solve(workspace, purpose, settings, follows, workspace.potential.value_names)
    values = (terms.values[energy][name] for energy, name in solve.names)
    tensors = (start, fixed_positions, terms.target, terms.inertia, terms.force, *values)
    needs_grad = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in tensors[1:])
    # Forward-mode differentiation also calls the function, which raises an error for it.
    if needs_grad or forward_ad._current_level >= 0:
        x: torch.Tensor = _Equilibrium.apply(solve, *tensors)
        assert solve.report is not None
        return x, solve.report
    return solve(tensors)


@dataclass
class _Solve:
    """A solve of a batch, with one thread per shard."""

    workspace: Workspace
    purpose: str
    settings: SolverSettings
    follows: torch.Tensor | None
    names: Names  # of the values
    report: SolveReport | None = None

    def __call__(self, inputs: Sequence[torch.Tensor | None]) -> tuple[torch.Tensor, SolveReport]:
        """Returns the minimiser and the report for a start, fixed positions and terms."""
        tensors = [None if tensor is None else tensor.detach() for tensor in inputs]

        def solve(part: tuple[slice, Workspace, NonlinearSolver]) -> tuple[torch.Tensor, SolveReport]:
            rows, own, solver = part
            own_follows = None if self.follows is None else self.follows[rows]
            return _solve(own, solver, own_follows, self.names, *(_rows(tensor, rows) for tensor in tensors))

        assert tensors[0] is not None
        with self.workspace.potential.lock:
            parts = [(rows, own, own.solver(self.purpose, self.settings)) for rows, own in self.workspace.parts]
            with threads_for(tensors[0][0].numel(), len(parts)):
                results = in_threads(solve, parts)
        x = results[0][0] if len(results) == 1 else torch.cat([solution for solution, _ in results])
        self.report = _joined([report for _, report in results])
        return x, self.report


class _Equilibrium(AdjointFunction):
    """x* = argmin of the incremental potential, with x = d at the fixed vertices.

    With the residual g(x, theta) = 0 and the Hessian H = dg/dx, the implicit function theorem gives dx = -H^-1
    (dg/dtheta) dtheta. For a loss with gradient w at x*, solve H z = w on the free vertices (z = 0 on the fixed ones);
    then

        dL/dy = k z,  dL/dk = -z . (x - y),  dL/df = z,  dL/dd = w_D - (K z)_D,  dL/dtheta = -z . dg/dtheta

    with K the stiffness, and theta the values of the energies. H is exact here, never clamped.
    """

    @override
    @staticmethod
    def forward(ctx: Any, solve: _Solve, *tensors: torch.Tensor | None) -> torch.Tensor:
        x, _ = solve(tensors)
        ctx.solve = solve
        ctx.save_for_backward(x, *tensors[2:])
        return x

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, *saved = ctx.saved_tensors
        x, saved = x.detach(), [None if tensor is None else tensor.detach() for tensor in saved]
        needed, solve = ctx.needs_input_grad[2:], ctx.solve

        types = (torch.float32, torch.float64) if solve.settings.factors == "single" else (torch.float64,)

        def differentiate(part: tuple[slice, Workspace, list[ExactHessian]]) -> tuple[torch.Tensor | None, ...]:
            rows, own, hessians = part
            return _adjoint(own, hessians, solve.names, needed, *(_rows(t, rows) for t in (gradient, x, *saved)))

        try:
            with solve.workspace.potential.lock:
                parts = [
                    (rows, own, [own.hessian(solve.settings.linear_solver, dtype) for dtype in types])
                    for rows, own in solve.workspace.parts
                ]
                for _, own, _ in parts:
                    own.potential.prepare_adjoint()
                with threads_for(gradient[0].numel(), len(parts)):
                    gradients = in_threads(differentiate, parts)
        except ConvergenceError as error:
            raise ConvergenceError(str(error), x.detach().clone(), None) from None
        return (None, None, *map(_join_gradients, (None, *saved), zip(*gradients, strict=True)))


def _rows(values: torch.Tensor | None, rows: slice) -> torch.Tensor | None:
    """Returns the values of some environments; values shared by all are returned unchanged."""
    return values if values is None or len(values) == 1 else values[rows]


def _joined(reports: Sequence[SolveReport]) -> SolveReport:
    """Returns the report of a batch from those of its shards."""
    names = [item.name for item in fields(SolveReport)]
    return SolveReport(*(torch.cat([getattr(report, name) for report in reports]) for name in names))


def _join_gradients(value: torch.Tensor | None, slopes: tuple[torch.Tensor | None, ...]) -> torch.Tensor | None:
    """Returns the gradient by a value from those of the shards: concatenated, or summed if the value is shared."""
    parts = [slope for slope in slopes if slope is not None]
    if len(parts) < 2:
        return parts[0] if parts else None
    return torch.stack(parts).sum(0) if value is not None and len(value) == 1 else torch.cat(parts)


def _terms(names: Names, tensors: Sequence[Any]) -> StepTerms:
    target, inertia, force, *values = tensors
    by_energy = [dict[str, torch.Tensor | None]() for _ in range(1 + max((energy for energy, _ in names), default=-1))]
    for (energy, name), value in zip(names, values, strict=True):
        by_energy[energy][name] = value
    return StepTerms(target, inertia, force, by_energy)


def _solve(
    workspace: Workspace,
    solver: NonlinearSolver,
    follows: torch.Tensor | None,
    names: Names,
    start: Any,
    fixed_positions: Any,
    *terms: Any,
) -> tuple[torch.Tensor, SolveReport]:
    """Returns the minimiser and the report of one shard.

    Where bodies bar the way of fixed vertices, these go as far as they can, and the others give way to them by a solve,
    again and again; the last solve has every fixed vertex in its place. A batch of which that holds agrees with its
    environments alone within the tolerance, not bit for bit.
    """
    potential, fixed = workspace.potential, workspace.fixed
    potential.set_terms(_terms(names, terms))
    potential.check_start(follows is not None and bool(follows.all()))
    parts: list[SolveReport] = []
    while not potential.place_fixed(fixed, fixed_positions, _LEAST_WAY if len(parts) < _MOST_PARTS else 1.0):
        assert potential.feasible is not None
        parts.append(solver.solve(potential.coordinates.hold(potential.feasible.clone())))
        potential.feasible.copy_(potential.positions)
    if len(fixed):
        start = start.clone()
        start[:, fixed] = fixed_positions
    report = solver.solve(potential.improved_start(start).to(start), None if parts else follows)
    work = {name: sum(getattr(part, name) for part in [*parts, report]) for name in ("iterations", "factorisations")}
    return potential.positions.to(start.dtype, copy=True), replace(report, **work)


def _adjoint(
    workspace: Workspace,
    hessians: Sequence[ExactHessian],
    names: Names,
    needed: Sequence[bool],
    gradient: Any,
    x: Any,
    *saved: Any,
) -> tuple[torch.Tensor | None, ...]:
    """Returns the gradients by fixed positions and terms (equations in `_Equilibrium`)."""
    terms = _terms(names, saved)
    potential = workspace.potential
    potential.set_terms(terms)
    potential.positions.copy_(x)
    gradient = gradient.double()
    z, product = _adjoint_solution(potential, hessians, gradient)
    fixed, target, inertia, force, *values = needed
    slopes = potential.value_adjoint(z) if any(values) else None
    by_values: list[torch.Tensor | None] = []
    for (energy, name), is_needed in zip(names, values, strict=True):
        value, slope = terms.values[energy][name], slopes[energy].get(name) if slopes else None
        if value is None or slope is None or not is_needed:
            by_values.append(None)
        else:
            by_values.append(slope.sum(0, keepdim=True) if len(value) < len(slope) else slope)
    return (
        (gradient - product)[:, workspace.fixed] if fixed else None,
        potential.restrict(terms.inertia[..., None] * z) if target else None,
        -(z * (x - terms.target)).sum(-1) * potential.free_mask if inertia else None,
        z if force else None,
        *by_values,
    )


def _adjoint_solution(
    potential: IncrementalPotential, hessians: Sequence[ExactHessian], gradient: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the adjoint z (B, N, 3) [m] and its product with the stiffness [N] at the potential's positions.

    Without a factor of its own where `ExactHessian.solve_with_kept_factor` solves it.

    Args:
        potential: potential with the terms and positions of the solution.
        hessians: Hessians to try in turn; a float32 factor is combined with iterative refinement.
        gradient: (B, N, 3) gradient of the loss by the positions.

    Raises:
        ConvergenceError: the Hessian is singular, for example if a body can turn about its only fixed vertex.
    """
    right = potential.restrict(gradient)
    solutions = hessians[0].solve_with_kept_factor([right])
    if solutions is not None:
        return solutions[0], potential.stiffness_product(solutions[0])
    size = right.flatten(1).norm(dim=1)

    def solved(hessian: ExactHessian, rest: torch.Tensor) -> torch.Tensor:
        return hessian.solve(rest.reshape(len(rest), -1, 1)).view_as(rest)

    for hessian in hessians:
        hessian.refactor_exact()
        z, rest, before = torch.zeros_like(right), right, size
        for _ in range(1 if hessian.exact else 1 + _REFINEMENTS):
            z = z + solved(hessian, rest)
            product = potential.stiffness_product(z)
            rest = right - potential.restrict(product + potential.inertia[..., None] * z)
            error = rest.flatten(1).norm(dim=1)
            accepted = error <= (1e-6 if hessian.exact else _ACCEPTED) * size
            # The refinement also ends where rounding of the product prevents progress.
            ended = (error <= _REFINED * size) | ~(error <= 0.5 * before)
            ends, succeeds = torch.stack([ended, accepted]).all(1).tolist()  # one look from the host
            if ends:
                break
            before = error
        if succeeds:
            return z, product
    raise ConvergenceError(
        "the adjoint system is singular at a state of the roll-out, so that there is no gradient: fix the body so "
        "that it cannot move freely, or keep away from the point where it buckles.",
        potential.positions.clone(),
        None,
    )
