"""Quality and volumes of the cells of a mesh."""

import numpy as np

from ...io.arrays import FloatArray, IntArray
from .elements import ELEMENTS
from .volume_mesh import Mesh, boundary_faces


def scaled_jacobian(mesh: Mesh) -> FloatArray:
    """Returns the smallest scaled Jacobian of each cell (M,) (Knupp 2000), from -1 to 1.

    It is 1 for a cube or a regular tetrahedron, 0 for a flat cell. At a corner, it is the volume
    spanned by the edges, over the product of their lengths. All corners of a tetrahedron span the
    same volume, and the largest product counts. Nodes between corners are ignored.
    """
    linear = ELEMENTS[mesh.element.linear]
    corners = mesh.vertices[mesh.cells[:, : linear.nodes]]
    both = np.concatenate([linear.edges, linear.edges[:, ::-1]])
    # (corners, 3)
    spokes = np.stack([both[both[:, 0] == corner, 1] for corner in range(linear.nodes)])
    edges = corners[:, spokes] - corners[:, : linear.nodes, None]  # (M, corners, 3 edges, 3)
    spanned = np.einsum("qki,mkj->mqij", linear.shape(linear.shape.nodes)[1], corners)
    sizes = np.linalg.norm(edges, axis=-1).prod(axis=-1)
    lengths = np.linalg.norm(spanned, axis=-1).prod(axis=-1)
    if linear.nodes == 4:  # constant Jacobian, sqrt(1/2) of the product for a regular tetrahedron
        return np.asarray(np.sqrt(2.0) * np.linalg.det(spanned[:, 0]) / sizes.max(axis=1))
    return np.asarray((np.linalg.det(spanned) / lengths).min(axis=1))


def cell_volumes(mesh: Mesh) -> FloatArray:
    """Returns the volume of each cell, (M,) [m^3]."""
    points, weights = mesh.element.rule
    jacobians = np.einsum("qki,mkj->mqij", mesh.element.shape(points)[1], mesh.vertices[mesh.cells])
    return np.asarray(np.linalg.det(jacobians) @ weights)


def is_one_cell_thick(mesh: Mesh, cells: IntArray) -> bool:
    """Returns whether every vertex of some cells is on their surface."""
    surface = boundary_faces(Mesh(mesh.vertices, mesh.cells[cells]))
    return len(np.unique(surface)) == len(np.unique(mesh.cells[cells]))
