"""Shape functions of the reference cells and quadrature rules on them. Nodes are in VTK's order."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# (8, 3) nodes of the reference hexahedron [-1, 1]^3.
HEXAHEDRON_NODES = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float
)
# (4, 3) nodes of the unit tetrahedron.
TETRAHEDRON_NODES = np.concatenate([np.zeros((1, 3)), np.eye(3)])
# (6, 2) edges of the tetrahedron; their midpoints are nodes 4 to 9 of the 10-node one.
TETRAHEDRON_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
# (10, 3) nodes of the 10-node unit tetrahedron.
TETRAHEDRON10_NODES = np.concatenate([TETRAHEDRON_NODES, TETRAHEDRON_NODES[TETRAHEDRON_EDGES].mean(axis=1)])

# (3, 2) edges of the triangle; their midpoints are nodes 3 to 5 of the 6-node one.
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [2, 0]])
# (4, 2) nodes of the reference quadrilateral [-1, 1]^2.
QUADRILATERAL_NODES = HEXAHEDRON_NODES[:4, :2]


def hexahedron_shape(points: Array) -> tuple[Array, Array]:
    """Trilinear shape functions on [-1, 1]^3: values (Q, 8) and reference gradients (Q, 8, 3)."""
    factors = 1.0 + points[:, None, :] * HEXAHEDRON_NODES  # (Q, 8, 3)
    values = factors.prod(axis=-1) / 8.0
    gradients = np.empty_like(factors)
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        gradients[..., axis] = HEXAHEDRON_NODES[:, axis] * factors[..., others].prod(axis=-1) / 8.0
    return values, gradients


def tetrahedron_shape(points: Array) -> tuple[Array, Array]:
    """Linear shape functions on the unit tetrahedron: values (Q, 4) and reference gradients (Q, 4, 3)."""
    values = np.concatenate([1.0 - points.sum(axis=1, keepdims=True), points], axis=1)
    gradients = np.concatenate([-np.ones((1, 3)), np.eye(3)])
    return values, np.broadcast_to(gradients, (len(points), 4, 3)).copy()


def tetrahedron10_shape(points: Array) -> tuple[Array, Array]:
    """Quadratic shape functions on the unit tetrahedron: values (Q, 10) and reference gradients (Q, 10, 3)."""
    corner, corner_gradient = tetrahedron_shape(points)
    i, j = TETRAHEDRON_EDGES.T
    values = np.concatenate([corner * (2.0 * corner - 1.0), 4.0 * corner[:, i] * corner[:, j]], axis=1)
    at_corners = (4.0 * corner - 1.0)[..., None] * corner_gradient
    at_edges = 4.0 * (corner[:, i, None] * corner_gradient[:, j] + corner[:, j, None] * corner_gradient[:, i])
    return values, np.concatenate([at_corners, at_edges], axis=1)


def gauss_hexahedron() -> tuple[Array, Array]:
    """2 x 2 x 2 Gauss rule on [-1, 1]^3: points (8, 3) and weights (8,)."""
    return HEXAHEDRON_NODES / np.sqrt(3.0), np.ones(8)


def gauss_tetrahedron() -> tuple[Array, Array]:
    """4-point rule of degree 2 on the unit tetrahedron (Keast 1986): points (4, 3) and weights (4,)."""
    a, b = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
    return a + (b - a) * TETRAHEDRON_NODES, np.full(4, 1.0 / 24.0)


def degree_four_tetrahedron() -> tuple[Array, Array]:
    """Conical product of 4-point Gauss rules, degree 5 and more, on the unit tetrahedron: (64, 3) and (64,).

    Exact for products of two quadratic functions, which the lumped masses of 10-node tetrahedra need.
    """
    x, w = np.polynomial.legendre.leggauss(4)
    x, w = (x + 1.0) / 2.0, w / 2.0
    a, b, c = (g.ravel() for g in np.meshgrid(x, x, x, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel() * (1.0 - a) ** 2 * (1.0 - b)
    return np.stack([a, b * (1.0 - a), c * (1.0 - a) * (1.0 - b)], axis=1), weights


def triangle_shape(points: Array) -> tuple[Array, Array]:
    """Linear shape functions on the unit triangle: values (Q, 3) and reference gradients (Q, 3, 2)."""
    values = np.concatenate([1.0 - points.sum(axis=1, keepdims=True), points], axis=1)
    gradients = np.concatenate([-np.ones((1, 2)), np.eye(2)])
    return values, np.broadcast_to(gradients, (len(points), 3, 2)).copy()


def triangle6_shape(points: Array) -> tuple[Array, Array]:
    """Quadratic shape functions on the unit triangle: values (Q, 6) and reference gradients (Q, 6, 2)."""
    corner, corner_gradient = triangle_shape(points)
    i, j = TRIANGLE_EDGES.T
    values = np.concatenate([corner * (2.0 * corner - 1.0), 4.0 * corner[:, i] * corner[:, j]], axis=1)
    at_corners = (4.0 * corner - 1.0)[..., None] * corner_gradient
    at_edges = 4.0 * (corner[:, i, None] * corner_gradient[:, j] + corner[:, j, None] * corner_gradient[:, i])
    return values, np.concatenate([at_corners, at_edges], axis=1)


def quadrilateral_shape(points: Array) -> tuple[Array, Array]:
    """Bilinear shape functions on [-1, 1]^2: values (Q, 4) and reference gradients (Q, 4, 2)."""
    factors = 1.0 + points[:, None, :] * QUADRILATERAL_NODES  # (Q, 4, 2)
    gradients = np.stack([QUADRILATERAL_NODES[:, i] * factors[..., 1 - i] for i in range(2)], axis=-1) / 4.0
    return factors.prod(axis=-1) / 4.0, gradients


def gauss_quadrilateral() -> tuple[Array, Array]:
    """2 x 2 Gauss rule on [-1, 1]^2: points (4, 2) and weights (4,)."""
    return QUADRILATERAL_NODES / np.sqrt(3.0), np.ones(4)


def gauss_triangle(degree: int) -> tuple[Array, Array]:
    """Conical product of Gauss rules on the unit triangle, exact up to a degree: (n^2, 2) points and (n^2,) weights."""
    if degree <= 1:
        return np.full((1, 2), 1.0 / 3.0), np.full(1, 0.5)
    x, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
    x, w = (x + 1.0) / 2.0, w / 2.0
    a, b = (g.ravel() for g in np.meshgrid(x, x, indexing="ij"))
    return np.stack([a, b * (1.0 - a)], axis=1), np.outer(w, w).ravel() * (1.0 - a)
