"""Block structure of the Hessian, and its assembly in the layout of a linear solver."""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ...kernels import hessian_blocks as kernels
from ..energies.launcher import warp_view
from ..energies.potential import IncrementalPotential
from ..fem.integration_points import Points
from ..linalg.linear_solver import LinearSolver


class BlockPattern:
    """Pairs of vertices coupled by the Hessian, and the cell blocks that contribute to each pair.

    Args:
        vertices: (N, 3) rest positions [m].
        eliminated: (H,) vertices that are not unknowns: the fixed and the dependent ones.
        sets: sets of points of all energies.
        sliding: (R,) vertices in symmetry planes.

    Attributes:
        free: (F,) vertices that are not fixed.
        rows: (E,) row of each block, an index into ``free``.
        cols: (E,) column of each block; ``rows >= cols``.
        start: (E + 1,) first entry of each block in ``contribution``.
        contribution: index of a cell block, or -1 - index for its transpose.
        diagonal_vertex: (E,) vertex of a diagonal block, else -1.
        offsets: first cell block of each point set.
        n_cell_blocks: number of cell blocks of all point sets.
        sliding_blocks: (T, 3) blocks of sliding vertices, and the projections of their row and
            column, or -1.
    """

    def __init__(
        self,
        vertices: NDArray[np.float64],
        eliminated: NDArray[np.int64],
        sets: Sequence[Points],
        sliding: Sequence[int] | NDArray[np.int64] = (),
    ) -> None:
        is_free = np.ones(len(vertices), dtype=bool)
        is_free[eliminated] = False
        self.free = np.flatnonzero(is_free)
        reduced = np.where(is_free, np.cumsum(is_free) - 1, -1)
        sources: list[NDArray[np.int64]] = []
        pairs: list[NDArray[np.int64]] = []
        self.offsets: list[int] = []
        self.n_cell_blocks = 0
        for points in sets:
            a, c = np.tril_indices(points.nodes.shape[1])
            pair = np.stack(
                [reduced[points.nodes[:, a]], reduced[points.nodes[:, c]]], axis=-1
            ).reshape(-1, 2)
            # Padded nodes have a zero gradient.
            used = np.abs(points.gradients).sum(axis=(1, 3)) > 0.0
            keep = (pair >= 0).all(axis=1) & (used[:, a] & used[:, c]).ravel()
            sources.append(self.n_cell_blocks + np.flatnonzero(keep))
            pairs.append(pair[keep])
            self.offsets.append(self.n_cell_blocks)
            self.n_cell_blocks += len(pair)
        self._collect(np.concatenate(sources), np.concatenate(pairs))
        projection = np.full(len(vertices), -1)
        projection[np.asarray(sliding, dtype=np.int64)] = np.arange(len(sliding))
        ends = projection[self.free][np.stack([self.rows, self.cols], axis=1)]
        touched = np.flatnonzero((ends >= 0).any(axis=1))
        self.sliding_blocks = np.column_stack([touched, ends[touched]])

    def unknowns(self, device: torch.device) -> torch.Tensor:
        """Returns the indices (3 F,) of the free coordinates."""
        free = torch.as_tensor(self.free, device=device)
        return (3 * free[:, None] + torch.arange(3, device=device)).reshape(-1)

    def _collect(self, source: NDArray[np.int64], pair: NDArray[np.int64]) -> None:
        """Sorts the cell blocks by matrix block; blocks above the diagonal are transposed."""
        n = len(self.free)
        source = np.where(pair[:, 0] < pair[:, 1], -1 - source, source)
        diagonal = np.arange(n) * (n + 1)
        key = pair.max(axis=1) * n + pair.min(axis=1)
        blocks, inverse = np.unique(np.concatenate([key, diagonal]), return_inverse=True)
        order = np.argsort(inverse[: len(key)], kind="stable")
        self.rows, self.cols = blocks // n, blocks % n
        self.contribution = source[order]
        self.start = np.searchsorted(inverse[: len(key)][order], np.arange(len(blocks) + 1))
        self.diagonal_vertex = np.where(self.rows == self.cols, self.free[self.rows], -1)


class HessianAssembly:
    """Recorded launches from the tangent of a potential to the value array of a linear solver.

    Attributes:
        launches: launches that set ``values`` in the environments of the potential's
            ``tangent_active``.
        values: (B, n_values).
    """

    def __init__(
        self, potential: IncrementalPotential, solver: LinearSolver, pattern: BlockPattern
    ) -> None:
        p = potential
        self._potential = p
        active = warp_view(p.tangent_active, wp.int32)
        blocks = p.zeros(pattern.n_cell_blocks, 3, 3)
        self.values = torch.zeros(p.batch, solver.n_values, device=p.device, dtype=solver.dtype)
        self._overwritten = solver.overwrites
        commands = []
        for s, tangent, offset in zip(p.sets, p.tangents, pattern.offsets, strict=True):
            inputs = [active, s.points, warp_view(tangent, wp.mat33d)]
            kernel, threads = kernels.cell_blocks, s.nodes_per_cell
            if p.by_cells or s.width == 1:
                pairs = np.stack(np.tril_indices(s.nodes_per_cell), axis=1).astype(np.int32)
                kernel, threads = kernels.pair_kernel(s.width), len(pairs)
                inputs.append(p.upload(pairs, int))
            out = [warp_view(blocks, wp.mat33d)]
            commands.append(p.record(kernel, (p.batch, s.cells, threads), [*inputs, offset], out))
        inputs = [
            active,
            p.upload(pattern.start.astype(np.int32), int),
            p.upload(pattern.contribution.astype(np.int32), int),
            p.upload(pattern.diagonal_vertex.astype(np.int32), int),
            p.upload(solver.address, int),
            warp_view(blocks, wp.mat33d),
            warp_view(p.terms.inertia, wp.float64),
        ]
        dim = (p.batch, len(pattern.rows))
        scalar = wp.float64 if solver.dtype == torch.float64 else wp.float32
        values = warp_view(self.values, scalar)
        commands.append(p.record(kernels.scatter_kernel(scalar), dim, inputs, [values]))
        count = len(pattern.sliding_blocks)
        if count:
            projected = p.upload(pattern.sliding_blocks.astype(np.int32), int)
            planes = warp_view(p.coordinates.projections, wp.mat33d)
            inputs = [active, projected, planes, p.upload(solver.address, int)]
            commands.append(
                p.record(kernels.projection_kernel(scalar), (p.batch, count), inputs, [values])
            )
        self.launches = p.capture(*commands)

    def __call__(self) -> torch.Tensor:
        """Returns the values (B, n_values) for the potential's last `update_tangent`.

        The next call overwrites them.
        """
        p = self._potential
        if self._overwritten and p.all_active:
            self.values.zero_()
        elif self._overwritten:
            self.values.masked_fill_(p.tangent_active.bool()[:, None], 0.0)
        p.launch(self.launches)
        return self.values
