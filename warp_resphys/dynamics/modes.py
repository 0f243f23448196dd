"""Vibration modes of a body about its rest shape."""

from dataclasses import replace

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import torch
from numpy.typing import NDArray

from ..io.errors import InputError
from ..linalg.linear_solver import SparseSolver
from .assembly import HessianAssembly
from .simulator import Simulator

FloatArray = NDArray[np.float64]

_DENSE = 600  # unknowns, beyond which all eigenvalues of a dense matrix take too long to find a few of them


def vibration_modes(simulator: Simulator, count: int) -> torch.Tensor:
    """(3 N, count) orthonormal columns that span the inertial forces M phi of the slowest vibrations about rest.

    The modes phi solve K phi = omega^2 M phi with K the stiffness of the rest shape.

    Raises:
        InputError: no mode, or more modes than there are free coordinates.
    """
    stiffness, inertia, free = _about_rest(simulator)
    unknowns = len(inertia)
    if not 1 <= count <= unknowns:
        raise InputError(f"{count} vibration modes were asked for, but the body has 1 to {unknowns}.")
    root = np.sqrt(inertia)
    unscale = scipy.sparse.diags_array(1.0 / root)
    scaled = (unscale @ stiffness @ unscale).tocsc()
    if unknowns <= max(_DENSE, count):
        _, shapes = scipy.linalg.eigh(scaled.toarray(), subset_by_index=[0, count - 1])
    else:
        # Lanczos about a little less than zero, where a body that nothing holds is regular too, always from one start.
        below = -1e-8 * float(scaled.diagonal().max())
        values, shapes = scipy.sparse.linalg.eigsh(scaled, count, sigma=below, v0=np.ones(unknowns))
        shapes = shapes[:, np.argsort(values)]
    basis = simulator.rest_positions.new_zeros(simulator.body.n_vertices, 3, count)
    orthonormal = np.linalg.qr(root[:, None] * shapes)[0]
    basis[free] = simulator.tensor(orthonormal.reshape(-1, 3, count))
    return basis.flatten(0, 1)


def _about_rest(simulator: Simulator) -> tuple[scipy.sparse.csc_array, FloatArray, NDArray[np.int64]]:
    """Elastic stiffness (3 F, 3 F) [N/m] and inertia (3 F,) of the F free vertices at rest, and these vertices."""
    workspace = simulator.workspace(1)
    p, pattern = workspace.potential, workspace.pattern
    rest = simulator.rest_state()
    stage = simulator.method.stage(rest, simulator.time_step)
    elastic = simulator.prepare(replace(simulator.material, stiffness_damping=0.0))
    p.set_terms(simulator.step_terms(stage, 1, None, elastic, workspace))
    p.positions.copy_(rest.q)
    p.update_tangent()
    solver = SparseSolver(pattern.rows, pattern.cols, len(pattern.free), 3, p.device, p.dtype)
    (entries,) = solver.mirrored(HessianAssembly(p, solver, pattern)())
    inertia = np.repeat(p.inertia[0].cpu().numpy()[pattern.free], 3)
    return (solver.matrix(entries) - scipy.sparse.diags_array(inertia)).tocsc(), inertia, pattern.free


class RestStiffness:
    """The stiffness K of a body at rest: what forces displace it by, and which forces a displacement takes.

    Args:
        simulator: of a body that is clamped.

    Raises:
        InputError: nothing holds the body.
    """

    def __init__(self, simulator: Simulator) -> None:
        if not len(simulator.fixed):
            raise InputError("a body without fixed vertices follows any force without end: fix some vertices.")
        stiffness, _, free = _about_rest(simulator)
        self._matrix = stiffness
        self._factor = scipy.sparse.linalg.splu(stiffness)
        self._dofs = (3 * free[:, None] + np.arange(3)).ravel()
        self._size = 3 * simulator.body.n_vertices

    def displacements(self, forces: FloatArray) -> FloatArray:
        """(3 N, m) K^-1 f of (3 N, m) [m]; zero at fixed vertices."""
        out = np.zeros((self._size, forces.shape[1]))
        out[self._dofs] = self._factor.solve(forces[self._dofs])
        return out

    def forces(self, displacements: FloatArray) -> FloatArray:
        """(3 N, m) K u of (3 N, m) [N]; zero at fixed vertices."""
        out = np.zeros((self._size, displacements.shape[1]))
        out[self._dofs] = self._matrix @ displacements[self._dofs]
        return out
