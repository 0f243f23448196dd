"""A step's residual and its exact derivative at any positions, for methods that solve it in their own way."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray

from ..energies.potential import StepTerms
from ..fem.coordinates import DeviceCoordinates
from ..linalg.linear_solver import Factor
from ..linalg.sparse import SparseSolver
from ..stepping.state import ImplicitStage, State
from .assembly import HessianAssembly
from .equilibrium import Workspace


class Linearisation:
    """The residual g(x) of a step and its Hessian H = dg/dx.

    It works on the buffers of a batch, and holds until the simulator is asked for something else for that batch.

    Args:
        workspace: of the batch.
        terms: of the step.
        stage: of the integrator.
        fixed_positions: (B, D, 3) where the fixed vertices are at the stage [m].
        coordinates: of the body; forces on vertices that others determine act on these, and displacements follow.
        finish: the state that a solution x leads to.
        linear_solver: which one factorises H.

    Attributes:
        stage: how x belongs to the step.
        start: (B, N, 3) where inertia alone takes the free vertices, and where the fixed ones are [m].
        finish: see above.
        free: (F,) free vertices.
    """

    def __init__(
        self,
        workspace: Workspace,
        terms: StepTerms,
        stage: ImplicitStage,
        fixed_positions: torch.Tensor,
        coordinates: DeviceCoordinates,
        finish: Callable[[torch.Tensor], State],
        linear_solver: str,
    ) -> None:
        self.stage, self.finish, self._workspace, self._name = stage, finish, workspace, linear_solver
        self._fixed_positions, self._coordinates, self._terms = fixed_positions, coordinates, terms
        self.start = self.hold(stage.target)
        self._potential = workspace.potential
        self._potential.set_terms(terms)
        self.free = torch.as_tensor(workspace.pattern.free, device=self._potential.device)

    def hold(self, x: torch.Tensor) -> torch.Tensor:
        """Returns x with the fixed vertices where they are, and those that others determine where these put them."""
        return self._coordinates.expand(x.index_copy(1, self._workspace.fixed, self._fixed_positions))

    def residual(self, x: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) g at x [N], zero at fixed vertices: the force that the step lacks to end there."""
        self._potential.positions.copy_(x)
        self._potential.evaluate()
        return self._potential.residual.clone()

    def factorise(self, x: torch.Tensor) -> None:
        """Makes H ready for `solve` and `product` at x (B, N, 3) [m]."""
        self._potential.positions.copy_(x)
        self._workspace.hessian(self._name).refactor_exact()

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """(B, 3 N, m) solutions of H y = r for (B, 3 N, m) right-hand sides; zero at fixed vertices."""
        fields = self._coordinates.reduce(right.unflatten(1, (-1, 3)))
        solution = self._workspace.hessian(self._name).solve(fields.flatten(1, 2))
        return self._coordinates.expand(solution.unflatten(1, (-1, 3))).flatten(1, 2)

    def update(self, x: torch.Tensor) -> None:
        """Makes H ready for `product` and `shifted` at x, without a factor."""
        self._potential.positions.copy_(x)
        self._potential.update_tangent()

    def product(self, direction: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) H d on the free vertices [N]."""
        p = self._potential
        return (p.stiffness_product(direction) + p.inertia[..., None] * direction) * p.free_mask[:, None]

    def shifted(self, scale: float) -> Factor:
        """A factor of I + scale H on the free vertices; H is clamped where that is not positive definite."""
        w, name = self._workspace, self._name
        shift = w.once(("shifted", name), lambda: _ShiftedHessian(w, name))
        factor = shift(scale)
        if factor.failed.any():
            self._potential.update_tangent(torch.as_tensor(factor.failed, device=self._potential.device))
            factor = shift(scale)
            self._potential.update_tangent()
        return factor

    def matrix(self, x: torch.Tensor) -> tuple[scipy.sparse.csc_array, NDArray[np.float64]]:
        """(3 F, 3 F) H of the first environment on the free vertices, and (3 F,) the inertia in its diagonal [N/m]."""
        p, pattern = self._potential, self._workspace.pattern
        self.update(x)
        solver = SparseSolver(pattern.rows, pattern.cols, len(pattern.free), 3, p.device, torch.float64)
        entries = solver.mirrored(HessianAssembly(p, solver, pattern)())[0]
        matrix = solver.matrix(entries)
        if p.low_rank is not None:
            columns = p.low_rank[0].view(p.n_vertices, 3, -1)[self.free].flatten(0, 1)
            columns = scipy.sparse.csc_array(columns.cpu().numpy())
            matrix = scipy.sparse.csc_array(matrix + columns @ columns.T)
        return matrix, np.repeat(p.inertia[0].cpu().numpy()[pattern.free], 3)

    def inertia_matrix(self, x: torch.Tensor) -> scipy.sparse.csc_array:
        """Returns the part (3 F, 3 F) of H that is inertia [N/m], that of rigid parts and glued vertices included."""
        whole, diagonal = self.matrix(x)
        if not len(self._coordinates.dependent):
            return scipy.sparse.csc_array(scipy.sparse.diags_array(diagonal))
        still = {n: v * 0.0 if v is not None and n.endswith("inertia") else v for n, v in self._terms.values.items()}
        self._potential.set_terms(replace(self._terms, inertia=0.0 * self._terms.inertia, values=still))
        elastic, _ = self.matrix(x)
        self._potential.set_terms(self._terms)
        return scipy.sparse.csc_array(whole - elastic)


class _ShiftedHessian:
    """Factors of I + scale H on the free vertices of a batch.

    Args:
        workspace: of the batch.
        linear_solver: which one factorises.
    """

    def __init__(self, workspace: Workspace, linear_solver: str) -> None:
        p, k = workspace.potential, workspace.pattern
        self._linear, self._potential = workspace.linear_solver(linear_solver), p
        self._dofs = k.unknowns(p.device)
        self._assemble = HessianAssembly(p, self._linear, k)
        diagonal = self._linear.address[k.rows == k.cols][:, [0, 4, 8]].ravel()
        self._diagonal = torch.as_tensor(diagonal.astype(np.int64), device=p.device)

    def __call__(self, scale: float) -> Factor:
        """The factor at the potential's last tangent."""
        values = scale * self._assemble()
        values[:, self._diagonal] += 1.0
        columns = self._potential.low_rank
        columns = None if columns is None else math.sqrt(scale) * columns[:, self._dofs]
        return self._linear.factor(values, columns=columns)
