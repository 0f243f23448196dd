"""Rigid motions of points, and their least-squares fit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..io.arrays import BoolArray, FloatArray
from ..io.errors import InputError


@dataclass(frozen=True)
class RigidTransform:
    """The map p -> R p + t."""

    rotation: FloatArray  # (..., 3, 3), determinant +1
    translation: FloatArray  # (..., 3) [m]

    def apply(self, points: ArrayLike) -> FloatArray:
        """Transforms points (..., N, 3) [m]."""
        rotated: FloatArray = np.asarray(points, dtype=np.float64) @ np.swapaxes(self.rotation, -1, -2)
        return rotated + self.translation[..., None, :]


def kabsch(source: ArrayLike, target: ArrayLike) -> RigidTransform:
    """Returns the rigid motion from source points to target points with the least sum of squares.

    Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. A32 (1976) 922. Both are
    (..., N, 3) [m]; leading axes of either are a batch.

    Raises:
        InputError: Fewer than three points, points on a line, unequal numbers of them, or a value not finite.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.shape[-2:] != b.shape[-2:] or a.shape[-1] != 3 or a.shape[-2] < 3:
        raise InputError(f"Registration needs three or more pairs of points, not {a.shape} with {b.shape}.")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError("Registration needs finite points: leave occluded markers and frames out.")
    motion, on_a_line = fit(a, b, np.ones(a.shape[-2]))
    if on_a_line.any():
        raise InputError("Registration needs points that do not all lie on one line.")
    return motion


def fit(a: FloatArray, b: FloatArray, weights: FloatArray) -> tuple[RigidTransform, BoolArray]:
    """Fits the rigid motion from points a to points b (..., N, 3) with the least weighted sum of squares.

    Returns:
        The motion, and whether the points lie on a line, so that it is not unique.
    """
    share = (weights / weights.sum(axis=-1, keepdims=True))[..., None]
    centre_a, centre_b = (share * a).sum(axis=-2, keepdims=True), (share * b).sum(axis=-2, keepdims=True)
    u, singular, vt = np.linalg.svd(np.swapaxes(share * (b - centre_b), -1, -2) @ (a - centre_a))
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    rotation = u @ vt
    translation = centre_b[..., 0, :] - (rotation @ centre_a[..., 0, :, None])[..., 0]
    return RigidTransform(rotation, translation), singular[..., 1] <= 1e-9 * singular[..., 0]


def fitted(a: FloatArray, b: FloatArray, rotation: FloatArray | None = None) -> RigidTransform:
    """Fits the rigid motion from points a to points b (N, 3), perhaps with a known rotation, by least squares."""
    if rotation is None:
        return fit(a, b, np.ones(len(a)))[0]
    return RigidTransform(rotation, (b - a @ rotation.T).mean(axis=0))


def root_mean_square(residual: FloatArray) -> float:
    """Root of the mean squared length of vectors (..., 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(residual), axis=-1))))
