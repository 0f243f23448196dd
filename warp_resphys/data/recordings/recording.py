"""Recordings: labelled markers over time, in metres and seconds, with occlusions as NaN."""

import dataclasses
import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ...io.arrays import BoolArray, Brief, FloatArray
from ...io.errors import DataFileError, InputError, listed, number_of
from ..force_sensors import AXES

log = logging.getLogger(__name__)

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_LONG = {"": "m", "centi": "cm", "milli": "mm"}
_METRES = ("meter", "meters", "metre", "metres")
_SPELLED = {prefix + word: unit for (prefix, unit), word in product(_LONG.items(), _METRES)}
# As Vicon and OptiTrack name trajectories.
_UNLABELLED = re.compile(r"(?:.*:)?\*|unlabell?ed|uname|[\d ]*$", re.IGNORECASE)
# Kind and factor to SI units of forces and moments; other spellings of products, as N*m, become
# these.
SI_PER_LOAD_UNIT = {
    **{"N": ("f", 1.0), "mN": ("f", 1e-3), "kN": ("f", 1e3)},
    **{"gf": ("f", 9.80665e-3), "kgf": ("f", 9.80665), "lbf": ("f", 4.4482216)},
    **{"N m": ("t", 1.0), "Nm": ("t", 1.0), "N cm": ("t", 1e-2), "Ncm": ("t", 1e-2)},
    **dict.fromkeys(("N mm", "Nmm", "mN m", "mNm"), ("t", 1e-3)),
    **{"lbf in": ("t", 0.11298483), "lbf ft": ("t", 1.3558179), "kgf cm": ("t", 9.80665e-2)},
}
# Factors to SI units; 1 for an actuation without a unit.
SI_PER_ACTUATION_UNIT = {
    "Pa": 1.0,
    "kPa": 1e3,
    "mbar": 1e2,
    "bar": 1e5,
    "N": 1.0,
    "m": 1.0,
    "mm": 1e-3,
    "1": 1.0,
}
LARGEST_SPAN = 100.0  # [m]
LEAST_SPAN = 1e-3  # [m]
_QUATERNION_ERROR = 0.01  # largest deviation of the length of a quaternion from one
ARM = 0.05  # [m] distance from a rigid body to the points that represent its rotation
RATES = (1e-3, 1e6)  # [Hz]


@dataclasses.dataclass(frozen=True)
class Recording(Brief):
    """Positions of markers over time.

    The reader of a file returns lengths in the unit of the file, and what the file does not say as
    no labels, a rate of NaN, or no unit; `in_metres` returns the recording that others read.
    """

    labels: tuple[str, ...]  # Names of the M markers
    positions: FloatArray  # (T, M, 3) [m], NaN where a marker is occluded
    rate: float  # Frames a second [Hz]
    source: Path  # The file
    # (T, C) [Pa, N or 1] actuation of the body in every frame, if recorded
    actuation: FloatArray | None = None
    # (M, 3) [m] markers on the body at rest, if known
    rest: FloatArray | None = None
    # (T, 6) motion of the base since the first frame, if recorded; see `data.base_motion`
    base: FloatArray | None = None
    start: float = 0.0  # Time of the first frame [s]; after `trim_to_release`, since the release
    # (T, 6) motions of obstacles, if recorded; see `data.obstacle_motion`
    obstacles: Mapping[str, FloatArray] = dataclasses.field(default_factory=dict)
    # (T, 6) readings of force sensors by name [N, N m] (`data.force_sensors`), NaN where there is
    # none
    loads: Mapping[str, FloatArray] = dataclasses.field(default_factory=dict)
    unit: str = "m"  # of positions and rest
    # (T, M, 4) quaternions, w first, of those markers that are rigid bodies; NaN for others; None
    # after `in_metres`
    turns: FloatArray | None = None

    @property
    def seen(self) -> BoolArray:
        """Whether a marker has a position, (T, M)."""
        return np.asarray(np.isfinite(self.positions).all(axis=2))

    @property
    def time(self) -> FloatArray:
        """Times of the frames, (T,) [s]."""
        return self.start + np.arange(len(self.positions)) / self.rate

    def select(self, labels: Sequence[str]) -> "Recording":
        """Returns the recording with these markers only, in this order.

        Raises:
            DataFileError: A marker is not in the recording.
        """
        missing = [label for label in labels if label not in self.labels]
        if missing:
            raise DataFileError(
                f"{self.source} has no marker named {listed(missing)}; it has "
                f"{listed(self.labels)}: set the marker names in the configuration to those of "
                "the recording, or name the markers that it has in data.trials.NAME.labels."
            )
        columns = [self.labels.index(label) for label in labels]
        rest = None if self.rest is None else self.rest[columns]
        return dataclasses.replace(
            self, labels=tuple(labels), positions=self.positions[:, columns], rest=rest
        )

    def frames(self, chosen: slice) -> "Recording":
        """Returns some of the frames, with rate and start unchanged."""
        actuation, base = (
            None if series is None else series[chosen] for series in (self.actuation, self.base)
        )
        obstacles = {name: poses[chosen] for name, poses in self.obstacles.items()}
        loads = {name: readings[chosen] for name, readings in self.loads.items()}
        kept = dataclasses.replace(
            self, positions=self.positions[chosen], actuation=actuation, base=base
        )
        return dataclasses.replace(kept, obstacles=obstacles, loads=loads)


def length_unit(text: str) -> str:
    """Returns m, cm or mm for a name of theirs in any case (Meters, MM), else the text.

    Without blanks and zeros.
    """
    word = text.replace("\0", " ").strip()
    unit = _SPELLED.get(word.lower(), word.lower())
    return unit if unit in METRES_PER_UNIT else word


def without_subject(labels: Sequence[str]) -> list[str]:
    """Returns labels as in Arm:Tip without the name of the subject, if all have the same one.

    Unlabelled ones stay.
    """
    named = [label for label in labels if not _UNLABELLED.match(label)]
    if len({label.rpartition(":")[0] for label in named}) != 1:
        return list(labels)
    return [label.rpartition(":")[2] if label in named else label for label in labels]


def hide_zeros(recording: Recording) -> Recording:
    """Replaces positions at exactly (0, 0, 0), which some programs write for occlusions,
    by NaN, with a warning.
    """
    zero = (recording.positions == 0.0).all(axis=2)
    if recording.turns is not None:
        zero &= ~np.isfinite(recording.turns).all(axis=2)
    if zero.any():
        names = [
            label for label, hidden in zip(recording.labels, zero.T, strict=False) if hidden.any()
        ]
        log.warning(
            "%s: %s at exactly (0, 0, 0) read as occluded, of %s.",
            recording.source.name,
            number_of(int(zero.sum()), "position"),
            listed(names),
        )
    return dataclasses.replace(
        recording, positions=np.where(zero[..., None], np.nan, recording.positions)
    )


def in_metres(
    recording: Recording,
    units: str | None = None,
    rate: float | None = None,
    labels: Sequence[str] | None = None,
) -> Recording:
    """Converts the content of a file to metres, names its markers, and checks it.

    Arguments, described in `recording_files.read_recording`, take precedence over the file. A
    marker without a name becomes `marker 3`, markers with one name become `name #1`, `name #2` and
    so on. A rigid body becomes four markers: its position, and the points `name +x`, `name +y` and
    `name +z` at 50 mm along its axes.

    Raises:
        DataFileError: The unit or the rate is missing or unknown, an array has the wrong shape, or
            the positions are too large or too small for the unit.
        InputError: The unit, rate or list of names in the arguments is invalid.
    """
    path = recording.source
    if units is not None and length_unit(units) not in METRES_PER_UNIT:
        raise InputError(f"units is {units!r}: set it to m, cm or mm, the unit of {path}.")
    if rate is not None and not RATES[0] <= rate <= RATES[1]:
        raise InputError(f"rate is {rate!r}: set it to the frames a second of {path}.")
    _check_shapes(recording)
    unit = length_unit(recording.unit if units is None else units)
    rate = recording.rate if rate is None else rate
    unit = unit if recording.positions.size else "m"  # of forces alone
    lacks, cures = list[str](), list[str]()
    if unit not in METRES_PER_UNIT:
        lacks.append(
            f"gives positions in '{unit}'"
            if unit
            else "does not say in which unit its positions are"
        )
        cures.append("units to m, cm or mm (data.units=mm, recording.units=mm)")
    if not RATES[0] <= rate <= RATES[1]:
        said = f"gives a frame rate of {rate} Hz" if rate and rate == rate else None
        lacks.append(said or "does not say how many frames a second it has")
        cures.append("rate in Hz (data.rate=100, recording.rate=100)")
    if lacks:
        raise DataFileError(
            f"{path} {' and '.join(lacks)}: set {' and '.join(cures)}, or export it with them."
        )
    positions, rest = (
        None
        if points is None
        else np.ascontiguousarray(points, dtype=np.float64) * METRES_PER_UNIT[unit]
        for points in (recording.positions, recording.rest)
    )
    assert positions is not None
    positions[~np.isfinite(positions).all(axis=2)] = np.nan
    named = dataclasses.replace(
        recording,
        labels=_names(recording, labels),
        positions=positions,
        rest=rest,
        rate=float(rate),
        unit="m",
    )
    named = _with_arms(named)
    _check_span(named)
    return named


def _check_shapes(recording: Recording) -> None:
    """Refuses arrays that do not belong to each other, and inputs or times that are not finite."""
    path, driven = recording.source, recording.actuation
    shape = recording.positions.shape
    forces_alone = shape[1:2] == (0,) and recording.loads
    if len(shape) != 3 or shape[2] != 3 or (0 in shape and not (forces_alone and shape[0])):
        raise DataFileError(
            f"{path} holds no marker trajectories: "
            f"positions must be (frames, markers, 3), not {shape}."
        )
    if recording.rest is not None and recording.rest.shape != shape[1:]:
        raise DataFileError(
            f"{path}: rest has the shape {recording.rest.shape} where {shape[1:]} is needed."
        )
    if driven is not None and (driven.ndim != 2 or len(driven) != shape[0]):
        raise DataFileError(
            f"{path}: actuation has the shape {driven.shape}; it needs a row for each of the "
            f"{shape[0]} frames."
        )
    wanted = (shape[0], len(AXES))
    for name, readings in recording.loads.items():
        if readings.shape != wanted:
            raise DataFileError(
                f"{path}: the readings of {name!r} have the shape {readings.shape}, not {wanted}."
            )
    if driven is not None and not np.isfinite(driven).all():
        raise DataFileError(f"{path}: an actuation is NaN or infinite; every frame needs one.")
    if not np.isfinite(recording.start):
        raise DataFileError(
            f"{path}: its first frame is at {recording.start} s: "
            "give the time of each frame, or no start."
        )


def _check_span(recording: Recording) -> None:
    """Refuses positions in a wrong unit, or none."""
    seen = recording.positions[recording.seen]
    if not recording.positions.size:
        return
    if not len(seen):
        raise DataFileError(
            f"{recording.source}: no marker is seen in any frame; check how it was exported."
        )
    with np.errstate(over="ignore"):
        span = float(np.ptp(seen, axis=0).max())
    if not LEAST_SPAN <= span <= LARGEST_SPAN:
        size = (
            f"all markers lie within {1e3 * span:.2g} mm"
            if span < LEAST_SPAN
            else f"markers span {span:.3g} m"
        )
        raise DataFileError(
            f"{recording.source}: {size}, which no recording of a robot does; check the unit of "
            "its positions and set units to it (m, cm or mm)."
        )


def _with_arms(recording: Recording) -> Recording:
    """Adds the points on the axes of rigid bodies, with unknown rest positions,
    in place of the quaternions.
    """
    names, positions, rest = recording.labels, recording.positions, recording.rest
    turns, path = recording.turns, recording.source
    if turns is None:
        return recording
    if turns.shape != (*positions.shape[:2], 4):
        raise DataFileError(
            f"{path}: its quaternions have the shape {turns.shape}; each marker in each frame "
            "needs (w, x, y, z), NaN for one that is no rigid body."
        )
    size = np.where(recording.seen, np.linalg.norm(turns, axis=2), np.nan)
    wrong = np.abs(size - 1.0) > _QUATERNION_ERROR
    if wrong.any():
        frame, column = np.argwhere(wrong)[0]
        raise DataFileError(
            f"{path}: the quaternion of {names[column]} has the length {size[frame, column]:.3g} "
            f"in frame {frame + 1} from the start, where a rotation has 1: check its four "
            "numbers, or mask them (empty, or NaN) where it was not seen."
        )
    for column in np.flatnonzero(np.isfinite(size).any(axis=0)):
        seen = np.isfinite(size[:, column])
        arms = np.full((len(positions), 3, 3), np.nan)
        axes = Rotation.from_quat(turns[seen, column][:, [1, 2, 3, 0]]).as_matrix()
        arms[seen] = positions[seen, column, None] + ARM * np.swapaxes(axes, 1, 2)
        positions = np.concatenate([positions, arms], axis=1)
        new = [f"{names[column]} +{axis}" for axis in "xyz"]
        taken = [name for name in new if name in names]
        if taken:
            raise DataFileError(
                f"{path}: a marker is named {taken[0]!r}, as a point of a rigid body is: rename it."
            )
        names = (*names, *new)
        rest = None if rest is None else np.concatenate([rest, np.full((3, 3), np.nan)])
    return dataclasses.replace(recording, labels=names, positions=positions, rest=rest, turns=None)


def _names(recording: Recording, labels: Sequence[str] | None) -> tuple[str, ...]:
    """Returns M distinct names."""
    path, markers = recording.source, recording.positions.shape[1]
    if labels is not None and len(labels) != markers:
        raise InputError(
            f"labels has {len(labels)} names; {path} has {markers} markers: name each of them."
        )
    names = (recording.labels if labels is None else labels) or [""] * markers
    if len(names) != markers:
        raise DataFileError(
            f"{path} has {markers} markers and {len(names)} labels: "
            "export it with a label for each."
        )
    names = [str(name).strip() or f"marker {number}" for number, name in enumerate(names, start=1)]
    counts = Counter(names)
    return tuple(
        name if counts[name] == 1 else f"{name} #{names[: place + 1].count(name)}"
        for place, name in enumerate(names)
    )


def bridged(recording: Recording, column: int, frames: ArrayLike) -> FloatArray:
    """Positions (T', 3) [m] of a marker at frames, by a cubic spline through the frames in which it
    was seen.

    Positions before the first and after the last of these are constant.
    """
    from scipy.interpolate import CubicSpline

    known = np.flatnonzero(recording.seen[:, column])
    spline = CubicSpline(known, recording.positions[known, column])
    return np.asarray(spline(np.clip(frames, known[0], known[-1])))


def runs(mask: ArrayLike) -> list[tuple[int, int]]:
    """First and past-the-last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.pad(np.asarray(mask, dtype=np.int8), 1)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]
