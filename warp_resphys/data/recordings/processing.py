"""Processing of measured recordings for the comparison with simulations.

Short gaps between measured frames are interpolated; longer gaps are masked: positions stay NaN, and `Recording.seen` is
False there.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...io.errors import DataFileError, InputError, listed
from ..base_motion import at_times
from .recording import Recording, bridged, runs
from .release import Release, find_release

_FIRST_SECONDS = 0.2  # [s] latest start of a stretch after that of the first one
_WHOLE = 1e-6  # Relative tolerance for a whole ratio of rates


def fill_gaps(recording: Recording, longest: int = 5, *, mask_long: bool = False) -> Recording:
    """Interpolates short occlusions by a cubic spline through the frames in which the marker was seen.

    Args:
        recording: The recording.
        longest: The longest gap that is filled, in frames.
        mask_long: Keep longer gaps, and gaps at either end, as NaN. Otherwise a longer gap is an error, and a short one
            at either end is filled with the nearest sample.

    Raises:
        DataFileError: A marker is seen in fewer than two frames or, unless masked, occluded for longer.
    """
    positions = recording.positions.copy()
    for column, (label, seen) in enumerate(zip(recording.labels, recording.seen.T, strict=True)):
        if np.count_nonzero(seen) < 2:
            raise DataFileError(
                f"{recording.source}: marker {label} is seen in {np.count_nonzero(seen)} of {len(seen)} frames; "
                "leave it out of the configured markers."
            )
        wanted = np.zeros(len(seen), dtype=np.bool_)
        for start, stop in runs(~seen):
            inner = start > 0 and stop < len(seen)
            if stop - start > longest and not mask_long:
                raise DataFileError(
                    f"{recording.source}: marker {label} is occluded in frames {start} to {stop - 1}, longer "
                    f"than the {longest} frames that are interpolated; leave it out or raise the limit."
                )
            wanted[start:stop] = stop - start <= longest and (inner or not mask_long)
        if wanted.any():
            positions[wanted, column] = bridged(recording, column, np.flatnonzero(wanted))
    return dataclasses.replace(recording, positions=positions)


def resample(recording: Recording, rate: float) -> Recording:
    """Resamples a recording at the simulator's rate 1/h [Hz].

    Where the recording's rate is a whole multiple, every n-th frame is kept, exactly as measured. Otherwise positions
    are interpolated by a cubic spline through the frames in which a marker was seen; a new frame is seen if the frames
    on both sides of it were. Actuation is interpolated linearly. The relative error of the spline is about
    (2 pi / n)^4 / 384 for an oscillation with n frames a period.
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
    actuation = None
    if recording.actuation is not None:
        actuation = np.stack([np.interp(new, old, channel) for channel in recording.actuation.T], axis=1)
    base = None if recording.base is None else at_times(recording.base, old, new)
    moved = {name: at_times(poses, old, new) for name, poses in recording.obstacles.items()}
    resampled = dataclasses.replace(recording, positions=positions, actuation=actuation, base=base, rate=float(rate))
    return dataclasses.replace(resampled, obstacles=moved)


def smooth(recording: Recording, cutoff: float) -> Recording:
    """Low-pass filters positions by a zero-phase Butterworth filter, forwards and backwards.

    Its gain is one half at the cut-off, and falls by 48 dB an octave above it. Forces follow from accelerations, in
    which noise grows with the square of its frequency: without a filter, reconstructed forces are mostly noise.

    Gaps stay NaN; the filter input is linear there.

    Raises:
        InputError: the cut-off [Hz] is not below half of the frame rate.
        DataFileError: too few frames.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0.0 < cutoff < 0.5 * recording.rate:
        raise InputError(
            f"the cut-off is {cutoff:g} Hz: it must lie between 0 and {0.5 * recording.rate:g} Hz, half of the rate."
        )
    sections = butter(4, cutoff, fs=recording.rate, output="sos")
    pad = min(round(3.0 * recording.rate / cutoff), len(recording.positions) - 2)
    if pad < 1:
        raise DataFileError(f"{recording.source} has {len(recording.positions)} frames, too few to be filtered.")
    positions = np.full_like(recording.positions, np.nan)
    frames = np.arange(len(positions))
    for column, seen in enumerate(recording.seen.T):
        if seen.any():
            filled = [np.interp(frames, frames[seen], x[seen]) for x in recording.positions[:, column].T]
            positions[:, column] = sosfiltfilt(sections, np.stack(filled, axis=1), axis=0, padlen=pad)
            positions[~seen, column] = np.nan
    return dataclasses.replace(recording, positions=positions)


def release_of(recording: Recording, labels: Sequence[str], longest_gap: int = 5) -> Release:
    """Finds the release of the body from the mean of the moving markers with the longest first stretch without gaps.

    Occlusions of up to `longest_gap` frames are interpolated.

    Raises:
        DataFileError: A marker is missing, or there is no release before all markers are hidden.
    """
    moving = fill_gaps(recording.select(labels), longest_gap, mask_long=True)
    stretches = [stretch for seen in moving.seen.T for stretch in runs(seen)]
    earliest = min(start for start, _ in stretches) + _FIRST_SECONDS * moving.rate
    start, stop = max((stretch for stretch in stretches if stretch[0] <= earliest), key=lambda ends: ends[1] - ends[0])
    use = moving.seen[start:stop].all(axis=0)
    part = (
        "" if stop - start == len(moving.positions) else f", frames {start} to {stop - 1}, the first without a long gap"
    )
    path = moving.positions[start:stop, use].mean(axis=1)
    release = find_release(path, recording.rate, source=f"{recording.source}{part}")
    return Release(start + release.frame, (start + release.rest[0], start + release.rest[1]))


def trim_to_release(recording: Recording, release: Release, seconds: float | None = None) -> Recording:
    """Returns the frames from the release on, with the held markers as `rest`.

    The release is between two frames: `start` of the result is the time from the release to the first frame. Frames
    later than `seconds` after the release are left out.

    Raises:
        DataFileError: A marker is never seen while the body is held, or too few frames are left.
    """
    held = recording.positions[slice(*release.rest)]
    visible = recording.seen[slice(*release.rest)]
    hidden = [label for label, frames in zip(recording.labels, visible.T, strict=True) if not frames.any()]
    if hidden:
        raise DataFileError(
            f"{recording.source}: {listed(hidden)} cannot be seen while the body is held (frames {release.rest[0]} to "
            f"{release.rest[1] - 1}), so where it sits is not known; leave it out of the configured markers."
        )
    first = max(0, int(np.ceil(release.frame)))
    last = len(recording.positions)
    if seconds is not None:
        last = min(last, int(np.floor(release.frame + seconds * recording.rate)) + 1)
    if last - first < 2:
        raise DataFileError(
            f"{recording.source} ends {last - first} frames after its release in frame {release.frame:.1f}; give a "
            "recording of the motion that follows."
        )
    start = (first - release.frame) / recording.rate
    return dataclasses.replace(recording.frames(slice(first, last)), rest=np.nanmedian(held, axis=0), start=start)
