"""Pictures of deformed bodies, coloured by a value at the vertices and painted from back to front.

Every boundary face is cut into pieces small enough that sorting them by depth hides what is hidden. It needs
no graphics driver, display or subprocess, so the picture is the same on every machine.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from numpy.typing import NDArray

from warp_resphys.mesh import Mesh, boundary_faces

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PIECES: Final = 9000  # About how many pieces a surface is cut into; the colour is constant on a piece.
FEATURE_ANGLE: Final = np.deg2rad(30.0)  # Faces that meet at a sharper angle share an edge of the outline.
OUTLINE_SETBACK: Final = 0.01  # Relative to the size of the body, as that of a piece.
TOWARDS_VIEWER: Final = (
    0.40,
    -1.0,
    0.40,
)  # z is up; a body along x is seen from the side, its free end nearer.
TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
SHADE: Final = 0.25  # Share of the colour that depends on the light; the rest stays readable as a value.


@dataclass(frozen=True, eq=False)
class View:
    """A parallel projection that shows a given set of points whole.

    Attributes:
        axes: (3, 3) orthonormal rows: to the right, up, towards the viewer.
        lower: (2,) lower left corner of what is seen [m].
        upper: (2,) upper right corner [m].
    """

    axes: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def around(cls, points: FloatArray, margin: float = 0.02) -> "View":
        """Return the view of (P, 3) points [m] with a margin relative to the longer side."""
        towards = _normalised(np.asarray(TOWARDS_VIEWER))
        right = _normalised(np.cross([0.0, 0.0, 1.0], towards))
        axes = np.stack([right, np.cross(towards, right), towards])
        seen = points @ axes[:2].T  # (P, 2) [m]
        lower, upper = seen.min(axis=0), seen.max(axis=0)
        space = margin * np.max(upper - lower)
        return cls(axes, lower - space, upper + space)

    @property
    def aspect(self) -> float:
        """Width over height."""
        width, height = self.upper - self.lower
        return float(width / height)


@dataclass(frozen=True, eq=False)
class Surface:
    """The boundary of a mesh in small pieces, as a linear map from its vertices.

    Attributes:
        faces: (F, K) vertices of the boundary faces, outward-oriented.
        weights: (P, K) shape functions of a face at the P points where it is cut.
        pieces: (C, 3 | 4) points of a piece, oriented as the face is.
        rims: (E, 2) points of the segments along the edges of the face.
        rim_owners: (E,) piece of each segment.
    """

    faces: IntArray
    weights: FloatArray
    pieces: IntArray
    rims: IntArray
    rim_owners: IntArray

    @classmethod
    def of(cls, mesh: Mesh) -> "Surface":
        """Return the surface of a mesh of hexahedra, 4-node or 10-node tetrahedra."""
        faces = boundary_faces(mesh)
        cuts = int(np.clip(np.sqrt(PIECES / len(faces)), 1, 12))
        nodes = faces.shape[1]
        weights, pieces, rims = _cut_quadrilateral(cuts) if nodes == 4 else _cut_triangle(cuts, nodes)
        touches = (rims[:, :, None, None] == pieces).any(axis=3).all(axis=1)  # (E, C)
        return cls(faces, weights, pieces, rims, touches.argmax(axis=1))

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Return (F, P, C) values at the points of every face from (N, C) values at the vertices."""
        return np.asarray(np.einsum("pk,fkc->fpc", self.weights, values[self.faces]))

    def outline(self, vertices: FloatArray) -> FloatArray:
        """Return the (L, 2, 3) ends [m] of the sharp edges of the body with these (N, 3) vertices [m]."""
        corners = self.faces[:, : 4 if self.faces.shape[1] == 4 else 3]
        first, second, third = (vertices[corners[:, node]] for node in range(3))
        normals = _normalised(np.cross(second - first, third - first))  # (F, 3)
        sides = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2)  # (F, K, 2)
        edges, owners = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        by_edge = np.argsort(owners.ravel(), kind="stable")
        starts = np.searchsorted(owners.ravel()[by_edge], np.arange(len(edges)))
        ends = np.append(starts[1:], len(by_edge))
        owner = by_edge // corners.shape[1]  # Faces, edge by edge.
        cosine = np.einsum("ec,ec->e", normals[owner[starts]], normals[owner[ends - 1]])
        return np.asarray(vertices[edges[cosine < np.cos(FEATURE_ANGLE)]])


def paint(
    axes: Axes,
    view: View,
    surface: Surface,
    vertices: FloatArray,
    colours: FloatArray,
    outline: FloatArray,
    outline_colour: str,
) -> None:
    """Draw a body, the edges of its faces, and an outline, each hidden where something stands before it.

    Args:
        axes: Where to draw; limits and aspect are set to the view's, ticks and frame removed.
        view: The projection.
        surface: The boundary of the body.
        vertices: (N, 3) deformed positions [m].
        colours: (N, 3) red, green and blue in [0, 1] at the vertices.
        outline: (L, 2, 3) ends of further edges [m], such as those of the undeformed body.
        outline_colour: Their colour.
    """
    points = surface.interpolate(vertices)  # (F, P, 3) [m]
    corners = surface.pieces.shape[1]
    pieces = points[:, surface.pieces].reshape(-1, corners, 3)
    rims = points[:, surface.rims].reshape(-1, 2, 3)
    dashes = _cut_lines(outline, cuts=60)

    shaded = (
        surface.interpolate(colours)[:, surface.pieces].mean(axis=2).reshape(-1, 3) * _shade(pieces)[:, None]
    )
    rgba = np.concatenate(
        [
            np.column_stack([shaded, np.ones(len(pieces))]),
            np.broadcast_to([0.0, 0.0, 0.0, 0.3], (len(rims), 4)),
            np.broadcast_to(to_rgba(outline_colour), (len(dashes), 4)),
        ]
    )
    widths = np.repeat(
        [0.5, 0.4, 0.9], [len(pieces), len(rims), len(dashes)]
    )  # [pt]; a piece's covers its seams.
    depths = pieces.mean(axis=1) @ view.axes[2]
    rim_depths = depths.reshape(len(points), -1)[:, surface.rim_owners].ravel()  # Each follows its piece.
    behind = OUTLINE_SETBACK * np.ptp(vertices)  # Where body and outline coincide, the body shows.
    depths = np.concatenate([depths, rim_depths, dashes.mean(axis=1) @ view.axes[2] - behind])
    flat = [each @ view.axes[:2].T for each in (*pieces, *rims, *dashes)]  # (3 | 4 | 2, 2) [m] each
    order = np.argsort(depths, kind="stable")  # The viewer is at plus infinity, so what is far comes first.
    axes.add_collection(
        PolyCollection(
            [flat[index] for index in order],
            facecolors=rgba[order],
            edgecolors=rgba[order],
            linewidths=widths[order],
            rasterized=True,
        ),
        autolim=False,
    )
    axes.set(xlim=(view.lower[0], view.upper[0]), ylim=(view.lower[1], view.upper[1]), aspect="equal")
    axes.set_axis_off()


def _cut_quadrilateral(cuts: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Weights, pieces and rims of a 4-node face cut into a grid."""
    ticks = np.linspace(0.0, 1.0, cuts + 1)
    s, t = (each.ravel() for each in np.meshgrid(ticks, ticks, indexing="ij"))
    weights = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=1)
    index = np.arange((cuts + 1) ** 2).reshape(cuts + 1, cuts + 1)
    pieces = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=2).reshape(-1, 4)
    return weights, pieces, _segments(index[:, 0], index[-1], index[:, -1], index[0])


def _cut_triangle(cuts: int, nodes: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Weights, pieces and rims of a 3- or 6-node face (corners, then midpoints of sides 01, 12, 20)."""
    lattice = [(i, j) for i in range(cuts + 1) for j in range(cuts + 1 - i)]
    index = {node: number for number, node in enumerate(lattice)}
    i, j = np.asarray(lattice).T
    corners = np.stack([cuts - i - j, i, j], axis=1) / cuts  # (P, 3) barycentric coordinates
    following = np.roll(corners, -1, axis=1)
    weights = corners if nodes == 3 else np.hstack([corners * (2 * corners - 1), 4 * corners * following])
    pieces = [[index[i, j], index[i + 1, j], index[i, j + 1]] for i, j in lattice if i + j < cuts]
    pieces += [
        [index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]] for i, j in lattice if i + j < cuts - 1
    ]
    run = range(cuts + 1)
    sides = ([index[k, 0] for k in run], [index[cuts - k, k] for k in run], [index[0, k] for k in run])
    return weights, np.asarray(pieces), _segments(*map(np.asarray, sides))


def _segments(*runs: IntArray) -> IntArray:
    return np.concatenate([np.stack([run[:-1], run[1:]], axis=1) for run in runs])


def _cut_lines(lines: FloatArray, cuts: int) -> FloatArray:
    """(L, 2, 3) lines as (L x cuts, 2, 3) short ones."""
    along = np.linspace(0.0, 1.0, cuts + 1)[:, None]
    dots = lines[:, None, 0] * (1.0 - along) + lines[:, None, 1] * along  # (L, cuts + 1, 3)
    return np.stack([dots[:, :-1], dots[:, 1:]], axis=2).reshape(-1, 2, 3)


def _shade(pieces: FloatArray) -> FloatArray:
    """(C,) brightness of flat pieces, 1 where they face the light."""
    normals = _normalised(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]))
    facing = np.clip(normals @ _normalised(np.asarray(TOWARDS_LIGHT)), 0.0, 1.0)
    return np.asarray(1.0 - SHADE * (1.0 - facing))


def _normalised(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(np.float64).tiny))
