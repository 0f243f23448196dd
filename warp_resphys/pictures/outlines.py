"""Outlines of bodies in pictures: of a mask, of a simulated body, and distances between the two.

The outline of a simulated body consists of the edges of its surface that separate triangles facing
the camera from others, where nothing of the body covers them. Its points move with the vertices of
their edge, to first order: where the outline is formed by other points of the surface a moment
later, these move along it (Giblin and Weiss 1987). Distances are measured both ways, to the closest
point of the other outline (Fitzgibbon 2003): from the measured outline, so that it is covered, and
from the simulated one, so that nothing of the body lies where none was seen.

`tests/pictures/test_outlines.py` compares with outlines of closed form.
"""

from dataclasses import dataclass

import contourpy
import numpy as np
import scipy.ndimage
import shapely
import torch
from scipy.spatial import cKDTree

from ..core.mesh.volume_mesh import Mesh, boundary_triangles
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import InputError

Mask = BoolArray

_SMOOTH = 1.0  # px, of a mask before its contour is drawn: a contour of pixels is a staircase
_PIXEL = 1.0  # px
_ON = 1e-3  # px, between the border of the seen body and points that form it
_APART = 2.0  # px, between points of an outline
_NEAR = 0.5  # px, between points of an outline to which distances are measured
_BORDER = 2.0  # px, at which a body is cut off by its picture
_LEAST = 8  # points of an outline


@dataclass(frozen=True)
class Outline:
    """A measured outline."""

    points: FloatArray  # (P, 2) at equal distances along it [px]
    region: shapely.Geometry  # what it encloses
    size: tuple[int, int]  # width and height of the picture [px]
    near: FloatArray  # (Q, 2) points that lie closer together, to which distances are measured [px]
    outward: FloatArray  # (Q, 2) unit vectors across it there

    @classmethod
    def of_mask(cls, mask: Mask) -> "Outline":
        """Returns the outline of a mask, to a fraction of a pixel,
        without the borders of the picture.

        Args:
            mask: (H, W) whether a pixel shows the body; that of row i and column j is at (j, i)
                [px].

        Raises:
            InputError: nothing is seen, or the body fills the picture.
        """
        smooth = np.pad(scipy.ndimage.gaussian_filter(mask.astype(np.float64), _SMOOTH), 1)
        lines = [
            np.asarray(line) - 1.0 for line in contourpy.contour_generator(z=smooth).lines(0.5)
        ]
        lines = [line for line in lines if len(line) >= _LEAST]
        if not lines:
            raise InputError(
                "the mask shows nothing of the body: check the picture, or the colours of its mask."
            )
        size = (mask.shape[1], mask.shape[0])
        points = np.concatenate([_evenly(line, _APART) for line in lines])
        near = np.concatenate([_evenly(line, _NEAR) for line in lines])
        points, near = points[within(points, size)], near[within(near, size)]
        if not len(points):
            raise InputError("the mask fills the picture: no outline of the body is in it.")
        region = shapely.build_area(
            shapely.geometrycollections([shapely.linestrings(line) for line in lines])
        )
        at = near.T[::-1] + 1.0  # rows and columns of the padded mask
        slope = np.stack(
            [
                scipy.ndimage.map_coordinates(part, at, order=1)
                for part in np.gradient(smooth)[::-1]
            ],
            1,
        )
        outward = -slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
        return cls(points, region, size, near, outward)

    def signed(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns distances (P,) of points (P, 2), negative inside,
        and their gradients (P, 2) [px].
        """
        return _closest(points, self.near, self.outward)[1:]


@dataclass(frozen=True)
class Silhouette:
    """The outline of a simulated body: P points (1 - t) a + t b of edges a b of its surface."""

    edges: IntArray  # (P, 2) vertices
    shares: FloatArray  # (P,) t
    pixels: FloatArray  # (P, 2) where they are seen [px]
    outward: FloatArray  # (P, 2) unit vectors across the outline, away from the body
    lengths: FloatArray  # (P,) of the outline that a point stands for [px]

    def points(self, vertices: torch.Tensor) -> torch.Tensor:
        """Returns the points (..., P, 3) from vertices (..., N, 3) [m]."""
        share = torch.as_tensor(self.shares).to(vertices)[:, None]
        first, second = torch.as_tensor(self.edges).unbind(1)
        return torch.lerp(vertices[..., first, :], vertices[..., second, :], share)

    def closest(self, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Returns the closest points of the outline to points (P, 2).

        Returns:
            Their indices (P,), the distances (P,), positive outside of the body, and their
            gradients (P, 2) [px].
        """
        return _closest(points, self.pixels, self.outward)


def _closest(
    points: FloatArray, outline: FloatArray, outward: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Closest points of an outline (Q, 2), with unit vectors across it, to points (P, 2).

    See `Silhouette.closest`.
    """
    distance, index = cKDTree(outline).query(points)
    between, across = points - outline[index], outward[index]
    side = np.where((between * across).sum(1) < 0.0, -1.0, 1.0)
    direct = side[:, None] * between / np.maximum(distance, 1e-12)[:, None]
    # Within a pixel the direction of the difference is that of the sampling.
    direct = np.where(distance[:, None] < _PIXEL, across, direct)
    return index, (between * direct).sum(1), direct


@dataclass(frozen=True)
class ClosedSurface:
    """The closed surface of a body: F triangles, their E edges,
    and the two triangles at every edge.
    """

    triangles: IntArray  # (F, 3)
    edges: IntArray  # (E, 2)
    beside: IntArray  # (E, 2)

    @classmethod
    def of(cls, body: Mesh | IntArray) -> "ClosedSurface":
        """Returns the surface of a body's mesh, or of triangles (F, 3).

        Raises:
            InputError: it is not closed.
        """
        import trimesh

        triangles = boundary_triangles(body) if isinstance(body, Mesh) else body
        beside, edges = trimesh.graph.face_adjacency(triangles, return_edges=True)
        if 2 * len(edges) != 3 * len(triangles):
            raise InputError(
                "the surface of the body is not closed: every edge must belong to two triangles."
            )
        return cls(triangles, edges, beside)

    def silhouette(self, pixels: FloatArray) -> Silhouette:
        """Returns the outline in a picture, as points that lie close together.

        Args:
            pixels: (N, 2) of the vertices [px].

        Raises:
            InputError: a vertex is behind the camera.
        """
        if not np.isfinite(pixels).all():
            raise InputError(
                "a part of the body is behind the camera: check the pose of the camera "
                "(world_to_camera)."
            )
        corners = pixels[self.triangles]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        front = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0.0  # y points down
        border = shapely.boundary(self.region(pixels, front))
        turns = front[self.beside[:, 0]] != front[self.beside[:, 1]]
        ends, beside = self.edges[turns], self.beside[turns]
        facing = np.where(front[beside[:, 0]], beside[:, 0], beside[:, 1])
        line = pixels[ends[:, 1]] - pixels[ends[:, 0]]
        length = np.linalg.norm(line, axis=1)
        across = np.stack([-line[:, 1], line[:, 0]], 1) / np.maximum(length, 1e-12)[:, None]
        inwards = (across * (corners[facing].mean(1) - pixels[ends[:, 0]])).sum(1) > 0.0
        outward = np.where(inwards[:, None], -across, across)
        count = np.maximum(np.ceil(length / _NEAR), 1).astype(int)
        owner = np.repeat(np.arange(len(ends)), count)
        number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        share = (number + 0.5) / count[owner]
        points = pixels[ends[owner, 0]] + share[:, None] * line[owner]
        shapely.prepare(border)
        keep = shapely.dwithin(border, shapely.points(points), _ON)
        owner = owner[keep]
        return Silhouette(
            ends[owner], share[keep], points[keep], outward[owner], (length / count)[owner]
        )

    def region(self, pixels: FloatArray, chosen: Mask | slice = slice(None)) -> shapely.Geometry:
        """Returns what the triangles, or some of them, cover of a picture,
        with their vertices at pixels (N, 2).
        """
        return shapely.union_all(shapely.polygons(pixels[self.triangles[chosen]]))


def within(points: FloatArray, size: tuple[int, int]) -> Mask:
    """(P,) whether points (P, 2) lie in a picture of a width and a height, off its borders [px]."""
    return np.asarray(((points > _BORDER) & (points < np.array(size) - 1.0 - _BORDER)).all(1))


def visibility(points: FloatArray, hidden: FloatArray, margin: float) -> FloatArray:
    """(P,) how much points (P, 2) count beside others (V, 2) that a clamp hides [px].

    It grows from zero at a margin around the convex hull of the hidden points to one at twice this
    margin, so that no point appears at once.
    """
    if not len(hidden):
        return np.ones(len(points))
    hull = shapely.convex_hull(shapely.multipoints(hidden))
    return np.clip(shapely.distance(hull, shapely.points(points)) / margin - 1.0, 0.0, 1.0)


def _evenly(line: FloatArray, spacing: float) -> FloatArray:
    """Points (P, 2) at equal distances along a line."""
    arc = np.concatenate([[0.0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()])
    count = max(round(arc[-1] / spacing), 1)
    at = (np.arange(count) + 0.5) / count * arc[-1]
    return np.stack([np.interp(at, arc, axis) for axis in line.T], 1)
