"""Closest points on a body's surface, and signed distances."""

from dataclasses import dataclass

import numpy as np

from ..io.errors import InputError
from .mesh import FloatArray, IntArray, Mesh, boundary_triangles

_TIE = 1e-9  # difference up to which triangles are equally close, over the diagonal of the mesh


@dataclass(frozen=True)
class ClosestPoints:
    """Closest surface points of P points."""

    triangles: IntArray  # (P, 3) vertices of the closest triangle, counter-clockwise seen from outside
    points: FloatArray  # (P, 3) closest point on that triangle [m]
    normals: FloatArray  # (P, 3) outer unit normal of the triangle
    distances: FloatArray  # (P,) signed distance, negative inside the body [m]


def closest_points(mesh: Mesh, points: FloatArray) -> ClosestPoints:
    """Finds the closest points on the boundary of the rest shape.

    Faces are split into triangles (`mesh.face_triangles`). Of triangles that share the closest edge, the one whose
    plane is farthest from the point is used.

    Raises:
        InputError: A point of (P, 3) [m] is not finite.
    """
    import trimesh

    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("A point whose closest point on a surface is needed is not finite.")
    triangles = boundary_triangles(mesh)
    corners = mesh.vertices[triangles]  # (F, 3, 3) [m]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tie = _TIE * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    chosen = np.empty(len(points), dtype=np.int64)
    nearest = np.empty_like(points)
    for row, point in enumerate(points):
        candidates = trimesh.triangles.closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
        distance = np.linalg.norm(candidates - point, axis=1)
        close = np.flatnonzero(distance <= distance.min() + tie)
        heights = np.abs(np.sum((point - candidates[close]) * normals[close], axis=1))
        chosen[row] = close[np.argmax(heights)]
        nearest[row] = candidates[chosen[row]]
    offset = points - nearest
    side = np.where(np.sum(offset * normals[chosen], axis=1) < 0.0, -1.0, 1.0)
    return ClosestPoints(triangles[chosen], nearest, normals[chosen], side * np.linalg.norm(offset, axis=1))
