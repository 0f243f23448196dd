"""Surfaces of a body on which pressure acts: closed chambers, and open faces; open cavities."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ...io.arrays import FloatArray
from ...io.errors import MeshError
from ...io.kernel_cache import ensure_kernel_cache, start_quietly
from ...kernels.contact.signed_distances import blocked
from ...kernels.modules import shareable
from .elements import FACES, Rule, Shape
from .volume_mesh import Mesh, boundary_faces, boundary_triangles, connected_parts, face_triangles

# Chambers with centres closer than this along the axis, over the body's length, are side by side.
_SAME_HEIGHT = 0.05
_DIRECTIONS = 24  # rays per triangle, over the hemisphere of its normal
_HIDDEN = 0.2  # fraction of unobstructed rays below which a triangle is inside a cavity
_LEAST_AREA = 0.01  # smallest area of a cavity, over that of the outer surface
# Distance of a ray's start from the surface, over the diagonal of the mesh; beyond float32's
# rounding.
_LIFT = 1e-5

ensure_kernel_cache()  # before Warp is first used


@dataclass(frozen=True, eq=False)
class Chamber:
    """A surface under pressure: a closed one inside a body (`find_chambers`),
    or open faces (`select_faces`).
    """

    name: str  # name in results and messages
    # (F, 3 | 4 | 6 | 8 | 9) vertices of the faces as from `boundary_faces`, counter-clockwise seen
    # from outside the solid, that is, from the side of the pressure
    faces: NDArray[np.int64]

    @property
    def vertices(self) -> NDArray[np.int64]:
        """(S,) vertices of the faces, sorted."""
        return np.unique(self.faces)

    @property
    def edges(self) -> NDArray[np.int64]:
        """(E, 2 | 3) vertices of the edges that belong to one face alone, ends first.

        None if the surface is closed.
        """
        corners = FACES[self.faces.shape[1]].corners
        ends, middles = self.faces[:, :corners], self.faces[:, corners : 2 * corners]
        nodes = [ends, np.roll(ends, -1, axis=1), *([middles] if middles.shape[1] else [])]
        edges = np.stack(nodes, axis=-1).reshape(-1, len(nodes))
        count = int(self.faces.max(initial=0)) + 1
        ahead, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
        return edges[~np.isin(ahead, back)]


def face_rule(chambers: Sequence[Chamber], degree: int) -> tuple[Shape, Rule]:
    """Returns shape functions of the faces, and a rule exact
    for linear faces and a degree on quadratic ones.
    """
    face = FACES[chambers[0].faces.shape[1]]
    return face.shape, face.rule(degree)


def find_chambers(mesh: Mesh, axis: Sequence[float] = (0.0, 0.0, -1.0)) -> tuple[Chamber, ...]:
    """Returns the closed inner components of a body's boundary, in a fixed order.

    A component is a chamber if its faces enclose a negative volume with the solid's orientation. A
    cavity that is open to the outside is part of the outer surface and not a chamber.

    Chambers are named ``chamber_1`` and so on, ordered along the axis, which points from the
    clamped end along the body; chambers side by side are ordered by their angle about it,
    counter-clockwise looking against the axis, from the x direction (y if the axis is x).
    """
    faces = boundary_faces(mesh)
    owner = connected_parts(faces)
    corners = mesh.vertices[face_triangles(faces)] - mesh.vertices.mean(axis=0)
    signed = np.linalg.det(corners).reshape(len(faces), -1).sum(axis=1)
    volumes = np.bincount(owner, weights=signed)
    inner = [faces[owner == i] for i in np.flatnonzero(volumes < 0.0)]
    order = _along(mesh, inner, np.asarray(axis, dtype=np.float64)) if inner else []
    return tuple(Chamber(f"chamber_{number}", inner[i]) for number, i in enumerate(order, start=1))


def outer_surface(mesh: Mesh, axis: Sequence[float] = (0.0, 0.0, -1.0)) -> Chamber:
    """Returns the faces of a body's boundary that look away
    from its middle line along an axis, as ``outside``.
    """
    faces, along = boundary_faces(mesh), np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    inner = [chamber.faces[:, 0] for chamber in find_chambers(mesh, axis)]
    faces = faces[~np.isin(faces[:, 0], np.concatenate([*inner, faces[:0, 0]]))]
    shape, (points, _) = face_rule([Chamber("outside", faces)], 2)
    tangents = np.einsum("fki,qkj->jfqi", mesh.vertices[faces], shape(points)[1]).mean(axis=2)
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    away = mesh.vertices[faces].mean(axis=1) - middle
    away -= np.outer(away @ along, along)
    return Chamber(
        "outside", faces[(np.cross(*tangents) * away).sum(axis=1) > 1e-9 * np.abs(away).max() ** 3]
    )


def _along(
    mesh: Mesh, surfaces: Sequence[NDArray[np.int64]], axis: NDArray[np.float64]
) -> list[int]:
    """Returns the order of surfaces along and about an axis."""
    along = axis / np.linalg.norm(axis)
    across = np.eye(3)[0 if abs(along[0]) < 0.9 else 1]
    across = across - (across @ along) * along
    across /= np.linalg.norm(across)
    centres = np.array([mesh.vertices[np.unique(faces)].mean(axis=0) for faces in surfaces])
    heights = centres @ along
    offset = centres - 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    angles = np.arctan2(offset @ np.cross(-along, across), offset @ across)
    angles = np.where(angles < -1e-2, angles + 2.0 * np.pi, angles)
    same = _SAME_HEIGHT * float(np.ptp(mesh.vertices @ along))
    level = np.zeros(len(centres), dtype=np.int64)
    by_height = np.argsort(heights, kind="stable")
    steps = np.diff(heights[by_height]) > same
    level[by_height[1:]] = np.cumsum(steps)
    return [int(i) for i in np.lexsort((angles, level))]


def check_chambers(chambers: Sequence[Chamber], mesh: Mesh) -> None:
    """Checks that chambers are surfaces of a mesh, correctly oriented
    if closed (open ones: `check_open_faces`).

    Raises:
        MeshError: a chamber without faces, with vertices that the mesh does not have, with wrong
            orientation, or with a face of another chamber.
    """
    owners: dict[frozenset[int], str] = {}
    for chamber in chambers:
        faces = chamber.faces
        if not len(faces):
            raise MeshError(f"{chamber.name} has no faces: name the surface that bounds it.")
        if faces.min() < 0 or faces.max() >= len(mesh.vertices):
            raise MeshError(
                f"{chamber.name} has faces of vertices that the mesh does not have: "
                "take both from one file."
            )
        triangles = face_triangles(faces)
        volume = (
            -float(np.linalg.det(mesh.vertices[triangles] - mesh.vertices[triangles[0, 0]]).sum())
            / 6.0
        )
        if volume <= 0.0 and not len(chamber.edges):
            raise MeshError(
                f"the faces of {chamber.name} look into the solid, or it is the outer surface of "
                "the body: list the vertices of each face counter-clockwise "
                "as seen from inside the chamber."
            )
        for face in map(frozenset, faces.tolist()):
            other = owners.setdefault(face, chamber.name)
            if other != chamber.name:
                raise MeshError(
                    f"{chamber.name} and {other} share a face: every face belongs to one chamber."
                )


def check_open_faces(chamber: Chamber, mesh: Mesh, held: NDArray[np.bool_]) -> None:
    """Checks that open faces look out of the solid,
    and that their pressure has a potential: their edges are held.

    Args:
        chamber: with edges.
        mesh: of the body.
        held: (E,) whether an edge is fixed, or stays in a symmetry plane.

    Raises:
        MeshError: a face that is not on the surface of the body, or an edge that can move.
    """
    surface = {*map(tuple, _from_lowest(boundary_faces(mesh)).tolist())}
    inner = [
        face for face in map(tuple, _from_lowest(chamber.faces).tolist()) if face not in surface
    ]
    if inner:
        raise MeshError(
            f"{len(inner)} of the {len(chamber.faces)} faces of {chamber.name} look into the "
            "solid, or are not on the surface of the body: take faces from select_faces, "
            "read_surfaces or boundary_faces."
        )
    if not held.all():
        where = ", ".join(
            f"{1e3 * x:.1f}" for x in mesh.vertices[chamber.edges[~held][0]].mean(axis=0)
        )
        raise MeshError(
            f"{chamber.name} has {int((~held).sum())} open edges that can move, one of them at "
            f"({where}) mm: close the surface, fix the vertices of its edges, or let these lie "
            "in symmetry planes, as pressure has no potential otherwise."
        )


def _from_lowest(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the corners of faces, each from that of the lowest number on."""
    corners = faces[:, : FACES[faces.shape[1]].corners]
    order = corners.argmin(axis=1)[:, None] + np.arange(corners.shape[1])
    return np.take_along_axis(corners, order % corners.shape[1], axis=1)


@dataclass(frozen=True)
class OpenCavity:
    """A part of the outer surface with mostly obstructed view of the outside."""

    centre: FloatArray  # (3,) area-weighted centre [m]
    area: float  # [m^2]


def open_cavities(mesh: Mesh) -> list[OpenCavity]:
    """Finds deep hollows in the outer surface, such
    as a chamber with a hole in its wall or without an end.

    Rays in uniformly distributed directions start from the centre of each triangle; if few of them
    leave the body without hitting it, the triangle is hidden. Connected hidden triangles form a
    cavity. Largest cavities come first.
    """
    triangles = boundary_triangles(mesh)
    inner = [chamber.vertices for chamber in find_chambers(mesh)]
    outer = triangles[~np.isin(triangles[:, 0], np.concatenate(inner))] if inner else triangles
    corners = mesh.vertices[outer]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centres = corners.mean(axis=1)
    sizes = np.linalg.norm(normals, axis=1)
    normals /= sizes[:, None]
    starts = centres + _LIFT * np.linalg.norm(np.ptp(mesh.vertices, axis=0)) * normals
    directions = _half_sphere(normals).reshape(-1, 3)
    start_quietly()
    with shareable():
        rays: list[Any] = [
            wp.array(vectors, dtype=wp.vec3, device="cpu")
            for vectors in (np.repeat(starts, _DIRECTIONS, axis=0), directions)
        ]
        points: Any = wp.array(mesh.vertices, dtype=wp.vec3, device="cpu")
        surface = wp.Mesh(points, wp.array(outer.ravel(), dtype=int, device="cpu"))
        hits: Any = wp.zeros(len(directions), dtype=float, device="cpu")
        wp.launch(blocked, len(directions), [surface.id, *rays], [hits], device="cpu")
    hidden = np.flatnonzero(1.0 - hits.numpy().reshape(-1, _DIRECTIONS).mean(axis=1) < _HIDDEN)
    parts, cavities = connected_parts(outer[hidden]), []
    for members in (hidden[parts == part] for part in np.unique(parts)):
        if sizes[members].sum() >= _LEAST_AREA * sizes.sum():
            centre = np.average(centres[members], axis=0, weights=sizes[members])
            cavities.append(OpenCavity(centre, 0.5 * float(sizes[members].sum())))
    return sorted(cavities, key=lambda cavity: -cavity.area)


def _half_sphere(normals: FloatArray) -> FloatArray:
    """Unit vectors (T, D, 3), uniformly distributed over the hemisphere of each normal (T, 3)."""
    heights = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    angles = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(_DIRECTIONS)  # golden spiral
    local = np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.sqrt(1.0 - heights**2)[:, None]
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first)], axis=1)  # (T, 2, 3)
    return np.asarray(np.einsum("dk,tkj->tdj", local, axes) + heights[:, None] * normals[:, None])
