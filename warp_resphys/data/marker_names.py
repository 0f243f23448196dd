"""Names of markers by their places.

Markers without names are matched with their nominal places by the motion and the pairs with the
least sum of squares. The best pairs for a motion are those of the Hungarian method (Kuhn, Naval
Research Logistics Quarterly 2 (1955) 83); the candidate motions carry a few markers, the anchors,
onto their nominal places. Points are (M, 3) [m].
"""

from collections.abc import Iterator, Sequence
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from ..io.arrays import FloatArray, IntArray
from ..io.errors import DataFileError, InputError, listed
from .registration import RigidTransform, fit, fitted, root_mean_square

_MILLI = 1e3
_REFINEMENTS = 3
_CLEAR = 1.3  # least ratio of the residual of the next best pairs and that of the best
_LEAST = 1e-4  # m: smaller residuals of pairs count as this one


def assign(
    seen: ArrayLike,
    expected: ArrayLike,
    names: Sequence[str],
    *,
    source: str | Path,
    anchors: Sequence[int] | None = None,
    rotation: FloatArray | None = None,
) -> tuple[IntArray, RigidTransform, float, float]:
    """Assigns names to measured markers.

    Args:
        seen: (S, 3) measured markers in the frame of the recording [m], NaN for one that was not
            seen; markers in excess of the names stay without a name.
        expected: (M, 3) nominal places of the named markers, in the frame of the body [m].
        names: M names.
        source: of the recording, for messages.
        anchors: indices of the names at their nominal places, which determine the motion: those on
            the clamp, for a bent body; all if None.
        rotation: (3, 3) from the frame of the recording to that of the body, where known. Then one
            anchor is enough; otherwise it takes three that are not on a line.

    Returns:
        The index of the measured marker of every name (M,), the motion from the frame of the
        recording to that of the body, and the root mean square distances of the pairs and of the
        next best ones [m].

    Raises:
        InputError: arrays of wrong shapes, or too few anchors.
        DataFileError: fewer markers than names, or other pairs with a similar residual.
    """
    points, places = np.asarray(seen, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    if (
        points.ndim != 2
        or points.shape[1] != 3
        or places.shape != (len(names), 3)
        or not np.isfinite(places).all()
    ):
        raise InputError(
            f"{len(names)} markers are named, with places {places.shape} and {points.shape} "
            "seen: both must be (markers, 3), and the places finite."
        )
    visible = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(visible) < len(names):
        raise DataFileError(
            f"{source} shows {len(visible)} markers, and {len(names)} are configured "
            f"({listed(names)}): leave out of the configuration those that it does not have."
        )
    fits = _assignments(
        points[visible],
        places,
        np.arange(len(names)) if anchors is None else np.array(anchors),
        rotation,
    )
    if not fits:
        raise DataFileError(
            f"{source}: no three of its markers stand as those "
            "of the configuration do: check these."
        )
    (rms, best, motion), *others = fits
    next_rms = others[0][0] if others else np.inf
    if next_rms < _CLEAR * max(rms, _LEAST):
        moved = [name for name, a, b in zip(names, best, others[0][1], strict=True) if a != b]
        by_column = dict(zip(visible[list(best)].tolist(), names, strict=True))
        labels = [
            by_column.get(column, f"other_{column + 1}") for column in range(len(np.asarray(seen)))
        ]
        raise DataFileError(
            f"{source}: which of its markers is which is not clear: they fit to "
            f"{_MILLI * rms:.1f} mm, and to {_MILLI * next_rms:.1f} mm with {listed(moved)} "
            "taken for others; correct their places in the configuration or, if the first is "
            f"right, give the recording labels: [{', '.join(labels)}]."
        )
    return visible[list(best)], motion, rms, next_rms


def _assignments(
    points: FloatArray, places: FloatArray, anchors: IntArray, rotation: FloatArray | None
) -> list[tuple[float, tuple[int, ...], RigidTransform]]:
    """Returns pairs by the indices of the points, with root mean square distance
    and motion, the best ones first.
    """
    fits: dict[tuple[int, ...], tuple[float, RigidTransform]] = {}
    for motion in _motions(points, places, anchors, rotation):
        pairs = _pairs(motion.apply(points), places)
        for _ in range(_REFINEMENTS):
            motion = fitted(points[pairs[anchors]], places[anchors], rotation)
            before, pairs = pairs, _pairs(motion.apply(points), places)
            if (pairs == before).all():
                break
        for candidate in _best_and_next(motion.apply(points), places, pairs):
            residual = root_mean_square(motion.apply(points[candidate]) - places)
            if tuple(candidate) not in fits or residual < fits[tuple(candidate)][0]:
                fits[tuple(candidate)] = residual, motion
    return sorted(
        ((rms, pairs, motion) for pairs, (rms, motion) in fits.items()), key=lambda fit: fit[0]
    )


def _motions(
    points: FloatArray, places: FloatArray, anchors: IntArray, rotation: FloatArray | None
) -> Iterator[RigidTransform]:
    """Motions that carry one marker, if the rotation is known, or three markers onto anchors."""
    if not len(anchors):
        raise InputError(
            "markers are named by those that stand still: configure one at least "
            "(markers.reference)."
        )
    if rotation is not None:
        for point in points:
            yield RigidTransform(rotation, places[anchors[0]] - rotation @ point)
        return
    if len(anchors) < 3:
        raise InputError(
            f"{len(anchors)} markers stand still, and it takes three to find how the recording "
            "is turned: configure more (markers.reference), or data.axes."
        )
    corners = np.array(
        max(permutations(anchors.tolist(), 3), key=lambda three: _area(places[list(three)]))
    )
    wanted = places[corners]
    for three in permutations(range(len(points)), 3):
        motion, on_a_line = fit(points[list(three)], wanted, np.ones(3))
        off = motion.apply(points[list(three)]) - wanted
        if not on_a_line and root_mean_square(off) < 0.1 * np.sqrt(_area(wanted)):
            yield motion


def _area(corners: FloatArray) -> float:
    return float(0.5 * np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))


def _squares(points: FloatArray, places: FloatArray) -> FloatArray:
    """Squared distances (M, S) between places and points."""
    return np.asarray(np.square(places[:, None] - points[None]).sum(axis=2))


def _pairs(points: FloatArray, places: FloatArray) -> IntArray:
    """Index (M,) of the point that is assigned to a place."""
    return np.asarray(linear_sum_assignment(_squares(points, places))[1])


def _best_and_next(points: FloatArray, places: FloatArray, pairs: IntArray) -> Iterator[IntArray]:
    """Yields the best pairs, then the best pairs without one of them, for every pair."""
    yield pairs
    squares = _squares(points, places)
    for place, point in enumerate(pairs):
        forbidden = squares.copy()
        forbidden[place, point] = 1e6 * (1.0 + squares.max())
        other = linear_sum_assignment(forbidden)[1]
        if other[place] != point:
            yield np.asarray(other)
