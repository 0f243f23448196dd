"""Vibration modes of a body about its rest shape."""

from dataclasses import replace

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import torch

from ...io.arrays import FloatArray, IntArray
from ...io.errors import InputError
from ..energies.materials import VISCOUS
from .simulator import Simulator

_DENSE = 600  # largest number of unknowns for a dense eigensolver
_MORE = 6  # modes beyond the count, so that no cluster is cut: a free body has six rigid-body modes
_AXES = np.array([1.0, 2.0, 4.0])  # weights of x, y and z, with distinct pairwise means
_SAME = 1e-4  # relative difference up to which eigenvalues count as equal
_ZERO = 1e-12  # absolute difference for zero eigenvalues, in units of the largest entry


def vibration_modes(simulator: Simulator, count: int) -> torch.Tensor:
    """Returns orthonormal columns (3 N, count) that span the inertial forces M phi
    of the lowest vibration modes.

    The modes phi solve K phi = omega^2 M phi with the stiffness K of the rest shape. They do not
    depend on rounding: modes of equal frequency, such as the bending modes of a square beam, get a
    unique basis from `align_degenerate_modes`; if the count cuts a cluster, its first modes are
    used.

    Raises:
        InputError: `count` is not between one and the number of free coordinates.
    """
    stiffness, inertia, free = _about_rest(simulator)
    unknowns = inertia.shape[0]
    if not 1 <= count <= unknowns:
        raise InputError(
            f"{count} vibration modes were asked for, but the body has 1 to {unknowns}."
        )
    root = _root(inertia)
    unscale = _inverse(root)
    scaled = (unscale.T @ stiffness @ unscale).tocsc()
    number = min(count + _MORE, unknowns)
    if unknowns <= max(_DENSE, number):
        values, shapes = scipy.linalg.eigh(scaled.toarray(), subset_by_index=[0, number - 1])
    else:
        # Lanczos with a shift slightly below zero, where a free body is regular too, and a fixed
        # starting vector.
        below = -1e-8 * float(scaled.diagonal().max())
        values, shapes = scipy.sparse.linalg.eigsh(
            scaled, number, sigma=below, v0=np.ones(unknowns)
        )
        order = np.argsort(values)
        values, shapes = values[order], shapes[:, order]
    same = _SAME * np.abs(values) + _ZERO * scaled.diagonal().max()
    shapes = align_degenerate_modes(values, shapes, simulator.body.mesh.vertices[free], same)
    shapes = shapes[:, :count]
    orthonormal = fix_signs(np.linalg.qr(root.T @ shapes)[0])
    basis = simulator.rest_positions.new_zeros(simulator.body.n_vertices, 3, count)
    basis[free] = simulator.tensor(orthonormal.reshape(-1, 3, count))
    return basis.flatten(0, 1)


def align_degenerate_modes(
    values: FloatArray, shapes: FloatArray, positions: FloatArray, same: FloatArray | float
) -> FloatArray:
    """Returns orthonormal shapes (3 F, m) with a unique basis,
    along the axes, for each set of equal eigenvalues.

    An eigensolver returns an arbitrary basis of such a set, which depends on rounding. This basis
    diagonalises a weighted sum of squares. The weights differ by axis, to separate bending in two
    directions, and grow along the axes, to separate shapes with equal components.

    Args:
        values: (m,) eigenvalues, in order.
        shapes: (3 F, m) orthonormal shapes.
        positions: (F, 3) rest positions of the vertices [m].
        same: difference up to which consecutive eigenvalues count as equal.
    """
    place = (positions - positions.min(0)) / np.ptp(positions, axis=0).max()
    weights = (np.exp(2.0 * place) @ _AXES)[:, None] * _AXES
    apart = np.abs(np.diff(values)) > np.broadcast_to(same, values.shape)[1:]
    clusters = np.split(shapes, np.flatnonzero(apart) + 1, axis=1)
    return np.hstack([s @ np.linalg.eigh(s.T @ (weights.reshape(-1, 1) * s))[1] for s in clusters])


def fix_signs(shapes: FloatArray) -> FloatArray:
    """Returns columns (n, m) with signs such that the first entry
    of nearly maximal size is positive.
    """
    size = np.abs(shapes)
    first = (size > 0.99 * size.max(0)).argmax(0)
    return shapes * np.sign(np.take_along_axis(shapes, first[None], 0))


def _root(inertia: scipy.sparse.csc_array) -> scipy.sparse.csc_array:
    """Returns the triangular R with R^T R = M.

    Only the few coordinates of rigid parts and glue are coupled.
    """
    coupled = np.flatnonzero(np.diff(inertia.indptr) > 1)
    root = scipy.sparse.diags_array(np.sqrt(inertia.diagonal())).tolil()
    if len(coupled):
        block = inertia[coupled][:, coupled].toarray()
        root[np.ix_(coupled, coupled)] = np.linalg.cholesky(block).T
    return scipy.sparse.csc_array(root)


def _inverse(root: scipy.sparse.csc_array) -> scipy.sparse.csc_array:
    """Returns R^-1."""
    coupled = np.flatnonzero((np.diff(root.indptr) > 1) | (np.diff(root.tocsr().indptr) > 1))
    inverse = scipy.sparse.diags_array(1.0 / root.diagonal()).tolil()
    if len(coupled):
        inverse[np.ix_(coupled, coupled)] = np.linalg.inv(root[coupled][:, coupled].toarray())
    return scipy.sparse.csc_array(inverse)


def _about_rest(
    simulator: Simulator,
) -> tuple[scipy.sparse.csc_array, scipy.sparse.csc_array, IntArray]:
    """Returns elastic stiffness and inertia (3 F, 3 F) [N/m] at rest, and the F free vertices."""
    # The lowest eigenvalues are below the rounding of float32.
    simulator = replace(simulator, dtype=torch.float64)
    rest = simulator.rest_state()
    elastic = simulator.prepare(
        {name: 0.0 for name in simulator.parameters if name.endswith(VISCOUS)}
    )
    linearisation = simulator.linearise(rest, parameters=elastic)
    hessian, _ = linearisation.matrix(rest.q)
    inertia = linearisation.inertia_matrix(rest.q)
    return scipy.sparse.csc_array(hessian - inertia), inertia, linearisation.free.cpu().numpy()


class RestStiffness:
    """The stiffness K of a body at rest, and its inverse.

    Args:
        simulator: simulator of a body that is held (`Simulator.is_held`).

    Raises:
        InputError: the body is not held.
    """

    def __init__(self, simulator: Simulator) -> None:
        if not simulator.is_held(simulator.rest_state()):
            raise InputError(
                "a body without fixed vertices follows any force without end: fix some vertices."
            )
        stiffness, _, free = _about_rest(simulator)
        self._matrix = stiffness
        self._factor = scipy.sparse.linalg.splu(stiffness)
        self._dofs = (3 * free[:, None] + np.arange(3)).ravel()
        coordinates, n = simulator.body.coordinates, simulator.body.n_vertices
        # (3 N, 3 N)
        self._map = scipy.sparse.csr_array(scipy.sparse.kron(coordinates.matrix, np.eye(3)))
        self._size = 3 * n

    def displacements(self, forces: FloatArray) -> FloatArray:
        """Returns K^-1 f (3 N, m) [m], zero at fixed vertices."""
        out = np.zeros((self._size, forces.shape[1]))
        out[self._dofs] = self._factor.solve((self._map.T @ forces)[self._dofs])
        return np.asarray(self._map @ out)

    def forces(self, displacements: FloatArray) -> FloatArray:
        """Returns K u (3 N, m) [N], zero at fixed vertices."""
        out = np.zeros((self._size, displacements.shape[1]))
        out[self._dofs] = self._matrix @ displacements[self._dofs]
        return out
