"""Rotations of the vertices since a factor of the Hessian, which make it one of the present state.

The Hessian of a body that has only been rotated is R H R^T, with the rotation R in the block of every vertex. With R of
the mean deformation gradient around each vertex, R H^-1 R^T is close to the inverse also where a body bends: fewer
iterations need the factor of an earlier state, and it lasts for longer.
"""

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..energies.launcher import warp_view
from ..energies.potential import IncrementalPotential
from ..fem.integration_points import SolidPoints
from ..kernels import vertex_rotations as kernels
from ..linalg.linear_solver import Factor


class Corotation:
    """Rotations of a batch since its last factors; none of vertices in symmetry planes.

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
        solids = [(s, s.source) for s in p.sets if isinstance(s.source, SolidPoints) and s.source.shape_volume.nnz]
        mean = sum(source.shape_volume.sum() / s.cells for s, source in solids) / max(1, len(solids))
        for s, source in solids:
            volumes = np.asarray(source.shape_volume.sum(axis=1)).reshape(s.cells, s.points_per_cell)
            operators = p.upload(np.einsum("cq,cqki->cki", volumes / mean, source.gradients), wp.vec3d)
            gradient = warp_view(p.zeros(s.cells, 3, 3), wp.mat33d)
            commands += [
                p.record(kernels.cell_gradients, (p.batch, s.cells), [s.points, operators, positions], [gradient]),
                p.record(kernels.sum_at_vertices, shape, [s.start, s.incident, s.nodes_per_cell, gradient], [total]),
            ]
        slides = np.zeros(shape[1], dtype=np.int32)
        slides[p.coordinates.sliding.cpu().numpy()] = 1
        commands.append(p.record(kernels.rotation, shape, [p.upload(slides, int), total], [rotation]))
        inputs = [p.upload(vertices.astype(np.int32), int), before, rotation]
        self._compute = p.capture(*commands)
        self._compare = p.capture(p.record(kernels.rotation_since, (p.batch, len(vertices)), inputs, [since]))

    def record(self, active: torch.Tensor | None = None) -> None:
        """Records the rotations at the potential's positions as those of new factors of environments (B,), or all."""
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
