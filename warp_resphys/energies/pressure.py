"""Follower pressure in closed chambers.

A point of a chamber's surface has an operator g_a for each node of its face that holds the shape function and its two
reference gradients, so that F = sum_a x_a g_a^T has the columns x, t1 and t2, the place and the tangents of the
deformed face. The enclosed volume is the sum of -w/3 x . (t1 x t2) = -w/3 det F, as the faces look into the chamber,
and the potential of a gauge pressure p is -p V (Bonet and Wood 2008, section 8.5.2).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from ..io.errors import InputError
from ..kernels import pressure as kernels
from ..mesh.chambers import Chamber, check_chambers, face_rule
from ..mesh.mesh import Mesh
from ..stepping.quantity import Quantity
from .base import Energy, PartPoints, PartTerm, PointSet, Values
from .launcher import Launcher, warp_view

PRESSURE = Quantity(
    *("pressure", "Pa"), per="chamber", typical=1e4, words="pressure", shown_unit="kPa", shown_factor=1e-3
)


@dataclass(frozen=True)
class Pressure(Energy):
    """-p V of every chamber; its input ``pressure`` has a gauge pressure [Pa] for each.

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
        """The points at which the volume of the chambers is integrated, exactly.

        Raises:
            MeshError: an open chamber.
        """
        check_chambers(self.chambers, mesh)
        shape, (points, weights) = face_rule(self.chambers, 4)
        values, gradients = shape(points)
        nodes = np.concatenate([chamber.faces for chamber in self.chambers])
        operator = np.concatenate([values[..., None], gradients], axis=2)  # (Q, K, 3)
        everywhere = np.broadcast_to(operator, (len(nodes), *operator.shape)).copy()
        owner = np.repeat(np.arange(self.count), [len(chamber.faces) * len(weights) for chamber in self.chambers])
        return (PartPoints(nodes, everywhere, owner, np.tile(weights / 3.0, len(nodes))),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "PressureTerm":
        return PressureTerm(launcher, sets, "pressure", self.count)


class PressureTerm(PartTerm):
    """Kernels of pressure."""

    @override
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        surface = [s.nodes, s.gradients, self.weights, self.part]
        return kernels.local_step, [*surface, *self.views(values), s.points_per_cell, positions]

    @override
    def tangent(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        return kernels.tangent, self.step(s, values, positions)[1]

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        return torch.zeros_like(self.weight)[None]

    @override
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        del values
        own, (s,) = self.launcher, self.sets
        out = own.zeros(self.n_points)
        views = [warp_view(vectors, wp.vec3d) for vectors in (positions, direction)]
        inputs = [s.nodes, s.gradients, self.weights, s.points_per_cell, *views]
        command = own.record(kernels.adjoint, (own.batch, s.n_points), inputs, [warp_view(out, wp.float64)])

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(command)
            return {self.value: self.sum_parts(out)}

        return differentiate
