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

from ..io.errors import InputError
from ..mesh.mesh import Mesh, check_mesh
from ..mesh.shape_functions import (
    Array,
    degree_four_tetrahedron,
    gauss_hexahedron,
    gauss_tetrahedron,
    hexahedron_shape,
    tetrahedron10_shape,
    tetrahedron_shape,
)

VOLUME_INTEGRATIONS = ("centre", "full")


@dataclass(frozen=True)
class Points:
    """Cells with the same number of nodes and of points, each point with the matrix F = sum_a x_a g_a^T.

    Attributes:
        nodes: (C, K) vertex of each node of a cell.
        gradients: (C, Q, K, 3) operators g_a; in a solid, gradients of the shape functions in rest space [1/m].
    """

    nodes: NDArray[np.int64]
    gradients: Array

    @property
    def points_per_cell(self) -> int:
        """Q."""
        return self.gradients.shape[1]

    @property
    def n_points(self) -> int:
        """P = C Q."""
        return self.gradients.shape[0] * self.gradients.shape[1]


@dataclass(frozen=True)
class PointSet(Points):
    """Points of a solid.

    Attributes:
        shape_volume: (C Q, M) sparse; volume of each element that the point carries for the shape term [m^3].
        volume_volume: (C Q, M) sparse; the same for the volume term [m^3].
    """

    shape_volume: scipy.sparse.csr_array
    volume_volume: scipy.sparse.csr_array


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


def mean_gradients(
    cells: NDArray[np.int64], gradients: Array, shares: scipy.sparse.csr_array
) -> tuple[NDArray[np.int64], Array]:
    """The mean gradient operator of the cells around each vertex, padded to the largest patch.

    Args:
        cells: (M, K) vertices of each cell.
        gradients: (M, K, 3) of its shape functions in rest space [1/m].
        shares: (N, M) sparse; volume of each cell that counts at each vertex [m^3].

    Returns:
        (N, W) vertices of each patch and (N, W, 3) their operators [1/m].
    """
    n, k = shares.shape[0], cells.shape[1]
    parts = shares.tocoo()
    vertex, cell = parts.row, parts.col
    share = parts.data / np.asarray(shares.sum(axis=1)).ravel()[vertex]
    node = cells[cell].ravel()
    keys, inverse = np.unique(np.repeat(vertex, k) * n + node, return_inverse=True)
    operator = np.zeros((len(keys), 3))
    np.add.at(operator, inverse, (share[:, None, None] * gradients[cell]).reshape(-1, 3))
    row, column = keys // n, keys % n
    place = np.arange(len(keys)) - np.searchsorted(row, np.arange(n))[row]
    width = int(place.max()) + 1
    nodes = np.repeat(np.arange(n)[:, None], width, axis=1)
    padded = np.zeros((n, width, 3))
    nodes[row, place] = column
    padded[row, place] = operator
    return nodes, padded


def _vertex_patches(mesh: Mesh, gradients: Array, quarter: scipy.sparse.csr_array) -> PointSet:
    """One point a vertex with the mean gradient operator of the cells around it."""
    nodes, operator = mean_gradients(mesh.cells, gradients, quarter)
    return PointSet(nodes, operator[:, None], scipy.sparse.csr_array((len(nodes), len(mesh.cells))), quarter)
