"""Vibration modes of a body about its rest shape."""

import numpy as np
import scipy.linalg
import torch

from .assembly import HessianAssembly
from .errors import InputError
from .linear_solver import make_linear_solver
from .simulator import Simulator


def vibration_modes(simulator: Simulator, count: int) -> torch.Tensor:
    """(3 N, count) orthonormal columns that span the inertial forces M phi of the slowest vibrations about rest.

    The modes phi solve K phi = omega^2 M phi with K the stiffness of the rest shape.

    Raises:
        InputError: no mode, or more modes than there are free coordinates.
    """
    workspace = simulator.workspace(1)
    p, pattern = workspace.potential, workspace.pattern
    unknowns = 3 * len(pattern.free)
    if not 1 <= count <= unknowns:
        raise InputError(f"{count} vibration modes were asked for, but the body has 1 to {unknowns}.")
    rest = simulator.rest_state()
    stage = simulator.method.stage(rest, simulator.time_step)
    p.set_terms(simulator.step_terms(stage, 1, None, simulator.prepare(), workspace))
    p.positions.copy_(rest.q)
    p.update_tangent()
    linear = make_linear_solver("dense", pattern.rows, pattern.cols, len(pattern.free), 3, p.device, p.dtype)
    lower = HessianAssembly(p, linear, pattern)().reshape(unknowns, unknowns).cpu().numpy()
    inertia = np.repeat(p.inertia[0].cpu().numpy()[pattern.free], 3)
    stiffness = np.tril(lower) + np.tril(lower, -1).T - np.diag(inertia)
    root = np.sqrt(inertia)
    _, shapes = scipy.linalg.eigh(stiffness / np.outer(root, root), subset_by_index=[0, count - 1])
    basis = simulator.rest_positions.new_zeros(simulator.body.n_vertices, 3, count)
    orthonormal = np.linalg.qr(root[:, None] * shapes)[0]
    basis[pattern.free] = simulator.tensor(orthonormal.reshape(-1, 3, count))
    return basis.flatten(0, 1)
