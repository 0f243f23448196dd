"""Detection of open cavities, which may have been intended as closed chambers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..io.arrays import FloatArray
from ..io.kernel_cache import ensure_kernel_cache
from ..kernels.modules import shareable
from ..kernels.triangles import blocked
from .chambers import find_chambers
from .mesh import Mesh, boundary_triangles, connected_parts

_DIRECTIONS = 24  # rays per triangle, over the hemisphere of its normal
_HIDDEN = 0.2  # fraction of unobstructed rays below which a triangle is inside a cavity
_LEAST_AREA = 0.01  # smallest area of a cavity, over that of the outer surface
_LIFT = 1e-5  # distance of a ray's start from the surface, over the diagonal of the mesh; beyond float32's rounding

ensure_kernel_cache()  # before Warp is first used


@dataclass(frozen=True)
class OpenCavity:
    """A part of the outer surface with mostly obstructed view of the outside."""

    centre: FloatArray  # (3,) area-weighted centre [m]
    area: float  # [m^2]


def open_cavities(mesh: Mesh) -> list[OpenCavity]:
    """Finds deep hollows in the outer surface, such as a chamber with a hole in its wall or without an end.

    Rays in uniformly distributed directions start from the centre of each triangle; if few of them leave the body
    without hitting it, the triangle is hidden. Connected hidden triangles form a cavity. Largest cavities come first.
    """
    triangles = boundary_triangles(mesh)
    inner = [chamber.vertices for chamber in find_chambers(mesh)]
    outer = triangles[~np.isin(triangles[:, 0], np.concatenate(inner))] if inner else triangles
    corners = mesh.vertices[outer]
    normals, centres = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(axis=1)
    sizes = np.linalg.norm(normals, axis=1)
    normals /= sizes[:, None]
    starts = centres + _LIFT * np.linalg.norm(np.ptp(mesh.vertices, axis=0)) * normals
    directions = _half_sphere(normals).reshape(-1, 3)
    with shareable():
        rays: list[Any] = [
            wp.array(own, dtype=wp.vec3, device="cpu") for own in (np.repeat(starts, _DIRECTIONS, axis=0), directions)
        ]
        points: Any = wp.array(mesh.vertices, dtype=wp.vec3, device="cpu")
        surface = wp.Mesh(points, wp.array(outer.ravel(), dtype=int, device="cpu"))
        hits: Any = wp.zeros(len(directions), dtype=float, device="cpu")
        wp.launch(blocked, len(directions), [surface.id, *rays], [hits], device="cpu")
    hidden = np.flatnonzero(1.0 - hits.numpy().reshape(-1, _DIRECTIONS).mean(axis=1) < _HIDDEN)
    parts, cavities = connected_parts(outer[hidden]), []
    for own in (hidden[parts == part] for part in np.unique(parts)):
        if sizes[own].sum() >= _LEAST_AREA * sizes.sum():
            centre = np.average(centres[own], axis=0, weights=sizes[own])
            cavities.append(OpenCavity(centre, 0.5 * float(sizes[own].sum())))
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
