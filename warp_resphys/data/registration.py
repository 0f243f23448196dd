"""Rigid registration: the motion from measured markers to their nominal places on a body, and its residual.

Points are (M, 3) [m].
"""

import dataclasses
from collections.abc import Sequence
from itertools import combinations
from math import comb
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..io.errors import DataFileError, InputError, listed
from .rigid import BoolArray, FloatArray, RigidTransform, fit, root_mean_square

_MILLI = 1e3
_MOST_FITS = 20_000  # Sets of markers that are tried in the search for outliers.


@dataclasses.dataclass(frozen=True)
class Registration:
    """Measured markers in the frame of the body."""

    names: tuple[str, ...]
    transform: RigidTransform  # From the frame of the recording to that of the body
    positions: FloatArray  # (M, 3) [m] markers in the frame of the body; NaN for one that was not seen
    residual: FloatArray  # (M,) [m] distances from the nominal positions; NaN for a marker that was not seen
    inliers: BoolArray  # (M,) whether a marker took part in the fit
    outliers: tuple[str, ...]  # Names of markers that were left out of the fit because of their distance
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

    The least-squares fit (Kabsch) is made to the largest set of markers with no residual above `largest_residual`;
    among sets of one size, to that with the least sum of squares. All sets are tried, up to 20 000, so that the best is
    not missed. The set has more than half of the markers and at least four: two of six markers or seven of fifteen may
    be anywhere, and three markers that do not fit are an error. Markers that are NaN are ignored. Where the rotation is
    known, one marker is enough. Where the vertical is known, two are enough, or several on a line, if they do not lie
    above one another: only the angle about the vertical is unknown.

    Args:
        measured: (M, 3) [m] markers of the body at rest, in the frame of the recording.
        nominal: (M, 3) [m] nominal positions, in the frame of the body.
        names: M names.
        source: File of the recording, for messages.
        largest_residual: Accuracy of the nominal positions [m].
        use: Names of the markers to fit, such as those on the clamp; all if None.
        rotation: (3, 3) from the frame of the recording to that of the body, if known.
        vertical: (3,) upward directions in the frame of the recording and in that of the body, if known.

    Raises:
        InputError: Arrays of wrong shapes, an unknown name in `use`, or nominal positions on one line (with a known
            vertical: above one another).
        DataFileError: Fewer than three of the markers are seen (two with a known vertical, one with a known rotation),
            or too many of them are too far off.
    """
    a, b = np.asarray(measured, dtype=np.float64), np.asarray(nominal, dtype=np.float64)
    if a.shape != (len(names), 3) or b.shape != a.shape:
        raise InputError(
            f"{len(names)} markers are named, with measured positions {a.shape} and nominal ones {b.shape}: both must "
            "be (markers, 3)."
        )
    turned = None if rotation is None else np.asarray(rotation, dtype=np.float64)
    least = 1 if turned is not None else 3 if vertical is None else 2
    used = _used(a, names, use, source, least)
    if turned is not None:
        near, motion = _shifted(a, b, used, turned, largest_residual)
        if not 2 * np.count_nonzero(near) > np.count_nonzero(used):
            off = np.linalg.norm(motion.apply(a) - b, axis=1)
            farthest = int(np.where(used, off, 0.0).argmax())
            raise DataFileError(
                f"{source}: the markers at rest do not fit their nominal positions to "
                f"{_MILLI * largest_residual:.1f} mm with the axes that are given: {names[farthest]!r} is "
                f"{_MILLI * off[farthest]:.1f} mm off, the median is {_MILLI * np.median(off[used]):.1f} mm; check the "
                "axes, and the markers' names, nominal positions and unit, or name those that stand where they should "
                "in markers.register_with."
            )
        return _registration(a, b, names, motion, used, near)
    if vertical is not None and _distance_from_line(b[used]) <= largest_residual:
        motion = _upright(a[used], b[used], vertical, largest_residual, listed(_pick(names, used)))
        off = np.linalg.norm(motion.apply(a[used]) - b[used], axis=1)
        if off.max() > largest_residual:
            raise DataFileError(
                f"{source}: {_pick(names, used)[int(off.argmax())]!r} is {_MILLI * off.max():.1f} mm off where the "
                f"vertical and {listed(_pick(names, used))} tell how the body stands: check their nominal positions, "
                "the unit and data.up."
            )
        return _registration(a, b, names, motion, used, used)
    if _distance_from_line(b[used]) <= largest_residual:
        raise InputError(
            f"The nominal positions of {listed(_pick(names, used))} lie on one line to within "
            f"{_MILLI * largest_residual:.1f} mm, so that the rotation about it is open: register with another marker."
        )
    fitted = _consensus(a, b, used, largest_residual)
    if fitted is None:
        raise DataFileError(
            f"{source}: the markers at rest do not fit their nominal positions to {_MILLI * largest_residual:.1f} mm: "
            f"{_worst(a, b, used, names)}; check its name, its nominal position and the unit."
        )
    motion, _ = fit(a[fitted], b[fitted], np.ones(np.count_nonzero(fitted)))
    return _registration(a, b, names, motion, used, fitted)


def _registration(
    a: FloatArray, b: FloatArray, names: Sequence[str], motion: RigidTransform, used: BoolArray, fitted: BoolArray
) -> Registration:
    moved = motion.apply(a)
    outliers = tuple(_pick(names, used & ~fitted))
    rms = root_mean_square((moved - b)[fitted])
    return Registration(tuple(names), motion, moved, np.linalg.norm(moved - b, axis=1), fitted, outliers, rms)


def _shifted(
    a: FloatArray, b: FloatArray, used: BoolArray, rotation: FloatArray, largest_residual: float
) -> tuple[BoolArray, RigidTransform]:
    """Largest set (M,) of used markers that one translation fits after the rotation, and the motion.

    A set has the markers close to the translation of one marker; of two sets of one size, the better fit is taken.
    """
    shifts = b - a @ rotation.T
    sets = [
        used & (np.linalg.norm(shifts - shifts[one], axis=1) <= 2.0 * largest_residual) for one in np.flatnonzero(used)
    ]
    misfits = [float(np.square(shifts[near] - shifts[near].mean(axis=0)).sum(axis=1).mean()) for near in sets]
    best = max(range(len(sets)), key=lambda row: (np.count_nonzero(sets[row]), -misfits[row]))
    shift = shifts[sets[best]].mean(axis=0)
    near = used & (np.linalg.norm(shifts - shift, axis=1) <= largest_residual)
    return near, RigidTransform(rotation, shifts[near].mean(axis=0) if near.any() else shift)


def _upright(
    a: FloatArray, b: FloatArray, vertical: tuple[ArrayLike, ArrayLike], least: float, names: str
) -> RigidTransform:
    """Least-squares motion from points a to points b (M, 3) that maps one vertical to the other."""
    up_measured, up = (np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis) for axis in vertical)
    tilt, _ = Rotation.align_vectors(up[None], up_measured[None])
    tilted, nominal = tilt.apply(a - a.mean(axis=0)), b - b.mean(axis=0)
    level = nominal - np.outer(nominal @ up, up)
    if np.linalg.norm(level, axis=1).max() <= least:
        raise InputError(
            f"{names} lie above one another to within {_MILLI * least:.1f} mm, so that the vertical does not tell how "
            "the body is turned: register with another marker."
        )
    angle = np.arctan2(np.sum(np.cross(tilted, level) @ up), np.sum(tilted * level))
    rotation = (Rotation.from_rotvec(angle * up) * tilt).as_matrix()
    return RigidTransform(rotation, b.mean(axis=0) - rotation @ a.mean(axis=0))


def axes_rotation(axes: Sequence[str]) -> FloatArray:
    """Rotation (3, 3) from the frame of the recording to that of the body.

    Args:
        axes: the recording's axes along the body's x, y and z: (x, z, -y) where the body's y is the recording's z, and
            its z the recording's -y.

    Raises:
        InputError: an axis twice, or axes of a mirror image.
    """
    rows = [np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0) for axis in axes]
    rotation = np.array(rows)
    if np.linalg.matrix_rank(rotation) < 3:
        raise InputError(f"the axes ({', '.join(axes)}) name one axis twice: each of x, y and z must be there once.")
    if np.linalg.det(rotation) < 0.0:
        raise InputError(
            f"the axes ({', '.join(axes)}) would mirror the recording: change the sign of one, or exchange two."
        )
    return rotation


def _used(
    measured: FloatArray, names: Sequence[str], use: Sequence[str] | None, source: str | Path, least: int
) -> BoolArray:
    """Which markers are fitted, (M,): those in `use` that were seen; at least `least`."""
    unknown = [name for name in use or () if name not in names]
    if unknown:
        raise InputError(f"Registration should use {listed(unknown)}, but the markers are {listed(names)}.")
    wanted = np.array([use is None or name in use for name in names], dtype=bool)
    seen = np.isfinite(measured).all(axis=1)
    if np.count_nonzero(wanted & seen) < least:
        needed = {1: "one marker", 2: "two markers", 3: "three markers"}[least]
        raise DataFileError(
            f"{source}: registration needs {needed} at rest, but {np.count_nonzero(wanted & seen)} are left to "
            f"it; not seen: {listed(_pick(names, wanted & ~seen))}."
        )
    return np.asarray(wanted & seen)


def _consensus(a: FloatArray, b: FloatArray, used: BoolArray, largest_residual: float) -> BoolArray | None:
    """Largest set (M,) of used markers that fit one motion, or None."""
    members = np.flatnonzero(used)
    count = len(members)
    tried = 0
    for left_out in range(max(0, count - max(4, count // 2 + 1)) + 1):
        tried += comb(count, left_out)
        if tried > _MOST_FITS:
            return None
        kept = np.ones((comb(count, left_out), count), dtype=bool)
        for row, without in enumerate(combinations(range(count), left_out)):
            kept[row, list(without)] = False
        motion, on_a_line = fit(a[members], b[members], kept.astype(np.float64))
        squares = np.square(motion.apply(a[members]) - b[members]).sum(axis=-1) * kept  # (sets, markers) [m²]
        fits_all = (squares.max(axis=1) <= largest_residual**2) & ~on_a_line
        fits_all &= np.array([_distance_from_line(b[members[row]]) > largest_residual for row in kept])
        if fits_all.any():
            chosen = np.zeros_like(used)
            chosen[members[kept[np.argmin(np.where(fits_all, squares.sum(axis=1), np.inf))]]] = True
            return chosen
    return None


def _distance_from_line(points: FloatArray) -> float:
    """Root mean square distance [m] of points (N, 3) from their best-fitting line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.sqrt(np.sum(spread[1:] ** 2) / len(points)))


def _worst(a: FloatArray, b: FloatArray, used: BoolArray, names: Sequence[str]) -> str:
    """Describes the marker without which the others fit best, and its residual."""
    members = np.flatnonzero(used).tolist()
    three = len(members) == 3
    fits: list[tuple[float, float, str]] = []
    for marker in members:
        others = [member for member in members if three or member != marker]
        motion, _ = fit(a[others], b[others], np.ones(len(others)))
        off = np.linalg.norm(motion.apply(a) - b, axis=1)
        fits.append((float(np.sqrt(np.mean(off[others] ** 2))), -float(off[marker]), names[marker]))
    rms, off_worst, worst = min(fits)
    return (
        f"'{worst}' is {-_MILLI * off_worst:.1f} mm off ({'all three' if three else 'the others'}: "
        f"{_MILLI * rms:.1f} mm root mean square)"
    )


def _pick(names: Sequence[str], chosen: BoolArray) -> list[str]:
    return [name for name, here in zip(names, chosen, strict=True) if here]
