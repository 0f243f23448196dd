"""Beads in transparent silicone as markers: each moves
with the point of the cell that it is cast into.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from warp_resphys.core.mesh.surface import locate
from warp_resphys.core.mesh.volume_mesh import Mesh
from warp_resphys.data.markers import Markers
from warp_resphys.io.errors import InputError
from warp_resphys.io.settings import Positive


@dataclass(frozen=True)
class Beads(Markers):
    """Points inside cells, as weighted sums of the vertices of these."""

    vertices: torch.Tensor  # (m, K)
    weights: torch.Tensor  # (m, K) with sum one
    gradients: torch.Tensor  # (m, K, 3) derivatives of the weights by the place of the bead [1/m]

    @classmethod
    def bind(
        cls, mesh: Mesh, places: np.ndarray, labels: Sequence[str], largest_outside: Positive = 5e-4
    ) -> "Beads":
        """Returns beads at places (m, 3) on the undeformed body [m].

        Args:
            mesh: of the body.
            places: of the beads.
            labels: their m names.
            largest_outside: distance from the body up to which a bead is extrapolated [m].

        Raises:
            InputError: a bead is outside of the body.
        """
        found = locate(mesh, places)
        far = int(np.argmax(found.outside))
        if found.outside[far] > largest_outside:
            raise InputError(
                f"{labels[far]} is {1e3 * found.distance[far]:.2g} mm outside "
                "of the body: move the bead."
            )
        return cls(
            *map(torch.from_numpy, (mesh.cells[found.cells], found.weights, found.gradients))
        )

    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the beads (B, m, 3) for positions (B, N, 3) of the vertices [m]."""
        return torch.einsum("bmki,mk->bmi", positions[:, self.vertices], self.weights)

    def moved(self, by: torch.Tensor) -> "Beads":
        """Returns beads that were cast elsewhere by (m, 3) [m],
        since nobody knows their places exactly.
        """
        weights = self.weights + torch.einsum("mkj,mj->mk", self.gradients, by.to(self.weights))
        return replace(self, weights=weights)
