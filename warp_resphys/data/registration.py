"""Rigid registration: which motion carries measured markers to where they should be on a body, and how well it fits.

Points are (M, 3) in metres. Nothing here knows about time.
"""

import dataclasses
from collections.abc import Sequence
from itertools import combinations
from math import comb
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..io.errors import DataFileError, InputError
from ..mesh.mesh import Mesh, boundary_triangles
from ..mesh.surface import ClosestPoints, closest_points

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_MILLI = 1e3
_MOST_FITS = 20_000  # Sets of markers that are tried when outliers are sought.
_SURFACE_ITERATIONS = 100
_HALVINGS = 40
_SURFACE_TOLERANCE = 1e-10  # [m] change of any marker at which the fit to a surface has settled.


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


@dataclasses.dataclass(frozen=True)
class Registration:
    """Measured markers in the frame of the body.

    Attributes:
        names: Of the M markers.
        transform: From the frame of the recording to that of the body.
        positions: (M, 3) [m] where the markers are in the frame of the body; NaN for one that was not seen.
        residual: (M,) [m] how far each is from where it should be; NaN for one that was not seen.
        inliers: (M,) whether it took part in the fit.
        outliers: Names of markers that should have taken part, and were too far off.
        rms: Root mean square [m] of the residuals of the inliers.
    """

    names: tuple[str, ...]
    transform: RigidTransform
    positions: FloatArray
    residual: FloatArray
    inliers: BoolArray
    outliers: tuple[str, ...]
    rms: float


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
    motion, on_a_line = _fit(a, b, np.ones(a.shape[-2]))
    if on_a_line.any():
        raise InputError("Registration needs points that do not all lie on one line.")
    return motion


def root_mean_square(residual: FloatArray) -> float:
    """Root of the mean squared length of vectors (..., 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(residual), axis=-1))))


def register_markers(
    measured: ArrayLike,
    nominal: ArrayLike,
    names: Sequence[str],
    *,
    source: str | Path,
    largest_residual: float = 0.004,
    most_outliers: int | None = None,
    use: Sequence[str] | None = None,
) -> Registration:
    """Registers markers at rest to their nominal positions, without those that are not where they should be.

    The fit is the least-squares one (Kabsch) to the largest set of markers of which none is left with more than
    `largest_residual`; among sets of one size, to that with the least sum of squares. All sets are tried, up to 20 000
    of them, so that no unlucky start can miss the best. The set is more than half of the markers and at least four:
    two of six markers or seven of fifteen may be anywhere, and three markers that do not fit are an error. Markers
    that are NaN are left out and do not count.

    Args:
        measured: (M, 3) [m] the markers while the body was at rest, in the frame of the recording.
        nominal: (M, 3) [m] where they should be, in the frame of the body.
        names: M names.
        source: The file that they come from, for messages.
        largest_residual: How well the nominal positions are known [m].
        most_outliers: How many markers may be left out at most; as many as possible if None.
        use: The markers to fit, such as those on the clamp; all if None.

    Raises:
        InputError: Arrays that do not fit, a name in `use` that there is not, or nominal positions on one line.
        DataFileError: Fewer than three of the markers are seen, or too many of them are too far off.
    """
    a, b = _checked(measured, nominal, names)
    used = np.isfinite(a).all(axis=1) & _named(names, use)
    _check_seen(used, names, use, source)
    if _distance_from_line(b[used]) <= largest_residual:
        raise InputError(
            f"The nominal positions of {_listed(_pick(names, used))} lie on one line to within "
            f"{_MILLI * largest_residual:.1f} mm, so that the rotation about it is open: register with another marker."
        )
    fitted = _consensus(a, b, used, largest_residual, most_outliers)
    if fitted is None:
        raise DataFileError(_why_not(a, b, used, names, source, largest_residual))
    motion, _ = _fit(a[fitted], b[fitted], np.ones(np.count_nonzero(fitted)))
    moved = motion.apply(a)
    return _registration(names, motion, moved, np.linalg.norm(moved - b, axis=1), fitted, used & ~fitted)


def register_to_surface(
    measured: ArrayLike,
    mesh: Mesh,
    start: RigidTransform,
    names: Sequence[str],
    *,
    source: str | Path,
    stem: ArrayLike | None = 0.0,
    hold: float = 0.01,
    largest_residual: float = 0.004,
    use: Sequence[str] | None = None,
) -> Registration:
    """Moves registered markers on so that all of them stand equally far off the surface.

    Gauss-Newton on the sum of (d(T p) - s)^2 + hold |T p - T0 p|^2 over the markers p, with d the signed distance from
    the surface, s the length of the stems and T0 the start. A surface does not see what slides along it; the second
    term keeps that part of the start.

    Args:
        measured: (M, 3) [m] the markers while the body was at rest, in the frame of the recording; NaN if not seen.
        mesh: The body.
        start: A registration that is near, such as that of `register_markers`.
        names: M names.
        source: The file that they come from, for messages.
        stem: Distance of the markers from the surface [m], one for all or one for each (M,); one for all is found if
            None.
        hold: Weight of the start, relative to that of the surface.
        largest_residual: How far a marker may be from its stem's end, measured along the normal [m].
        use: The markers to fit; all if None.

    Raises:
        InputError: Arrays that do not fit, a name in `use` that there is not, or a negative or zero `hold`.
        DataFileError: Fewer than three of the markers are seen, one is left too far from the surface, or the fit does
            not settle.
    """
    a, _ = _checked(measured, measured, names)
    if not hold > 0.0:
        raise InputError(f"hold is {hold:g}: it must be positive, as a surface does not see what slides along it.")
    seen = np.isfinite(a).all(axis=1)
    used = seen & _named(names, use)
    _check_seen(used, names, use, source)
    stems = None if stem is None else np.broadcast_to(np.asarray(stem, dtype=np.float64), len(a))
    motion, found = _slide(a[used], mesh, start, None if stems is None else stems[used], hold, source)
    stems = np.full(len(a), found[0]) if stems is None else stems
    moved = motion.apply(a)
    residual = np.full(len(a), np.nan)
    residual[seen] = np.abs(closest_points(mesh, moved[seen]).distances - stems[seen])
    worst = int(np.argmax(np.where(used, residual, -1.0)))
    if residual[worst] > largest_residual:
        raise DataFileError(
            f"{source}: marker '{names[worst]}' is {_MILLI * residual[worst]:.1f} mm off a stem of "
            f"{_MILLI * stems[worst]:.1f} mm on the surface, more than {_MILLI * largest_residual:.1f} mm: check the "
            "mesh, its unit and the registration that this one starts from."
        )
    return _registration(names, motion, moved, residual, used, np.zeros_like(used))


def _slide(
    points: FloatArray, mesh: Mesh, start: RigidTransform, stems: FloatArray | None, hold: float, source: str | Path
) -> tuple[RigidTransform, FloatArray]:
    """The motion of `register_to_surface` for P points, and the lengths (P,) of their stems [m]."""
    triangles = boundary_triangles(mesh)
    origin = start.apply(points)
    found = closest_points(mesh, origin, triangles)

    def objective(moved: FloatArray, length: FloatArray, found: ClosestPoints) -> float:
        return float(np.sum((found.distances - length) ** 2) + hold * np.sum((moved - origin) ** 2))

    moved = origin
    length = np.full(len(points), found.distances.mean()) if stems is None else stems
    value = objective(moved, length, found)
    for _ in range(_SURFACE_ITERATIONS):
        twist = _surface_step(moved, origin, found, length, stems is None, hold)
        for halving in range(_HALVINGS):
            share = 0.5**halving
            trial = kabsch(points, moved + share * (np.cross(twist[:3], moved - moved.mean(axis=0)) + twist[3:6]))
            trial_length = length + share * twist[6]
            trial_moved = trial.apply(points)
            found = closest_points(mesh, trial_moved, triangles)
            trial_value = objective(trial_moved, trial_length, found)
            if trial_value <= value:
                break
        change = max(float(np.abs(trial_moved - moved).max()), float(np.abs(trial_length - length).max()))
        moved, length, value = trial_moved, trial_length, trial_value
        if change <= _SURFACE_TOLERANCE:
            return trial, length
    raise DataFileError(
        f"{source}: the registration to the surface does not settle: start nearer, or raise hold ({hold:g})."
    )


def _surface_step(
    moved: FloatArray, origin: FloatArray, found: ClosestPoints, length: FloatArray, free_length: bool, hold: float
) -> FloatArray:
    """(7,) Gauss-Newton step: a rotation vector about the centre of the points, a translation, a change of length."""
    offset = moved - found.points
    away = np.abs(found.distances)[:, None] > 1e-12
    # The distance grows fastest straight away from the closest point, which at an edge is not along a normal.
    slope = np.where(away, offset / np.where(away, found.distances[:, None], 1.0), found.normals)
    arms = moved - moved.mean(axis=0)
    spin = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)  # (P, 3, 3) d moved / d rotation
    move = np.concatenate([spin, np.broadcast_to(np.eye(3), spin.shape)], axis=2)  # (P, 3, 6)
    stems = np.full((len(moved), 1), -1.0 if free_length else 0.0)
    surface = np.concatenate([np.einsum("pi,pij->pj", slope, move), stems], axis=1)
    held = np.concatenate([move.reshape(-1, 6), np.zeros((3 * len(moved), 1))], axis=1)
    root = np.sqrt(hold)
    right = np.concatenate([length - found.distances, root * (origin - moved).ravel()])
    step: FloatArray = np.linalg.lstsq(np.concatenate([surface, root * held]), right, rcond=None)[0]
    return step


def _checked(measured: ArrayLike, nominal: ArrayLike, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    a, b = np.asarray(measured, dtype=np.float64), np.asarray(nominal, dtype=np.float64)
    if a.shape != (len(names), 3) or b.shape != a.shape:
        raise InputError(
            f"{len(names)} markers are named, with measured positions {a.shape} and nominal ones {b.shape}: both must "
            "be (markers, 3)."
        )
    return a, b


def _named(names: Sequence[str], use: Sequence[str] | None) -> BoolArray:
    """(M,) whether a marker is in `use`."""
    unknown = [] if use is None else [name for name in use if name not in names]
    if unknown:
        raise InputError(f"Registration should use {_listed(unknown)}, but the markers are {_listed(names)}.")
    return np.array([use is None or name in use for name in names], dtype=bool)


def _check_seen(used: BoolArray, names: Sequence[str], use: Sequence[str] | None, source: str | Path) -> None:
    if np.count_nonzero(used) < 3:
        lost = [name for name, here in zip(names, used, strict=True) if not here and (use is None or name in use)]
        raise DataFileError(
            f"{source}: registration needs three markers at rest, but {np.count_nonzero(used)} are left to it; "
            f"not seen: {_listed(lost)}."
        )


def _fit(a: FloatArray, b: FloatArray, weights: FloatArray) -> tuple[RigidTransform, BoolArray]:
    """Weighted least squares, in a batch; and whether the points lie on a line, where the motion is not determined."""
    share = (weights / weights.sum(axis=-1, keepdims=True))[..., None]
    centre_a, centre_b = (share * a).sum(axis=-2, keepdims=True), (share * b).sum(axis=-2, keepdims=True)
    u, singular, vt = np.linalg.svd(np.swapaxes(share * (b - centre_b), -1, -2) @ (a - centre_a))
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    rotation = u @ vt
    translation = centre_b[..., 0, :] - (rotation @ centre_a[..., 0, :, None])[..., 0]
    return RigidTransform(rotation, translation), singular[..., 1] <= 1e-9 * singular[..., 0]


def _consensus(
    a: FloatArray, b: FloatArray, used: BoolArray, largest_residual: float, most_outliers: int | None
) -> BoolArray | None:
    """(M,) the largest set of used markers that fit one motion, or None."""
    members = np.flatnonzero(used)
    count = len(members)
    most = max(0, count - max(4, count // 2 + 1))
    most = most if most_outliers is None else min(most, most_outliers)
    fits = 0
    for left_out in range(most + 1):
        fits += comb(count, left_out)
        if fits > _MOST_FITS:
            return None
        kept = np.ones((comb(count, left_out), count), dtype=bool)
        for row, without in enumerate(combinations(range(count), left_out)):
            kept[row, list(without)] = False
        motion, on_a_line = _fit(a[members], b[members], kept.astype(np.float64))
        squares = np.square(motion.apply(a[members]) - b[members]).sum(axis=-1) * kept  # (sets, markers) [m²]
        fit = (squares.max(axis=1) <= largest_residual**2) & ~on_a_line
        fit &= np.array([_distance_from_line(b[members[row]]) > largest_residual for row in kept])
        if fit.any():
            chosen = np.zeros_like(used)
            chosen[members[kept[np.argmin(np.where(fit, squares.sum(axis=1), np.inf))]]] = True
            return chosen
    return None


def _distance_from_line(points: FloatArray) -> float:
    """Root mean square distance [m] of points (N, 3) from the line that is closest to them."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.sqrt(np.sum(spread[1:] ** 2) / len(points)))


def _why_not(
    a: FloatArray,
    b: FloatArray,
    used: BoolArray,
    names: Sequence[str],
    source: str | Path,
    largest_residual: float,
) -> str:
    """The sentence for markers that do not fit: names the one without which the others fit best."""
    members = np.flatnonzero(used).tolist()
    three = len(members) == 3
    fits: list[tuple[float, float, str]] = []
    for marker in members:
        others = [each for each in members if three or each != marker]
        motion, _ = _fit(a[others], b[others], np.ones(len(others)))
        off = np.linalg.norm(motion.apply(a) - b, axis=1)
        fits.append((float(np.sqrt(np.mean(off[others] ** 2))), -float(off[marker]), names[marker]))
    rms, off_worst, worst = min(fits)
    return (
        f"{source}: the markers at rest do not fit their nominal positions to {_MILLI * largest_residual:.1f} mm: "
        f"'{worst}' is {-_MILLI * off_worst:.1f} mm off ({'all three' if three else 'the others'}: "
        f"{_MILLI * rms:.1f} mm root mean square); check its name, its nominal position and the unit."
    )


def _registration(
    names: Sequence[str],
    motion: RigidTransform,
    moved: FloatArray,
    residual: FloatArray,
    inliers: BoolArray,
    outliers: BoolArray,
) -> Registration:
    rms = float(np.sqrt(np.mean(residual[inliers] ** 2)))
    return Registration(tuple(names), motion, moved, residual, inliers, tuple(_pick(names, outliers)), rms)


def _pick(names: Sequence[str], chosen: BoolArray) -> list[str]:
    return [name for name, here in zip(names, chosen, strict=True) if here]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names) if names else "none"
