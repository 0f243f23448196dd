"""How well shaped the cells of a mesh are, and how large."""

import numpy as np

from .mesh import FloatArray, Mesh
from .shape_functions import HEXAHEDRON_NODES, gauss_hexahedron, hexahedron_shape

_REGULAR_TETRAHEDRON = np.sqrt(2.0)  # makes the scaled Jacobian of a regular tetrahedron 1


def scaled_jacobian(mesh: Mesh) -> FloatArray:
    """Smallest scaled Jacobian of each cell (Knupp 2000): 1 for a cube or a regular tetrahedron, 0 for a flat cell.

    At each corner, it is the volume that the edges there span, over the product of their lengths. A tetrahedron's
    corners share one volume, and are compared by the largest product; midpoints of edges are not looked at.

    Args:
        mesh: The mesh.

    Returns:
        (M,) from -1 to 1.
    """
    corners = mesh.vertices[mesh.cells]
    if mesh.kind == "hexahedron":
        edges = _hexahedron_edges(corners, HEXAHEDRON_NODES)
        lengths = np.linalg.norm(edges, axis=-1).prod(axis=-1)
        return np.asarray((np.linalg.det(edges) / lengths).min(axis=1))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    spokes = corners[:, others] - corners[:, :4, None]  # (M, 4 corners, 3 edges, 3)
    longest = np.linalg.norm(spokes, axis=-1).prod(axis=-1).max(axis=1)
    return np.asarray(_REGULAR_TETRAHEDRON * np.linalg.det(spokes[:, 0]) / longest)


def cell_volumes(mesh: Mesh) -> FloatArray:
    """Volume of each cell [m^3], (M,); edges of tetrahedra are taken to be straight."""
    corners = mesh.vertices[mesh.cells]
    if mesh.kind == "hexahedron":
        points, weights = gauss_hexahedron()
        return np.asarray(np.linalg.det(_hexahedron_edges(corners, points)) @ weights)
    return np.asarray(np.linalg.det(corners[:, 1:4] - corners[:, :1]) / 6.0)


def _hexahedron_edges(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Derivatives (M, Q, 3, 3) of the positions by the reference coordinates, as rows, at points (Q, 3)."""
    return np.einsum("qki,mkj->mqij", hexahedron_shape(points)[1], corners)
