"""Detection of open cavities, which may have been intended as closed chambers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..io.progress import QUIET_SECONDS, Progress
from .chambers import find_chambers
from .mesh import FloatArray, Mesh, boundary_triangles, connected_parts

MOST_TRIANGLES = 10_000  # largest surface that is examined
_DIRECTIONS = 24  # rays per triangle, over the hemisphere of its normal
_HIDDEN = 0.2  # fraction of unobstructed rays below which a triangle is inside a cavity
_LEAST_AREA = 0.01  # smallest area of a cavity, over that of the outer surface
_LIFT = 1e-6  # distance of a ray's start from the surface, over the diagonal of the mesh
_RAYS = 200_000  # ray-triangle pairs processed together


@dataclass(frozen=True)
class OpenCavity:
    """A part of the outer surface with mostly obstructed view of the outside."""

    centre: FloatArray  # (3,) area-weighted centre [m]
    area: float  # [m^2]


def open_cavities(mesh: Mesh) -> list[OpenCavity] | None:
    """Finds deep hollows in the outer surface, such as a chamber with a hole in its wall or without an end.

    Rays in uniformly distributed directions start from the centre of each triangle; if few of them leave the body
    without hitting it, the triangle is hidden. Connected hidden triangles form a cavity.

    Returns:
        The cavities, largest first; None if the surface has more than `MOST_TRIANGLES`.
    """
    import trimesh

    triangles = boundary_triangles(mesh)
    if len(triangles) > MOST_TRIANGLES:
        return None
    inner = [chamber.vertices for chamber in find_chambers(mesh)]
    outer = triangles[~np.isin(triangles[:, 0], np.concatenate(inner))] if inner else triangles
    surface = trimesh.Trimesh(mesh.vertices, outer, process=False)
    centres, normals, areas = surface.triangles_center, surface.face_normals, surface.area_faces
    starts = centres + _LIFT * surface.scale * normals
    hidden = np.flatnonzero(_blocked(starts, normals, surface.triangles))  # candidates: obstructed along the normal
    directions = _half_sphere(normals[hidden]).reshape(-1, 3)
    blocked = _blocked(np.repeat(starts[hidden], _DIRECTIONS, axis=0), directions, surface.triangles)
    hidden = hidden[1.0 - blocked.reshape(-1, _DIRECTIONS).mean(axis=1) < _HIDDEN]
    parts = connected_parts(outer[hidden])
    cavities = []
    for own in (hidden[parts == part] for part in np.unique(parts)):
        if areas[own].sum() >= _LEAST_AREA * areas.sum():
            cavities.append(OpenCavity(np.average(centres[own], axis=0, weights=areas[own]), float(areas[own].sum())))
    return sorted(cavities, key=lambda cavity: -cavity.area)


def _half_sphere(normals: FloatArray) -> FloatArray:
    """Returns unit vectors (T, D, 3), uniformly distributed over the hemisphere of each normal (T, 3)."""
    heights = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    angles = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(_DIRECTIONS)  # golden spiral
    local = np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.sqrt(1.0 - heights**2)[:, None]
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first)], axis=1)  # (T, 2, 3)
    return np.asarray(np.einsum("dk,tkj->tdj", local, axes) + heights[:, None] * normals[:, None])


def _blocked(starts: FloatArray, directions: FloatArray, corners: FloatArray) -> FloatArray:
    """Returns 1 for rays (R,) that hit any triangle (T, 3, 3), else 0."""
    hit = np.zeros(len(starts))
    chunk = max(1, _RAYS // len(corners))
    with Progress("open cavities", len(starts), "rays", after=QUIET_SECONDS) as progress:
        for begin in range(0, len(starts), chunk):
            own = slice(begin, begin + chunk)
            hit[own] = _hits(starts[own], directions[own], corners).any(axis=1)
            progress.advance(len(hit[own]))
    return hit


def _hits(starts: FloatArray, directions: FloatArray, corners: FloatArray) -> NDArray[np.bool_]:
    """Returns whether rays (R,) hit triangles (T, 3, 3), (R, T) (Moeller and Trumbore 1997)."""
    origin, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    rays, offset = directions[:, None], starts[:, None] - origin
    across = np.cross(rays, second)
    determinant = (across * first).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (across * offset).sum(axis=-1) / determinant
        around = np.cross(offset, first)
        v = (around * rays).sum(axis=-1) / determinant
        distance = (around * second).sum(axis=-1) / determinant
        return np.asarray((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0))
