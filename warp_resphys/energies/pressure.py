"""Follower pressure in closed chambers.

The operators g_a of a surface point hold the shape functions of its face and their two reference gradients, so that
F = sum_a x_a g_a^T has the columns x, t1 and t2: position and tangents of the deformed face. The enclosed volume is the
sum of -w/3 x . (t1 x t2) = -w/3 det F, as the faces are oriented into the chamber, and the potential of a gauge
pressure p is -p V (Bonet and Wood 2008, section 8.5.2).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from typing_extensions import override

from ..io.errors import InputError
from ..kernels.follower_pressure import PRESSURE as PRESSURE_LAW
from ..mesh.chambers import Chamber, check_chambers, face_rule
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Quantity
from .base import Energy
from .launcher import Launcher
from .term import LawTerm, PartPoints, PointSet

PRESSURE = Quantity(
    *("pressure", "Pa"), per="chamber", typical=1e4, words="pressure", shown_unit="kPa", shown_factor=1e-3
)


@dataclass(frozen=True)
class Pressure(Energy):
    """-p V of every chamber, with the gauge pressures as the input ``pressure`` [Pa].

    Raises:
        InputError: no chamber.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (PRESSURE,)
    is_load: ClassVar[bool] = True

    chambers: Sequence[Chamber]  # closed surfaces (`mesh.chambers.find_chambers`)

    def __post_init__(self) -> None:
        """Checks that there is a chamber."""
        if not self.chambers:
            raise InputError("pressure acts in chambers, but there are none: find them with find_chambers.")

    @property
    @override
    def count(self) -> int:
        return len(self.chambers)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(chamber.name for chamber in self.chambers)

    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns points at which the volume of the chambers is integrated exactly.

        Raises:
            MeshError: an open chamber.
        """
        check_chambers(self.chambers, mesh)
        shape, (points, weights) = face_rule(self.chambers, 4)
        values, gradients = shape(points)
        nodes = np.concatenate([chamber.faces for chamber in self.chambers])
        operator = np.concatenate([values[..., None], gradients], axis=2)  # (Q, K, 3)
        operators = np.broadcast_to(operator, (len(nodes), *operator.shape)).copy()
        part = np.repeat(np.arange(self.count), [len(chamber.faces) * len(weights) for chamber in self.chambers])
        return (PartPoints(nodes, operators, part, np.tile(weights / 3.0, len(nodes))),)

    def volumes(self, mesh: Mesh, positions: torch.Tensor) -> torch.Tensor:
        """Returns the volumes (B, chambers) at positions (B, N, 3) of the vertices of a mesh, differentiable [m^3].

        A volume is minus the derivative of the energy by the pressure.
        """
        (points,) = self.points(mesh)
        operators, weights = (torch.as_tensor(x).to(positions) for x in (points.gradients, points.weights))
        f = torch.einsum("cqkw,bcki->bcqiw", operators, positions[:, torch.as_tensor(points.nodes)])
        parts = -torch.linalg.det(f).flatten(1) * weights
        return parts.new_zeros(len(parts), self.count).index_add(1, torch.as_tensor(points.part).to(f.device), parts)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> LawTerm:
        return LawTerm(launcher, sets, PRESSURE_LAW, {"pressure": (self.count,)}, self.count)
