"""Quality of a recording: occlusions, jumps, exchanged labels, noise,
and drift of markers that should stand still.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.spatial.distance import cdist

from ...io.arrays import FloatArray
from ...io.errors import DataFileError, InputError, listed, number_of
from .processing import Release
from .recording import Recording, bridged, runs

LEAST_JUMP = 2e-4  # [m]
_MILLI = 1e3
# Of jumps and exchanged labels:
_TIMES_USUAL = 8.0  # Least ratio of a jump and the median of the steps around it.
_USUAL_FRAMES = 21
_SHARE_OF_LARGEST = (
    0.75  # Excludes the residual of 4/6 that a jump of 1 leaves in the steps beside it.
)
_NEIGHBOURS = np.array([-1.0, 4.0, 4.0, -1.0]) / 6.0
_RELEASE_FRAMES = 1.5  # around the release, in which a jerk of a marker is no jump
_TAKEN_OVER = 0.25  # of the marker's displacement: largest distance from the other marker's place
# Of motion, noise and drift:
_LEAST_MOTION = 5e-4  # [m]
_NOISE_FRAMES = 25
_LEAST_NOISE_FRAMES = 10
_QUIET_QUARTILE = 25.0
_DRIFT_PART = 0.1  # of the frames, at either end
_MUCH_DRIFT_MM = 0.2


@dataclasses.dataclass(frozen=True)
class Jump:
    """A step of a single marker."""

    frame: int  # The first frame after the jump
    mm: float  # part of the step that neither its neighbours in time nor the other markers explain


@dataclasses.dataclass(frozen=True)
class MarkerQuality:
    """Quality of one marker."""

    label: str
    still: bool  # Whether it should not move
    seen: float  # Share of the frames in which it was seen
    gaps: int  # Number of occlusions
    longest_gap_frames: int
    masked_frames: int  # in gaps that are too long to be filled, or at either end
    jumps: tuple[Jump, ...]  # in the order of time
    noise_mm: float | None  # of one coordinate, see `noise_level`; None if too little is seen
    # between the median places in the first and last tenth of the frames; None if it may move, or
    # is never seen
    drift_mm: float | None

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user, one sentence each."""
        warnings = []
        if self.masked_frames:
            warnings.append(
                f"{self.label} is hidden for up to "
                f"{number_of(self.longest_gap_frames, 'frame')}; "
                f"{number_of(self.masked_frames, 'frame')} "
                f"{'is' if self.masked_frames == 1 else 'are'} masked."
            )
        if self.jumps:
            largest = max(self.jumps, key=lambda jump: jump.mm)
            often = "once," if len(self.jumps) == 1 else f"{len(self.jumps)} times, farthest"
            warnings.append(
                f"{self.label} jumps {often} by {largest.mm:.2f} mm, in frame {largest.frame}."
            )
        if self.drift_mm is not None and self.drift_mm > max(
            _MUCH_DRIFT_MM, 5.0 * (self.noise_mm or 0.0)
        ):
            warnings.append(f"{self.label} should not move and drifts by {self.drift_mm:.2f} mm.")
        return warnings


@dataclasses.dataclass(frozen=True)
class Quality:
    """Quality of a recording, the content of quality.json."""

    source: Path
    rate_hz: float
    frames: int
    release_frame: float | None  # Release of the body, if known
    longest_gap_filled: int  # The longest occlusion that counts as short, in frames
    markers: tuple[MarkerQuality, ...]
    warnings: tuple[str, ...]  # for the user, one sentence each


def quality(
    recording: Recording,
    still: Sequence[str] = (),
    release: Release | None = None,
    *,
    longest_gap: int = 5,
    least_jump: float = LEAST_JUMP,
) -> Quality:
    """Examines a measured recording before gaps are filled.

    Args:
        recording: The recording.
        still: Markers that should not move, such as those on the clamp.
        release: Release of the body, if known; its jerk is not counted as a jump.
        longest_gap: The longest occlusion that will be filled, in frames.
        least_jump: Smallest size of a jump [m].

    Raises:
        DataFileError: A marker that should not move is not in the recording.
    """
    recording.select(still)
    noise, markers = noise_level(recording), []
    jumps = find_jumps(recording, least_jump)
    for column, (label, seen) in enumerate(zip(recording.labels, recording.seen.T, strict=True)):
        if release is not None and label not in still:
            jumps[label] = [
                jump for jump in jumps[label] if abs(jump.frame - release.frame) > _RELEASE_FRAMES
            ]
        hidden, frames = [stop - start for start, stop in runs(~seen)], len(seen)
        masked = [
            stop - start
            for start, stop in runs(~seen)
            if stop - start > longest_gap or start == 0 or stop == frames
        ]
        path, drift = recording.positions[seen, column], None
        if label in still and len(path):
            part = max(1, round(_DRIFT_PART * len(path)))
            ends = [np.median(end, axis=0) for end in (path[:part], path[-part:])]
            drift = _MILLI * float(np.linalg.norm(ends[1] - ends[0]))
        counts = (len(hidden), max(hidden, default=0), sum(masked), tuple(jumps[label]))
        noise_mm = _MILLI * float(noise[column]) if np.isfinite(noise[column]) else None
        markers.append(
            MarkerQuality(label, label in still, float(seen.mean()), *counts, noise_mm, drift)
        )
    warnings = [
        f"From frame {frame} on, {label} stands where {other} was: check the labels."
        for label, other, frame in find_swaps(recording, jumps)
    ]
    for marker in markers:
        warnings += marker.warnings
    released = None if release is None else release.frame
    of_file = (recording.source, recording.rate, len(recording.positions), released)
    return Quality(*of_file, longest_gap, tuple(markers), tuple(warnings))


QUALITY_COLUMNS = ("Seen", "Gaps", "Longest", "Masked", "Jumps", "Noise [mm]", "Drift [mm]")


def quality_table(markers: Sequence[MarkerQuality]) -> dict[str, list[str]]:
    """Returns the cells of `QUALITY_COLUMNS` by marker."""
    cells = {}
    for marker in markers:
        largest = max((jump.mm for jump in marker.jumps), default=0.0)
        cells[marker.label] = [
            f"{100.0 * marker.seen:.1f} %",
            *map(str, (marker.gaps, marker.longest_gap_frames, marker.masked_frames)),
            f"{len(marker.jumps)}" + (f" ({largest:.2f} mm)" if marker.jumps else ""),
            "" if marker.noise_mm is None else f"{marker.noise_mm:.4f}",
            "" if marker.drift_mm is None else f"{marker.drift_mm:.3f}",
        ]
    return cells


def noise_level(recording: Recording) -> FloatArray:
    """Standard deviation of the noise in a coordinate of every marker, (M,) [m].

    NaN where too few frames were seen.

    Third differences of a smooth motion are small, those of white noise with variance s^2 have the
    variance 20 s^2 (1 + 9 + 9 + 1). They are averaged over stretches of 25 frames, and the lower
    quartile of the stretches is taken, so that oscillations or jumps in some of them do not count
    as noise.
    """
    third = np.diff(recording.positions, n=3, axis=0)  # (T-3, M, 3), NaN beside gaps
    stretches = [
        third[start : start + _NOISE_FRAMES] for start in range(0, len(third), _NOISE_FRAMES)
    ]
    noise = np.full(len(recording.labels), np.nan)
    for column in range(len(recording.labels)):
        values = [
            stretch[:, column][np.isfinite(stretch[:, column]).all(axis=1)] for stretch in stretches
        ]
        variances = [
            np.mean(np.square(part)) / 20.0 for part in values if len(part) >= _LEAST_NOISE_FRAMES
        ]
        if variances:
            noise[column] = np.sqrt(np.percentile(variances, _QUIET_QUARTILE))
    return noise


def find_jumps(recording: Recording, least: float = LEAST_JUMP) -> dict[str, list[Jump]]:
    """Finds steps between two frames that neither the marker's own motion nor
    that of another marker explains.

    A step is predicted from the two steps on either side by a cubic, which is exact for a motion
    that is smooth over six frames. Its residual is compared with the residuals of all other
    markers, since a body that is released or hits something jerks as a whole; the smallest
    difference counts. It is a jump if it is larger than `least` and larger than eight times its
    median over 21 frames. Gaps are interpolated by a spline.
    """
    jumps: dict[str, list[Jump]] = {label: [] for label in recording.labels}
    if len(recording.positions) < 6:
        return jumps
    positions = np.zeros_like(recording.positions)
    for column, known in enumerate(recording.seen.T):
        if np.count_nonzero(known) > 1:
            positions[:, column] = bridged(recording, column, np.arange(len(positions)))
    steps = np.diff(positions, axis=0)
    padded = np.pad(steps, ((2, 2), (0, 0), (0, 0)), mode="reflect")
    beside = (padded[:-4], padded[1:-3], padded[3:-1], padded[4:])
    residual = steps - sum(weight * step for weight, step in zip(_NEIGHBOURS, beside, strict=True))
    # (T-1, M) [m] part of the steps that is neither smooth nor shared
    size = np.linalg.norm(residual, axis=2)
    for column in range(len(recording.labels)):
        others = np.linalg.norm(
            np.delete(residual, column, axis=1) - residual[:, column, None], axis=2
        )
        size[:, column] = np.minimum(size[:, column], others.min(axis=1, initial=np.inf))
    usual = median_filter(size, size=(_USUAL_FRAMES, 1), mode="nearest")
    largest = maximum_filter1d(size, 5, axis=0, mode="nearest")
    is_jump = (size > least) & (size > _TIMES_USUAL * usual) & (size >= _SHARE_OF_LARGEST * largest)
    for at, column in np.argwhere(is_jump):
        jumps[recording.labels[column]].append(Jump(int(at) + 1, _MILLI * float(size[at, column])))
    return jumps


def find_swaps(
    recording: Recording, jumps: Mapping[str, Sequence[Jump]]
) -> list[tuple[str, str, int]]:
    """Finds markers that appear at the last place of another marker after a jump or an occlusion.

    Returns:
        The marker, the other marker, and the first frame at its place.
    """
    seen = recording.seen
    # (T, M)
    last_seen = np.maximum.accumulate(np.where(seen, np.arange(len(seen))[:, None], -1), axis=0)
    swaps = []
    for column, label in enumerate(recording.labels):
        frames = {jump.frame for jump in jumps[label]}
        frames |= {stop for start, stop in runs(~seen[:, column]) if start > 0 and stop < len(seen)}
        for frame in sorted(frames):
            before = last_seen[frame - 1]  # (M,)
            if not seen[frame, column] or before[column] < 0:
                continue
            here = recording.positions[frame, column]
            moved = np.linalg.norm(here - recording.positions[before[column], column])
            distance = np.linalg.norm(
                here - recording.positions[before, np.arange(len(before))], axis=1
            )
            distance[(before < 0) | (np.arange(len(before)) == column)] = np.inf
            nearest = int(np.argmin(distance))
            if distance[nearest] < _TAKEN_OVER * moved and moved > 5.0 * LEAST_JUMP:
                swaps.append((label, recording.labels[nearest], frame))
    return swaps


def compare_base(
    recordings: Sequence[Recording],
    labels: Sequence[str],
    largest_distortion: float = np.inf,
    largest_shift: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Compares the median positions of markers on a rigid base
    with those in the first of R recordings.

    Args:
        recordings: of one set-up.
        labels: M markers, two or more.
        largest_distortion: largest change of the distance between two markers [m].
        largest_shift: largest distance of a marker from its place in the first recording [m];
            anywhere if None, for recordings that are registered separately.

    Returns:
        Distances (R - 1, M) of the markers from their places in the first recording, and median
        changes of a marker's distances to the other ones [m].

    Raises:
        DataFileError: A marker is missing or never seen in a recording, or was moved between two.
        InputError: There are fewer than two markers to compare.
    """
    if len(labels) < 2:
        raise InputError(
            f"The base has {len(labels)} markers: name two or more that sit on the clamp."
        )
    places, shifts, distortions = list[FloatArray](), list[FloatArray](), list[FloatArray]()
    for recording in recordings:
        base = recording.select(labels)
        absent = [label for label, seen in zip(labels, base.seen.T, strict=True) if not seen.any()]
        if absent:
            raise DataFileError(
                f"{recording.source}: {listed(absent)} is never seen; "
                "leave it out of the base markers."
            )
        places.append(np.nanmedian(base.positions, axis=0))
        changes = np.abs(cdist(places[-1], places[-1]) - cdist(places[0], places[0]))
        changes = changes[~np.eye(len(labels), dtype=np.bool_)].reshape(len(labels), -1)
        distortions.append(np.median(changes, axis=1))
        shifts.append(np.linalg.norm(places[-1] - places[0], axis=1))
        if changes.max() > largest_distortion:
            raise DataFileError(
                f"{recording.source}: base marker {labels[int(np.argmax(distortions[-1]))]} "
                f"moved by {_MILLI * changes.max():.2f} mm against the other base markers since "
                f"{recordings[0].source}; put it back, check the unit, leave it out, or raise "
                f"the limit of {_MILLI * largest_distortion:g} mm."
            )
        if largest_shift is not None and shifts[-1].max() > largest_shift:
            raise DataFileError(
                f"{recording.source}: base marker {labels[int(np.argmax(shifts[-1]))]} stands "
                f"{_MILLI * shifts[-1].max():.2f} mm from its place in {recordings[0].source}: "
                "the set-up or the cameras' frame was moved; register each recording by itself, "
                f"or raise the limit of {_MILLI * largest_shift:g} mm."
            )
    return np.stack(shifts)[1:], np.stack(distortions)[1:]


def check_motion(recording: Recording, labels: Sequence[str]) -> None:
    """Checks that one of the markers moves; none does in a frozen stream or with the wrong markers.

    A marker moves if the median of three frames is half a millimetre from its first position.

    Raises:
        DataFileError: A marker is not in the recording, or none of them moves.
    """
    chosen, farthest = recording.select(labels), 0.0
    for path, seen in zip(chosen.positions.swapaxes(0, 1), chosen.seen.T, strict=True):
        if seen.any():
            smooth = median_filter(path[seen], size=(3, 1), mode="nearest")
            farthest = max(farthest, float(np.linalg.norm(smooth - smooth[0], axis=1).max()))
    if farthest < _LEAST_MOTION:
        raise DataFileError(
            f"{recording.source}: {listed(labels)} never move by more than "
            f"{_MILLI * farthest:.2f} mm in the {len(recording.positions) / recording.rate:.3g} "
            "s that are read: follow markers that move, read more by data.seconds or "
            "data.steps, begin later by data.lead, or leave the recording out."
        )
