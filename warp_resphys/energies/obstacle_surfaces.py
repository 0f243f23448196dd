"""Surfaces of rigid obstacles as triangles, at rest and in a roll-out, for files and pictures."""

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ..mesh.motion_files import MovingSurface
from .obstacles import Box, Capsule, Cylinder, DistanceGrid, HalfSpace, Obstacle, Pose, Sphere

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CORNERS: Final = 64  # of a circle
_PLATE: Final = (1.5, 0.02)  # edge and thickness of the plate that stands for a half-space, over the body's size


@dataclass(frozen=True, eq=False)
class ObstacleMotion:
    """Motion of an obstacle in a roll-out of T steps.

    Attributes:
        name: of the obstacle, with that of its body if there are several.
        obstacle: its shape.
        beside: (N, 3) vertices of the body at rest, beside which the plate of a half-space lies [m].
        poses: (T + 1,) poses of B environments, of this obstacle alone.
    """

    name: str
    obstacle: Obstacle
    beside: FloatArray
    poses: tuple[Pose, ...]

    def surface(self, environment: int) -> MovingSurface:
        """Returns the moving triangles of an environment."""
        growth = float(self.poses[0].growth[environment, 0].detach())
        own, triangles = surface_of(self.obstacle, growth, self.beside)
        local = torch.as_tensor(own)[None, :, None]
        points = []
        for pose in self.poses:
            here = (value[environment, None].detach().cpu().double() for value in (pose.place, pose.turn, pose.growth))
            points.append(Pose(*here).world(local)[0, :, 0].numpy())
        return MovingSurface(self.name, np.stack(points), triangles)


def surface_of(obstacle: Obstacle, growth: float, beside: FloatArray) -> tuple[FloatArray, IntArray]:
    """Returns points (P, 3) [m] and triangles (S, 3) of an obstacle in its axes, with normals that point outwards.

    Args:
        obstacle: its shape.
        growth: by which its surface lies further out [m].
        beside: (N, 3) vertices of the body, beside which the plate of a half-space lies [m].
    """
    if isinstance(obstacle, DistanceGrid):
        return _contour(obstacle, growth)
    points = _solid(obstacle, beside, growth)
    return points, _outwards(ConvexHull(points))


def _contour(grid: DistanceGrid, growth: float) -> tuple[FloatArray, IntArray]:
    """Returns the points (P, 3) [m] and triangles (S, 3) at a distance from the surface of a grid."""
    import pyvista

    image = pyvista.ImageData(dimensions=grid.distances.shape, spacing=(grid.spacing,) * 3, origin=grid.low)
    surface = image.contour([growth], scalars=grid.distances.ravel(order="F"))
    return np.asarray(surface.points, dtype=float), np.asarray(surface.faces, dtype=np.int64).reshape(-1, 4)[:, :0:-1]


def _outwards(hull: ConvexHull) -> IntArray:
    """Returns the triangles (S, 3) of a convex hull, with normals that point outwards."""
    triangles = np.array(hull.simplices, dtype=np.int64)
    corners = hull.points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = (normals * hull.equations[:, :3]).sum(axis=1) < 0.0
    triangles[inwards] = triangles[inwards, ::-1]
    return triangles


def _solid(obstacle: Obstacle, vertices: FloatArray, growth: float) -> FloatArray:
    """Returns points (P, 3) in the axes of an obstacle, whose convex hull it is.

    Args:
        obstacle: its shape.
        vertices: (N, 3) of the body, beside which the plate of a half-space lies [m].
        growth: by which its surface lies further out [m].
    """
    x, y, z = obstacle.size
    match obstacle:
        case HalfSpace():
            edge, thickness = np.multiply(_PLATE, np.ptp(vertices, axis=0).max())
            middle = (vertices.mean(axis=0) - obstacle.position) @ obstacle.turn
            lowest = np.array([middle[0] - 0.5 * edge, middle[1] - 0.5 * edge, growth - thickness])
            return np.array([*product(*zip(lowest, lowest + (edge, edge, thickness), strict=True))])
        case Box():
            half = np.array([x, y, z]) + growth
            return np.array([*product(*zip(-half, half, strict=True))])
        case Sphere() | Capsule():
            angles = np.linspace(0.0, 0.5 * np.pi, _CORNERS // 4 + 1)
            radii = np.tile((x + growth) * np.sin(angles), 2)
            heights = np.outer([1.0, -1.0], z + (x + growth) * np.cos(angles)).ravel()
        case Cylinder():
            radii, heights = np.full(2, x + growth), np.array([-z, z]) + growth * np.array([-1.0, 1.0])
        case _:
            raise TypeError(f"{type(obstacle).__name__} has no surface to draw")
    around = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    rings = [np.column_stack([r * circle, np.full(_CORNERS, h)]) for r, h in zip(radii, heights, strict=True)]
    return np.concatenate(rings)
