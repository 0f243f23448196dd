"""Samples gone astray: markers that jump, and markers that took over each other's names."""

import dataclasses

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter

from .recording import FloatArray, Recording, bridged, runs

LEAST_JUMP = 2e-4  # [m]
_TIMES_USUAL = 8.0  # A jump is so many times the median of the steps around it.
_USUAL_FRAMES = 21
_SHARE_OF_LARGEST = 0.75  # A step of 1 leaves 4/6 beside it, which is no jump of its own.
_TAKEN_OVER = 0.25  # of the way that the marker went
_NEIGHBOURS = np.array([-1.0, 4.0, 4.0, -1.0]) / 6.0


@dataclasses.dataclass(frozen=True)
class Jump:
    """A step that a marker made alone."""

    label: str
    frame: int  # The first frame after the jump
    size: float  # [m] how far it went beyond what its neighbours in time, and the other markers, explain


@dataclasses.dataclass(frozen=True)
class Swap:
    """A marker that appears where another one was."""

    label: str
    other: str  # The marker in whose place it appears
    frame: int  # The first frame of that


def find_jumps(recording: Recording, least: float = LEAST_JUMP) -> list[Jump]:
    """Finds steps between two frames that neither the marker's own motion nor that of another marker explains.

    A step is predicted from the two steps on either side of it by a cubic: exact for a motion that is smooth over six
    frames. What is left is compared with what is left of every other marker, since a body that is let go, or hits
    something, jerks as a whole; the smallest difference counts. It is a jump if it is larger than `least` and than
    eight times its median over 21 frames. Gaps are bridged by a spline for this.
    """
    size = _unexplained(recording)
    if not len(size):
        return []
    usual = median_filter(size, size=(_USUAL_FRAMES, 1), mode="nearest")
    largest = maximum_filter1d(size, 5, axis=0, mode="nearest")
    found = (size > least) & (size > _TIMES_USUAL * usual) & (size >= _SHARE_OF_LARGEST * largest)
    return [Jump(recording.labels[column], int(at) + 1, float(size[at, column])) for at, column in np.argwhere(found)]


def find_swaps(recording: Recording, jumps: list[Jump]) -> list[Swap]:
    """Finds markers that, after a jump or an occlusion, stand where another marker was before."""
    seen = recording.seen
    last_seen = np.maximum.accumulate(np.where(seen, np.arange(len(seen))[:, None], -1), axis=0)  # (T, M)
    swaps: list[Swap] = []
    for column, label in enumerate(recording.labels):
        frames = {jump.frame for jump in jumps if jump.label == label}
        frames |= {stop for start, stop in runs(~seen[:, column]) if start > 0 and stop < len(seen)}
        for frame in sorted(frames):
            before = last_seen[frame - 1]  # (M,)
            if not seen[frame, column] or before[column] < 0:
                continue
            gone = np.linalg.norm(recording.positions[frame, column] - recording.positions[before[column], column])
            places = recording.positions[before, np.arange(len(before))]  # (M, 3)
            distance = np.linalg.norm(recording.positions[frame, column] - places, axis=1)
            distance[(before < 0) | (np.arange(len(before)) == column)] = np.inf
            nearest = int(np.argmin(distance))
            if distance[nearest] < _TAKEN_OVER * gone and gone > 5.0 * LEAST_JUMP:
                swaps.append(Swap(label, recording.labels[nearest], frame))
    return swaps


def _unexplained(recording: Recording) -> FloatArray:
    """(T-1, M) [m] how much of each step is not smooth, and not shared by any other marker."""
    frames = len(recording.positions)
    if frames < 6:
        return np.zeros((0, len(recording.labels)))
    positions = np.zeros_like(recording.positions)
    for column, known in enumerate(recording.seen.T):
        if np.count_nonzero(known) > 1:
            positions[:, column] = bridged(recording, column, np.arange(frames))
    steps = np.diff(positions, axis=0)
    padded = np.pad(steps, ((2, 2), (0, 0), (0, 0)), mode="reflect")
    beside = (padded[:-4], padded[1:-3], padded[3:-1], padded[4:])
    left = steps - sum(weight * each for weight, each in zip(_NEIGHBOURS, beside, strict=True))
    size = np.linalg.norm(left, axis=2)
    for column in range(len(recording.labels)):
        others = np.linalg.norm(np.delete(left, column, axis=1) - left[:, column, None], axis=2)
        if others.shape[1]:
            size[:, column] = np.minimum(size[:, column], others.min(axis=1))
    return size


def mask_repeats(recording: Recording) -> Recording:
    """Makes NaN the frames in which every marker that is seen stands exactly where it stood in the frame before.

    Measured positions always differ by their noise. Equal ones are a stream that was read faster than it was updated:
    the frame says nothing new, and less than that of a body that moves.
    """
    positions = recording.positions
    equal = (positions[1:] == positions[:-1]) | (np.isnan(positions[1:]) & np.isnan(positions[:-1]))
    repeated = np.flatnonzero(equal.all(axis=(1, 2))) + 1
    masked = positions.copy()
    masked[repeated] = np.nan
    return dataclasses.replace(recording, positions=masked)
