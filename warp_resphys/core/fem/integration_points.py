"""Finite elements as points: every integration rule is a list of points
with a gradient operator and weights.

A *point* has the rest-space gradients of the shape functions of its cell's nodes, which give the
deformation gradient ``F = sum_a x_a (grad N_a)^T``, and its share of each element's volume in the
shape term and in the volume term of the energy. Gauss points, element centres and averages over
vertex patches all have this form.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, Self, get_args

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ...io.errors import InputError
from ..mesh.elements import BY_NODES, Array, conical_simplex, gauss_box
from ..mesh.volume_mesh import Mesh, check_mesh

VolumeIntegration = Literal["centre", "full"]
VOLUME_INTEGRATIONS: tuple[VolumeIntegration, ...] = get_args(VolumeIntegration)
# Lode's parameter of a loading mode: tension extends one direction, compression (or biaxial
# tension) two.
LODE: Final = {"tension": -1.0, "shear": 0.0, "compression": 1.0}
_ALIKE: Final = 0.05  # strain up to which all modes are alike
_MOST_STATES = 400


@dataclass(frozen=True)
class Points:
    """Cells with K nodes and Q points each; at a point, F = sum_a x_a g_a^T."""

    nodes: NDArray[np.int64]  # (C, K) vertex of each node of a cell
    # (C, Q, K, 3) operators g_a; in a solid, gradients of the shape functions in rest space [1/m].
    # (C, Q, K, 1) where the energy is a function of a vector sum_a g_a x_a
    gradients: Array

    @property
    def points_per_cell(self) -> int:
        """Number of points per cell Q."""
        return self.gradients.shape[1]

    @property
    def n_points(self) -> int:
        """Number of points P = C Q."""
        return self.gradients.shape[0] * self.gradients.shape[1]

    def shifted(self, first: int) -> Self:
        """Returns the points with numbers of vertices that begin at `first`."""
        return replace(self, nodes=self.nodes + first)


@dataclass(frozen=True)
class SolidPoints(Points):
    """Points of a solid."""

    # (C Q, M) sparse; volume of each element that the point carries, in the shape term and in the
    # volume term [m^3]
    shape_volume: scipy.sparse.csr_array
    volume_volume: scipy.sparse.csr_array


@dataclass(frozen=True)
class Discretisation:
    """Integration points and volumes of a mesh."""

    point_sets: tuple[SolidPoints, ...]  # where the energy is evaluated
    element_volumes: Array  # (M,) [m^3]
    # (N, M) sparse; integral of N_a over each element [m^3]: consistent body forces
    load_volume: scipy.sparse.csr_array
    lumped_volume: scipy.sparse.csr_array  # (N, M) sparse; positively lumped volumes [m^3]: masses


def physical_gradients(
    vertices: Array, cells: NDArray[np.int64], reference_gradients: Array
) -> tuple[Array, Array]:
    """Returns rest-space gradients (C, Q, K, 3) [1/m]
    and Jacobian determinants (C, Q) [m^3] of isoparametric cells.
    """
    jacobian = np.einsum("cki,qkj->cqij", vertices[cells], reference_gradients)
    return np.einsum("qkj,cqji->cqki", reference_gradients, np.linalg.inv(jacobian)), np.linalg.det(
        jacobian
    )


def volume_points(mesh: Mesh, cells: NDArray[np.int64]) -> tuple[Array, Array]:
    """Returns places (P, 3) [m] and volumes (P,) [m^3] of points
    by which to integrate polynomials over cells.
    """
    points, weights = conical_simplex(4) if mesh.element.is_simplex else gauss_box(4)
    values, reference = mesh.element.shape(points)
    _, determinants = physical_gradients(mesh.vertices, mesh.cells[cells], reference)
    places = np.einsum("qk,cki->cqi", values, mesh.vertices[mesh.cells[cells]])
    return places.reshape(-1, 3), (determinants * weights).ravel()


def _one_hot(volumes: Array) -> scipy.sparse.csr_array:
    """Returns the (C Q, C) matrix whose row c Q + q holds volumes[c, q] in column c."""
    c, q = volumes.shape
    rows = np.arange(c * q)
    return scipy.sparse.csr_array((volumes.ravel(), (rows, rows // q)), shape=(c * q, c))


def _per_vertex(cells: NDArray[np.int64], n_vertices: int, values: Array) -> scipy.sparse.csr_array:
    """Returns the (N, M) matrix that sums values[m, a] into row cells[m, a], column m."""
    columns = np.repeat(np.arange(len(cells)), cells.shape[1])
    return scipy.sparse.csr_array(
        (values.ravel(), (cells.ravel(), columns)), shape=(n_vertices, len(cells))
    )


def discretise(
    mesh: Mesh,
    volume_integration: str = "centre",
    cells: NDArray[np.int64] | None = None,
    cracks: bool = False,
) -> Discretisation:
    """Returns the points, masses and loads of a mesh, or of some of its cells.

    The shape term uses the points of the element's rule. With ``centre``, the volume term is
    under-integrated against locking, on deformation gradients projected on few polynomials per
    element (Simo and Hughes 1998, section 4.4): constants, that is the volume-weighted mean, for
    8-node hexahedra and 10-node tetrahedra, linear polynomials for quadratic hexahedra; or on their
    mean over the cells around each vertex, for 4-node tetrahedra (Bonet and Burton 1998).
    Projections pass the patch test on distorted elements too (Flanagan and Belytschko 1981). With
    ``full``, the volume term uses the points of the shape term.

    Args:
        mesh: the rest shape.
        volume_integration: ``centre`` or ``full``.
        cells: (M',) cell indices, all cells if omitted. Averages over patches are restricted to
            these cells.
        cracks: whether vertices may coincide, like those of glued parts.

    Raises:
        InputError: an unknown volume integration.
        MeshError: a mesh that cannot be used (see `volume_mesh.check_mesh`).
    """
    if volume_integration not in VOLUME_INTEGRATIONS:
        raise InputError(
            f"volume_integration is {volume_integration!r}: choose one of "
            f"{', '.join(VOLUME_INTEGRATIONS)}."
        )
    if cells is not None:
        return _discretise_cells(mesh, volume_integration, cells, cracks)
    check_mesh(mesh, cracks)
    full = volume_integration == "full"
    if mesh.element.volume_modes is None:
        return _linear_tetrahedra(mesh, full)
    return _isoparametric(mesh, full)


def _discretise_cells(
    mesh: Mesh, volume_integration: str, cells: NDArray[np.int64], cracks: bool
) -> Discretisation:
    """Returns the discretisation of a submesh, with the vertex numbers of the whole mesh."""
    used, renumbered = np.unique(mesh.cells[cells], return_inverse=True)
    part = Mesh(mesh.vertices[used], renumbered.reshape(-1, mesh.cells.shape[1]))
    discretised = discretise(part, volume_integration, cracks=cracks)
    spread = scipy.sparse.eye_array(len(mesh.vertices), format="csc")[:, used]
    return Discretisation(
        tuple(replace(points, nodes=used[points.nodes]) for points in discretised.point_sets),
        discretised.element_volumes,
        scipy.sparse.csr_array(spread @ discretised.load_volume),
        scipy.sparse.csr_array(spread @ discretised.lumped_volume),
    )


def _isoparametric(mesh: Mesh, full: bool) -> Discretisation:
    """A discretisation with one rule for both terms, or projected gradients for the volume term."""
    element = mesh.element
    points, weights = element.rule
    values, reference = element.shape(points)
    gradients, determinants = physical_gradients(mesh.vertices, mesh.cells, reference)
    volumes = determinants * weights
    element_volumes = volumes.sum(axis=1)
    if full:
        shape_volume = volume_volume = volumes
    else:
        projected, projected_volumes = _projected(mesh, points, volumes, gradients)
        gradients = np.concatenate([gradients, projected], axis=1)
        shape_volume = np.concatenate([volumes, np.zeros_like(projected_volumes)], axis=1)
        volume_volume = np.concatenate([np.zeros_like(volumes), projected_volumes], axis=1)
    load = volumes @ values
    lumped = load if element.mass_rule is None else _hrz_lumping(mesh, element_volumes)
    n = len(mesh.vertices)
    return Discretisation(
        (SolidPoints(mesh.cells, gradients, _one_hot(shape_volume), _one_hot(volume_volume)),),
        element_volumes,
        _per_vertex(mesh.cells, n, load),
        _per_vertex(mesh.cells, n, lumped),
    )


def _projected(mesh: Mesh, points: Array, volumes: Array, gradients: Array) -> tuple[Array, Array]:
    """Returns projected gradients (M, Q', K, 3) [1/m]
    and volumes (M, Q') [m^3] of the points of the volume term.

    The least-squares projection on the element's modes phi_n, by volume at the points of the shape
    term, is sum_n phi_n(x) M^-1_nm sum_q v_q phi_m(x_q) g_q with M_nm = sum_q v_q phi_n(x_q)
    phi_m(x_q). The volumes of the rule are corrected (smallest change) to integrate the modes as
    the points of the shape term do, which the patch test needs.

    Args:
        mesh: the mesh.
        points: (Q, 3) points of the shape term, in the reference element.
        volumes: (M, Q) volumes of these points [m^3].
        gradients: (M, Q, K, 3) gradients at these points [1/m].
    """
    element = mesh.element
    assert element.volume_modes is not None
    if element.volume_rule is None:
        mean = np.einsum("cq,cqki->cki", volumes, gradients) / volumes.sum(axis=1)[:, None, None]
        return mean[:, None], volumes.sum(axis=1, keepdims=True)
    at, weights = element.volume_rule
    modes, there = (np.prod(x[:, None, :] ** element.volume_modes, axis=-1) for x in (points, at))
    gram = np.einsum("cq,qn,qm->cnm", volumes, modes, modes)
    moments = np.einsum("cq,qm,cqki->cmki", volumes, modes, gradients)
    coefficients = np.linalg.solve(gram, moments.reshape(*moments.shape[:2], -1)).reshape(
        moments.shape
    )
    _, determinants = physical_gradients(mesh.vertices, mesh.cells, element.shape(at)[1])
    corrected = determinants * weights
    missing = volumes @ modes - corrected @ there
    corrected += np.linalg.solve(there.T @ there, missing.T).T @ there.T
    return np.einsum("pn,cnki->cpki", there, coefficients), corrected


def _hrz_lumping(mesh: Mesh, element_volumes: Array) -> Array:
    """Returns volumes (M, K) in proportion to the diagonal
    of the consistent mass (Hinton, Rock, Zienkiewicz 1976).

    Row sums of quadratic elements may be negative at corners; these volumes are positive and sum to
    the element's.
    """
    assert mesh.element.mass_rule is not None
    points, weights = mesh.element.mass_rule
    values, reference = mesh.element.shape(points)
    _, determinants = physical_gradients(mesh.vertices, mesh.cells, reference)
    diagonal = (determinants * weights) @ values**2
    return diagonal * (element_volumes / diagonal.sum(axis=1))[:, None]


def _linear_tetrahedra(mesh: Mesh, full: bool) -> Discretisation:
    """Returns a discretisation with one point per cell for the shape term.

    These or vertex patches for the volume.
    """
    points, weights = mesh.element.rule
    gradients, determinants = physical_gradients(
        mesh.vertices, mesh.cells, mesh.element.shape(points)[1]
    )
    volumes = determinants * weights  # (M, 1)
    n, m = len(mesh.vertices), len(mesh.cells)
    quarter = _per_vertex(mesh.cells, n, np.repeat(volumes / 4.0, 4, axis=1))
    volume_of_cell = _one_hot(volumes)
    nothing = scipy.sparse.csr_array((m, m))
    cells = SolidPoints(mesh.cells, gradients, volume_of_cell, volume_of_cell if full else nothing)
    if full:
        return Discretisation((cells,), volumes[:, 0], quarter, quarter)
    nodes, operator = mean_gradients(mesh.cells, gradients[:, 0], quarter)
    patches = SolidPoints(nodes, operator[:, None], scipy.sparse.csr_array((n, m)), quarter)
    return Discretisation((cells, patches), volumes[:, 0], quarter, quarter)


def mean_gradients(
    cells: NDArray[np.int64], gradients: Array, shares: scipy.sparse.csr_array
) -> tuple[NDArray[np.int64], Array]:
    """Returns the mean gradient operator of cells around each vertex, padded to the largest patch.

    Args:
        cells: (M, K) vertices of each cell.
        gradients: (M, K, 3) rest-space gradients of the shape functions [1/m].
        shares: (N, M) sparse; weight of each cell at each vertex, a volume [m^3].

    Returns:
        (N, W) vertices of each patch and (N, W, 3) their operators [1/m].
    """
    n, k = shares.shape[0], cells.shape[1]
    parts = shares.tocoo()
    vertex, cell = parts.row, parts.col
    share = parts.data / np.asarray(shares.sum(axis=1)).ravel()[vertex]
    operators = (share[:, None, None] * gradients[cell]).reshape(-1, 3)
    return padded_operators(np.repeat(vertex, k), cells[cell].ravel(), operators, np.arange(n))


def padded_operators(
    rows: NDArray[np.int64], nodes: NDArray[np.int64], operators: Array, padding: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array]:
    """Sums the operators of each node in a row, and pads the rows to one width.

    Args:
        rows: (E,) row of each operator.
        nodes: (E,) vertex on which it acts.
        operators: (E, ...) operators.
        padding: (R,) vertex of each row that fills it up, with operators of zero.

    Returns:
        (R, W) vertices of each row and (R, W, ...) their operators.
    """
    count = int(nodes.max()) + 1
    keys, inverse = np.unique(rows * count + nodes, return_inverse=True)
    sums = np.zeros((len(keys), *operators.shape[1:]))
    np.add.at(sums, inverse, operators)
    row, column = np.divmod(keys, count)
    place = np.arange(len(keys)) - np.searchsorted(row, np.arange(len(padding)))[row]
    padded_nodes = np.repeat(padding[:, None], int(place.max()) + 1, axis=1)
    padded = np.zeros((*padded_nodes.shape, *operators.shape[1:]))
    padded_nodes[row, place], padded[row, place] = column, sums
    return padded_nodes, padded


def principal_stretches(mesh: Mesh, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the principal stretches at centres of cells, of at most 400 of states, evenly chosen.

    Args:
        mesh: undeformed mesh of C cells.
        positions: (S, N, 3) vertices of some states [m].

    Returns:
        (S', C, 3) singular values of the deformation gradient, descending; NaN where a position is
        not finite.
    """
    element = BY_NODES[mesh.cells.shape[1]]
    centre = element.shape.nodes[: element.nodes - len(element.parents)].mean(axis=0)
    gradients, _ = physical_gradients(mesh.vertices, mesh.cells, element.shape(centre[None])[1])
    chosen = positions[:: max(1, -(-len(positions) // _MOST_STATES))]
    deformation = np.einsum("scki,ckj->scij", chosen[:, mesh.cells], gradients[:, 0])
    finite = np.isfinite(deformation).all((-2, -1))
    values = np.full(deformation.shape[:-1], np.nan)
    values[finite] = np.linalg.svd(deformation[finite], compute_uv=False)
    return values


def share_outside(
    stretches: NDArray[np.float64], between: Sequence[float], modes: Collection[str] = tuple(LODE)
) -> float:
    """Returns the share of cells and states with a principal stretch outside of a range,
    or another loading mode.

    The mode is Lode's parameter (2 e_2 - e_1 - e_3) / (e_1 - e_3) of the logarithms e of the
    stretches, see `LODE`. It may be half a step beyond those of the modes. Strains of up to 5 % are
    alike in all modes.

    Args:
        stretches: (S, C, 3) principal stretches.
        between: least and largest stretch of the range.
        modes: those of the range, of `LODE`.
    """
    known = np.sort(stretches[np.isfinite(stretches).all(-1)])
    least, middle, largest = np.log(np.maximum(known, 1e-12)).T
    lode = (2.0 * middle - least - largest) / np.maximum(largest - least, 1e-12)
    ends = [LODE[mode] for mode in modes]
    other = (lode < min(ends) - 0.5) | (lode > max(ends) + 0.5)
    small = np.abs(known - 1.0).max(axis=1, initial=0.0) <= _ALIKE
    outside = (known[:, 0] < between[0]) | (known[:, 2] > between[1]) | (other & ~small)
    return float(outside.mean())
