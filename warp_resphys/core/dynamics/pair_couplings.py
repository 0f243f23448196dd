"""Second derivatives of pairs, such as those in contact, as matrices of the unknowns."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ...io.errors import InputError
from ...kernels.hessian_blocks import sum_blocks
from ..energies.launcher import warp_view
from ..energies.potential import IncrementalPotential
from ..energies.term import PairTangents
from ..linalg.coupling import Coupling, VertexCouplings, coordinates
from ..linalg.linear_solver import numbered

_MOST_VALUES: Final = 2**31 - 1  # Warp's offsets here are 32-bit.
_ROUNDED: Final = 8  # Numbers of vertices with couplings are rounded up to multiples of it.


class PairCouplings:
    """Assembles the second derivatives of pairs.

    Args:
        potential: the potential.
        free: (F,) free vertices.
    """

    def __init__(self, potential: IncrementalPotential, free: NDArray[np.int64]) -> None:
        self._potential = potential
        # Numbers of the free and, behind them, the dependent vertices; -1 for fixed ones.
        unknown, depends = torch.as_tensor(free, device=potential.device), potential.coordinates
        self._vertices = torch.cat([unknown, depends.dependent])
        self._place = torch.full((potential.n_vertices,), -1, device=potential.device)
        self._place[self._vertices] = torch.arange(len(self._vertices), device=potential.device)
        self._reduction: VertexCouplings | None = None
        if depends.depends:
            weights = depends.weights
            place = self._place[depends.controls].masked_fill(weights == 0.0, -1)
            itself = torch.full((len(unknown), place.shape[1]), -1, device=potential.device)
            itself[:, 0] = self._place[unknown]
            shares = torch.cat([(itself >= 0).to(weights), weights])
            self._reduction = VertexCouplings(torch.cat([itself, place]), shares)

    def __call__(self, parts: Sequence[PairTangents]) -> list[Coupling]:
        """Returns second derivatives of pairs as matrices of the unknowns,
        one for every environment with pairs.
        """
        if not parts:
            return []
        environment = torch.cat([part.environment for part in parts])
        nodes = self._place[torch.cat([part.nodes for part in parts])]
        blocks = torch.cat([part.blocks for part in parts])
        device, total = nodes.device, len(self._vertices)
        keys, local = torch.where(nodes < 0, -1, environment[:, None] * total + nodes).unique(
            return_inverse=True
        )
        fixed = int((keys < 0).sum())  # all fixed vertices have one key
        keys, local = keys[fixed:], local - fixed
        if not len(keys):
            return []
        row = keys // total
        count, at = numbered(row, self._potential.batch)
        # A size that depends on the environment alone, so that on a CPU it is bit for bit what it
        # is in another batch.
        sizes = -(-count // _ROUNDED) * _ROUNDED
        order = sizes.argsort(stable=True)
        squares = (3 * sizes[order]) ** 2
        first = torch.empty_like(sizes)
        first[order] = squares.cumsum(0) - squares
        rows = torch.stack([first[row], 3 * sizes[row], at], 1)
        columns = torch.where(local < 0, -1, at[local.clamp_min(0)])
        values = self._summed(blocks, local, rows, columns, int(squares.sum()))
        vertices = torch.full((len(sizes), int(sizes.max())), -1, device=device)
        vertices[row, at] = keys % total
        out, done = list[Coupling](), 0
        for size, number in zip(
            *(x.tolist() for x in sizes.unique(return_counts=True)), strict=True
        ):
            environments, m = order[sizes[order] == size], 3 * size
            if size:
                matrices = values[done : done + number * m * m].view(number, m, m)
                if self._reduction is None:
                    out.append(
                        Coupling(environments, coordinates(vertices[environments, :size]), matrices)
                    )
                else:
                    out += self._reduction.reduced(
                        environments, vertices[environments, :size], matrices
                    )
                done += number * m * m
        return out

    def _summed(
        self,
        blocks: torch.Tensor,
        local: torch.Tensor,
        rows: torch.Tensor,
        columns: torch.Tensor,
        size: int,
    ) -> torch.Tensor:
        """Returns the values of the matrices (``kernels.hessian_blocks.sum_blocks``).

        Args:
            blocks: (A, 12, 12) second derivatives of pairs.
            local: (A, 4) rows of their vertices, negative for those that are left out.
            rows: (R, 3) first value, size and number in its matrix, of every row.
            columns: (A, 4) numbers of their vertices in the matrices.
            size: number of values.

        Raises:
            InputError: more values than a kernel addresses.
        """
        if size > _MOST_VALUES:
            raise InputError(
                f"the matrices of contact have {size:.1e} numbers, beyond the {_MOST_VALUES:.1e} "
                "that a kernel addresses: take fewer environments, or coarser surfaces."
            )
        launcher, values = self._potential, blocks.new_zeros(size)
        entry = local.ravel().argsort(stable=True)
        start = torch.searchsorted(
            local.ravel()[entry], torch.arange(len(rows) + 1, device=local.device)
        )
        arrays = [(start, wp.int32), (entry, wp.int32), (rows, wp.vec3i), (columns, wp.vec4i)]
        inputs = [warp_view(array.to(torch.int32), kind) for array, kind in arrays]
        inputs.append(warp_view(blocks, wp.float64))
        launcher.launch(
            launcher.record(sum_blocks, (len(rows),), inputs, [warp_view(values, wp.float64)])
        )
        return values
