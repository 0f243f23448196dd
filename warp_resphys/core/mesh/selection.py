"""Vertices and faces in planes, slabs and boxes, and cells in boxes."""

from collections.abc import Sequence

import numpy as np

from ...io.arrays import IntArray
from ...io.errors import MeshError
from ...io.settings import parse
from .elements import ELEMENTS
from .place import Place
from .volume_mesh import Mesh, boundary_faces

Extent = float | Sequence[float]  # a coordinate, or a range of coordinates


def select_vertices(
    mesh: Mesh,
    x: Extent | None = None,
    y: Extent | None = None,
    z: Extent | None = None,
    tolerance: float = 1e-9,
) -> IntArray:
    """Returns the vertices (S,) in a plane, a slab or a box, sorted.

    Args:
        mesh: The mesh.
        x: A coordinate, or a range of coordinates [m].
        y: Likewise [m].
        z: Likewise [m].
        tolerance: Tolerance of the coordinates [m].

    Raises:
        InputError: an invalid coordinate.
        MeshError: No coordinate, or no vertex lies there.
    """
    return vertices_at(mesh, _place("select_vertices", tolerance, x=x, y=y, z=z))


def select_faces(
    mesh: Mesh,
    x: Extent | None = None,
    y: Extent | None = None,
    z: Extent | None = None,
    tolerance: float = 1e-9,
) -> IntArray:
    """Returns the faces (F, n) of the surface with all vertices in a plane,
    a slab or a box, as `boundary_faces`.

    Args:
        mesh: The mesh.
        x: A coordinate, or a range of coordinates [m].
        y: Likewise [m].
        z: Likewise [m].
        tolerance: Tolerance of the coordinates [m].

    Raises:
        InputError: an invalid coordinate.
        MeshError: No coordinate, or no face lies there.
    """
    return faces_at(mesh, _place("select_faces", tolerance, x=x, y=y, z=z))


def _place(function: str, tolerance: float, **coordinates: Extent | None) -> Place:
    values = {axis: np.asarray(at).tolist() for axis, at in coordinates.items() if at is not None}
    return parse(Place, {**values, "tolerance": tolerance}, function)


def vertices_at(mesh: Mesh, place: Place) -> IntArray:
    """Returns the vertices (S,) in a place, sorted.

    Raises:
        MeshError: the place has no coordinate, or no vertex lies there.
    """
    if not place.spans:
        raise MeshError("a selection of vertices needs at least one of the coordinates x, y and z")
    chosen = np.flatnonzero(place.holds(mesh.vertices))
    if not len(chosen):
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        axes = [*place.spans]
        there = ", ".join(
            f"{axis} from {low['xyz'.index(axis)]:g} to {high['xyz'.index(axis)]:g}"
            for axis in axes
        )
        first = "xyz".index(axes[0])
        tenth = 0.1 * (high[first] - low[first])
        raise MeshError(
            f"no vertex lies within {place.nearness:g} m of {place} m: the mesh reaches "
            f"{there} m; give a range for a face that is not flat, as in "
            f"{axes[0]}=[{low[first]:.3g}, {low[first] + tenth:.3g}], or a larger tolerance"
        )
    return chosen


def faces_at(mesh: Mesh, place: Place) -> IntArray:
    """Returns the faces (F, n) of the surface with all vertices in a place.

    Raises:
        MeshError: the place has no coordinate, or no vertex or face lies there.
    """
    faces = boundary_faces(mesh)
    faces = faces[np.isin(faces, vertices_at(mesh, place)).all(axis=1)]
    if not len(faces):
        raise MeshError(
            f"no face of the surface has all its vertices at {place} m: "
            "choose a place with whole faces"
        )
    return faces


def select_cells(
    mesh: Mesh,
    x: Sequence[float] = (-np.inf, np.inf),
    y: Sequence[float] = (-np.inf, np.inf),
    z: Sequence[float] = (-np.inf, np.inf),
) -> IntArray:
    """Returns the cells (S,) with centres in a box,
    given by a range of coordinates along each axis [m].

    Raises:
        MeshError: no cell lies there.
    """
    corners = mesh.cells[:, : ELEMENTS[mesh.element.linear].nodes]
    centres, box = mesh.vertices[corners].mean(axis=1), np.array([x, y, z], dtype=np.float64)
    chosen = ((centres >= box[:, 0]) & (centres <= box[:, 1])).all(axis=1)
    if not chosen.any():
        asked = ", ".join(
            f"{axis} from {low:g} to {high:g}" for axis, (low, high) in zip("xyz", box, strict=True)
        )
        ranges = zip("xyz", centres.min(axis=0), centres.max(axis=0), strict=True)
        there = ", ".join(f"{axis} from {low:g} to {high:g}" for axis, low, high in ranges)
        raise MeshError(
            f"no cell has its centre within {asked} m: those of the mesh reach {there} m"
        )
    return np.flatnonzero(chosen)
