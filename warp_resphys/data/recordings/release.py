"""The moment in which a body that was held is let go."""

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...io.errors import DataFileError
from .recording import FloatArray

_QUIET = 0.2  # [s] that the body must have been still
_LEAST_DROP = 1e-3  # [m]


@dataclasses.dataclass(frozen=True)
class Release:
    """When a body that was held still began to move."""

    frame: float  # The moment of release, in frames and parts of a frame
    rest: tuple[int, int]  # First and past-the-last frame of the quiet stretch before it, in which the body was held


def find_release(path: FloatArray, rate: float, source: str | Path = "the recording") -> Release:
    """Finds when a point that was held still was let go.

    The point moves fast for the first time where one frame's step reaches a third of the largest (of a path
    through a three-frame median, which a sample gone astray does not pass). The body was held in the last
    stretch before that which is quiet: it spreads by less than 2 % of the later excursion. A body let go from
    rest first moves by s = a (t - t0)^2 / 2, so sqrt(s) of the first three frames of motion is a line, and
    its zero is the release.

    Args:
        path: (T, 3) [m], without NaN; a mean of several markers is best.
        rate: Frames a second [Hz].
        source: Where the path comes from.

    Raises:
        DataFileError: The path has no such moment.
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
    line = root_line(moving, travelled[moving])
    if line is None:
        return float(last_still)
    slope, zero = line
    # A frame that noise hides may be the first of the motion: the line tells how long ago it was let go at most.
    moved = np.sqrt(max(travelled[last_still] + 2.0 * noise, 0.0))
    return float(np.clip(zero, last_still - min(moved / slope, 1.0), last_still + 1))


def root_line(time: FloatArray | NDArray[np.int64], travelled: FloatArray) -> tuple[float, float] | None:
    """Slope and zero of a line through the roots of (T,) ways [m]; None where these do not grow.

    A body that starts from rest first moves by s = a (t - t0)^2 / 2, so that the zero is t0.
    """
    root = np.sqrt(np.maximum(travelled, 0.0))
    if len(root) < 2 or root[-1] <= root[0]:
        return None
    slope, intercept = np.polyfit(time, root, 1)
    return float(slope), float(-intercept / slope)
