"""Faulty samples: markers that jump, and markers with exchanged labels."""

import dataclasses

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter

from .recording import FloatArray, Recording, bridged, runs

LEAST_JUMP = 2e-4  # [m]
_TIMES_USUAL = 8.0  # Least ratio of a jump and the median of the steps around it.
_USUAL_FRAMES = 21
_SHARE_OF_LARGEST = 0.75  # Excludes the residual of 4/6 that a jump of 1 leaves in the steps beside it.
_TAKEN_OVER = 0.25  # of the marker's displacement: largest distance from the other marker's place
_NEIGHBOURS = np.array([-1.0, 4.0, 4.0, -1.0]) / 6.0


@dataclasses.dataclass(frozen=True)
class Jump:
    """A step of a single marker."""

    label: str
    frame: int  # The first frame after the jump
    size: float  # [m] part of the step that neither its neighbours in time nor the other markers explain


@dataclasses.dataclass(frozen=True)
class Swap:
    """A marker that appears at the last place of another one."""

    label: str
    other: str  # The other marker
    frame: int  # The first frame at that place


def find_jumps(recording: Recording, least: float = LEAST_JUMP) -> list[Jump]:
    """Finds steps between two frames that neither the marker's own motion nor that of another marker explains.

    A step is predicted from the two steps on either side by a cubic, which is exact for a motion that is smooth over
    six frames. Its residual is compared with the residuals of all other markers, since a body that is released or hits
    something jerks as a whole; the smallest difference counts. It is a jump if it is larger than `least` and larger
    than eight times its median over 21 frames. Gaps are interpolated by a spline.
    """
    size = _unexplained(recording)
    if not len(size):
        return []
    usual = median_filter(size, size=(_USUAL_FRAMES, 1), mode="nearest")
    largest = maximum_filter1d(size, 5, axis=0, mode="nearest")
    is_jump = (size > least) & (size > _TIMES_USUAL * usual) & (size >= _SHARE_OF_LARGEST * largest)
    return [Jump(recording.labels[column], int(at) + 1, float(size[at, column])) for at, column in np.argwhere(is_jump)]


def find_swaps(recording: Recording, jumps: list[Jump]) -> list[Swap]:
    """Finds markers that appear at the last place of another marker after a jump or an occlusion."""
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
            moved = np.linalg.norm(recording.positions[frame, column] - recording.positions[before[column], column])
            places = recording.positions[before, np.arange(len(before))]  # (M, 3)
            distance = np.linalg.norm(recording.positions[frame, column] - places, axis=1)
            distance[(before < 0) | (np.arange(len(before)) == column)] = np.inf
            nearest = int(np.argmin(distance))
            if distance[nearest] < _TAKEN_OVER * moved and moved > 5.0 * LEAST_JUMP:
                swaps.append(Swap(label, recording.labels[nearest], frame))
    return swaps


def _unexplained(recording: Recording) -> FloatArray:
    """Part of the steps (T-1, M) [m] that is neither smooth nor shared by another marker."""
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
    residual = steps - sum(weight * step for weight, step in zip(_NEIGHBOURS, beside, strict=True))
    size = np.linalg.norm(residual, axis=2)
    for column in range(len(recording.labels)):
        others = np.linalg.norm(np.delete(residual, column, axis=1) - residual[:, column, None], axis=2)
        if others.shape[1]:
            size[:, column] = np.minimum(size[:, column], others.min(axis=1))
    return size


def mask_repeats(recording: Recording) -> Recording:
    """Masks frames (NaN) in which all seen markers have exactly their positions in the frame before.

    Measured positions always differ by their noise. Equal ones come from a stream that was read faster than it was
    updated.
    """
    positions = recording.positions
    equal = (positions[1:] == positions[:-1]) | (np.isnan(positions[1:]) & np.isnan(positions[:-1]))
    repeated = np.flatnonzero(equal.all(axis=(1, 2))) + 1
    masked = positions.copy()
    masked[repeated] = np.nan
    return dataclasses.replace(recording, positions=masked)
