"""Solutions with the factor of an earlier state, and when to make a new one.

The Hessian H of a state is solved by conjugate gradients, preconditioned with the factor of an
earlier Hessian that has rotated with the body (`corotation`). A factor takes as long as some 25
iterations. With k solutions of n_1, ..., n_k iterations since the last factor, a solution costs
(25 + n_1 + ... + n_k) / k iterations on average, which falls as long as the last one is below this
mean: the factor is replaced as soon as it is not.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ...kernels import vertex_rotations as kernels
from ..energies.launcher import warp_view
from ..energies.potential import IncrementalPotential
from ..fem.integration_points import SolidPoints
from ..linalg.conjugate_gradients import conjugate_gradients
from ..linalg.linear_solver import Factor, LinearSolver
from .assembly import HessianAssembly

_EXACT: Final = 1e-12  # relative accuracy
_MOST_ITERATIONS: Final = 40
_FACTOR: Final = 25  # iterations that take as long as a new factor


class Corotation:
    """Rotations of a batch since its last factors; none of vertices in symmetry planes.

    The Hessian of a body that has only been rotated is R H R^T, with the rotation R in the block of
    every vertex. With R of the mean deformation gradient around each vertex, R H^-1 R^T is close to
    the inverse also where a body bends: fewer iterations need the factor of an earlier state, and
    it lasts for longer.

    Args:
        potential: the potential, whose positions are used.
        vertices: (F,) vertices of the unknowns, in the order of the vectors.

    Attributes:
        vertices: these vertices, on the device.
    """

    def __init__(self, potential: IncrementalPotential, vertices: NDArray[np.int64]) -> None:
        p, shape = potential, (potential.batch, potential.n_vertices)
        self._potential, self.vertices = p, torch.as_tensor(vertices, device=p.device)
        self._sum, self._rotation = p.zeros(shape[1], 3, 3), p.zeros(shape[1], 3, 3)
        self._before, self._since = p.zeros(len(vertices), 3, 3), p.zeros(len(vertices), 3, 3)
        total, rotation, before, since = (
            warp_view(x, wp.mat33d) for x in (self._sum, self._rotation, self._before, self._since)
        )
        positions, commands = warp_view(p.positions, wp.vec3d), []
        solids = [
            (s, s.source)
            for s in p.sets
            if isinstance(s.source, SolidPoints) and s.source.shape_volume.nnz
        ]
        mean = sum(source.shape_volume.sum() / s.cells for s, source in solids) / max(
            1, len(solids)
        )
        for s, source in solids:
            volumes = np.asarray(source.shape_volume.sum(axis=1)).reshape(
                s.cells, s.points_per_cell
            )
            operators = p.upload(
                np.einsum("cq,cqki->cki", volumes / mean, source.gradients), wp.vec3d
            )
            gradient = warp_view(p.zeros(s.cells, 3, 3), wp.mat33d)
            commands += [
                p.record(
                    kernels.cell_gradients,
                    (p.batch, s.cells),
                    [s.points, operators, positions],
                    [gradient],
                ),
                p.record(
                    kernels.sum_at_vertices,
                    shape,
                    [s.start, s.incident, s.nodes_per_cell, gradient],
                    [total],
                ),
            ]
        slides = np.zeros(shape[1], dtype=np.int32)
        slides[p.coordinates.sliding.cpu().numpy()] = 1
        commands.append(
            p.record(kernels.rotation, shape, [p.upload(slides, int), total], [rotation])
        )
        inputs = [p.upload(vertices.astype(np.int32), int), before, rotation]
        self._compute = p.capture(*commands)
        self._compare = p.capture(
            p.record(kernels.rotation_since, (p.batch, len(vertices)), inputs, [since])
        )

    def record(self, active: torch.Tensor | None = None) -> None:
        """Records the rotations at the potential's positions as those of new factors of
        environments (B,), or all.
        """
        self._compute_rotations()
        now = self._rotation[:, self.vertices]
        active = torch.ones_like(now[:, 0, 0, 0], dtype=torch.bool) if active is None else active
        self._before.copy_(torch.where(active[:, None, None, None], now, self._before))
        self._since[active] = torch.eye(3, device=now.device, dtype=now.dtype)

    def update(self) -> None:
        """Computes the rotations from the factors' positions to the potential's."""
        self._compute_rotations()
        self._potential.launch(self._compare)

    def _compute_rotations(self) -> None:
        self._sum.zero_()
        self._potential.launch(self._compute)

    def rotate_back(self, vectors: torch.Tensor) -> None:
        """Rotates vectors (B, F, 3) back to the factors' positions, in place."""
        vectors.copy_((self._since.mT @ vectors[..., None].double())[..., 0])

    def rotate(self, vectors: torch.Tensor) -> None:
        """Rotates vectors (B, F, 3) with the body, in place."""
        vectors.copy_((self._since @ vectors[..., None].double())[..., 0])

    def solve_in_place(self, factor: Factor, right: torch.Tensor) -> None:
        """Overwrites right-hand sides (B, F, 3) with R H^-1 R^T of them, from the factor of H."""
        self.rotate_back(right)
        factor.solve_in_place(right.flatten(1))
        self.rotate(right)


class KeptFactor:
    """A factor that serves the Hessians of several states.

    Args:
        potential: the potential, at whose positions Hessians are solved.
        assembly: assembly of the Hessian.
        linear: linear solver of the factor.
        corotation: rotations of the vertices since the factor.
    """

    def __init__(
        self,
        potential: IncrementalPotential,
        assembly: HessianAssembly,
        linear: LinearSolver,
        corotation: Corotation,
    ) -> None:
        self._potential = potential
        self._assembly, self._linear = assembly, linear
        self._corotation = corotation
        self._factor: Factor | None = None
        # With this factor, which counts as `_FACTOR` iterations.
        self._solutions = self._iterations = 0

    def solve(self, rights: Sequence[torch.Tensor]) -> list[torch.Tensor] | None:
        """Returns solutions (B, N, 3) for right-hand sides,
        or None if the Hessian is not positive definite.

        Their last digits depend on which factor is kept, and so on earlier solutions.
        """
        self._potential.update_tangent()
        self._corotation.update()
        solutions = []
        for right in rights:
            size = right.flatten(1).norm(dim=1)[:, None, None]
            size = torch.where(size > 0.0, size, 1.0)  # residuals are rounded to float32
            solution = self._solved(right / size)
            if solution is None:
                return None
            solutions.append(solution * size)
        return solutions

    def _solved(self, right: torch.Tensor) -> torch.Tensor | None:
        for renews in (True,) if self._factor is None else (False, True):
            if renews and not self._renew():
                return None
            iterate = conjugate_gradients(
                self._product, self._precondition, right, _EXACT, _MOST_ITERATIONS
            )
            if bool(iterate.converged.all()):
                self._solutions += 1
                self._iterations += iterate.iterations
                if iterate.iterations * self._solutions > self._iterations:
                    self._factor = None
                return iterate.x
        self._factor = None
        return None

    def _renew(self) -> bool:
        """Returns whether the Hessian has a factor, which is kept."""
        factor = self._linear.direction_factor(self._assembly())
        self._factor = None if factor.failed.any() else factor
        self._corotation.record()
        self._solutions, self._iterations = 0, _FACTOR
        return self._factor is not None

    def _product(self, x: torch.Tensor) -> torch.Tensor:
        p = self._potential
        return p.restrict(p.stiffness_product(x) + p.inertia[..., None] * x)

    def _precondition(self, x: torch.Tensor) -> torch.Tensor:
        assert self._factor is not None
        unknowns = x[:, self._corotation.vertices]
        self._corotation.solve_in_place(self._factor, unknowns)
        return torch.zeros_like(x).index_copy_(1, self._corotation.vertices, unknowns)
