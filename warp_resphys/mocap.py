"""Rigid registration of measured markers.

Positions are (..., 3) in metres. Nothing here knows about a body or a simulator.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warp_resphys.errors import InputError

FloatArray = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class RigidTransform:
    """The map p -> R p + t.

    Attributes:
        rotation: (..., 3, 3), determinant +1.
        translation: (..., 3) [m].
    """

    rotation: FloatArray
    translation: FloatArray

    def apply(self, points: ArrayLike) -> FloatArray:
        """Transforms points (..., N, 3) [m]."""
        rotated: FloatArray = np.asarray(points, dtype=np.float64) @ np.swapaxes(self.rotation, -1, -2)
        return rotated + self.translation[..., None, :]


def kabsch(source: ArrayLike, target: ArrayLike) -> RigidTransform:
    """The rigid motion that carries source points onto target points with the least sum of squares.

    Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. A32 (1976) 922;
    leading axes of either argument are a batch.

    Args:
        source: (..., N, 3) [m].
        target: (..., N, 3) [m].

    Raises:
        InputError: Fewer than three points, points on a line, unequal numbers of them, or a value not finite.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.shape[-2:] != b.shape[-2:] or a.shape[-1] != 3 or a.shape[-2] < 3:
        raise InputError(f"Registration needs three or more pairs of points, not {a.shape} with {b.shape}.")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError("Registration needs finite points: leave occluded markers and frames out.")
    centre_a, centre_b = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    covariance = np.swapaxes(b - centre_b, -1, -2) @ (a - centre_a)
    u, singular, vt = np.linalg.svd(covariance)
    if (singular[..., 1] <= 1e-9 * singular[..., 0]).any():
        raise InputError("Registration needs points that do not all lie on one line.")
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    rotation = u @ vt
    translation = centre_b[..., 0, :] - (rotation @ centre_a[..., 0, :, None])[..., 0]
    return RigidTransform(rotation, translation)


def root_mean_square(residual: FloatArray) -> float:
    """Root of the mean squared length of vectors (..., 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(residual), axis=-1))))
