"""Principal stretches of deformed meshes."""

import numpy as np
from numpy.typing import NDArray

from ..mesh.elements import BY_NODES
from ..mesh.mesh import Mesh
from .elements import physical_gradients

_MOST_STATES = 400


def principal_stretches(mesh: Mesh, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the principal stretches at the centres of the cells, of at most 400 of the states, evenly chosen.

    Args:
        mesh: undeformed mesh of C cells.
        positions: (S, N, 3) vertices of some states [m].

    Returns:
        (S', C, 3) singular values of the deformation gradient, descending; NaN where a position is not finite.
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


def share_outside(stretches: NDArray[np.float64], low: float, high: float) -> float:
    """Returns the share of cells and states (S, C, 3) with a principal stretch outside of a range."""
    beyond = (stretches.min(-1) < low) | (stretches.max(-1) > high)
    return float(beyond[np.isfinite(stretches).all(-1)].mean())
