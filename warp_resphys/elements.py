"""Finite elements as points: every integration rule is a list of points with a gradient operator and a weight.

A *point* holds the rest-space gradients of the shape functions of its cell's nodes, so that the deformation gradient
there is ``F = sum_a x_a (grad N_a)^T``, and says how much of each element's volume it carries for the shape and for the
volume term of the energy. Gauss points, element centres and averages over vertex patches are all of this form.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from .errors import InputError
from .mesh import Mesh, check_mesh

Array = NDArray[np.float64]

VOLUME_INTEGRATIONS = ("centre", "full")

# Nodes of the reference hexahedron [-1, 1]^3 in VTK order.
_HEXAHEDRON_NODES = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float
)
# Corner pairs whose midpoints are nodes 4 to 9 of the 10-node tetrahedron, in VTK order.
TETRAHEDRON_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])


@dataclass(frozen=True)
class PointSet:
    """Cells with the same number of nodes and of points.

    Attributes:
        nodes: (C, K) vertex of each node of a cell.
        gradients: (C, Q, K, 3) gradients of the shape functions in rest space [1/m].
        shape_volume: (C Q, M) sparse; volume of each element that the point carries for the shape term [m^3].
        volume_volume: (C Q, M) sparse; the same for the volume term [m^3].
    """

    nodes: NDArray[np.int64]
    gradients: Array
    shape_volume: scipy.sparse.csr_array
    volume_volume: scipy.sparse.csr_array

    @property
    def points_per_cell(self) -> int:
        """Q."""
        return self.gradients.shape[1]

    @property
    def n_points(self) -> int:
        """P = C Q."""
        return self.gradients.shape[0] * self.gradients.shape[1]


@dataclass(frozen=True)
class Discretisation:
    """All that a body's mesh and integration rule determine.

    Attributes:
        point_sets: where the energy is evaluated.
        element_volumes: (M,) [m^3].
        load_volume: (N, M) sparse; integral of N_a over each element [m^3]: consistent body forces.
        lumped_volume: (N, M) sparse; positive lumping of each element's volume [m^3]: masses.
    """

    point_sets: tuple[PointSet, ...]
    element_volumes: Array
    load_volume: scipy.sparse.csr_array
    lumped_volume: scipy.sparse.csr_array


def hexahedron_shape(points: Array) -> tuple[Array, Array]:
    """Trilinear shape functions on [-1, 1]^3: values (Q, 8) and reference gradients (Q, 8, 3)."""
    factors = 1.0 + points[:, None, :] * _HEXAHEDRON_NODES  # (Q, 8, 3)
    values = factors.prod(axis=-1) / 8.0
    gradients = np.empty_like(factors)
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        gradients[..., axis] = _HEXAHEDRON_NODES[:, axis] * factors[..., others].prod(axis=-1) / 8.0
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
    return _HEXAHEDRON_NODES / np.sqrt(3.0), np.ones(8)


def gauss_tetrahedron() -> tuple[Array, Array]:
    """4-point rule of degree 2 on the unit tetrahedron (Keast 1986): points (4, 3) and weights (4,)."""
    a, b = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
    return np.full((4, 3), a) + np.concatenate([np.zeros((1, 3)), (b - a) * np.eye(3)]), np.full(4, 1.0 / 24.0)


def degree_four_tetrahedron() -> tuple[Array, Array]:
    """Conical product of 4-point Gauss rules, degree 5 and more, on the unit tetrahedron: (64, 3) and (64,).

    Exact for products of two quadratic functions, which the lumped masses of 10-node tetrahedra need.
    """
    x, w = np.polynomial.legendre.leggauss(4)
    x, w = (x + 1.0) / 2.0, w / 2.0
    a, b, c = (g.ravel() for g in np.meshgrid(x, x, x, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel() * (1.0 - a) ** 2 * (1.0 - b)
    return np.stack([a, b * (1.0 - a), c * (1.0 - a) * (1.0 - b)], axis=1), weights


def physical_gradients(vertices: Array, cells: NDArray[np.int64], reference_gradients: Array) -> tuple[Array, Array]:
    """Gradients in rest space (C, Q, K, 3) [1/m] and Jacobian determinants (C, Q) [m^3] of isoparametric cells."""
    jacobian = np.einsum("cki,qkj->cqij", vertices[cells], reference_gradients)
    return np.einsum("qkj,cqji->cqki", reference_gradients, np.linalg.inv(jacobian)), np.linalg.det(jacobian)


def _one_hot(volumes: Array) -> scipy.sparse.csr_array:
    """(C Q, C) matrix whose row c Q + q holds volumes[c, q] in column c."""
    c, q = volumes.shape
    rows = np.arange(c * q)
    return scipy.sparse.csr_array((volumes.ravel(), (rows, rows // q)), shape=(c * q, c))


def _per_vertex(cells: NDArray[np.int64], n_vertices: int, values: Array) -> scipy.sparse.csr_array:
    """(N, M) matrix that sums values[m, a] into row cells[m, a], column m."""
    columns = np.repeat(np.arange(len(cells)), cells.shape[1])
    matrix = scipy.sparse.coo_array((values.ravel(), (cells.ravel(), columns)), shape=(n_vertices, len(cells)))
    return matrix.tocsr()


def discretise(mesh: Mesh, volume_integration: str = "centre") -> Discretisation:
    """The points, masses and loads of a mesh.

    Hexahedra take 2 x 2 x 2 Gauss points, 10-node tetrahedra 4 and 4-node tetrahedra 1 for the shape term. The volume
    term is under-integrated against locking (``centre``), on a volume-weighted mean deformation gradient: that of each
    element for hexahedra and 10-node tetrahedra, that of the cells around each vertex for 4-node tetrahedra (Bonet and
    Burton 1998). The mean is the value at the centre where an element is not distorted, and passes the patch test where
    it is (Flanagan and Belytschko 1981). ``full`` takes the shape term's points.

    Args:
        mesh: the rest shape.
        volume_integration: ``centre`` or ``full``.

    Raises:
        InputError: an unknown volume integration.
        MeshError: a mesh that cannot be used (see `mesh.check_mesh`).
    """
    if volume_integration not in VOLUME_INTEGRATIONS:
        raise InputError(
            f"volume_integration is {volume_integration!r}: choose one of {', '.join(VOLUME_INTEGRATIONS)}."
        )
    check_mesh(mesh)
    full = volume_integration == "full"
    if mesh.kind == "hexahedron":
        return _isoparametric(mesh, hexahedron_shape, gauss_hexahedron(), full)
    if mesh.kind == "tetrahedron10":
        return _isoparametric(mesh, tetrahedron10_shape, gauss_tetrahedron(), full)
    return _linear_tetrahedra(mesh, full)


def _isoparametric(
    mesh: Mesh,
    shape: Callable[[Array], tuple[Array, Array]],
    rule: tuple[Array, Array],
    full: bool,
) -> Discretisation:
    """Gauss points for the shape term; the same, or one point with their mean gradients, for the volume term."""
    points, weights = rule
    values, reference = shape(points)
    gradients, determinants = physical_gradients(mesh.vertices, mesh.cells, reference)
    volumes = determinants * weights
    element_volumes = volumes.sum(axis=1)
    if full:
        shape_volume = volume_volume = volumes
    else:
        mean = np.einsum("cq,cqki->cki", volumes, gradients) / element_volumes[:, None, None]
        gradients = np.concatenate([gradients, mean[:, None]], axis=1)
        shape_volume = np.concatenate([volumes, np.zeros((len(volumes), 1))], axis=1)
        volume_volume = np.concatenate([np.zeros_like(volumes), element_volumes[:, None]], axis=1)
    load = volumes @ values
    lumped = load if mesh.kind == "hexahedron" else _hrz_lumping(mesh, element_volumes)
    n = len(mesh.vertices)
    return Discretisation(
        (PointSet(mesh.cells, gradients, _one_hot(shape_volume), _one_hot(volume_volume)),),
        element_volumes,
        _per_vertex(mesh.cells, n, load),
        _per_vertex(mesh.cells, n, lumped),
    )


def _hrz_lumping(mesh: Mesh, element_volumes: Array) -> Array:
    """(M, K) volumes in proportion to the consistent mass matrix's diagonal (Hinton, Rock, Zienkiewicz 1976).

    Row sums of the quadratic tetrahedron are negative at its corners; these are positive and keep the volume.
    """
    points, weights = degree_four_tetrahedron()
    values, reference = tetrahedron10_shape(points)
    _, determinants = physical_gradients(mesh.vertices, mesh.cells, reference)
    diagonal = (determinants * weights) @ values**2
    return diagonal * (element_volumes / diagonal.sum(axis=1))[:, None]


def _linear_tetrahedra(mesh: Mesh, full: bool) -> Discretisation:
    """One point a cell for the shape term; the same, or vertex patches, for the volume term."""
    _, reference = tetrahedron_shape(np.full((1, 3), 0.25))
    gradients, determinants = physical_gradients(mesh.vertices, mesh.cells, reference)
    volumes = determinants / 6.0  # (M, 1)
    n, m = len(mesh.vertices), len(mesh.cells)
    quarter = _per_vertex(mesh.cells, n, np.repeat(volumes / 4.0, 4, axis=1))
    own = _one_hot(volumes)
    nothing = scipy.sparse.csr_array((m, m))
    cells = PointSet(mesh.cells, gradients, own, own if full else nothing)
    sets = (cells,) if full else (cells, _vertex_patches(mesh, gradients[:, 0], quarter))
    return Discretisation(sets, volumes[:, 0], quarter, quarter)


def _vertex_patches(mesh: Mesh, gradients: Array, quarter: scipy.sparse.csr_array) -> PointSet:
    """One point a vertex with the mean gradient operator of the cells around it, padded to the largest patch."""
    n = len(mesh.vertices)
    shares = quarter.tocoo()
    vertex, cell = shares.row, shares.col
    share = shares.data / np.asarray(quarter.sum(axis=1)).ravel()[vertex]
    node = mesh.cells[cell].ravel()
    keys, inverse = np.unique(np.repeat(vertex, 4) * n + node, return_inverse=True)
    operator = np.zeros((len(keys), 3))
    np.add.at(operator, inverse, (share[:, None, None] * gradients[cell]).reshape(-1, 3))
    row, column = keys // n, keys % n
    place = np.arange(len(keys)) - np.searchsorted(row, np.arange(n))[row]
    width = int(place.max()) + 1
    nodes = np.repeat(np.arange(n)[:, None], width, axis=1)
    padded = np.zeros((n, 1, width, 3))
    nodes[row, place] = column
    padded[row, 0, place] = operator
    return PointSet(nodes, padded, scipy.sparse.csr_array((n, len(mesh.cells))), quarter)
