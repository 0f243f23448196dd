"""Detection of the time at which a body begins to move: the release of a held body, or the opening of a valve."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...io.errors import DataFileError
from .recording import FloatArray, Recording

# Of a release:
_QUIET = 0.2  # [s] that the body must have been still
_LEAST_DROP = 1e-3  # [m]
# Of an opening valve:
_LEAST_REST = 0.03  # [s] that the body must be seen at rest
_LEAST_MOTION = 5e-4  # [m]
_FAST = 1.0 / 3.0  # of the largest speed: from there on the body certainly moves
_STILL = 0.1  # of the largest speed: below that the body is at rest
_QUIET_SHARE = 0.2  # of the excursion: largest displacement of a body at rest
_FITTED = 2  # frames of the motion; with more, the line would begin too early, as sqrt(s) of a swing is concave
_BEFORE = 1.0  # frames of the motion that noise and a slow start may hide


@dataclasses.dataclass(frozen=True)
class Release:
    """Release of a held body."""

    frame: float  # The moment of release, in frames and parts of a frame
    rest: tuple[int, int]  # First and past-the-last frame of the quiet stretch before, in which the body was held


def find_release(path: FloatArray, rate: float, source: str | Path = "the recording") -> Release:
    """Finds the release of a point on a path (T, 3) [m] without NaN at a rate [Hz].

    The fast motion begins where the step between two frames first reaches a third of the largest one, after a
    median filter of three frames against outliers. The body was held in the last quiet stretch before, with a
    spread of less than 2 % of the later excursion. A body released from rest first moves by
    s = a (t - t0)^2 / 2, so sqrt(s) of the first three frames of motion is a line, and its zero is the release.

    A mean of several markers is the best path.

    Raises:
        DataFileError: The path has no release.
    """
    length = max(2, round(_QUIET * rate))
    smooth = median_filter(path, size=(3, 1), mode="nearest")
    steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
    fast = int(np.argmax(3.0 * steps >= steps.max(initial=0.0))) + 1 if len(steps) else 0
    before = path[max(fast - 1, 0)] if len(path) else np.zeros(3)
    drop = float(np.linalg.norm(smooth[fast:] - before, axis=1).max(initial=0.0))
    if drop < _LEAST_DROP:
        raise DataFileError(
            f"No release found in {source}: the tip never moves by more than {1e3 * drop:.2f} mm; give a recording in "
            "which the body is let go."
        )
    for stop in range(fast - 1, length - 1, -1):
        if np.ptp(path[stop - length : stop], axis=0).max() < 0.02 * drop:
            rest = (stop - length, stop)
            return Release(_onset(path, rest, fast, drop), rest)
    raise DataFileError(
        f"No release found in {source}: the tip is not still for {length} frames before it first moves fast, "
        f"in frame {fast}; give a recording that begins with the body held at rest."
    )


def _onset(path: FloatArray, rest: tuple[int, int], fast: int, drop: float) -> float:
    """The release in frames, by a line through sqrt(s) of the first three frames of motion."""
    held = path[slice(*rest)]
    centre = np.median(held, axis=0)
    direction = (path[fast] - centre) / np.linalg.norm(path[fast] - centre)
    travelled = (path - centre) @ direction  # (T,) [m]
    noise = float(np.std(travelled[slice(*rest)]))
    still = np.flatnonzero(travelled[rest[0] : fast] < max(4.0 * noise, 0.005 * drop))
    last_still = rest[0] + int(still[-1])
    moving = np.arange(last_still + 1, min(last_still + 4, len(path)))
    line = _root_line(moving, travelled[moving])
    if line is None:
        return float(last_still)
    slope, zero = line
    # Noise may hide the first frame of the motion: the line gives the earliest time of the release.
    moved = np.sqrt(max(travelled[last_still] + 2.0 * noise, 0.0))
    return float(np.clip(zero, last_still - min(moved / slope, 1.0), last_still + 1))


def valve_opening(recording: Recording, followed: Sequence[str]) -> float:
    """Finds the opening of a valve, at which a body at rest begins to move, between two frames.

    The fast motion begins where the speed of the mean of the followed markers first reaches a third of the largest. The
    rest ends in the last frame before with less than a tenth of the largest speed. As pressure builds up, the body
    first moves by about s = a (t - t0)^2 / 2, so sqrt(s) of the next two frames is a line, and its zero is the opening;
    it may be up to a frame before the end of the rest, as noise hides a slow start. Missing frames there add an error
    of up to their number. A slow drift, such as that of a leaking valve, is not counted as the opening.

    Frames in which a followed marker was not seen are ignored. Repeated frames should be masked before
    (`segment.mask_repeats`).

    Returns:
        The time [s], on the recording's own clock (`Recording.time`).

    Raises:
        DataFileError: a marker is not in the recording, nothing moves, or it moves from the first frame on.
    """
    chosen = recording.select(followed)
    seen = np.flatnonzero(chosen.seen.all(axis=1))
    if len(seen) < 2 + _FITTED:
        raise DataFileError(
            f"No opening of the valve found in {recording.source}: the followed markers are seen together in "
            f"{len(seen)} frames; follow markers that are seen."
        )
    path, time = chosen.positions[seen].mean(axis=1), recording.time[seen]
    smooth = median_filter(path, size=(3, 1), mode="nearest")
    excursion = float(np.linalg.norm(smooth - smooth[0], axis=1).max())
    if excursion < _LEAST_MOTION:
        raise DataFileError(
            f"No opening of the valve found in {recording.source}: the followed markers never move by more than "
            f"{1e3 * excursion:.2f} mm; follow markers that the pressure moves."
        )
    speed = np.linalg.norm(np.diff(smooth, axis=0), axis=1) / np.diff(time)
    fast = int(np.argmax(speed >= _FAST * speed.max()))
    slow = np.flatnonzero(speed[:fast] < _STILL * speed.max())
    last = int(slow[-1]) + 1 if len(slow) else 0
    wandered = float(np.ptp(smooth[: last + 1], axis=0).max())
    if time[last] - time[0] < _LEAST_REST - 0.5 / recording.rate or wandered > _QUIET_SHARE * excursion:
        raise DataFileError(
            f"{recording.source}: the followed markers move from the first frame on, or too soon after it; give a "
            f"recording that begins {_LEAST_REST:g} s or more before the valve opens."
        )
    moving = slice(last + 1, last + 1 + _FITTED)
    way = path[moving] - np.median(path[: last + 1], axis=0)
    line = _root_line(time[moving], way @ (way[-1] / np.linalg.norm(way[-1])))
    if line is None:
        return float(time[last])
    return float(np.clip(line[1], max(time[last] - _BEFORE / recording.rate, time[0]), time[last + 1]))


def _root_line(time: FloatArray | NDArray[np.int64], travelled: FloatArray) -> tuple[float, float] | None:
    """Slope and zero of a line through the square roots of distances (T,) [m]; None where these do not grow.

    A body that starts from rest first moves by s = a (t - t0)^2 / 2, so that the zero is t0.
    """
    root = np.sqrt(np.maximum(travelled, 0.0))
    if len(root) < 2 or root[-1] <= root[0]:
        return None
    slope, intercept = np.polyfit(time, root, 1)
    return float(slope), float(-intercept / slope)
