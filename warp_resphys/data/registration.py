"""Rigid registration of markers (M, 3) [m]: the motion
from measured markers to their nominal places on a body.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..io.arrays import BoolArray, Brief, FloatArray, IntArray
from ..io.errors import DataFileError, InputError, listed

_MILLI = 1e3
_MOST_FITS = 20_000  # Sets of markers that are tried in the search for outliers.


class RegistrationSummary(TypedDict, total=False):
    """Registration of a trial in registration.json."""

    positions: dict[str, list[float]]  # (3,) of the markers, in the frame of the body [m]
    rms_mm: float
    residual_mm: dict[str, float | None]  # by marker
    outliers: list[str]
    shift_mm: dict[str, list[float]]  # (3,) of the markers
    mounting: dict[str, dict[str, float]]  # mean `distance_mm`, `angle_deg`, by rigid body
    vertical_deg: float  # between the verticals of this trial and of all


@dataclass(frozen=True)
class RigidTransform(Brief):
    """The map p -> R p + t."""

    rotation: FloatArray  # (..., 3, 3), determinant +1
    translation: FloatArray  # (..., 3) [m]

    def apply(self, points: ArrayLike) -> FloatArray:
        """Transforms points (..., N, 3) [m]."""
        rotated: FloatArray = np.asarray(points, dtype=np.float64) @ np.swapaxes(
            self.rotation, -1, -2
        )
        return rotated + self.translation[..., None, :]


def kabsch(source: ArrayLike, target: ArrayLike) -> RigidTransform:
    """Returns the rigid motion from source points to target points with the least sum of squares.

    Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. A32 (1976)
    922. Both are (..., N, 3) [m]; leading axes of either are a batch.

    Raises:
        InputError: Fewer than three points, points on a line, unequal numbers of them, or a value
            not finite.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.shape[-2:] != b.shape[-2:] or a.shape[-1] != 3 or a.shape[-2] < 3:
        raise InputError(
            f"Registration needs three or more pairs of points, not {a.shape} with {b.shape}."
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError("Registration needs finite points: leave occluded markers and frames out.")
    motion, on_a_line = fit(a, b, np.ones(a.shape[-2]))
    if on_a_line.any():
        raise InputError("Registration needs points that do not all lie on one line.")
    return motion


def fit(a: FloatArray, b: FloatArray, weights: FloatArray) -> tuple[RigidTransform, BoolArray]:
    """Fits the rigid motion from points a to points b (..., N, 3)
    with the least weighted sum of squares.

    Returns:
        The motion, and whether the points lie on a line, so that it is not unique.
    """
    share = (weights / weights.sum(axis=-1, keepdims=True))[..., None]
    centre_a = (share * a).sum(axis=-2, keepdims=True)
    centre_b = (share * b).sum(axis=-2, keepdims=True)
    u, singular, vt = np.linalg.svd(np.swapaxes(share * (b - centre_b), -1, -2) @ (a - centre_a))
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    rotation = u @ vt
    translation = centre_b[..., 0, :] - (rotation @ centre_a[..., 0, :, None])[..., 0]
    return RigidTransform(rotation, translation), singular[..., 1] <= 1e-9 * singular[..., 0]


def fitted(a: FloatArray, b: FloatArray, rotation: FloatArray | None = None) -> RigidTransform:
    """Fits the rigid motion from points a to points b (N, 3),
    perhaps with a known rotation, by least squares.
    """
    if rotation is None:
        return fit(a, b, np.ones(len(a)))[0]
    return RigidTransform(rotation, (b - a @ rotation.T).mean(axis=0))


def root_mean_square(residual: FloatArray) -> float:
    """Root of the mean squared length of vectors (..., 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(residual), axis=-1))))


@dataclass(frozen=True)
class Registration(Brief):
    """Measured markers in the frame of the body."""

    names: tuple[str, ...]
    transform: RigidTransform  # From the frame of the recording to that of the body
    positions: (
        FloatArray  # (M, 3) [m] markers in the frame of the body; NaN for one that was not seen
    )
    residual: FloatArray  # (M,) distances from the nominal positions [m]; NaN if not seen
    inliers: BoolArray  # (M,) whether a marker took part in the fit
    outliers: tuple[str, ...]  # Names of markers left out of the fit for their distance
    rms: float  # Root mean square [m] of the residuals of the inliers


def register_markers(
    measured: ArrayLike,
    nominal: ArrayLike,
    names: Sequence[str],
    *,
    source: str | Path,
    largest_residual: float = 0.004,
    use: Sequence[str] | None = None,
    rotation: ArrayLike | None = None,
    vertical: tuple[ArrayLike, ArrayLike] | None = None,
) -> Registration:
    """Registers markers at rest to their nominal positions, and detects outliers.

    The least-squares fit (Kabsch) is made to the largest set of markers with no residual above
    `largest_residual`; among sets of one size, to that with the least sum of squares. All sets are
    tried, up to 20 000. The set has more than half of the markers and at least four: two of six
    markers or seven of fifteen may be anywhere. Markers that are NaN are ignored. With a known
    rotation one marker is enough; with a known vertical two, or several on a line, if they do not
    lie above one another.

    Args:
        measured: (M, 3) [m] markers of the body at rest, in the frame of the recording.
        nominal: (M, 3) [m] nominal positions, in the frame of the body.
        names: M names.
        source: File of the recording, for messages.
        largest_residual: Accuracy of the nominal positions [m].
        use: Names of the markers to fit, such as those on the clamp; all if None. None at all, with
            a known rotation: the origin of the recording is that of the body.
        rotation: (3, 3) from the frame of the recording to that of the body, if known.
        vertical: (3,) upward directions in the frame of the recording and in that of the body, if
            known.

    Raises:
        InputError: Arrays of wrong shapes, an unknown name in `use`, or nominal positions on one
            line (with a known vertical: above one another).
        DataFileError: Fewer than three of the markers are seen (two with a known vertical, one with
            a known rotation), or too many of them are too far off.
    """
    a, b = np.asarray(measured, dtype=np.float64), np.asarray(nominal, dtype=np.float64)
    if use is not None and not use and rotation is not None:
        known = RigidTransform(np.asarray(rotation, dtype=np.float64), np.zeros(3))
        nothing = np.full(len(names), np.nan)
        return Registration(
            tuple(names), known, known.apply(a), nothing, np.isfinite(nothing), (), 0.0
        )
    used = _used(
        a, b, names, use, source, 1 if rotation is not None else 3 if vertical is None else 2
    )
    fewest = max(4, len(used) // 2 + 1)
    turned, shown = None, ""
    if rotation is not None:
        fewest, turned = len(used) // 2 + 1, np.asarray(rotation, dtype=np.float64)
        shown = " with the axes that are given"
    elif _distance_from_line(b[used]) <= largest_residual:
        turned = _upright(
            a[used], b[used], vertical, largest_residual, listed([names[row] for row in used])
        )
        fewest, shown = len(used), " with the vertical that is given"
    best = _consensus(a, b, used, fewest, turned, largest_residual)
    if best is None:
        raise DataFileError(
            f"{source}: the markers at rest do not fit their nominal positions to "
            f"{_MILLI * largest_residual:.1f} mm{shown}: {_worst(a, b, used, turned, names)}; "
            "check its name, its nominal position, the unit and the axes, or name those that "
            "stand where they should in markers.register_with."
        )
    rows, motion = best
    moved, inliers = motion.apply(a), np.isin(np.arange(len(names)), rows)
    outliers = tuple(names[row] for row in used if row not in rows)
    residual = np.linalg.norm(moved - b, axis=1)
    return Registration(
        tuple(names),
        motion,
        moved,
        residual,
        inliers,
        outliers,
        root_mean_square((moved - b)[rows]),
    )


def _used(
    a: FloatArray,
    b: FloatArray,
    names: Sequence[str],
    use: Sequence[str] | None,
    source: str | Path,
    least: int,
) -> IntArray:
    """Indices of the measured markers a to register to nominal ones b, at least so many."""
    if a.shape != (len(names), 3) or b.shape != a.shape:
        raise InputError(
            f"{len(names)} markers are named, with measured positions {a.shape} and nominal ones "
            f"{b.shape}: both must be (markers, 3)."
        )
    unknown = [name for name in use or () if name not in names]
    if unknown:
        raise InputError(
            f"Registration should use {listed(unknown)}, but the markers are {listed(names)}."
        )
    seen = np.asarray(np.isfinite(a).all(axis=1))
    wanted = [row for row, name in enumerate(names) if use is None or name in use]
    used = [row for row in wanted if seen[row]]
    if len(used) < least:
        needed = ["one marker", "two markers", "three markers"][least - 1]
        raise DataFileError(
            f"{source}: registration needs {needed} at rest, but {len(used)} are left to it; not "
            f"seen: {listed([names[row] for row in wanted if not seen[row]])}."
        )
    return np.array(used, dtype=np.int64)


def _upright(
    a: FloatArray,
    b: FloatArray,
    vertical: tuple[ArrayLike, ArrayLike] | None,
    least: float,
    named: str,
) -> FloatArray:
    """Rotation (3, 3) that maps one vertical to the other and fits points a to b,
    which lie on one line.
    """
    if vertical is None:
        raise InputError(
            f"The nominal positions of {named} lie on one line to within {_MILLI * least:.1f} "
            "mm, so that the rotation about it is open: register with another marker."
        )
    up_measured, up = (
        np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis) for axis in vertical
    )
    tilt, _ = Rotation.align_vectors(up[None], up_measured[None])
    tilted, nominal = tilt.apply(a - a.mean(axis=0)), b - b.mean(axis=0)
    level = nominal - np.outer(nominal @ up, up)
    if np.linalg.norm(level, axis=1).max() <= least:
        raise InputError(
            f"{named} lie above one another to within {_MILLI * least:.1f} mm, so that the "
            "vertical does not tell how the body is turned: register with another marker."
        )
    angle = np.arctan2(np.sum(np.cross(tilted, level) @ up), np.sum(tilted * level))
    return np.asarray((Rotation.from_rotvec(angle * up) * tilt).as_matrix())


def _consensus(
    a: FloatArray,
    b: FloatArray,
    used: IntArray,
    fewest: int,
    rotation: FloatArray | None,
    largest_residual: float,
) -> tuple[IntArray, RigidTransform] | None:
    """Largest set of used markers, at least the fewest, that fit one motion, and the motion.

    None without one.
    """
    tried = 0
    for count in range(len(used), min(fewest, len(used)) - 1, -1):
        tried += comb(len(used), count)
        if tried > _MOST_FITS:
            return None
        fits = list[tuple[float, IntArray, RigidTransform]]()
        for rows in map(np.array, combinations(used, count)):
            if rotation is None and _distance_from_line(b[rows]) <= largest_residual:
                continue
            motion = fitted(a[rows], b[rows], rotation)
            squares = np.square(motion.apply(a[rows]) - b[rows]).sum(axis=1)  # [m²]
            if squares.max() <= largest_residual**2:
                fits.append((float(squares.sum()), rows, motion))
        if fits:
            return min(fits, key=lambda one: one[0])[1:]
    return None


def _worst(
    a: FloatArray, b: FloatArray, used: IntArray, rotation: FloatArray | None, names: Sequence[str]
) -> str:
    """Describes the marker without which the others fit best, and its residual."""
    few = len(used) <= 3
    fits: list[tuple[float, float, str]] = []
    for marker in used:
        others = used if few else used[used != marker]
        off = np.linalg.norm(fitted(a[others], b[others], rotation).apply(a) - b, axis=1)
        fits.append((float(np.sqrt(np.mean(off[others] ** 2))), -float(off[marker]), names[marker]))
    rms, off_worst, worst = min(fits)
    of_whom = f"all {['', 'one', 'two', 'three'][len(used)]}" if few else "the others"
    return (
        f"'{worst}' is {-_MILLI * off_worst:.1f} mm off ({of_whom}: {_MILLI * rms:.1f} mm root "
        "mean square)"
    )


def _distance_from_line(points: FloatArray) -> float:
    """Root mean square distance [m] of points (N, 3) from their best-fitting line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.sqrt(np.sum(spread[1:] ** 2) / len(points)))


def unit_vector(axis: str | Sequence[float]) -> FloatArray:
    """Returns the unit vector (3,) of an axis, such as ``x`` or ``-x``, or along a vector (3,)."""
    if isinstance(axis, str):
        return np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
    vector = np.asarray(axis, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))


def axes_rotation(axes: Sequence[str]) -> FloatArray:
    """Rotation (3, 3) from the frame of the recording to that of the body.

    Args:
        axes: the recording's axes along the body's x, y and z: (x, z, -y) where the body's y is the
            recording's z, and its z the recording's -y.

    Raises:
        InputError: an axis twice, or axes of a mirror image.
    """
    rotation = np.stack([unit_vector(axis) for axis in axes])
    if np.linalg.matrix_rank(rotation) < 3:
        raise InputError(
            f"the axes ({', '.join(axes)}) name one axis twice: "
            "each of x, y and z must be there once."
        )
    if np.linalg.det(rotation) < 0.0:
        raise InputError(
            f"the axes ({', '.join(axes)}) would mirror the recording: "
            "change the sign of one, or exchange two."
        )
    return rotation
