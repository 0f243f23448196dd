"""Processing of measured recordings for the comparison with simulations,
and the time at which a body begins to move.

Short gaps between measured frames are interpolated; longer gaps are masked: positions stay NaN, and
`Recording.seen` is False there. A body begins to move as a held one is released, or as a valve
opens.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from ...io.arrays import FloatArray, IntArray
from ...io.errors import DataFileError, InputError
from ..base_motion import at_times, followed
from .recording import Recording, bridged, runs

_FIRST_SECONDS = 0.2  # [s] latest start of a stretch after that of the first one
_WHOLE = 1e-6  # Relative tolerance for a whole ratio of rates
# Of a release:
_QUIET = 0.2  # [s] that the body must have been still
_LEAST_DROP = 1e-3  # [m]
# Of an opening valve:
_LEAST_REST = 0.03  # [s] that the body must be seen at rest
_LEAST_MOTION = 5e-4  # [m]
_FAST = 1.0 / 3.0  # of the largest speed: from there on the body certainly moves
_STILL = 0.1  # of the largest speed: below that the body is at rest
_QUIET_SHARE = 0.2  # of the excursion: largest displacement of a body at rest
# Frames of the motion; with more, the line would begin too early, as sqrt(s) of a swing is concave.
_FITTED = 2
_BEFORE = 1.0  # frames of the motion that noise and a slow start may hide


@dataclasses.dataclass(frozen=True)
class Release:
    """Release of a held body."""

    frame: float  # The moment of release, in frames and parts of a frame
    rest: tuple[int, int]  # First and past-the-last frame of the quiet stretch before it


def fill_gaps(recording: Recording, longest: int) -> Recording:
    """Interpolates gaps of up to `longest` frames by a cubic spline through the frames
    in which the marker was seen.

    Longer gaps, and gaps at either end, stay NaN.

    Raises:
        DataFileError: A marker is seen in fewer than two frames.
    """
    positions = recording.positions.copy()
    for column, (label, seen) in enumerate(zip(recording.labels, recording.seen.T, strict=True)):
        if np.count_nonzero(seen) < 2:
            raise DataFileError(
                f"{recording.source}: marker {label} is seen in {np.count_nonzero(seen)} of "
                f"{len(seen)} frames; leave it out of the configured markers."
            )
        wanted = np.zeros(len(seen), dtype=np.bool_)
        for start, stop in runs(~seen):
            wanted[start:stop] = stop - start <= longest and start > 0 and stop < len(seen)
        if wanted.any():
            positions[wanted, column] = bridged(recording, column, np.flatnonzero(wanted))
    return dataclasses.replace(recording, positions=positions)


def _interpolated(series: FloatArray, old: IntArray, new: FloatArray) -> FloatArray:
    """Interpolates a series (T, C) linearly at new places among its frames, (T', C)."""
    return np.stack([np.interp(new, old, channel) for channel in series.T], axis=1)


def resample(recording: Recording, rate: float) -> Recording:
    """Resamples a recording at the simulator's rate 1/h [Hz].

    Where the recording's rate is a whole multiple, every n-th frame is kept, exactly as measured.
    Otherwise positions are interpolated by a cubic spline through the frames in which a marker was
    seen; a new frame is seen if the frames on both sides of it were. Actuation is interpolated
    linearly. The relative error of the spline is about (2 pi / n)^4 / 384 for an oscillation with n
    frames a period.
    """
    ratio = recording.rate / rate
    every = round(ratio)
    if every >= 1 and abs(ratio - every) <= _WHOLE * ratio:
        return dataclasses.replace(recording.frames(slice(None, None, every)), rate=float(rate))
    old = np.arange(len(recording.positions))
    new = np.arange(int((len(old) - 1) / ratio * (1.0 + _WHOLE)) + 1) * ratio
    new = np.minimum(new, old[-1])
    below, above = np.floor(new + _WHOLE).astype(int), np.ceil(new - _WHOLE).astype(int)
    positions = np.full((len(new), len(recording.labels), 3), np.nan)
    for column, known in enumerate(recording.seen.T):
        kept = known[below] & known[above]
        if kept.any() and np.count_nonzero(known) > 1:
            positions[kept, column] = bridged(recording, column, new[kept])
    driven = recording.actuation
    actuation = None if driven is None else _interpolated(driven, old, new)
    base = None if recording.base is None else at_times(recording.base, old, new)
    moved = {name: at_times(poses, old, new) for name, poses in recording.obstacles.items()}
    loads = {  # NaN beside NaN
        name: _interpolated(readings, old, new) for name, readings in recording.loads.items()
    }
    resampled = dataclasses.replace(
        recording, positions=positions, actuation=actuation, base=base, rate=float(rate)
    )
    return dataclasses.replace(resampled, obstacles=moved, loads=loads)


def smooth(recording: Recording, cutoff: float) -> Recording:
    """Low-pass filters positions by a zero-phase Butterworth filter, forwards and backwards.

    Its gain is one half at the cut-off, and falls by 48 dB an octave above it. Forces follow from
    accelerations, in which noise grows with the square of its frequency: without a filter,
    reconstructed forces are mostly noise.

    Gaps stay NaN; the filter input is linear there.

    Raises:
        InputError: the cut-off [Hz] is not below half of the frame rate.
        DataFileError: too few frames.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0.0 < cutoff < 0.5 * recording.rate:
        raise InputError(
            f"the cut-off is {cutoff:g} Hz: it must lie between 0 and {0.5 * recording.rate:g} "
            "Hz, half of the rate."
        )
    sections = butter(4, cutoff, fs=recording.rate, output="sos")
    pad = min(round(3.0 * recording.rate / cutoff), len(recording.positions) - 2)
    if pad < 1:
        raise DataFileError(
            f"{recording.source} has {len(recording.positions)} frames, too few to be filtered."
        )
    positions = np.full_like(recording.positions, np.nan)
    frames = np.arange(len(positions))
    for column, seen in enumerate(recording.seen.T):
        if seen.any():
            filled = [
                np.interp(frames, frames[seen], x[seen]) for x in recording.positions[:, column].T
            ]
            positions[:, column] = sosfiltfilt(
                sections, np.stack(filled, axis=1), axis=0, padlen=pad
            )
            positions[~seen, column] = np.nan
    return dataclasses.replace(recording, positions=positions)


def find_release(path: FloatArray, rate: float, source: str | Path = "the recording") -> Release:
    """Finds the release of a point on a path (T, 3) [m] without NaN at a rate [Hz].

    The fast motion begins where the step between two frames first reaches a third of the largest
    one, after a median filter of three frames against outliers. The body was held in the last quiet
    stretch before, with a spread of less than 2 % of the later excursion. A body released from rest
    first moves by s = a (t - t0)^2 / 2, so sqrt(s) of the first three frames of motion is a line,
    and its zero is the release.

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
            f"No release found in {source}: the tip never moves by more than {1e3 * drop:.2f} "
            "mm; give a recording in which the body is let go."
        )
    for stop in range(fast - 1, length - 1, -1):
        if np.ptp(path[stop - length : stop], axis=0).max() < 0.02 * drop:
            rest = (stop - length, stop)
            return Release(_onset(path, rest, fast, drop), rest)
    raise DataFileError(
        f"No release found in {source}: the tip is not still for {length} frames before it first "
        f"moves fast, in frame {fast}; give a recording that begins with the body held at rest."
    )


def _onset(path: FloatArray, rest: tuple[int, int], fast: int, drop: float) -> float:
    """The release in frames, by a line through sqrt(s) of the first three frames of motion."""
    resting = path[slice(*rest)]
    centre = np.median(resting, axis=0)
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


def release_of(recording: Recording, labels: Sequence[str], longest_gap: int) -> Release:
    """Finds the release of the body from the mean of the moving markers
    with the longest first stretch without gaps.

    Occlusions of up to `longest_gap` frames are interpolated.

    Raises:
        DataFileError: A marker is missing, or there is no release before all markers are hidden.
    """
    moving = fill_gaps(recording.select(labels), longest_gap)
    stretches = [stretch for seen in moving.seen.T for stretch in runs(seen)]
    earliest = min(start for start, _ in stretches) + _FIRST_SECONDS * moving.rate
    start, stop = max(
        (stretch for stretch in stretches if stretch[0] <= earliest),
        key=lambda ends: ends[1] - ends[0],
    )
    use = moving.seen[start:stop].all(axis=0)
    part = (
        ""
        if stop - start == len(moving.positions)
        else f", frames {start} to {stop - 1}, the first without a long gap"
    )
    path = moving.positions[start:stop, use].mean(axis=1)
    release = find_release(path, recording.rate, source=f"{recording.source}{part}")
    return Release(start + release.frame, (start + release.rest[0], start + release.rest[1]))


def trim_to_release(
    recording: Recording, release: Release, seconds: float | None = None
) -> Recording:
    """Returns the frames from the release on.

    The release is between two frames: `start` of the result is the time from the release to the
    first frame. Frames later than `seconds` after the release are left out.

    Raises:
        DataFileError: Too few frames are left.
    """
    first = max(0, int(np.ceil(release.frame)))
    last = len(recording.positions)
    if seconds is not None:
        last = min(last, int(np.floor(release.frame + seconds * recording.rate)) + 1)
    if last - first < 2:
        raise DataFileError(
            f"{recording.source} ends {last - first} frames after its release in frame "
            f"{release.frame:.1f}; give a recording of the motion that follows."
        )
    start = (first - release.frame) / recording.rate
    return dataclasses.replace(recording.frames(slice(first, last)), start=start)


def valve_opening(recording: Recording, followed: Sequence[str]) -> float:
    """Finds the opening of a valve, at which a body at rest begins to move, between two frames.

    The fast motion begins where the speed of the mean of the followed markers first reaches a third
    of the largest. The rest ends in the last frame before with less than a tenth of the largest
    speed. As pressure builds up, the body first moves by about s = a (t - t0)^2 / 2, so sqrt(s) of
    the next two frames is a line, and its zero is the opening; it may be up to a frame before the
    end of the rest, as noise hides a slow start. Missing frames there add an error of up to their
    number. A slow drift, such as that of a leaking valve, is not counted as the opening.

    Frames in which a followed marker was not seen are ignored. Repeated frames should be masked
    before (`segment.mask_repeats`).

    Returns:
        The time [s], on the recording's own clock (`Recording.time`).

    Raises:
        DataFileError: a marker is not in the recording, nothing moves, or it moves from the first
            frame on.
    """
    chosen = recording.select(followed)
    seen = np.flatnonzero(chosen.seen.all(axis=1))
    if len(seen) < 2 + _FITTED:
        raise DataFileError(
            f"No opening of the valve found in {recording.source}: the followed markers are seen "
            f"together in {len(seen)} frames; follow markers that are seen."
        )
    path, time = chosen.positions[seen].mean(axis=1), recording.time[seen]
    smooth = median_filter(path, size=(3, 1), mode="nearest")
    excursion = float(np.linalg.norm(smooth - smooth[0], axis=1).max())
    if excursion < _LEAST_MOTION:
        raise DataFileError(
            f"No opening of the valve found in {recording.source}: the followed markers never "
            f"move by more than {1e3 * excursion:.2f} mm; follow markers that the pressure moves."
        )
    speed = np.linalg.norm(np.diff(smooth, axis=0), axis=1) / np.diff(time)
    fast = int(np.argmax(speed >= _FAST * speed.max()))
    slow = np.flatnonzero(speed[:fast] < _STILL * speed.max())
    last = int(slow[-1]) + 1 if len(slow) else 0
    wandered = float(np.ptp(smooth[: last + 1], axis=0).max())
    if (
        time[last] - time[0] < _LEAST_REST - 0.5 / recording.rate
        or wandered > _QUIET_SHARE * excursion
    ):
        raise DataFileError(
            f"{recording.source}: the followed markers move from the first frame on, or too soon "
            f"after it; give a recording that begins {_LEAST_REST:g} s "
            "or more before the valve opens."
        )
    moving = slice(last + 1, last + 1 + _FITTED)
    way = path[moving] - np.median(path[: last + 1], axis=0)
    line = _root_line(time[moving], way @ (way[-1] / np.linalg.norm(way[-1])))
    if line is None:
        return float(time[last])
    return float(
        np.clip(line[1], max(time[last] - _BEFORE / recording.rate, time[0]), time[last + 1])
    )


def _root_line(time: FloatArray | IntArray, travelled: FloatArray) -> tuple[float, float] | None:
    """Slope and zero of a line through the square roots of distances (T,) [m].

    None where these do not grow.

    A body that starts from rest first moves by s = a (t - t0)^2 / 2, so that the zero is t0.
    """
    root = np.sqrt(np.maximum(travelled, 0.0))
    if len(root) < 2 or root[-1] <= root[0]:
        return None
    slope, intercept = np.polyfit(time, root, 1)
    return float(slope), float(-intercept / slope)


def obstacle_motion(recording: Recording, name: str, seconds: float) -> FloatArray:
    """Poses (T, 6) of an obstacle in the frame of a recording,
    from the marker or rigid body of its name.

    Args:
        recording: with all of its markers.
        name: of the obstacle. A marker shows a translation alone.
        seconds: at the start, in which the obstacle stands at its configured place [s].

    Raises:
        DataFileError: there is no such marker, or it is seen in less than half of the frames, or
            not at the start.
    """
    if name not in recording.labels:
        raise DataFileError(
            f"{recording.source} has no marker or rigid body {name!r}, which shows the motion of "
            "this obstacle: name it so, or give its motion in data.obstacle_motion."
        )
    arms = [f"{name} +{axis}" for axis in "xyz"]
    shown = recording.select([name, *(arms if {*arms} <= {*recording.labels} else ())])
    first = shown.positions[: max(round(seconds * recording.rate), 1)]
    if not np.isfinite(first).all(-1).any(0).all():
        raise DataFileError(
            f"{recording.source}: {name!r} is not seen in the first {seconds:g} s, while its "
            "obstacle stands: start the recording earlier, or give the motion in "
            "data.obstacle_motion."
        )
    return followed(
        shown.positions, np.nanmedian(first, axis=0), recording.source, f"the obstacle {name!r}"
    )
