"""Quality of a recording: occlusions, jumps, noise, and drift of markers that should stand still."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.distance import cdist

from ...io.errors import DataFileError, InputError, listed
from .jumps import LEAST_JUMP, Jump, Swap, find_jumps, find_swaps
from .recording import FloatArray, Recording, runs
from .release import Release

_LEAST_MOTION = 5e-4  # [m]
_MILLI = 1e3
_NOISE_FRAMES = 25
_LEAST_NOISE_FRAMES = 10
_QUIET_QUARTILE = 25.0
_DRIFT_PART = 0.1  # of the frames, at either end
_MUCH_DRIFT = 2e-4  # [m]
_RELEASE_FRAMES = 1.5  # around the release, in which a jerk of a marker is no jump


@dataclasses.dataclass(frozen=True)
class MarkerQuality:
    """Quality of one marker."""

    label: str
    still: bool  # Whether it should not move
    seen: float  # Share of the frames in which it was seen
    gaps: int  # Number of occlusions
    longest_gap: int  # The longest of them, in frames
    masked: int  # Frames in gaps that are too long to be filled, or at either end
    jumps: tuple[Jump, ...]  # Its jumps, in the order of time
    noise: float  # [m] standard deviation of one coordinate, from third differences in the quietest parts
    drift: float | None  # [m] between the median places in the first and last tenth of the frames; None if it may move
    reach: float  # [m] largest distance from its median position

    @property
    def largest_jump(self) -> Jump | None:
        """The largest jump, if there is one."""
        return max(self.jumps, key=lambda jump: jump.size, default=None)


@dataclasses.dataclass(frozen=True)
class Quality:
    """Quality of a recording."""

    source: Path
    rate: float  # Frames a second [Hz]
    frames: int
    release: Release | None  # Release of the body, if known
    markers: tuple[MarkerQuality, ...]  # One entry for every marker
    swaps: tuple[Swap, ...]  # Markers at the place of another one
    longest_gap: int  # The longest occlusion that counts as short, in frames

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user, one sentence each."""
        warnings = [
            f"From frame {swap.frame} on, {swap.label} stands where {swap.other} was: check the labels."
            for swap in self.swaps
        ]
        for marker in self.markers:
            if marker.masked:
                warnings.append(
                    f"{marker.label} is hidden for up to {marker.longest_gap} frames; {marker.masked} frames are "
                    "masked."
                )
            if largest := marker.largest_jump:
                often = "once," if len(marker.jumps) == 1 else f"{len(marker.jumps)} times, farthest"
                warnings.append(
                    f"{marker.label} jumps {often} by {_MILLI * largest.size:.2f} mm, in frame {largest.frame}."
                )
            if marker.drift is not None and marker.drift > max(_MUCH_DRIFT, 5.0 * marker.noise):
                warnings.append(f"{marker.label} should not move and drifts by {_MILLI * marker.drift:.2f} mm.")
        return warnings

    def to_plain(self) -> dict[str, Any]:
        """Returns the content of quality.json, with lengths in millimetres."""
        markers = [
            {
                "label": marker.label,
                "still": marker.still,
                "seen": marker.seen,
                "gaps": marker.gaps,
                "longest_gap_frames": marker.longest_gap,
                "masked_frames": marker.masked,
                "jumps": [{"frame": jump.frame, "mm": _MILLI * jump.size} for jump in marker.jumps],
                "noise_mm": _MILLI * marker.noise,
                "drift_mm": None if marker.drift is None else _MILLI * marker.drift,
                "reach_mm": _MILLI * marker.reach,
            }
            for marker in self.markers
        ]
        return {
            "source": self.source,
            "rate_hz": self.rate,
            "frames": self.frames,
            "release_frame": None if self.release is None else self.release.frame,
            "held_frames": None if self.release is None else list(self.release.rest),
            "longest_gap_filled": self.longest_gap,
            "markers": markers,
            "swaps": [dataclasses.asdict(swap) for swap in self.swaps],
            "warnings": self.warnings,
        }


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
    jumps = [
        jump
        for jump in find_jumps(recording, least_jump)
        if release is None or jump.label in still or abs(jump.frame - release.frame) > _RELEASE_FRAMES
    ]
    noise = noise_level(recording)
    markers = []
    for column, (label, seen) in enumerate(zip(recording.labels, recording.seen.T, strict=True)):
        hidden = runs(~seen)
        lengths = [stop - start for start, stop in hidden]
        masked = [
            stop - start for start, stop in hidden if stop - start > longest_gap or start == 0 or stop == len(seen)
        ]
        path = recording.positions[seen, column]
        markers.append(
            MarkerQuality(
                label=label,
                still=label in still,
                seen=float(seen.mean()),
                gaps=len(hidden),
                longest_gap=max(lengths, default=0),
                masked=sum(masked),
                jumps=tuple(jump for jump in jumps if jump.label == label),
                noise=float(noise[column]),
                drift=_drift(path) if label in still else None,
                reach=float(np.linalg.norm(path - np.median(path, axis=0), axis=1).max()) if len(path) else np.nan,
            )
        )
    swaps = tuple(find_swaps(recording, jumps))
    frames = len(recording.positions)
    return Quality(recording.source, recording.rate, frames, release, tuple(markers), swaps, longest_gap)


def noise_level(recording: Recording) -> FloatArray:
    """Standard deviation of the noise in a coordinate of every marker, (M,) [m]; NaN where too few frames were seen.

    Third differences of a smooth motion are small, those of white noise with variance s^2 have the variance 20 s^2
    (1 + 9 + 9 + 1). They are averaged over stretches of 25 frames, and the lower quartile of the stretches is taken, so
    that oscillations or jumps in some of them do not count as noise.
    """
    third = np.diff(recording.positions, n=3, axis=0)  # (T-3, M, 3), NaN beside gaps
    stretches = [third[start : start + _NOISE_FRAMES] for start in range(0, len(third), _NOISE_FRAMES)]
    noise = np.full(len(recording.labels), np.nan)
    for column in range(len(recording.labels)):
        values = [stretch[:, column][np.isfinite(stretch[:, column]).all(axis=1)] for stretch in stretches]
        variances = [np.mean(np.square(part)) / 20.0 for part in values if len(part) >= _LEAST_NOISE_FRAMES]
        if variances:
            noise[column] = np.sqrt(np.percentile(variances, _QUIET_QUARTILE))
    return noise


def quality_table(result: Quality) -> list[list[str]]:
    """Returns rows of text with a header; lengths in millimetres."""
    header = ["marker", "seen", "gaps", "longest", "masked", "jumps", "largest [mm]", "noise [mm]", "drift [mm]"]
    rows = [header]
    for marker in result.markers:
        counts = map(str, (marker.gaps, marker.longest_gap, marker.masked, len(marker.jumps)))
        jump = f"{_MILLI * marker.largest_jump.size:.2f}" if marker.largest_jump else ""
        noise = f"{_MILLI * marker.noise:.4f}" if np.isfinite(marker.noise) else ""
        drift = "" if marker.drift is None else f"{_MILLI * marker.drift:.3f}"
        rows.append([marker.label, f"{100.0 * marker.seen:.1f} %", *counts, jump, noise, drift])
    return rows


@dataclasses.dataclass(frozen=True)
class BaseMotion:
    """Displacement of the base markers of a recording relative to the first recording."""

    source: Path
    shift: FloatArray  # (M,) [m] distances of the markers from their places in the first recording
    changes: FloatArray  # (M, M) [m] changes of the distances between every two markers

    @property
    def distortion(self) -> FloatArray:
        """Median change of a marker's distances to the other ones, (M,) [m]."""
        count = len(self.changes)
        others = self.changes[~np.eye(count, dtype=np.bool_)].reshape(count, count - 1)
        return np.asarray(np.median(others, axis=1))


def compare_base(recordings: Sequence[Recording], labels: Sequence[str]) -> list[BaseMotion]:
    """Compares the median positions of two or more markers on a rigid base in several recordings.

    Returns:
        One entry for every recording after the first.

    Raises:
        DataFileError: A marker is missing or never seen in a recording.
    """
    places = []
    for recording in recordings:
        base = recording.select(labels)
        absent = [label for label, seen in zip(labels, base.seen.T, strict=True) if not seen.any()]
        if absent:
            raise DataFileError(
                f"{recording.source}: {listed(absent)} is never seen; leave it out of the base markers."
            )
        places.append(np.nanmedian(base.positions, axis=0))
    distances = [cdist(place, place) for place in places]
    return [
        BaseMotion(recording.source, np.linalg.norm(place - places[0], axis=1), np.abs(between - distances[0]))
        for recording, place, between in zip(recordings[1:], places[1:], distances[1:], strict=True)
    ]


def check_base(
    recordings: Sequence[Recording],
    labels: Sequence[str],
    *,
    largest_distortion: float = 1e-3,
    largest_shift: float | None = None,
) -> None:
    """Checks that no marker on the base of a set-up was moved between trials.

    The distance between two markers may change by `largest_distortion` [m]. A marker may be `largest_shift` [m] from
    its place in the first recording; anywhere if None, for recordings that are registered separately.

    Raises:
        DataFileError: A marker moved, is missing or is never seen.
        InputError: There are fewer than two markers to compare.
    """
    if len(labels) < 2:
        raise InputError(f"The base has {len(labels)} markers: name two or more that sit on the clamp.")
    for motion in compare_base(recordings, labels):
        worst = int(np.argmax(motion.distortion))
        largest = motion.changes.max()
        if largest > largest_distortion:
            raise DataFileError(
                f"{motion.source}: base marker {labels[worst]} moved by {_MILLI * largest:.2f} mm "
                f"against the other base markers since {recordings[0].source}; put it back, check the unit, leave "
                f"it out, or raise the limit of {_MILLI * largest_distortion:g} mm."
            )
        worst = int(np.argmax(motion.shift))
        if largest_shift is not None and motion.shift[worst] > largest_shift:
            raise DataFileError(
                f"{motion.source}: base marker {labels[worst]} stands {_MILLI * motion.shift[worst]:.2f} mm from its "
                f"place in {recordings[0].source}: the set-up or the cameras' frame was moved; register each recording "
                f"by itself, or raise the limit of {_MILLI * largest_shift:g} mm."
            )


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
            f"{recording.source}: {listed(labels)} never move by more than {_MILLI * farthest:.2f} mm in the "
            f"{len(recording.positions) / recording.rate:.3g} s that count: follow markers that move, or leave the "
            "recording out."
        )


def check_passive(recording: Recording) -> None:
    """Checks that a recording has no actuation, which would be ignored; raises DataFileError."""
    if recording.actuation is not None:
        raise DataFileError(
            f"{recording.source} holds an actuation, {recording.actuation.shape[1]} in each frame, which nothing here "
            "uses: take an experiment with pressures (data.kind: pressure), or leave it out of the file."
        )


def _drift(path: FloatArray) -> float:
    """Distance [m] between the median positions of the first and the last tenth of (T, 3)."""
    if not len(path):
        return float("nan")
    part = max(1, round(_DRIFT_PART * len(path)))
    return float(np.linalg.norm(np.median(path[-part:], axis=0) - np.median(path[:part], axis=0)))
