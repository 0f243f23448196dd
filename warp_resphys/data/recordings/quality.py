"""How good a recording is: occlusions, jumps, noise, and whether what should stand still does."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.distance import cdist

from ...io.errors import DataFileError, InputError
from .jumps import LEAST_JUMP, Jump, Swap, find_jumps, find_swaps
from .recording import FloatArray, Recording, listed, runs
from .release import Release

_LEAST_MOTION = 5e-4  # [m]
_MILLI = 1e3
_NOISE_FRAMES = 25
_LEAST_NOISE_FRAMES = 10
_QUIET_QUARTILE = 25.0
_DRIFT_PART = 0.1  # of the frames, at either end
_MUCH_DRIFT = 2e-4  # [m]
_RELEASE_FRAMES = 1.5  # around the release, in which a marker that is alone on its body jerks without a fault


@dataclasses.dataclass(frozen=True)
class MarkerQuality:
    """One marker of a recording."""

    label: str
    still: bool  # Whether it should not move
    seen: float  # Share of the frames in which it was seen
    gaps: int  # Number of occlusions
    longest_gap: int  # The longest of them, in frames
    masked: int  # Frames in gaps that are too long to be filled, or at either end
    jumps: tuple[Jump, ...]  # Its jumps, in the order of time
    noise: float  # [m] standard deviation of one coordinate, from third differences in the quietest parts
    drift: float | None  # [m] from its place in the first tenth of the frames to that in the last; None if it may move
    reach: float  # [m] largest distance from its median position

    @property
    def largest_jump(self) -> Jump | None:
        """The jump that went farthest, if there is one."""
        return max(self.jumps, key=lambda jump: jump.size, default=None)


@dataclasses.dataclass(frozen=True)
class Quality:
    """What `quality` found out about a recording."""

    source: Path
    rate: float  # Frames a second [Hz]
    frames: int
    release: Release | None  # When the body was let go, if that was looked for and found
    markers: tuple[MarkerQuality, ...]  # One entry a marker
    swaps: tuple[Swap, ...]  # Markers that took over each other's place
    longest_gap: int  # The longest occlusion that counts as short, in frames

    @property
    def warnings(self) -> list[str]:
        """What a user should look at, a sentence each."""
        found = [
            f"From frame {swap.frame} on, {swap.label} stands where {swap.other} was: check the labels."
            for swap in self.swaps
        ]
        for marker in self.markers:
            if marker.masked:
                found.append(
                    f"{marker.label} is hidden for up to {marker.longest_gap} frames; {marker.masked} frames are "
                    "masked."
                )
            if largest := marker.largest_jump:
                often = "once," if len(marker.jumps) == 1 else f"{len(marker.jumps)} times, farthest"
                found.append(
                    f"{marker.label} jumps {often} by {_MILLI * largest.size:.2f} mm, in frame {largest.frame}."
                )
            if marker.drift is not None and marker.drift > max(_MUCH_DRIFT, 5.0 * marker.noise):
                found.append(f"{marker.label} should not move and drifts by {_MILLI * marker.drift:.2f} mm.")
        return found

    def to_plain(self) -> dict[str, Any]:
        """For quality.json: lengths in millimetres, as in the table."""
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
    """Examines a recording as it was measured, before gaps are filled.

    Args:
        recording: The recording.
        still: Markers that should not move, such as those on the clamp.
        release: When the body was let go, if known: the jerk of that is no jump.
        longest_gap: The longest occlusion that will be filled, in frames.
        least_jump: The smallest jump that counts [m].

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
    """Standard deviation [m] of one coordinate of each marker, (M,); NaN where too little was seen.

    Third differences of a smooth motion are small, those of white noise of variance s^2 have the variance 20 s^2
    (1 + 9 + 9 + 1). They are averaged over stretches of 25 frames, and the lower quartile of these is taken, so that a
    swing or a jump in some of them does not count as noise.
    """
    third = np.diff(recording.positions, n=3, axis=0)  # (T-3, M, 3), NaN beside gaps
    stretches = [third[start : start + _NOISE_FRAMES] for start in range(0, len(third), _NOISE_FRAMES)]
    noise = np.full(len(recording.labels), np.nan)
    for column in range(len(recording.labels)):
        values = [stretch[:, column][np.isfinite(stretch[:, column]).all(axis=1)] for stretch in stretches]
        variances = [np.mean(np.square(each)) / 20.0 for each in values if len(each) >= _LEAST_NOISE_FRAMES]
        if variances:
            noise[column] = np.sqrt(np.percentile(variances, _QUIET_QUARTILE))
    return noise


def quality_table(result: Quality) -> list[list[str]]:
    """The table as rows of text, the first one the header; lengths in millimetres."""
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
    """How the base markers of a recording differ from those of the first one."""

    source: Path
    shift: FloatArray  # (M,) [m] how far each marker stands from its place in the first recording
    changes: FloatArray  # (M, M) [m] how much the distance between each two of them differs: of the shape they make

    @property
    def distortion(self) -> FloatArray:
        """(M,) [m] median change of each marker's distance to the other ones."""
        count = len(self.changes)
        others = self.changes[~np.eye(count, dtype=np.bool_)].reshape(count, count - 1)
        return np.asarray(np.median(others, axis=1))


def compare_base(recordings: Sequence[Recording], labels: Sequence[str]) -> list[BaseMotion]:
    """Compares where two or more markers on something rigid stand, by their median positions in several recordings.

    Returns:
        An entry for each recording after the first.

    Raises:
        DataFileError: A marker is missing, or never seen, in one of them.
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
    """Refuses trials on one set-up between which a marker on its base was moved.

    The distance between two markers may change by `largest_distortion` [m]. A marker may stand `largest_shift` [m] from
    its place in the first recording; anywhere if None, which is right where each recording is registered by itself.

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
                f"against the other base markers since {recordings[0].source}; put it back, leave it out, or raise "
                f"the limit of {_MILLI * largest_distortion:g} mm."
            )
        worst = int(np.argmax(motion.shift))
        if largest_shift is not None and motion.shift[worst] > largest_shift:
            raise DataFileError(
                f"{motion.source}: base marker {labels[worst]} stands {_MILLI * motion.shift[worst]:.2f} mm from its "
                f"place in {recordings[0].source}: the set-up or the cameras' frame was moved; register each recording "
                f"by itself, or raise the limit of {_MILLI * largest_shift:g} mm."
            )


def check_motion(recording: Recording, labels: Sequence[str]) -> None:
    """Refuses a recording in which none of these markers moves, as of a stream that froze, or of the wrong ones.

    One of them must move by half a millimetre from its first position, in the median of three frames.

    Raises:
        DataFileError: A marker is not in the recording, or none of them moves so far.
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
    """Refuses a recording with pressures or forces that nothing would use; raises DataFileError."""
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
