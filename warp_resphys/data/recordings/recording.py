"""What every reader returns: labelled markers over time, in metres and seconds, with occlusions as NaN."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...io.errors import DataFileError, InputError
from ..base_motion import since_first

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
# What an actuation is divided into; one without a unit is kept as it is.
SI_PER_ACTUATION_UNIT = {"Pa": 1.0, "kPa": 1e3, "mbar": 1e2, "bar": 1e5, "N": 1.0, "1": 1.0}
LARGEST_SPAN = 100.0  # [m]
LEAST_SPAN = 1e-3  # [m]
RATES = (1e-3, 1e6)  # [Hz]


@dataclasses.dataclass(frozen=True)
class Recording:
    """Markers followed over time.

    Attributes:
        labels: Names of the M markers.
        positions: (T, M, 3) [m], NaN where a marker is occluded.
        rate: Frames a second [Hz].
        source: The file it came from.
        actuation: (T, C) [Pa, N or without a unit] what drove the body in each frame, if that was recorded.
        rest: (M, 3) [m] the markers on the body at rest, if known; it tells where they sit on it.
        base: (T, 6) the motion since the first frame of what the body is fixed to, if that was recorded; see
            `data.base_motion`.
        start: Time of the first frame [s]; after `trim_to_release`, since the release.
    """

    labels: tuple[str, ...]
    positions: FloatArray
    rate: float
    source: Path
    actuation: FloatArray | None = None
    rest: FloatArray | None = None
    base: FloatArray | None = None
    start: float = 0.0

    @property
    def seen(self) -> BoolArray:
        """(T, M) whether a marker has a position; what a loss or an error may use."""
        return np.asarray(np.isfinite(self.positions).all(axis=2))

    @property
    def time(self) -> FloatArray:
        """(T,) [s] of the frames."""
        return self.start + np.arange(len(self.positions)) / self.rate

    def select(self, labels: Sequence[str]) -> "Recording":
        """The same recording with these markers only, in this order.

        Raises:
            DataFileError: A marker is not in the recording.
        """
        missing = [label for label in labels if label not in self.labels]
        if missing:
            raise DataFileError(
                f"{self.source} has no marker named {listed(missing)}; it has {listed(self.labels)}: "
                "set the marker names in the configuration to those of the recording."
            )
        columns = [self.labels.index(label) for label in labels]
        rest = None if self.rest is None else self.rest[columns]
        return dataclasses.replace(self, labels=tuple(labels), positions=self.positions[:, columns], rest=rest)


@dataclasses.dataclass(frozen=True)
class RawRecording:
    """What a file holds, in its own units; None for what it does not say.

    Attributes:
        positions: (T, M, 3) [unit].
        labels: M names.
        unit: m, cm or mm.
        rate: [Hz].
        actuation: (T, C) [Pa, N or 1].
        rest: (M, 3) [unit].
        base: (T, 7) a point of what the body is fixed to [m], and a quaternion of its rotation, w first.
        start: Time of the first frame [s].
    """

    positions: FloatArray
    labels: tuple[str, ...] | None
    unit: str | None
    rate: float | None
    actuation: FloatArray | None = None
    rest: FloatArray | None = None
    base: FloatArray | None = None
    start: float = 0.0


def to_recording(
    raw: RawRecording,
    path: Path,
    units: str | None = None,
    rate: float | None = None,
    labels: Sequence[str] | None = None,
) -> Recording:
    """Brings what was read to metres and seconds, and checks it; what is given goes before what the file says.

    A marker without a name becomes `marker 3`, those that share one `name #1`, `name #2` and so on.

    Args:
        raw: The content of the file.
        path: The file, for messages.
        units: m, cm or mm.
        rate: Frames a second [Hz].
        labels: A name for each marker, in the file's order.

    Raises:
        DataFileError: The unit or the rate is missing or not known, an array has the wrong shape, or the positions are
            too large or too small to be in this unit.
        InputError: A given unit, rate or list of names cannot be used.
    """
    if units is not None and units not in METRES_PER_UNIT:
        raise InputError(f"units is {units!r}: set it to m, cm or mm, the unit of {path}.")
    if rate is not None and not RATES[0] <= rate <= RATES[1]:
        raise InputError(f"rate is {rate!r}: set it to the frames a second of {path}.")
    markers = raw.positions.shape[1] if raw.positions.ndim == 3 else 0
    if raw.positions.ndim != 3 or raw.positions.shape[2] != 3 or 0 in raw.positions.shape:
        raise DataFileError(
            f"{path} holds no marker trajectories: positions must be (frames, markers, 3), not {raw.positions.shape}."
        )
    factor = METRES_PER_UNIT[_unit(raw, path, units)]
    names = _names(raw, path, labels, markers)
    positions = np.ascontiguousarray(raw.positions, dtype=np.float64) * factor
    positions[~np.isfinite(positions).all(axis=2)] = np.nan
    rest = None if raw.rest is None else np.asarray(raw.rest, dtype=np.float64) * factor
    if rest is not None and rest.shape != (markers, 3):
        raise DataFileError(f"{path}: rest has the shape {rest.shape} where {(markers, 3)} is needed.")
    if raw.actuation is not None and (raw.actuation.ndim != 2 or len(raw.actuation) != len(positions)):
        raise DataFileError(
            f"{path}: actuation has the shape {raw.actuation.shape}; it needs a row for each of the "
            f"{len(positions)} frames."
        )
    if raw.actuation is not None and not np.isfinite(raw.actuation).all():
        raise DataFileError(f"{path}: an actuation is NaN or infinite; every frame needs one.")
    if not np.isfinite(raw.start):
        raise DataFileError(f"{path}: its first frame is at {raw.start} s: give the time of each frame, or no start.")
    check_span(positions, path)
    base = None
    if raw.base is not None:
        if raw.base.shape != (len(positions), 7):
            raise DataFileError(
                f"{path}: base has the shape {raw.base.shape}; it needs a place and a quaternion (w, x, y, z) for each "
                f"of the {len(positions)} frames."
            )
        base = since_first(raw.base[:, :3], raw.base[:, 3:], path)
    return Recording(names, positions, _rate(raw, path, rate), path, raw.actuation, rest, base, raw.start)


def check_span(positions: FloatArray, path: Path) -> None:
    """Refuses positions that no marker system records of a body of a laboratory, as those in a wrong unit.

    Args:
        positions: (T, M, 3) [m].
        path: Their file, for messages.

    Raises:
        DataFileError: No marker is ever seen, or the positions span less than 1 mm or more than 100 m.
    """
    seen = positions[np.isfinite(positions).all(axis=2)]
    if not len(seen):
        raise DataFileError(f"{path}: no marker is seen in any frame; check how it was exported.")
    with np.errstate(over="ignore"):
        span = float(np.ptp(seen, axis=0).max())
    if not LEAST_SPAN <= span <= LARGEST_SPAN:
        size = f"all markers lie within {1e3 * span:.2g} mm" if span < LEAST_SPAN else f"markers span {span:.3g} m"
        raise DataFileError(
            f"{path}: {size}, which no recording of a robot does; check the unit of its positions and set units to it "
            "(m, cm or mm)."
        )


def runs(mask: ArrayLike) -> list[tuple[int, int]]:
    """First and past-the-last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.pad(np.asarray(mask, dtype=np.int8), 1)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def listed(names: Sequence[str]) -> str:
    """Names in quotation marks, separated by commas."""
    return ", ".join(f"'{name}'" for name in names) if names else "none"


def _unit(raw: RawRecording, path: Path, given: str | None) -> str:
    unit = given if given is not None else raw.unit
    if unit is None:
        raise DataFileError(f"{path} does not say in which unit its positions are: set units to m, cm or mm.")
    if unit not in METRES_PER_UNIT:
        raise DataFileError(f"{path} gives positions in '{unit}': export it in m, cm or mm, or set units.")
    return unit


def _rate(raw: RawRecording, path: Path, given: float | None) -> float:
    rate = given if given is not None else raw.rate
    if rate is None:
        raise DataFileError(f"{path} does not say how many frames a second it has: set rate, in Hz.")
    if not RATES[0] <= rate <= RATES[1]:
        raise DataFileError(f"{path} gives a frame rate of {rate} Hz: export it with its rate, or set rate.")
    return float(rate)


def _names(raw: RawRecording, path: Path, given: Sequence[str] | None, markers: int) -> tuple[str, ...]:
    if given is not None and len(given) != markers:
        raise InputError(f"labels has {len(given)} names; {path} has {markers} markers: name each of them.")
    names = given if given is not None else raw.labels
    if names is None:
        names = [""] * markers
    if len(names) != markers:
        raise DataFileError(f"{path} has {markers} markers and {len(names)} labels: export it with a label for each.")
    names = [str(name).strip() or f"marker {number}" for number, name in enumerate(names, start=1)]
    counts = {name: names.count(name) for name in names}
    return tuple(
        name if counts[name] == 1 else f"{name} #{names[: place + 1].count(name)}" for place, name in enumerate(names)
    )
