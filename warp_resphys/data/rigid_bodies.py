r"""Poses of rigid bodies, as motion capture records them, in the form of four points.

A pose (p, R) is observed as the corners of a regular tetrahedron about p, which turn with R,

    x_k = p + R a_k,   a_k = sqrt(3/2) L c_k,

with the unit vectors c_k along (1, 1, 1), (1, -1, -1), (-1, 1, -1) and (-1, -1, 1). These add up to
zero, and sum c_k c_k^T = 4/3 1, so that an error dp of the position and one of the orientation by
an angle w give

    1/4 sum |dx_k|^2 = |dp|^2 + L^2 (2 sin w/2)^2.

Sums of squares of points therefore weigh orientations by the length L, the ratio of the expected
errors of positions [m] and of orientations [rad], with no preferred axis. Registration, gaps,
filters and bindings are those of markers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..io.arrays import FloatArray
from ..io.errors import DataFileError, did_you_mean, listed
from ..settings.performed import CORNERS
from .recordings.recording import ARM, Recording
from .registration import RigidTransform, fit

_SIGNS = np.where(np.array([[*corner] for corner in CORNERS]) == "+", 1.0, -1.0)


def arms(length: float) -> FloatArray:
    """Returns the points (4, 3) of a pose in its own frame [m]; `length` is L."""
    return np.sqrt(0.5) * length * _SIGNS


def with_corners(recording: Recording, lengths: Mapping[str, float]) -> Recording:
    """Adds the four points of rigid bodies to a recording.

    Args:
        recording: has a position and three points on the axes of a rigid body, as `in_metres`
            returns them.
        lengths: L of the rigid bodies by name [m].

    Raises:
        DataFileError: the recording has no rigid body of a name, or one without orientation.
    """
    labels, positions, rest = recording.labels, recording.positions, recording.rest
    for name, length in lengths.items():
        axes = [f"{name} +{axis}" for axis in "xyz"]
        if name not in labels:
            known = [label for label in recording.labels if f"{label} +x" in recording.labels]
            hint = did_you_mean(name, known) or (
                f": it has {listed(known)}; name it in markers.rigid_bodies as the recording "
                "does, or name the markers that it has in data.trials.NAME.labels."
            )
            raise DataFileError(f"{recording.source} has no rigid body {name!r}{hint}")
        if not {*axes} <= {*labels}:
            raise DataFileError(
                f"{recording.source}: {name!r} is a marker without an orientation: export it as "
                "a rigid body with its quaternion (docs/recordings.md), or track it as a marker "
                "in markers.tracked."
            )
        pose = recording.select([name, *axes])
        weights = arms(length) / ARM
        corners, still = (
            None if x is None else x[..., :1, :] + weights @ (x[..., 1:, :] - x[..., :1, :])
            for x in (pose.positions, pose.rest)
        )
        labels = (*labels, *(f"{name} {corner}" for corner in CORNERS))
        positions = np.concatenate([positions, corners], axis=1)
        rest = None if rest is None else np.concatenate([rest, still])
    return replace(recording, labels=labels, positions=positions, rest=rest)


def with_axes(recording: Recording, lengths: Mapping[str, float]) -> Recording:
    """Returns a recording with the points that motion capture gives
    in place of those of `with_corners`.
    """
    labels, positions = [*recording.labels], recording.positions.copy()
    rest = None if recording.rest is None else recording.rest.copy()
    for name, rows in corners_of(labels).items():
        weights = ARM / (4.0 * np.sqrt(0.5) * lengths[name]) * _SIGNS.T
        for points in (positions, rest):
            if points is not None:
                corners = points[..., rows, :]
                place = corners.mean(axis=-2, keepdims=True)
                points[..., rows, :] = np.concatenate([place, place + weights @ corners], axis=-2)
        labels[rows] = [name, *(f"{name} +{axis}" for axis in "xyz")]
    return replace(recording, labels=tuple(labels), positions=positions, rest=rest)


def corners_of(labels: Sequence[str]) -> dict[str, slice]:
    """Indices of the four points of the rigid bodies among observed points, by name."""
    ends = [number for number, label in enumerate(labels) if label.endswith(f" {CORNERS[-1]}")]
    return {labels[end].rpartition(" ")[0]: slice(end - 3, end + 1) for end in ends}


def owners(labels: Sequence[str]) -> tuple[str, ...]:
    """Returns labels of markers as they are, and the names of rigid bodies
    in place of those of their points.
    """
    return tuple(_owned(labels))


def independent(labels: Sequence[str]) -> list[float] | None:
    """Share of the coordinates of each point that are independent:
    six of the twelve of a rigid body; None for all.
    """
    shares = np.ones(len(labels))
    for rows in corners_of(labels).values():
        shares[rows] = 0.5
    return None if (shares == 1.0).all() else shares.tolist()


def as_markers(points: ArrayLike, labels: Sequence[str], axis: int = -2) -> FloatArray:
    """Replaces the four points of a rigid body by its position, their mean.

    The labels are then their `owners`.

    Args:
        points: (..., M, ...) with observed points along an axis.
        labels: M labels.
        axis: the axis.
    """
    values, owned = np.asarray(points), _owned(labels)
    if len(owned) == len(labels):
        return values
    return np.stack([values.take(rows, axis).mean(axis) for rows in owned.values()], axis)


def _owned(labels: Sequence[str]) -> dict[str, list[int]]:
    """Indices of the points of markers and rigid bodies by name."""
    ends, owned = tuple(f" {corner}" for corner in CORNERS), dict[str, list[int]]()
    for number, label in enumerate(labels):
        owned.setdefault(label.rpartition(" ")[0] if label.endswith(ends) else label, []).append(
            number
        )
    return owned


def motion_between(points: ArrayLike, moved: ArrayLike) -> RigidTransform:
    """Returns the motion from points (..., 4, 3) of a rigid body to moved ones [m],
    NaN unless all are finite.
    """
    a, b = np.broadcast_arrays(
        np.asarray(points, dtype=np.float64), np.asarray(moved, dtype=np.float64)
    )
    known = (np.isfinite(a) & np.isfinite(b)).all(axis=(-2, -1))[..., None, None]
    motion, _ = fit(np.where(known, a, _SIGNS), np.where(known, b, _SIGNS), np.ones(4))
    translation = np.where(known[..., 0], motion.translation, np.nan)
    return RigidTransform(np.where(known, motion.rotation, np.nan), translation)


def angles(points: ArrayLike, others: ArrayLike) -> FloatArray:
    """Angles (...) [rad] between orientations of a rigid body, from points (..., 4, 3).

    NaN unless all are finite.
    """
    turned = motion_between(points, others).rotation
    skew = turned - np.swapaxes(turned, -1, -2)
    sine = 0.5 * np.linalg.norm(
        np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1), axis=-1
    )
    return np.asarray(np.arctan2(sine, 0.5 * (np.trace(turned, axis1=-2, axis2=-1) - 1.0)))
