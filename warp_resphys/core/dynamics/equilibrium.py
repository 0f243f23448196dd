"""Differentiable minimisation of an incremental potential,
with an implicit adjoint, and the reactions there.

At a vertex i that is fixed, or slides in a symmetry plane, the potential (``energies.potential``)
does not balance. Its gradient there, normal to the planes in the latter case,

    r_i = k_i (x_i - y_i) - f_i + sum_e dE_e / dx_i,

is the force with which the clamp or the planes hold the vertex: that of the energies, damping
included, the rate of change of the vertex's momentum, less its share of the loads and what energies
add there (`BoundEnergy.load_at_fixed`). In a midpoint step, forces and places are those of its
middle. What obstacles and guides in the world exert is not included.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch.autograd import forward_ad
from typing_extensions import override

from ...io.errors import ConvergenceError
from ..energies.potential import IncrementalPotential, Names, StepTerms
from ..linalg.threads import in_threads, threads_for
from ..stepping.adjoints import AdjointFunction, first_derivatives
from ..stepping.state import Reaction, SolveReport
from .hessian import ExactHessian
from .minimiser import Minimiser
from .solver_settings import SolverSettings
from .workspace import Workspace

P = TypeVar("P")
T = TypeVar("T")

# Iterations of an adjoint solve with a float32 factor before a float64 factor is used
_REFINEMENTS = 8
# Of the way of fixed vertices that bodies bar: a part of it, and their number.
_LEAST_WAY, _MOST_PARTS = 1e-2, 32
# Relative residuals: target, and limit if rounding prevents the target.
_REFINED, _ACCEPTED = 1e-12, 1e-9


def equilibrium(
    workspace: Workspace,
    purpose: str,
    settings: SolverSettings,
    terms: StepTerms,
    start: torch.Tensor,
    fixed_positions: torch.Tensor,
    follows: torch.Tensor | None = None,
) -> tuple[torch.Tensor, SolveReport, torch.Tensor]:
    """Returns the minimiser (B, N, 3) of a step's potential,
    differentiable in the terms and fixed positions.

    Args:
        workspace: workspace of the batch.
        purpose: ``dynamics`` or ``statics`` (`Workspace.minimiser`).
        settings: settings of the solver.
        terms: terms of the step.
        start: (B, N, 3) initial guess [m], without gradient; it affects the result only within the
            tolerance.
        fixed_positions: (B, D, 3) positions of the fixed vertices [m].
        follows: passed to `Minimiser.solve`.

    Returns:
        The last iterate, the solver's report, which says whether it converged (`check_converged`),
        and the gradient (B, D + R, 3) of the energies at the held vertices, as numbers for
        `reaction_of` [N].
    """
    problem = _Minimisation(workspace, purpose, settings, follows, workspace.potential.value_names)
    values = (terms.values[energy][name] for energy, name in problem.names)
    tensors = (start, fixed_positions, terms.target, terms.inertia, terms.force, *values)
    needs_grad = torch.is_grad_enabled() and any(
        x is not None and x.requires_grad for x in tensors[1:]
    )
    # Forward-mode differentiation also calls the function, which raises an error for it.
    through_graph = needs_grad or forward_ad._current_level >= 0
    x: torch.Tensor = (
        _Equilibrium.apply(problem, *tensors) if through_graph else problem.minimise(tensors)
    )
    assert problem.report is not None
    assert problem.held_gradient is not None
    return x, problem.report, problem.held_gradient


@dataclass
class _Minimisation:
    """The minimisation of a step's potential for a batch,
    and its adjoint, with one thread per shard.
    """

    workspace: Workspace
    purpose: str
    settings: SolverSettings
    follows: torch.Tensor | None
    names: Names  # of the values
    report: SolveReport | None = None
    held_gradient: torch.Tensor | None = None  # (B, D + R, 3) of the energies, at the minimiser [N]

    def minimise(self, tensors: Sequence[torch.Tensor | None]) -> torch.Tensor:
        """Returns the minimiser for a start, fixed positions and terms,
        and sets `report` and `held_gradient`.
        """
        start, *others = (None if tensor is None else tensor.detach() for tensor in tensors)
        assert start is not None

        def work(
            rows: slice, workspace: Workspace, minimiser: Minimiser
        ) -> tuple[torch.Tensor, SolveReport, Any]:
            follows = None if self.follows is None else self.follows[rows]
            return _minimise(
                workspace,
                minimiser,
                follows,
                self.names,
                *(_rows(tensor, rows) for tensor in (start, *others)),
            )

        def prepare(workspace: Workspace) -> Minimiser:
            return workspace.minimiser(self.purpose, self.settings)

        results = _in_shards(self.workspace, prepare, work, start[0].numel())
        solutions, reports, gradients = zip(*results, strict=True)
        self.report = _joined(reports)
        self.held_gradient = gradients[0] if len(results) == 1 else torch.cat(gradients)
        return solutions[0] if len(results) == 1 else torch.cat(solutions)

    def differentiate(
        self,
        gradient: torch.Tensor,
        x: torch.Tensor,
        terms: Sequence[torch.Tensor | None],
        needed: Sequence[bool],
    ) -> list[torch.Tensor | None]:
        """Returns the gradients by fixed positions and terms, from that by the minimiser x.

        Raises:
            ConvergenceError: the Hessian is singular at x.
        """
        single = self.settings.factors == "single"
        types = (torch.float32, torch.float64) if single else (torch.float64,)

        def prepare(workspace: Workspace) -> list[ExactHessian]:
            workspace.potential.prepare_adjoint()
            return [workspace.hessian(self.settings.linear_solver, dtype) for dtype in types]

        def work(
            rows: slice, workspace: Workspace, hessians: list[ExactHessian]
        ) -> tuple[torch.Tensor | None, ...]:
            return _adjoint(
                workspace,
                hessians,
                self.names,
                needed,
                *(_rows(t, rows) for t in (gradient, x, *terms)),
            )

        try:
            gradients = _in_shards(self.workspace, prepare, work, gradient[0].numel())
        except ConvergenceError as error:
            raise ConvergenceError(str(error), x.clone(), None) from None
        return [
            _join_gradients(*pair)
            for pair in zip((None, *terms), zip(*gradients, strict=True), strict=True)
        ]


def _in_shards(
    workspace: Workspace,
    prepare: Callable[[Workspace], P],
    work: Callable[[slice, Workspace, P], T],
    unknowns: int,
) -> list[T]:
    """The results of work in all shards, each with what was prepared for it in this thread."""
    with workspace.potential.lock:
        parts = [(rows, shard, prepare(shard)) for rows, shard in workspace.parts]
        with threads_for(unknowns, len(parts)):
            return in_threads(lambda part: work(*part), parts)


class _Equilibrium(AdjointFunction):
    """x* = argmin of the incremental potential, with x = d at the fixed vertices.

    With the residual g(x, theta) = 0 and the Hessian H = dg/dx, the implicit function theorem gives
    dx = -H^-1 (dg/dtheta) dtheta. For a loss with gradient w at x*, solve H z = w on the free
    vertices (z = 0 on the fixed ones); then

        dL/dy = k z,  dL/dk = -z . (x - y),  dL/df = z,  dL/dd = w_D - (K z)_D,
        dL/dtheta = -z . dg/dtheta

    with K the stiffness, and theta the values of the energies. H is exact here, never clamped.
    """

    @override
    @staticmethod
    def forward(ctx: Any, problem: _Minimisation, *tensors: torch.Tensor | None) -> torch.Tensor:
        x = problem.minimise(tensors)
        ctx.problem = problem
        ctx.save_for_backward(x, *tensors[2:])
        return x

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, *terms = (None if tensor is None else tensor.detach() for tensor in ctx.saved_tensors)
        return None, None, *ctx.problem.differentiate(gradient, x, terms, ctx.needs_input_grad[2:])


def reaction_of(
    workspace: Workspace,
    terms: StepTerms,
    x: torch.Tensor,
    gradient: torch.Tensor,
    loads: torch.Tensor | None = None,
) -> Reaction | None:
    """Returns the reaction at the held vertices in a solve, differentiable.

    None without such vertices.

    Args:
        workspace: of the batch.
        terms: of the solve.
        x: (B, N, 3) its solution [m].
        gradient: (B, D + R, 3) of the energies at the held vertices, from `equilibrium` [N].
        loads: (B, N, 3) further loads on the held vertices, from `EnergySet.loads_at_fixed` [N].
    """
    held = workspace.held
    if not len(held):
        return None
    force = terms.force if loads is None else terms.force + loads
    values = (terms.values[energy][name] for energy, name in workspace.potential.value_names)
    tensors = gradient.to(x), x, terms.target, terms.inertia, force
    forces = (
        _HeldForces.apply(workspace, *tensors, *values)
        if torch.is_grad_enabled()
        else _held(workspace, *tensors)
    )
    return Reaction(held, forces, x.index_select(1, held))


def _held(
    workspace: Workspace, gradient: Any, x: Any, target: Any, inertia: Any, force: Any
) -> torch.Tensor:
    """Returns the reaction (B, D + R, 3) [N] from the gradient
    of the energies there (equation of the module).
    """
    acting = torch.addcmul(force, inertia[..., None], target - x)
    return _exerted(workspace, gradient - acting.index_select(1, workspace.held))


def _exerted(workspace: Workspace, forces: torch.Tensor) -> torch.Tensor:
    """Returns what clamps and planes can exert of forces (B, D + R, 3):
    at vertices in planes the normal part.
    """
    coordinates = workspace.potential.coordinates
    if not coordinates.slides:
        return forces
    count = len(workspace.fixed)
    return torch.cat([forces[:, :count], coordinates.normal(forces[:, count:])], 1)


class _HeldForces(AdjointFunction):
    """r = k (x - y) - f + sum_e dE_e / dx at the held vertices,
    whose last part is known from the solve; its adjoint.

    For a loss with derivatives z by r, along planes and at other vertices zero, dL/dx = K z + k z,
    dL/dy = -k z, dL/dk = z . (x - y), dL/df = -z and dL/dtheta = z . dg/dtheta, with the stiffness
    K at x, the gradient g of the energies, and their values theta.
    """

    @override
    @staticmethod
    def forward(
        ctx: Any, workspace: Workspace, known: torch.Tensor, *tensors: torch.Tensor | None
    ) -> torch.Tensor:
        ctx.workspace = workspace
        ctx.save_for_backward(*tensors)
        return _held(workspace, known, *tensors[:4])

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        tensors: list[Any] = [
            None if tensor is None else tensor.detach() for tensor in ctx.saved_tensors
        ]
        x, *terms = tensors
        z = torch.zeros_like(x).index_copy(1, ctx.workspace.held, _exerted(ctx.workspace, gradient))
        by_position, _, _, _, *by_values = ctx.needs_input_grad[2:]
        names = ctx.workspace.potential.value_names

        def work(rows: slice, workspace: Workspace, _: None) -> tuple[torch.Tensor | None, ...]:
            potential = workspace.potential
            mine = StepTerms.of(names, *(_rows(tensor, rows) for tensor in terms))
            potential.set_terms(mine)
            potential.positions.copy_(x[rows])
            along = z[rows].double()
            if by_position:
                potential.update_tangent()
            slopes = _by_values(potential, names, mine, by_values, along)
            product = potential.stiffness_product(along).to(x) if by_position else None
            return product, *(None if slope is None else -slope for slope in slopes)

        found = _in_shards(
            ctx.workspace, lambda shard: shard.potential.prepare_adjoint(), work, x[0].numel()
        )
        product, *slopes = (
            _join_gradients(*pair)
            for pair in zip((x, *terms[3:]), zip(*found, strict=True), strict=True)
        )
        target, inertia, *_ = terms
        stiff = inertia[..., None] * z
        product = None if product is None else product + stiff
        return None, None, product, -stiff, (z * (x - target)).sum(-1), -z, *slopes


def _rows(values: torch.Tensor | None, rows: slice) -> torch.Tensor | None:
    """Returns the values of some environments; values shared by all are returned unchanged."""
    return values if values is None or len(values) == 1 else values[rows]


def _joined(reports: Sequence[SolveReport]) -> SolveReport:
    """Returns the report of a batch from those of its shards."""
    if len(reports) == 1:
        return reports[0]
    names = [item.name for item in fields(SolveReport)]
    return SolveReport(
        *(torch.cat([getattr(report, name) for report in reports]) for name in names)
    )


def _join_gradients(
    value: torch.Tensor | None, slopes: tuple[torch.Tensor | None, ...]
) -> torch.Tensor | None:
    """Returns the gradient by a value from those of the shards:
    concatenated, or summed if the value is shared.
    """
    parts = [slope for slope in slopes if slope is not None]
    if len(parts) < 2:
        return parts[0] if parts else None
    return torch.stack(parts).sum(0) if value is not None and len(value) == 1 else torch.cat(parts)


def _minimise(
    workspace: Workspace,
    minimiser: Minimiser,
    follows: torch.Tensor | None,
    names: Names,
    start: Any,
    fixed_positions: Any,
    *terms: Any,
) -> tuple[torch.Tensor, SolveReport, torch.Tensor]:
    """Returns the minimiser, the report, and the gradient at held vertices of one shard.

    Where bodies bar the way of fixed vertices, these go as far as they can, and the others give way
    to them by a solve, again and again; the last solve has every fixed vertex in its place. A batch
    of which that holds agrees with its environments alone within the tolerance, not bit for bit.
    """
    potential, fixed = workspace.potential, workspace.fixed
    potential.set_terms(StepTerms.of(names, *terms))
    potential.check_start(follows is not None and bool(follows.all()))
    parts: list[SolveReport] = []
    while not potential.place_fixed(
        fixed, fixed_positions, _LEAST_WAY if len(parts) < _MOST_PARTS else 1.0
    ):
        assert potential.feasible is not None
        parts.append(minimiser.solve(potential.coordinates.hold(potential.feasible.clone())))
        potential.feasible.copy_(potential.positions)
    if len(fixed):
        start = start.clone()
        start[:, fixed] = fixed_positions
    report = minimiser.solve(potential.improved_start(start).to(start), None if parts else follows)
    solves = [*parts, report]
    work: dict[str, Any] = {
        "iterations": sum(part.iterations for part in solves),
        "factorisations": sum(part.factorisations for part in solves),
    }
    gradient = potential.held_gradient[:, workspace.held]
    return potential.positions.to(start.dtype, copy=True), replace(report, **work), gradient


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
    terms = StepTerms.of(names, *saved)
    potential = workspace.potential
    potential.set_terms(terms)
    potential.positions.copy_(x)
    gradient = gradient.double()
    z, product = _adjoint_solution(potential, hessians, gradient)
    fixed, target, inertia, force, *values = needed
    return (
        (gradient - product)[:, workspace.fixed] if fixed else None,
        potential.restrict(terms.inertia[..., None] * z) if target else None,
        -(z * (x - terms.target)).sum(-1) * potential.free_mask if inertia else None,
        z if force else None,
        *_by_values(potential, names, terms, values, z),
    )


def _by_values(
    potential: IncrementalPotential,
    names: Names,
    terms: StepTerms,
    needed: Sequence[bool],
    z: torch.Tensor,
) -> list[torch.Tensor | None]:
    """Returns the needed -z . d residual / d value at the potential's positions,
    for an adjoint z (B, N, 3) [m].
    """
    slopes, found = potential.value_adjoint(z) if any(needed) else None, list[torch.Tensor | None]()
    for (energy, name), is_needed in zip(names, needed, strict=True):
        value, slope = terms.values[energy][name], slopes[energy].get(name) if slopes else None
        if value is None or slope is None or not is_needed:
            found.append(None)
        else:
            found.append(slope.sum(0, keepdim=True) if len(value) < len(slope) else slope)
    return found


def _adjoint_solution(
    potential: IncrementalPotential, hessians: Sequence[ExactHessian], gradient: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the adjoint z (B, N, 3) [m] and its product
    with the stiffness [N] at the potential's positions.

    Without a factor of its own where `ExactHessian.kept` solves it.

    Args:
        potential: potential with the terms and positions of the solution.
        hessians: Hessians to try in turn; a float32 factor is combined with iterative refinement.
        gradient: (B, N, 3) gradient of the loss by the positions.

    Raises:
        ConvergenceError: the Hessian is singular, for example if a body can turn about its only
            fixed vertex.
    """
    right = potential.restrict(gradient)
    solutions = None if hessians[0].kept is None else hessians[0].kept.solve([right])
    if solutions is not None:
        return solutions[0], potential.stiffness_product(solutions[0])
    size = right.flatten(1).norm(dim=1)

    def solved(hessian: ExactHessian, rest: torch.Tensor) -> torch.Tensor:
        return hessian.solve(rest.reshape(len(rest), -1, 1)).view_as(rest)

    for hessian in hessians:
        hessian.refactor_exact()
        z = torch.zeros_like(right)
        rest, before = right, size
        for _ in range(1 if hessian.exact else 1 + _REFINEMENTS):
            z = z + solved(hessian, rest)
            product = potential.stiffness_product(z)
            rest = right - potential.restrict(product + potential.inertia[..., None] * z)
            error = rest.flatten(1).norm(dim=1)
            accepted = error <= (1e-6 if hessian.exact else _ACCEPTED) * size
            # The refinement also ends where rounding of the product prevents progress.
            ended = (error <= _REFINED * size) | ~(error <= 0.5 * before)
            # One look from the host.
            ends, succeeds = torch.stack([ended, accepted]).all(1).tolist()
            if ends:
                break
            before = error
        if succeeds:
            return z, product
    raise ConvergenceError(
        "the adjoint system is singular at a state of the roll-out, so that there is no "
        "gradient: fix the body so that it cannot move freely, "
        "or keep away from the point where it buckles.",
        potential.positions.clone(),
        None,
    )
