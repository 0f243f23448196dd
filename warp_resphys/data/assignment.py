"""Which of the markers of a recording is which, where nobody named them.

The markers that were seen are matched with the places where markers should be, by the rigid motion and the pairs that
leave the least sum of squares. For a motion, the best pairs are those of the Hungarian method (Kuhn, Naval Research
Logistics Quarterly 2 (1955) 83); motions are tried that carry a few markers, the anchors, onto their places.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from ..io.errors import DataFileError, InputError, listed
from .rigid import FloatArray, RigidTransform, fit, root_mean_square

IntArray = NDArray[np.int64]

_REFINEMENTS = 3
_CLEAR = 1.3  # by which the next best pairs must fit worse
_LEAST = 1e-4  # m: pairs that fit better than that fit alike
_MILLI = 1e3


@dataclass(frozen=True)
class Assignment:
    """Markers by name."""

    columns: IntArray  # (M,) of each name, the number of the marker that was seen
    transform: RigidTransform  # from the frame of the recording to that of the body
    rms: float  # root mean square distance of the pairs [m]
    next_rms: float  # the same of the next best pairs, with which these must not be mistaken [m]


def assign(
    seen: ArrayLike,
    expected: ArrayLike,
    names: Sequence[str],
    *,
    source: str | Path,
    anchors: Sequence[int] | None = None,
    rotation: FloatArray | None = None,
) -> Assignment:
    """Names the markers that were seen.

    Args:
        seen: (S, 3) markers in the frame of the recording [m], NaN for one that was not seen; more than there are names
            are left over.
        expected: (M, 3) where the named ones should be, in the frame of the body [m].
        names: M names.
        source: of the recording, for messages.
        anchors: the names, by number, that stand where they should, from which the motion is found: those on the clamp,
            for a body that is bent; all if None.
        rotation: (3, 3) from the frame of the recording to that of the body, where it is known. One anchor is enough
            then, otherwise it takes three that are not on a line.

    Raises:
        InputError: arrays that do not fit, or too few anchors.
        DataFileError: fewer markers than names, or other pairs that fit about as well.
    """
    points, places = np.asarray(seen, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or places.shape != (len(names), 3) or not np.isfinite(places).all():
        raise InputError(
            f"{len(names)} markers are named, with places {places.shape} and {points.shape} seen: both must be "
            "(markers, 3), and the places finite."
        )
    there = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(there) < len(names):
        raise DataFileError(
            f"{source} shows {len(there)} markers, and {len(names)} are configured ({listed(names)}): leave out of the "
            "configuration those that it does not have."
        )
    points, fixed = points[there], np.arange(len(names)) if anchors is None else np.asarray(anchors, dtype=np.int64)
    found: dict[tuple[int, ...], tuple[float, RigidTransform]] = {}
    for motion in _motions(points, places, fixed, rotation):
        pairs = _pairs(motion.apply(points), places)
        for _ in range(_REFINEMENTS):
            motion = _fitted(points[pairs[fixed]], places[fixed], rotation)
            before, pairs = pairs, _pairs(motion.apply(points), places)
            if (pairs == before).all():
                break
        for some in _and_next_best(motion.apply(points), places, pairs):
            off = root_mean_square(motion.apply(points[some]) - places)
            if tuple(some) not in found or off < found[tuple(some)][0]:
                found[tuple(some)] = off, motion
    if not found:
        raise DataFileError(f"{source}: no three of its markers stand as those of the configuration do: check these.")
    (best, (rms, motion)), *others = sorted(found.items(), key=lambda each: each[1][0])
    next_rms = others[0][1][0] if others else np.inf
    if next_rms < _CLEAR * max(rms, _LEAST):
        moved = [name for name, a, b in zip(names, best, others[0][0], strict=True) if a != b]
        raise DataFileError(
            f"{source}: which of its markers is which is not clear: they fit to {_MILLI * rms:.1f} mm, and to "
            f"{_MILLI * next_rms:.1f} mm with {listed(moved)} taken for others; name them (labels), or correct "
            "their places in the configuration."
        )
    return Assignment(there[list(best)], motion, rms, next_rms)


def _motions(
    points: FloatArray, places: FloatArray, anchors: IntArray, rotation: FloatArray | None
) -> Iterator[RigidTransform]:
    """Motions that carry some of the markers onto anchors: one if the rotation is known, otherwise three."""
    if not len(anchors):
        raise InputError("markers are named by those that stand still: configure one at least (markers.reference).")
    if rotation is not None:
        for point in points:
            yield RigidTransform(rotation, places[anchors[0]] - rotation @ point)
        return
    if len(anchors) < 3:
        raise InputError(
            f"{len(anchors)} markers stand still, and it takes three to find how the recording is turned: configure "
            "more (markers.reference), or data.axes."
        )
    corners = np.array(max(permutations(anchors.tolist(), 3), key=lambda three: _area(places[list(three)])))
    wanted = places[corners]
    for three in permutations(range(len(points)), 3):
        motion, on_a_line = fit(points[list(three)], wanted, np.ones(3))
        off = motion.apply(points[list(three)]) - wanted
        if not on_a_line and root_mean_square(off) < 0.1 * np.sqrt(_area(wanted)):
            yield motion


def _area(corners: FloatArray) -> float:
    return float(0.5 * np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))


def _fitted(points: FloatArray, places: FloatArray, rotation: FloatArray | None) -> RigidTransform:
    if rotation is None:
        return fit(points, places, np.ones(len(points)))[0]
    return RigidTransform(rotation, (places - points @ rotation.T).mean(axis=0))


def _squares(points: FloatArray, places: FloatArray) -> FloatArray:
    """(M, S) squared distances."""
    return np.asarray(np.square(places[:, None] - points[None]).sum(axis=2))


def _pairs(points: FloatArray, places: FloatArray) -> IntArray:
    """(M,) the point of each place."""
    return np.asarray(linear_sum_assignment(_squares(points, places))[1])


def _and_next_best(points: FloatArray, places: FloatArray, pairs: IntArray) -> Iterator[IntArray]:
    """The best pairs, and the best without each of them."""
    yield pairs
    squares = _squares(points, places)
    for place, point in enumerate(pairs):
        forbidden = squares.copy()
        forbidden[place, point] = 1e6 * (1.0 + squares.max())
        other = linear_sum_assignment(forbidden)[1]
        if other[place] != point:
            yield np.asarray(other)
