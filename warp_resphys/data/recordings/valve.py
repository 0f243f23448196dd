"""The moment in which a valve opens and a body that was at rest begins to move."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from ...io.errors import DataFileError
from .recording import Recording
from .release import root_line

_FAST = 1.0 / 3.0  # of the largest speed: from there on the body certainly moves
_STILL = 0.1  # of the largest speed: below that it does not yet
_QUIET_SHARE = 0.2  # of the excursion: what a body at rest may wander
_FITTED = 2  # frames of the motion; a line through more would begin too early, as sqrt(s) of a swing bends down
_BEFORE = 1.0  # frames of it that noise and a slow start may hide
_QUIET = 0.03  # [s] that the body must be seen at rest
_LEAST = 5e-4  # [m] the smallest excursion that counts as a motion


def valve_opening(recording: Recording, followed: Sequence[str]) -> float:
    """Finds when a body at rest begins to move, between two frames.

    The mean of the followed markers moves fast for the first time where its speed reaches a third of the largest. The
    last frame before that which is slower than a tenth of it ends the rest. As pressure builds up, the body first moves
    by about s = a (t - t0)^2 / 2, so sqrt(s) of the next two frames is a line, and its zero is the opening; it may lie
    up to a frame before the end of the rest, as noise hides a slow start. Frames that are missing there cost up to
    their number. A slow drift, as of a valve that leaks, is not taken for the opening.

    Args:
        recording: frames in which one of the followed markers was not seen are left out; so should be those that repeat
            the one before (`jumps.mask_repeats`).
        followed: markers whose mean is followed.

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
    if excursion < _LEAST:
        raise DataFileError(
            f"No opening of the valve found in {recording.source}: the followed markers never move by more than "
            f"{1e3 * excursion:.2f} mm; follow markers that the pressure moves."
        )
    speed = np.linalg.norm(np.diff(smooth, axis=0), axis=1) / np.diff(time)
    fast = int(np.argmax(speed >= _FAST * speed.max()))
    slow = np.flatnonzero(speed[:fast] < _STILL * speed.max())
    last = int(slow[-1]) + 1 if len(slow) else 0
    wandered = float(np.ptp(smooth[: last + 1], axis=0).max())
    if time[last] - time[0] < _QUIET - 0.5 / recording.rate or wandered > _QUIET_SHARE * excursion:
        raise DataFileError(
            f"{recording.source}: the followed markers move from the first frame on, or too soon after it; give a "
            f"recording that begins {_QUIET:g} s or more before the valve opens."
        )
    moving = slice(last + 1, last + 1 + _FITTED)
    way = path[moving] - np.median(path[: last + 1], axis=0)
    line = root_line(time[moving], way @ (way[-1] / np.linalg.norm(way[-1])))
    if line is None:
        return float(time[last])
    return float(np.clip(line[1], max(time[last] - _BEFORE / recording.rate, time[0]), time[last + 1]))
