"""How well shaped the cells of a mesh are, and how large."""

import numpy as np

from .elements import ELEMENTS
from .mesh import FloatArray, IntArray, Mesh


def scaled_jacobian(mesh: Mesh) -> FloatArray:
    """Smallest scaled Jacobian of each cell (Knupp 2000): 1 for a cube or a regular tetrahedron, 0 for a flat cell.

    At each corner, it is the volume that the edges there span, over the product of their lengths. A tetrahedron's
    corners share one volume, and are compared by the largest product; nodes between corners are not looked at.

    Returns:
        (M,) from -1 to 1.
    """
    linear = ELEMENTS[mesh.element.linear]
    corners = mesh.vertices[mesh.cells[:, : linear.nodes]]
    spokes = np.stack([_spokes(linear.edges, corner) for corner in range(linear.nodes)])  # (corners, 3)
    edges = corners[:, spokes] - corners[:, : linear.nodes, None]  # (M, corners, 3 edges, 3)
    spanned = np.einsum("qki,mkj->mqij", linear.shape(linear.shape.nodes)[1], corners)
    sizes = np.linalg.norm(edges, axis=-1).prod(axis=-1)
    lengths = np.linalg.norm(spanned, axis=-1).prod(axis=-1)
    if linear.nodes == 4:  # whose Jacobian is the same everywhere; sqrt(1/2) of the product if it is regular
        return np.asarray(np.sqrt(2.0) * np.linalg.det(spanned[:, 0]) / sizes.max(axis=1))
    return np.asarray((np.linalg.det(spanned) / lengths).min(axis=1))


def _spokes(edges: IntArray, corner: int) -> IntArray:
    """(3,) the corners at the other ends of the edges of one."""
    mine = edges[(edges == corner).any(axis=1)]
    return np.where(mine[:, 0] == corner, mine[:, 1], mine[:, 0])


def cell_volumes(mesh: Mesh) -> FloatArray:
    """Volume of each cell [m^3], (M,)."""
    points, weights = mesh.element.rule
    jacobians = np.einsum("qki,mkj->mqij", mesh.element.shape(points)[1], mesh.vertices[mesh.cells])
    return np.asarray(np.linalg.det(jacobians) @ weights)
