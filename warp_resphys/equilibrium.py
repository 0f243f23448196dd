"""The differentiable solve: minimiser of an incremental potential, with its implicit adjoint."""

from typing import Any

import torch
from typing_extensions import override

from .assembly import BlockPattern
from .body import Body
from .errors import ConvergenceError
from .linear_solver import make_linear_solver
from .metric import HessianMetric
from .point_terms import StepTerms
from .potential import IncrementalPotential
from .solver import NonlinearSolver, SolveReport, SolverSettings
from .threads import threads_for


class Workspace:
    """Buffers, launches and factors for one batch size of a body.

    Args:
        body: the body.
        model: material model (an integer of ``kernels.elasticity``).
        pattern: block structure of the Hessian.
        batch: environments.
        device: of every buffer.
        dtype: of states and factors; the potential is evaluated in float64.
    """

    def __init__(
        self,
        body: Body,
        model: int,
        pattern: BlockPattern,
        batch: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.potential = IncrementalPotential(body, model, batch, device, torch.float64)
        self.pattern, self.dtype = pattern, dtype
        self.fixed = torch.as_tensor(body.fixed_vertices, device=device)
        self._solvers: dict[tuple[str, SolverSettings], NonlinearSolver] = {}
        self._adjoint: HessianMetric | None = None

    def solver(self, purpose: str, settings: SolverSettings) -> NonlinearSolver:
        """The solver for a purpose (dynamics, statics), built at its first use; each keeps its own factor."""
        key = (purpose, settings)
        if key not in self._solvers:
            self._solvers[key] = NonlinearSolver(self.potential, self.pattern, settings, self.dtype)
        return self._solvers[key]

    def adjoint_metric(self, linear_solver: str) -> HessianMetric:
        """The exact Hessian for adjoint solves."""
        if self._adjoint is None:
            p, k = self.potential, self.pattern
            linear = make_linear_solver(linear_solver, k.rows, k.cols, len(k.free), 3, p.device, p.dtype)
            self._adjoint = HessianMetric(p, k, linear)
        return self._adjoint


class Equilibrium(torch.autograd.Function):
    """x* = argmin of the incremental potential, with x = d at the fixed vertices.

    With the residual g(x, theta) = 0 and the Hessian H = dg/dx, the implicit function theorem gives dx = -H^-1
    (dg/dtheta) dtheta. For a loss with gradient w at x*, solve H z = w on the free vertices (z = 0 on the fixed ones);
    then

        dL/dy = k z,  dL/dk = -z . (x - y),  dL/df = z,  dL/dd = w_D - (K z)_D,  dL/dtheta = -z . dg/dtheta

    with K the stiffness. H is exact here, never clamped.
    """

    @override
    @staticmethod
    def forward(
        ctx: Any,
        workspace: Workspace,
        solver: NonlinearSolver,
        reports: list[SolveReport],
        start: torch.Tensor,
        fixed_positions: torch.Tensor,
        target: torch.Tensor,
        inertia: torch.Tensor,
        force: torch.Tensor,
        shape_stiffness: torch.Tensor,
        volume_stiffness: torch.Tensor,
        viscosity: torch.Tensor,
        *constants: torch.Tensor | None,
    ) -> torch.Tensor:
        terms = StepTerms(target, inertia, force, shape_stiffness, volume_stiffness, viscosity, *constants)
        workspace.potential.set_terms(terms)
        if len(workspace.fixed):
            start = start.detach().clone()
            start[:, workspace.fixed] = fixed_positions.detach()
        with threads_for(start.numel()):
            reports.append(solver.solve(start.detach()))
        x = workspace.potential.positions.to(start.dtype, copy=True)
        ctx.workspace, ctx.linear_solver = workspace, solver.settings.linear_solver
        ctx.save_for_backward(x, *terms.tensors())
        return x

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        with threads_for(gradient.numel()):
            return _adjoint(ctx, gradient)


def _adjoint(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    """Gradients of the inputs of `Equilibrium.forward`; the equations are in its docstring."""
    x, *saved = ctx.saved_tensors
    terms = StepTerms(*saved)
    potential = ctx.workspace.potential
    potential.set_terms(terms)
    potential.positions.copy_(x)
    metric = ctx.workspace.adjoint_metric(ctx.linear_solver)
    metric.refactor_exact()
    gradient = gradient.to(potential.dtype)
    z = metric.apply(gradient.reshape(len(x), -1)).view_as(x)
    product = potential.stiffness_product(z)
    _check_adjoint(potential, z, product, gradient)
    needs = dict(zip(_INPUTS, ctx.needs_input_grad, strict=True))
    grads: dict[str, torch.Tensor | None] = dict.fromkeys(_INPUTS)
    grads["target"] = terms.inertia[..., None] * z * potential.free_mask[:, None]
    grads["inertia"] = -(z * (x - terms.target)).sum(-1) * potential.free_mask
    grads["force"] = z
    if needs["fixed_positions"]:
        grads["fixed_positions"] = (gradient - product)[:, ctx.workspace.fixed]
    if any(needs[k] for k in _CONSTANTS):
        adjoints = potential.parameter_adjoint(z)
        for name in ("shape_stiffness", "volume_stiffness", "fibre_stiffness"):
            values = getattr(terms, name)
            if values is not None and len(values) == 1:
                adjoints[name] = adjoints[name].sum(0, keepdim=True)
        grads.update({name: adjoints[name] for name in _CONSTANTS if getattr(terms, name) is not None})
    return tuple(grads[name] if needs[name] else None for name in _INPUTS)


_CONSTANTS = ("shape_stiffness", "volume_stiffness", "viscosity", "reference_strain", "pressure", "fibre_stiffness")
_INPUTS = (
    "workspace",
    "solver",
    "reports",
    "start",
    "fixed_positions",
    "target",
    "inertia",
    "force",
    *_CONSTANTS,
)


def _check_adjoint(
    potential: IncrementalPotential, z: torch.Tensor, product: torch.Tensor, gradient: torch.Tensor
) -> None:
    """Refuses an adjoint that does not solve its system.

    Raises:
        ConvergenceError: the Hessian is singular, as where a body can turn about its only fixed vertex.
    """
    right = gradient * potential.free_mask[:, None]
    left = (product + potential.inertia[..., None] * z) * potential.free_mask[:, None]
    error = (left - right).flatten(1).norm(dim=1)
    if not bool((error <= 1e-6 * right.flatten(1).norm(dim=1)).all()):
        raise ConvergenceError(
            "the adjoint system is singular at a state of the roll-out, so that there is no gradient: fix the body so "
            "that it cannot move freely, or keep away from the point where it buckles.",
            potential.positions.clone(),
            None,
        )


class GreenStrain(torch.autograd.Function):
    """E = (F^T F - I) / 2 at every point, (B, N, 3) to (B, P, 3, 3)."""

    @override
    @staticmethod
    def forward(ctx: Any, potential: IncrementalPotential, positions: torch.Tensor) -> torch.Tensor:
        ctx.potential = potential
        ctx.save_for_backward(positions)
        return potential.strain(positions.detach().to(potential.dtype))

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        (positions,) = ctx.saved_tensors
        return None, ctx.potential.strain_adjoint(positions.to(gradient.dtype), gradient)
