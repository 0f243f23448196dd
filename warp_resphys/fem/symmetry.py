"""Symmetry planes, in which vertices slide (`fem.coordinates`)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..io.errors import InputError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class SymmetryPlane:
    """The plane n . x = offset that cuts a symmetric body: its vertices in the plane only move within it.

    The mesh is one side of the body; its motion is that of the whole body as long as loads and motion are symmetric.

    Raises:
        InputError: a normal of zero length, or numbers that are not finite.
    """

    normal: Sequence[float]  # (3,) n, scaled to unit length
    offset: float = 0.0  # [m]
    tolerance: float = 1e-9  # largest distance of a vertex in the plane [m]

    def __post_init__(self) -> None:
        """Checks the numbers and scales the normal."""
        normal = np.asarray(self.normal, dtype=np.float64)
        if normal.shape != (3,) or not np.isfinite([*normal, self.offset]).all() or not normal.any():
            raise InputError(f"a symmetry plane has the normal {self.normal}: give three finite numbers, not all zero.")
        object.__setattr__(self, "normal", tuple((normal / np.linalg.norm(normal)).tolist()))

    def contains(self, vertices: FloatArray) -> NDArray[np.bool_]:
        """Returns (N,) whether vertices (N, 3) [m] lie in the plane."""
        return np.asarray(np.abs(vertices @ np.asarray(self.normal) - self.offset) <= self.tolerance)


def tangential_projections(normals: FloatArray, touched: NDArray[np.bool_]) -> FloatArray:
    """Returns the projections (R, 3, 3) onto the directions along all planes that contain a vertex.

    Args:
        normals: (S, 3) unit normals of the planes.
        touched: (R, S) whether a vertex lies in a plane.
    """
    combinations, which = np.unique(touched, axis=0, return_inverse=True)
    by_combination = [np.eye(3) - np.linalg.pinv(normals[own]) @ normals[own] for own in combinations]
    return np.asarray(by_combination)[which.reshape(-1)]
