"""Follower pressure in closed chambers and on open faces.

The operators g_a of a surface point hold the shape functions of its face and their two reference
gradients, so that F = sum_a x_a g_a^T has the columns x, t1 and t2: position and tangents of the
deformed face. The enclosed volume is the sum of -w/3 x . (t1 x t2) = -w/3 det F, as the faces are
oriented into the chamber, and the potential of a gauge pressure p is -p V (Bonet and Wood 2008,
section 8.5.2).

Over open faces, V is the volume of the cone from a constant apex c, with x - c in place of x. Its
derivatives are the forces of the pressure, the sums of -w (t1 x t2) N_a, except at vertices of the
open edges, where they differ by an integral along the edges. That part does no work where the edges
are fixed, or slide in a symmetry plane through c, so that -p V is a potential there too. In the
reactions of fixed vertices it is corrected (`BoundPressure.load_at_fixed`). Verified in
tests/energies/test_open_faces.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from typing_extensions import override

from ...io.arrays import FloatArray
from ...io.errors import InputError, MeshError, check_fields
from ...kernels.follower_pressure import PRESSURE as PRESSURE_LAW
from ..fem.bodies import Body
from ..mesh.chambers import Chamber, check_chambers, check_open_faces, face_rule
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Quantity
from .base import BoundEnergy, Energy, EnergySite
from .launcher import Launcher
from .term import LawTerm, PartPoints, PointLaw, PointSet, Values, value_of

PRESSURE = Quantity(
    "pressure",
    "Pa",
    per="chamber",
    typical=1e4,
    words="pressure",
    shown_unit="kPa",
    shown_factor=1e-3,
)


@dataclass(frozen=True)
class Pressure(Energy):
    """-p V of every chamber, closed or open, with the gauge pressures
    as the input ``pressure`` [Pa].

    The edges of open faces must be fixed or lie in symmetry planes.

    Raises:
        InputError: no chamber.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (PRESSURE,)
    is_load: ClassVar[bool] = True

    chambers: Sequence[Chamber]  # closed surfaces (`mesh.chambers.find_chambers`), or open faces

    def __post_init__(self) -> None:
        """Checks that there is a chamber."""
        check_fields(self)
        if not self.chambers:
            raise InputError(
                "pressure acts in chambers, but there are none: find them with find_chambers."
            )

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
            MeshError: a chamber that is no surface of the mesh, or looks into the solid.
        """
        check_chambers(self.chambers, mesh)
        shape, (points, weights) = face_rule(self.chambers, 4)
        values, gradients = shape(points)
        nodes = np.concatenate([chamber.faces for chamber in self.chambers])
        operator = np.concatenate([values[..., None], gradients], axis=2)  # (Q, K, 3)
        operators = np.broadcast_to(operator, (len(nodes), *operator.shape)).copy()
        part = np.repeat(
            np.arange(self.count), [len(chamber.faces) * len(weights) for chamber in self.chambers]
        )
        return (PartPoints(nodes, operators, part, np.tile(weights / 3.0, len(nodes))),)

    def volumes(self, mesh: Mesh, positions: torch.Tensor) -> torch.Tensor:
        """Returns the volumes (B, chambers) at positions (B, N, 3)
        of the vertices of a mesh, differentiable [m^3].

        That of a closed chamber is what it encloses, that of open faces what they have swept on a
        straight way from rest. The pressure does the work p dV: dV/dx is its force per pressure,
        while open edges stay where they were.
        """
        (points,) = self.points(mesh)
        operators, weights = (
            torch.as_tensor(x).to(positions) for x in (points.gradients, points.weights)
        )
        nodes = torch.as_tensor(points.nodes)
        part = torch.as_tensor(points.part).to(positions.device)
        # (B, P, 3, 3)
        f = torch.einsum("cqkw,bcki->bcqiw", operators, positions[:, nodes]).flatten(1, 2)
        rest = torch.einsum(
            "cqkw,cki->cqiw", operators, torch.as_tensor(mesh.vertices).to(f)[nodes]
        ).flatten(0, 1)
        is_open = torch.tensor(
            [len(chamber.edges) > 0 for chamber in self.chambers], device=f.device
        )[part]
        ways = (f - rest)[..., 0]
        # Simpson's rule is exact
        areas = _normals(rest) + 4.0 * _normals(0.5 * (f + rest)) + _normals(f)
        swept = 0.5 * (ways * areas).sum(-1)
        parts = -weights * torch.where(is_open, swept, torch.linalg.det(f))
        return parts.new_zeros(len(parts), self.count).index_add(1, part, parts)

    @override
    def bind(self, site: EnergySite) -> "BoundPressure":
        return BoundPressure(self, site)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> LawTerm:
        shapes = {"pressure": (self.count,), "apex": (self.count, 3)}
        return LawTerm(launcher, sets, PointLaw(PRESSURE_LAW), shapes, self.count)


class BoundPressure(BoundEnergy):
    """Pressure in a simulator: apexes of the cones over open faces, and forces at open edges.

    Raises:
        MeshError: open faces that are not on the surface, or with an edge that can move.
    """

    energy: Pressure

    def __init__(self, energy: Pressure, site: EnergySite) -> None:
        super().__init__(energy, site)
        device, (points,) = site.rest_positions.device, site.points
        assert isinstance(points, PartPoints)
        apexes = np.array([_apex(chamber, site.body) for chamber in energy.chambers])
        edges = (
            np.unique(np.concatenate([chamber.edges.ravel() for chamber in energy.chambers]))
            + site.first
        )
        at_edge = np.isin(points.nodes, edges)
        touching = at_edge.any(axis=1)
        shape = points.gradients.shape[:2]
        self._apex, self._operators, self._weights = (
            torch.as_tensor(values, device=device, dtype=torch.float64)
            for values in (
                apexes,
                points.gradients[touching],
                points.weights.reshape(shape)[touching],
            )
        )
        self._nodes = torch.as_tensor(points.nodes[touching], device=device)
        self._part = torch.as_tensor(points.part.reshape(shape)[touching], device=device)
        self._at_edge = torch.as_tensor(at_edge[touching], device=device)

    @override
    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        return {"apex": self._apex[None]}

    @override
    def load_at_fixed(self, q: torch.Tensor, values: Values) -> torch.Tensor | None:
        """Returns the force of the pressure at the vertices of open edges,
        less the derivative of p V [N].

        A point of weight w (a third of the face's) has the force -3 w p a0 N_a and the derivative
        -w p cof F g_a, with the columns a0 = t1 x t2, a1 = t2 x (x - c) and a2 = (x - c) x t1 of
        cof F.
        """
        if not len(self._nodes):
            return None
        f = torch.einsum("cqkw,bcki->bcqiw", self._operators, q[:, self._nodes].double())
        x = f[..., 0] - self._apex[self._part]
        t1, t2 = f[..., 1], f[..., 2]
        columns = (
            2.0 * torch.linalg.cross(t1, t2),
            torch.linalg.cross(x, t2),
            torch.linalg.cross(t1, x),
        )
        push = -self._weights * value_of(values, "pressure").double()[:, self._part]
        forces = torch.einsum(
            "bcqiw,cqkw->bcki", push[..., None, None] * torch.stack(columns, -1), self._operators
        )
        forces = forces * self._at_edge[..., None]
        return torch.zeros_like(q).index_add(1, self._nodes.ravel(), forces.flatten(1, 2).to(q))


def _normals(f: torch.Tensor) -> torch.Tensor:
    """Returns the products t1 x t2 (..., 3) of the tangents of points."""
    return torch.linalg.cross(f[..., 1], f[..., 2])


def _apex(chamber: Chamber, body: Body) -> FloatArray:
    """Returns the apex (3,) of the cone over open faces [m]:
    in the symmetry planes of their edges, or the origin.

    Raises:
        MeshError: see `check_open_faces`; or two of the planes are parallel.
    """
    edges = chamber.edges
    if not len(edges):
        return np.zeros(3)
    sliding = [plane.contains(body.vertices[edges]).all(axis=1) for plane in body.symmetry]
    fixed = np.isin(edges, body.fixed_vertices).all(axis=1)
    check_open_faces(chamber, body.mesh, np.any([fixed, *sliding], axis=0))
    planes = [
        plane
        for plane, inside in zip(body.symmetry, sliding, strict=True)
        if (inside & ~fixed).any()
    ]
    if not planes:
        return np.zeros(3)
    normals = np.array([plane.normal for plane in planes])
    offsets = np.array([plane.offset for plane in planes])
    apex = np.linalg.lstsq(normals, offsets, rcond=None)[0]
    if not np.allclose(
        normals @ apex, offsets, rtol=0.0, atol=max(plane.tolerance for plane in planes)
    ):
        raise MeshError(
            f"{chamber.name} has open edges in symmetry planes that have no common point: leave "
            "one of the planes out, or fix the vertices of the edges there."
        )
    return np.asarray(apex)
