"""Hexahedral meshes of round and elliptic rods, straight or curved.

The section of a rod is a square of cells in the middle, and rings of cells between the square and
the rim, so that no cell has an angle of 180 degrees. The nodes of the rim lie on a circle slightly
larger than the rod, so that the area of the section, and with it weight and axial stiffness, is
exact. The bending stiffness of a round rod is too large by 5 % with four straight sides, by less
than 0.3 % with eight or with quadratic cells.
"""

import numpy as np
import scipy.integrate
from numpy.typing import ArrayLike

from ...io.arrays import FloatArray, IntArray
from ...io.errors import MeshError
from .elements import BY_NODES, FACES, gauss_box
from .volume_mesh import Mesh

_TIE = 1e-6  # tolerance in the choice of the axis most perpendicular to the tangent
_CORE = 0.55  # half diagonal of the middle square, over the radius


def rod(
    centreline: ArrayLike,
    radii: ArrayLike,
    layers: int,
    core: int = 1,
    rings: int = 1,
    nodes: int = 27,
    grading: float = 0.0,
) -> Mesh:
    """Returns a round or elliptic rod of hexahedra.

    Args:
        centreline: (M, 3) points of the centreline, a polyline [m].
        radii: one radius; (R, 2) arc lengths and radii, linearly interpolated; or (R, 3) arc
            lengths and two semi-axes, the first one along the coordinate axis that is most
            perpendicular to the rod at its start (in the order x, y, z if several are) [m].
        layers: number of layers of cells along the rod.
        core: cells along a side of the middle square.
        rings: rings of cells around the square.
        nodes: nodes of a cell, 8, 20 or 27.
        grading: exponent of the radius (geometric mean of the semi-axes) in the length of a layer:
            0 for equal lengths, 1 for equal aspect ratios.

    Raises:
        MeshError: fewer than two points, a radius that is not positive, a number that is not an
            integer, a grading out of range, or a radius of curvature smaller than the rod's radius.
    """
    axis, profile = _checked_centreline(centreline), _checked_radii(radii)
    for name, value in (("layers", layers), ("core", core), ("rings", rings)):
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
            raise MeshError(
                f"{name} of a rod is {value!r}: it must be a whole number, one or more."
            )
    if nodes not in (8, 20, 27):
        raise MeshError(f"a rod of cells with {nodes} nodes: choose 8, 20 or 27.")
    if not 0.0 <= grading <= 1.0:
        raise MeshError(
            f"the grading of a rod is {grading:g}: it must be from 0, "
            "for layers of one length, to 1."
        )
    order = 1 if nodes == 8 else 2
    section, squares = _section(core * order, rings * order, order)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(axis, axis=0), axis=1))])
    along = _levels(float(length[-1]), profile, layers, order, grading)
    places, frames = _transported(axis, length, along)
    radius = np.stack(
        [np.interp(along, profile[:, 0], semi_axis) for semi_axis in profile[:, 1:].T], axis=1
    )
    vertices = places[:, None] + np.einsum("sj,nj,sji->sni", radius, section, frames)
    first = np.arange(layers) * order
    levels = first[:, None] + np.arange(order + 1)
    # (L, S, p + 1, p + 1, p + 1)
    cells = levels[:, None, None, None, :] * len(section) + squares[None, ..., None]
    element = BY_NODES[nodes]
    place = np.round((element.shape.nodes + 1.0) / 2.0 * order).astype(np.int64)
    cells = cells.reshape(-1, *cells.shape[2:])[:, place[:, 0], place[:, 1], place[:, 2]]
    used, numbers = np.unique(cells, return_inverse=True)
    mesh = Mesh(vertices.reshape(-1, 3)[used], numbers.reshape(cells.shape))
    slopes = element.shape(element.rule[0])[1]
    if not (
        np.linalg.det(np.einsum("cki,qkj->cqij", mesh.vertices[mesh.cells], slopes)) > 0.0
    ).all():
        raise MeshError(
            "a rod is bent more sharply than it is thick: "
            "straighten its centreline, or make it thinner."
        )
    return mesh


def _checked_centreline(centreline: ArrayLike) -> FloatArray:
    """Returns the points (M, 3) of a polyline [m], or raises MeshError."""
    axis = np.asarray(centreline, dtype=np.float64)
    if axis.ndim != 2 or axis.shape[1] != 3 or len(axis) < 2 or not np.isfinite(axis).all():
        raise MeshError(
            f"the centreline of a rod has shape {axis.shape}: "
            "it needs two or more finite points (M, 3)."
        )
    if not np.diff(axis, axis=0).any(axis=1).all():
        raise MeshError(
            "the centreline of a rod has two points in a row at one place: leave one of them out."
        )
    return axis


def _checked_radii(radii: ArrayLike) -> FloatArray:
    """Returns arc lengths and two semi-axes (R, 3) [m], or raises MeshError."""
    profile = np.asarray(radii, dtype=np.float64)
    profile = np.array([[0.0, float(profile)]]) if profile.ndim == 0 else profile
    listed = profile.ndim == 2 and profile.shape[1] in (2, 3) and bool(np.isfinite(profile).all())
    if not (listed and (profile[:, 1:] > 0.0).all() and (np.diff(profile[:, 0]) > 0.0).all()):
        raise MeshError(
            "the radii of a rod must be one positive number, or rising arc lengths with one or "
            "two positive radii each."
        )
    return profile[:, [0, 1, -1]]


def _levels(
    length: float, radii: FloatArray, layers: int, order: int, grading: float
) -> FloatArray:
    """Returns the arc lengths (layers order + 1,) [m] of the nodes of graded layers."""
    ends = np.linspace(0.0, length, layers + 1)
    if grading != 0.0:
        fine = np.linspace(0.0, length, 1000 * layers + 1)
        mean = np.sqrt(np.interp(fine, *radii[:, :2].T) * np.interp(fine, *radii[:, ::2].T))
        share = scipy.integrate.cumulative_trapezoid(mean**-grading, fine, initial=0.0)
        ends = np.interp(np.linspace(0.0, share[-1], layers + 1), share, fine)
    return np.interp(np.arange(layers * order + 1) / order, np.arange(layers + 1), ends)


def _section(core: int, rings: int, order: int) -> tuple[FloatArray, IntArray]:
    """Returns nodes (n, 2) of a disc of radius one,
    and its cells (S, order + 1, order + 1), counter-clockwise.

    Args:
        core: node intervals along a side of the middle square.
        rings: node intervals between the square and the circle.
        order: node intervals along the edge of a cell.
    """
    side = np.linspace(-1.0, 1.0, core + 1) * _CORE / np.sqrt(2.0)
    square = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    ids = np.arange(len(square)).reshape(core + 1, core + 1)
    # counter-clockwise
    edge = np.concatenate([ids[:-1, 0], ids[-1, :-1], ids[:0:-1, -1], ids[0, :0:-1]])
    angle = -0.75 * np.pi + np.arange(len(edge)) * 2.0 * np.pi / len(edge)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    share = np.arange(1, rings + 1)[:, None, None] / rings
    outer = (1.0 - share) * square[edge] + share * circle  # (rings, edge, 2)
    ring = np.concatenate(
        [edge[None], len(square) + np.arange(rings * len(edge)).reshape(rings, -1)]
    )
    ring = np.concatenate([ring, ring[:, :1]], axis=1)

    def blocks(grid: IntArray) -> list[IntArray]:
        rows, columns = (range(0, size - 1, order) for size in grid.shape)
        return [grid[i : i + order + 1, j : j + order + 1] for i in rows for j in columns]

    nodes = np.concatenate([square, outer.reshape(-1, 2)])
    cells = np.array([*blocks(ids), *blocks(ring)])
    return nodes * np.sqrt(np.pi / _area(nodes, cells)), cells


def _area(nodes: FloatArray, cells: IntArray) -> float:
    """Returns the area of cells (S, p + 1, p + 1) with nodes (n, 2)."""
    order = cells.shape[1] - 1
    shape = FACES[(order + 1) ** 2].shape
    place = np.round((shape.nodes + 1.0) / 2.0 * order).astype(np.int64)
    points, weights = gauss_box(order + 1, 2)
    corners = nodes[cells[:, place[:, 0], place[:, 1]]]  # (S, K, 2)
    return float(
        (np.linalg.det(np.einsum("ski,qkj->sqij", corners, shape(points)[1])) @ weights).sum()
    )


def _transported(
    axis: FloatArray, length: FloatArray, along: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points (s, 3) of a polyline at arc lengths, and two twist-free unit normals (s, 2, 3)."""
    places = np.stack([np.interp(along, length, axis[:, i]) for i in range(3)], axis=1)
    tangents = np.gradient(places, along, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    crossed = np.abs(tangents[0])
    across = np.eye(3)[np.argmax(crossed <= crossed.min() + _TIE)]
    frames = np.empty((len(along), 2, 3))
    for i, tangent in enumerate(tangents):
        across = across - (across @ tangent) * tangent
        across /= np.linalg.norm(across)
        frames[i] = across, np.cross(tangent, across)
    return places, frames
