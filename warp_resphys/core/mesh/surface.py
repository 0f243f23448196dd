"""Closest points on a body's surface, signed distances, and cells that contain points."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...io.arrays import FloatArray, IntArray
from ...io.errors import InputError
from .elements import Array, Element
from .volume_mesh import Mesh, boundary_triangles

_TIE = 1e-9  # difference up to which triangles are equally close, over the diagonal of the mesh
_CANDIDATES = 16  # triangles that are tried first for a point
_PAIRS = 200_000  # of points and triangles that are compared at once
_ITERATIONS = 20
_CELLS = 12  # smallest number searched for a point
_TOGETHER = 256  # points located at the same time


@dataclass(frozen=True)
class ClosestPoints:
    """Closest surface points of P points."""

    triangles: (
        IntArray  # (P, 3) vertices of the closest triangle, counter-clockwise seen from outside
    )
    points: FloatArray  # (P, 3) closest point on that triangle [m]
    normals: FloatArray  # (P, 3) outer unit normal of the triangle
    distances: FloatArray  # (P,) signed distance, negative inside the body [m]


def closest_points(mesh: Mesh, points: FloatArray) -> ClosestPoints:
    """Finds the closest points on the boundary of the rest shape.

    Faces are split into triangles (`face_triangles`). Of triangles that share the closest edge, the
    one whose plane is farthest from the point is used.

    Raises:
        InputError: A point of (P, 3) [m] is not finite.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("A point whose closest point on a surface is needed is not finite.")
    return closest_of(boundary_triangles(mesh), mesh.vertices, points)


def closest_of(
    triangles: IntArray, vertices: FloatArray, points: FloatArray, towards: FloatArray | None = None
) -> ClosestPoints:
    """Returns the closest points on a surface in space,
    as `closest_points` does for the rest shape.

    Triangles are tried by the distance of their centres, until no other can be closer.

    Args:
        triangles: (F, 3) vertices, counter-clockwise seen from outside.
        vertices: (N, 3) [m].
        points: (P, 3) [m].
        towards: (P, 3) directions; only triangles whose outer normal has a positive component along
            that of a point are compared with it. All of them, if left out.
    """
    corners = vertices[triangles]  # (F, 3, 3) [m]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tie = _TIE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    centres = corners.mean(1)
    radius, tree = float(np.linalg.norm(corners - centres[:, None], axis=2).max()), cKDTree(centres)
    chosen, nearest = np.empty(len(points), dtype=np.int64), np.empty_like(points)
    left, count = np.arange(len(points)), min(_CANDIDATES, len(triangles))
    while len(left):
        again = []
        for rows in np.array_split(left, len(left) * count // _PAIRS + 1):
            apart, candidates = (
                found.reshape(len(rows), count) for found in tree.query(points[rows], count)
            )
            index, places, distance = _closest_candidate(
                corners[candidates],
                normals[candidates],
                points[rows],
                None if towards is None else towards[rows],
                tie,
            )
            chosen[rows], nearest[rows] = (
                np.take_along_axis(candidates, index[:, None], 1)[:, 0],
                places,
            )
            again.append(rows[distance > apart[:, -1] - radius - tie])
        left = np.concatenate(again) if count < len(triangles) else left[:0]
        count = min(4 * count, len(triangles))
    offset = points - nearest
    side = np.where(np.sum(offset * normals[chosen], axis=1) < 0.0, -1.0, 1.0)
    return ClosestPoints(
        triangles[chosen], nearest, normals[chosen], side * np.linalg.norm(offset, axis=1)
    )


def _closest_candidate(
    corners: FloatArray,
    normals: FloatArray,
    points: FloatArray,
    towards: FloatArray | None,
    tie: float,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Index (R,) of the closest of K triangles (R, K, 3, 3) with normals (R, K, 3),
    the point on it, and its distance.

    The distance is infinite where none of them faces the direction (R, 3) of its point.
    """
    import trimesh

    copies = np.repeat(points[:, None], corners.shape[1], axis=1)  # (R, K, 3)
    places = trimesh.triangles.closest_point(
        corners.reshape(-1, 3, 3), copies.reshape(-1, 3)
    ).reshape(copies.shape)
    distance = np.linalg.norm(places - copies, axis=2)
    if towards is not None:
        distance = np.where(np.einsum("rki,ri->rk", normals, towards) > 0.0, distance, np.inf)
    least = distance.min(1)
    heights = np.abs(np.einsum("rki,rki->rk", copies - places, normals))
    index = np.argmax(np.where(distance <= least[:, None] + tie, heights, -1.0), axis=1)
    return index, places[np.arange(len(points)), index], least


@dataclass(frozen=True)
class Location:
    """Points as weighted sums of the nodes of cells, x = sum_a w_a x_a."""

    cells: IntArray  # (P,) cell of each point
    weights: FloatArray  # (P, K) weights of its nodes, with sum one
    gradients: FloatArray  # (P, K, 3) derivatives of the weights by the position of the point [1/m]
    outside: FloatArray  # (P,) distance from the cell [m]; zero inside, infinite where it fails
    distance: FloatArray  # (P,) distance from the cell [m], there too


def locate(mesh: Mesh, points: FloatArray) -> Location:
    """Finds the cell that contains each point, or the nearest one,
    with extrapolated shape functions.

    Reference coordinates are found by Newton's method in the nearby cells.

    Args:
        mesh: the rest shape.
        points: (P, 3) [m].

    Raises:
        InputError: a point that is not finite.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("a point to locate in a mesh is not finite.")
    nodes = mesh.vertices[mesh.cells]  # (M, K, 3)
    low, high = nodes.min(axis=1), nodes.max(axis=1)
    parts = [
        _located(mesh.element, nodes, low, high, points[k : k + _TOGETHER])
        for k in range(0, len(points), _TOGETHER)
    ]
    if not parts:
        none, k = np.zeros(0), mesh.cells.shape[1]
        return Location(
            np.zeros(0, dtype=np.int64), np.zeros((0, k)), np.zeros((0, k, 3)), none, none
        )
    return Location(*map(np.concatenate, zip(*parts, strict=True)))


def _located(
    element: Element, nodes: FloatArray, low: FloatArray, high: FloatArray, points: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The fields of the `Location` of points (P, 3) in cells (M, K, 3)
    with the corners (M, 3) of their boxes.
    """
    near, last = list[IntArray](), min(_CELLS, len(nodes)) - 1
    for point in points:  # cells whose boxes are nearest
        away = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1)
        near.append(np.flatnonzero(away <= np.partition(away, last)[last]))
    cells, ends = np.concatenate(near), np.cumsum([len(cells_near) for cells_near in near])
    targets = np.repeat(points, np.diff(ends, prepend=0), axis=0)
    place = _reference_coordinates(element, nodes[cells], targets)
    within = np.clip(place, -1.0, 1.0)
    if element.is_simplex:
        barycentric = np.maximum(np.column_stack([1.0 - place.sum(axis=1), place]), 0.0)
        within = barycentric[:, 1:] / barycentric.sum(axis=1, keepdims=True)
    values, _ = element.shape(within)
    distances = np.linalg.norm(np.einsum("ck,cki->ci", values, nodes[cells]) - targets, axis=1)
    best = [
        candidates[np.argmin(distances[candidates])]
        for candidates in np.split(np.arange(ends[-1]), ends[:-1])
    ]
    cells, distances = cells[best], distances[best]
    weights, slopes = element.shape(place[best])
    gradients = slopes @ np.linalg.pinv(np.einsum("pki,pkj->pij", nodes[cells], slopes))
    error = np.linalg.norm(np.einsum("pk,pki->pi", weights, nodes[cells]) - points, axis=1)
    size = np.linalg.norm(high[cells] - low[cells], axis=1)
    outside = np.where(distances > 1e-9 * size, distances, 0.0)
    return cells, weights, gradients, np.where(error > 1e-6 * size, np.inf, outside), distances


def _reference_coordinates(element: Element, nodes: Array, points: Array) -> Array:
    """Returns reference coordinates (C, 3) of a point (C, 3) in each cell (C, K, 3),
    which need not contain it.
    """
    place = np.full((len(nodes), 3), 0.25 if element.is_simplex else 0.0)
    left = np.arange(len(nodes))
    for _ in range(_ITERATIONS):
        values, slopes = element.shape(place[left])
        error = points[left] - np.einsum("ck,cki->ci", values, nodes[left])
        jacobian = np.einsum("cki,ckj->cij", nodes[left], slopes)
        step = np.einsum("cij,cj->ci", np.linalg.pinv(jacobian), error)
        place[left] = np.clip(place[left] + step, -3.0, 3.0)  # The map may fold farther outside.
        left = left[np.abs(step).max(axis=1) >= 1e-12]
        if not len(left):
            break
    return place
