"""Residual of a step and its exact derivative at any positions,
for other methods than the simulator's solvers.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..linalg.linear_solver import Factor
from ..linalg.threads import threads_for
from ..stepping.adjoints import AdjointFunction, first_derivatives
from ..stepping.inputs import Acts
from ..stepping.state import State
from .assembly import HessianAssembly
from .time_step import TimeStep
from .workspace import Workspace

_MOST_COLUMNS = 4  # right-hand sides up to which a factor of another state may be cheaper


class Linearisation:
    """The residual g(x) of a step and its Hessian H = dg/dx.

    It uses the buffers of a batch, and is valid until the simulator is used again for a batch of
    that size.

    Args:
        problem: a time step or a static equilibrium.

    Attributes:
        stage: stage of the integrator.
        start: (B, N, 3) inertial target of the free vertices, positions of the fixed ones [m].
        finish: maps a solution x to the new state.
        free: (F,) free vertices.
    """

    def __init__(self, problem: TimeStep) -> None:
        equations = problem.equations
        self._workspace = problem.workspace
        self._terms = problem.terms()
        self._reaction = problem.reaction
        self.stage = problem.step.stage
        self.finish = problem.finish
        self._name = equations.settings.linear_solver
        self._fixed_positions, self._coordinates = problem.fixed_positions(), equations.coordinates
        self.start = self.hold(self.stage.target)
        self._potential = self._workspace.potential
        self._potential.set_terms(self._terms)
        self.free = torch.as_tensor(self._workspace.pattern.free, device=self._potential.device)
        self._unknowns = 3 * self._potential.n_vertices
        self._at, self._has_factor = self.start, True

    def hold(self, x: torch.Tensor) -> torch.Tensor:
        """Returns x with fixed and dependent vertices in their places,
        and sliding vertices in their planes.
        """
        held = self._coordinates.hold(x.index_copy(1, self._workspace.fixed, self._fixed_positions))
        return self._coordinates.expand(held)

    def residual(self, x: torch.Tensor) -> torch.Tensor:
        """Returns g (B, N, 3) at x [N], zero at fixed vertices:
        the additional force for which x solves the step.
        """
        self._potential.positions.copy_(x)
        self._potential.evaluate()
        return self._potential.residual.clone()

    def reached(self, x: torch.Tensor, missing: Acts = "external") -> State:
        """Returns the new state, with its reaction, as if x solved the step, differentiable by x.

        Args:
            x: (B, N, 3) [m].
            missing: whether the force with which x solves the step (`residual`) acts within the
                body or on it.
        """
        force = _Residual.apply(self, x) if missing == "internal" else None
        self._potential.positions.copy_(x.detach())
        self._potential.evaluate()
        gradient = self._potential.held_gradient[:, self._workspace.held]
        return replace(self.finish(x), reaction=self._reaction(self._terms, x, gradient, force))

    def factorise(self, x: torch.Tensor) -> None:
        """Prepares H at x (B, N, 3) [m] for `product` and `solve`,
        which makes an expensive factor if it needs one.
        """
        hessian = self._workspace.hessian(self._name)
        self._at, self._has_factor = x.detach().clone(), hessian.kept is None
        if hessian.kept is not None:
            self.update(x)
            return
        self._potential.positions.copy_(x)
        with threads_for(self._unknowns):
            hessian.refactor_exact()

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Returns the solutions (B, 3 N, m) of H y = r for (B, 3 N, m) right-hand sides,
        zero at fixed vertices.
        """
        hessian = self._workspace.hessian(self._name)
        fields = self._coordinates.restrict(self._coordinates.reduce(right.unflatten(1, (-1, 3))))
        with threads_for(self._unknowns):
            solution = None
            if hessian.kept is not None and not self._has_factor:
                self._potential.positions.copy_(self._at)
                if 0 < fields.shape[3] <= _MOST_COLUMNS:
                    columns = [
                        self._potential.restrict(column) for column in fields.double().unbind(3)
                    ]
                    solutions = hessian.kept.solve(columns)
                    if solutions is not None:
                        solution = torch.stack(solutions, 3).to(fields)
                if solution is None:
                    hessian.refactor_exact()
                    self._has_factor = True
            if solution is None:
                solution = hessian.solve(fields.flatten(1, 2)).unflatten(1, (-1, 3))
        return self._coordinates.expand(solution).flatten(1, 2)

    def update(self, x: torch.Tensor) -> None:
        """Prepares H at x for `product` and `shifted`, without a factor."""
        self._potential.positions.copy_(x)
        self._potential.update_tangent()

    def restrict(self, field: torch.Tensor) -> torch.Tensor:
        """Returns a field (B, N, 3), zero where vertices have no unknowns."""
        return self._potential.restrict(field)

    def product(self, direction: torch.Tensor) -> torch.Tensor:
        """Returns H d (B, N, 3) on the free vertices [N]."""
        p = self._potential
        return p.restrict(p.stiffness_product(direction) + p.inertia[..., None] * direction)

    @property
    def _shift(self) -> "_ShiftedHessian":
        w, name = self._workspace, self._name
        return w.cached(("shifted", name), lambda: _ShiftedHessian(w, name))

    def shifted(self, scale: float) -> Factor:
        """Returns a factor of I + scale H on the free vertices, for preconditioning.

        H is clamped if this is not positive definite, and without pairs (`Term.pair_tangents`).
        """
        factor = self._shift(scale)
        if factor.failed.any():
            self._potential.update_tangent(
                torch.as_tensor(factor.failed, device=self._potential.device)
            )
            factor = self._shift(scale)
            self._potential.update_tangent()
        return factor

    def matrix(self, x: torch.Tensor) -> tuple[scipy.sparse.csc_array, NDArray[np.float64]]:
        """Returns H (3 F, 3 F) of the first environment on the free vertices,
        and the inertia (3 F,) in it [N/m].
        """
        p, pattern = self._potential, self._workspace.pattern
        self.update(x)
        matrix = self._shift.linear.matrix(self._shift.assemble()[0])
        if p.low_rank is not None:
            columns = p.low_rank[0].view(p.n_vertices, 3, -1)[self.free].flatten(0, 1)
            columns = scipy.sparse.csc_array(columns.cpu().numpy())
            matrix = scipy.sparse.csc_array(matrix + columns @ columns.T)
        for coupling in self._workspace.hessian(self._name).couplings(p.last_pair_tangents):
            for number in (coupling.environments == 0).nonzero().ravel():
                used = coupling.unknowns[number] >= 0
                at = coupling.unknowns[number][used].cpu().numpy()
                block = coupling.matrices[number][used][:, used].cpu().numpy()
                pairs = (block.ravel(), (np.repeat(at, len(at)), np.tile(at, len(at))))
                matrix = scipy.sparse.csc_array(
                    matrix + scipy.sparse.coo_array(pairs, matrix.shape)
                )
        return matrix, np.repeat(p.inertia[0].cpu().numpy()[pattern.free], 3)

    def inertia_matrix(self, x: torch.Tensor) -> scipy.sparse.csc_array:
        """Returns the inertia (3 F, 3 F) in H, including rigid parts and glued vertices [N/m]."""
        whole, diagonal = self.matrix(x)
        if not len(self._coordinates.dependent):
            return scipy.sparse.csc_array(scipy.sparse.diags_array(diagonal))
        still = [
            {
                name: v * 0.0 if v is not None and name == "inertia" else v
                for name, v in values.items()
            }
            for values in self._terms.values
        ]
        self._potential.set_terms(
            replace(self._terms, inertia=0.0 * self._terms.inertia, values=still)
        )
        elastic, _ = self.matrix(x)
        self._potential.set_terms(self._terms)
        return scipy.sparse.csc_array(whole - elastic)


class _Residual(AdjointFunction):
    """The residual g (B, N, 3) of a linearised step at x (B, N, 3).

    DL/dx = H z for dL/dg = z, as H is symmetric.
    """

    @override
    @staticmethod
    def forward(ctx: Any, step: Linearisation, x: torch.Tensor) -> torch.Tensor:
        ctx.step = step
        ctx.save_for_backward(x)
        return step.residual(x).to(x)

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (x,) = ctx.saved_tensors
        ctx.step.update(x)
        free = ctx.step.restrict(gradient.double())  # g is zero at fixed vertices
        return None, ctx.step.product(free).to(x)


def first_order(x: torch.Tensor, here: Linearisation, there: Linearisation) -> torch.Tensor:
    """Returns solutions (E R, N, 3) of E other steps or equilibria each,
    to first order in what these differ by [m].

    Args:
        x: (R, N, 3) solution of the first ones [m].
        here: linearisation of the first ones.
        there: of the others.
    """
    here.factorise(x)
    sets = len(there.start) // len(x)
    at = x.repeat(sets, 1, 1)
    forces = (there.residual(at) - here.residual(x).repeat(sets, 1, 1)).unflatten(0, (sets, -1))
    moved = here.solve(forces.permute(1, 2, 3, 0).flatten(1, 2)).unflatten(1, (-1, 3))
    return at - moved.permute(3, 0, 1, 2).flatten(0, 1)


class _ShiftedHessian:
    """Factors of I + scale H on the free vertices of a batch, by the named linear solver."""

    def __init__(self, workspace: Workspace, linear_solver: str) -> None:
        p, k = workspace.potential, workspace.pattern
        self.linear, self._potential = workspace.linear_solver(linear_solver), p
        self._dofs = k.unknowns(p.device)
        self.assemble = HessianAssembly(p, self.linear, k)
        diagonal = self.linear.address[k.rows == k.cols][:, [0, 4, 8]].ravel()
        self._diagonal = torch.as_tensor(diagonal.astype(np.int64), device=p.device)

    def __call__(self, scale: float) -> Factor:
        """Returns the factor for the potential's last tangent."""
        values = scale * self.assemble()
        values[:, self._diagonal] += 1.0
        columns = self._potential.low_rank
        columns = None if columns is None else math.sqrt(scale) * columns[:, self._dofs]
        return self.linear.factor(values, columns=columns)
