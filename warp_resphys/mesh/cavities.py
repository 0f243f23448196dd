"""Cavities of a body that are open to the outside: what should perhaps have been a closed chamber."""

from dataclasses import dataclass

import numpy as np

from .chambers import find_chambers
from .mesh import FloatArray, Mesh, boundary_triangles, connected_parts

MOST_TRIANGLES = 10_000  # of a surface that is looked at
_DIRECTIONS = 24  # from each triangle, over the half of all directions that it faces
_HIDDEN = 0.2  # share of directions that lead out, below which a triangle lies within a cavity
_LEAST_AREA = 0.01  # of a cavity, over the area of the outside
_LIFT = 1e-6  # of a ray's start off the surface, over the diagonal of the mesh
_RAYS = 200_000  # pairs of a ray and a triangle that are looked at in one go, over the number of triangles


@dataclass(frozen=True)
class OpenCavity:
    """A part of the outer surface from which little of the outside is seen."""

    centre: FloatArray  # (3,) [m] mean of its triangles
    area: float  # of it [m^2]


def open_cavities(mesh: Mesh) -> list[OpenCavity] | None:
    """Finds where the outer surface lies in a deep hollow: a chamber with a hole in its wall or without an end.

    From the middle of each triangle, straight lines go in evenly spread directions; where few of them leave without
    meeting the body again, the triangle is hidden. Hidden triangles that touch are one cavity.

    Returns:
        The cavities, largest first; None where the surface has more than `MOST_TRIANGLES`.
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
    hidden = np.flatnonzero(_blocked(starts, normals, surface.triangles))  # who sees the outside ahead is not hidden
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
    """(T, D, 3) unit vectors, spread evenly over the half sphere around each normal (T, 3)."""
    heights = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    angles = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(_DIRECTIONS)  # golden spiral
    local = np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.sqrt(1.0 - heights**2)[:, None]
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first)], axis=1)  # (T, 2, 3)
    return np.asarray(np.einsum("dk,tkj->tdj", local, axes) + heights[:, None] * normals[:, None])


def _blocked(starts: FloatArray, directions: FloatArray, corners: FloatArray) -> FloatArray:
    """Whether rays (R, 3) meet any triangle (T, 3, 3), (R,) of 0 and 1 (Moeller and Trumbore 1997)."""
    origin, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    met = np.zeros(len(starts))
    chunk = max(1, _RAYS // len(corners))
    for begin in range(0, len(starts), chunk):
        rays, offset = directions[begin : begin + chunk, None], starts[begin : begin + chunk, None] - origin
        across = np.cross(rays, second)
        determinant = (across * first).sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (across * offset).sum(axis=-1) / determinant
            around = np.cross(offset, first)
            v = (around * rays).sum(axis=-1) / determinant
            distance = (around * second).sum(axis=-1) / determinant
            inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        met[begin : begin + chunk] = inside.any(axis=1)
    return met
