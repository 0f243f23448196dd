"""Recordings from the cells of a table whose layout is known: which column holds which coordinate.

A cell that is empty or NaN is an occlusion.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...io.arrays import FloatArray, IntArray
from ...io.errors import DataFileError
from ...io.text import Rows, number
from ..force_sensors import AXES as FORCES
from .column_names import AXES
from .recording import Recording

log = logging.getLogger(__name__)

_OCCLUDED = {"", "nan", "null", "none", "na", "n/a", "#n/a", "-", "--"}
_UNEVEN = 0.25  # of a frame: largest error of a time stamp
_NEXT = 1.5  # of the median interval: the longest one without a missing frame
# Difference of a rate from a whole number that counts as none; that of NTSC, 59.94 Hz, is 1e-3.
_WHOLE = 5e-4
_LARGEST_STAMP = 1e12  # [s or 1] largest valid time or frame number
_LEAST_FRAMES = 2  # of a recording
# Median intervals between lines, through which coordinates of uneven times are interpolated.
_LONGEST_GAP = 3.0
_LEAST_RECORDED = 0.1  # of the frames between the first and the last

Place = tuple[str, str, int]  # label, axis and column of a coordinate
# Names of the k columns with the rotation of a rigid body, and a function of their numbers (T, k)
# that returns quaternions (T, 4), w first
Turn = tuple[Sequence[str], Callable[[FloatArray], FloatArray]]
QUATERNION: Turn = (("qw", "qx", "qy", "qz"), np.asarray)


def quaternions(numbers: FloatArray, rotations: Callable[[FloatArray], Rotation]) -> FloatArray:
    """Returns quaternions (T, 4), w first, of numbers (T, k) by a function of (T', k).

    NaN where a number is.
    """
    result = np.full((len(numbers), 4), np.nan)
    seen = np.isfinite(numbers).all(axis=1)
    if seen.any():
        result[seen] = rotations(numbers[seen]).as_quat()[:, [3, 0, 1, 2]]
    return result


@dataclass(frozen=True)
class Layout:
    """Columns of a table with numbers: their places and their meaning.

    Attributes:
        first: number of the first line of numbers.
        width: number of cells of a line; empty cells after them are ignored.
        places: label, axis (x, y, z or one of ``turn``) and column of every coordinate.
        unit: of positions; None if the table does not state it.
        clock: column of the frame number or time; None if every line is a frame.
        seconds: unit of the time [s]; None for frame numbers.
        rate: of the frames [Hz], where there is no time; with times, that at which these are
            sampled again, as they are uneven.
        channels: factors to SI units of the columns of the actuation.
        loads: name, index in `force_sensors.AXES` and factor to SI units of the columns of force
            sensors.
        planar: whether a coordinate that no marker has a column for is zero.
        turn: how rotations are given.
    """

    first: int
    width: int
    places: Sequence[Place]
    unit: str | None = None
    clock: int | None = None
    seconds: float | None = None
    rate: float | None = None
    channels: Mapping[int, float] = field(default_factory=dict)
    loads: Mapping[int, tuple[str, int, float]] = field(default_factory=dict)
    planar: bool = False
    turn: Turn = QUATERNION

    def read(self, rows: Rows, path: Path) -> Recording:
        """Reads the recording from all lines of a file."""
        markers, chosen, turned = self._markers(path)
        others = list(chain.from_iterable(turned.values()))
        others += [] if self.clock is None else [self.clock]
        known = sorted({*chosen, *others, *self.channels, *self.loads} - {-1})
        read, lines = self._numbers(rows, known, path)
        # The last column stays zero, for planar markers.
        values = np.zeros((len(read), max(known, default=0) + 2))
        values[:, known] = read
        stamps = np.arange(len(values), dtype=np.float64)
        if self.clock is not None:
            stamps = values[:, self.clock] * (self.seconds or 1.0)
        if self.seconds is not None and self.rate is not None:
            if turned:
                body = markers[next(iter(turned))]
                raise DataFileError(
                    f"{path}: {body} is a rigid body, whose rotations are not sampled again at "
                    "data.table.rate: export the recording at a constant frame rate."
                )
            _check_rise(stamps, lines, path)
            values, stamps, lines = self._even(values, stamps, lines, self.rate, path)
        frames, measured_rate = _frames(stamps, self.seconds is not None, lines, path)
        actuation = None
        if self.channels:
            with np.errstate(over="ignore"):
                driven = values[:, list(self.channels)] * list(self.channels.values())
            driven = _switched_on(driven, lines, path)
            values, frames = values[: len(driven)], frames[: len(driven)]
            grid = np.arange(frames[-1] + 1)
            actuation = np.stack([np.interp(grid, frames, channel) for channel in driven.T], axis=1)
        # NaN in frames that were not recorded
        positions = np.full((frames[-1] + 1, len(markers), 3), np.nan)
        positions[frames] = values[:, chosen].reshape(len(values), len(markers), 3)
        loads, given = dict[str, FloatArray](), set[tuple[str, int]]()
        for column, (name, axis, factor) in self.loads.items():
            if (name, axis) in given:
                twice = f"{name}.{FORCES[axis]}"
                raise DataFileError(
                    f"{path} has two columns named '{twice}': rename one of these sensors."
                )
            given.add((name, axis))
            readings = loads.setdefault(name, np.full((len(positions), len(FORCES)), np.nan))
            readings[frames, axis] = factor * values[:, column]
        turns = np.full((*positions.shape[:2], 4), np.nan)
        for marker, columns in turned.items():
            try:
                turns[frames, marker] = self.turn[1](values[:, columns])
            except ValueError as error:
                raise DataFileError(
                    f"{path}: {markers[marker]} has a row that is no rotation ({error})."
                ) from error
        timed = self.seconds is not None
        rate = measured_rate if timed else self.rate
        return Recording(
            tuple(markers),
            positions,
            np.nan if rate is None else rate,
            path,
            actuation,
            start=float(stamps[0]) if timed else 0.0,
            unit=self.unit or "",
            turns=turns if turned else None,
            loads=loads,
        )

    def _even(
        self, values: FloatArray, stamps: FloatArray, lines: Sequence[int], rate: float, path: Path
    ) -> tuple[FloatArray, FloatArray, list[int]]:
        """Returns values, times [s] and lines at a rate [Hz], from times that rise.

        Channels hold their last known values; coordinates are interpolated linearly between lines
        that have them, and are NaN where these are further apart than three in the median.
        """
        _check_span(stamps, float(np.median(np.diff(stamps))), lines, path)
        times = stamps[0] + np.arange(int((stamps[-1] - stamps[0]) * rate + 1e-6) + 1) / rate
        if len(times) < _LEAST_FRAMES:
            raise DataFileError(
                f"{path} has less than two frames at {rate:g} Hz: raise data.table.rate."
            )
        even = np.zeros((len(times), values.shape[1]))
        for column in range(values.shape[1] - 1):
            known = np.isfinite(values[:, column])
            at, series = stamps[known], values[known, column]
            after = np.searchsorted(at, times + 1e-9, side="right")
            if column in self.channels:
                even[:, column] = (
                    np.where(after > 0, series[after - 1], np.nan) if len(at) else np.nan
                )
            elif len(at) > 1:
                even[:, column] = np.interp(times, at, series, left=np.nan, right=np.nan)
                gaps = np.diff(at)[after.clip(1, len(at) - 1) - 1]
                apart = np.abs(
                    times[:, None] - at[np.stack([after - 1, after], 1).clip(0, len(at) - 1)]
                ).min(1)
                even[(gaps > _LONGEST_GAP * np.median(np.diff(at))) & (apart > 1e-6), column] = (
                    np.nan
                )
            else:
                even[:, column] = np.nan
        before = np.searchsorted(stamps, times + 1e-9, side="right") - 1
        return even, times, [lines[row] for row in before]

    def _markers(self, path: Path) -> tuple[list[str], list[int], dict[int, list[int]]]:
        """Returns labels, the columns of their x, y and z,
        and those of rotations by the index of the rigid body.

        The column of the axis that planar markers do not have is -1.
        """
        columns: dict[tuple[str, str], int] = {}
        for label, axis, column in self.places:
            if (label, axis) in columns:
                raise DataFileError(
                    f"{path} has two columns named '{label}.{axis}': rename one of these markers."
                )
            columns[label, axis] = column
        labels = list(dict.fromkeys(label for label, axis in columns if axis in AXES))
        axes = {axis for _, axis in columns if axis in AXES}
        optional = {*AXES} - axes if self.planar and len(axes) == 2 else set()
        bodies = dict.fromkeys(label for label, axis in columns if axis in self.turn[0])
        wanted = [*product(labels, [axis for axis in AXES if axis not in optional])]
        wanted += product(bodies, (*AXES, *self.turn[0]))
        for label, axis in wanted:
            if (label, axis) not in columns:
                what, cure = "marker", "export it again with all"
                if label in bodies:
                    what = "rigid body"
                    cure = f"export it again with all ({', '.join((*AXES, *self.turn[0]))})"
                elif len([name for name, _ in columns if name == label]) == 1:
                    cure = (
                        "its single axis is a distance, as of a laser, and a marker needs two or "
                        "three: give the others, 0 where it cannot move, "
                        "or leave the column out in data.table"
                    )
                raise DataFileError(
                    f"{path}: {what} {label} has no column '{label}.{axis}'; {cure}."
                )
        chosen = [columns.get(place, -1) for place in product(labels, AXES)]
        turned = {}
        for body in bodies:
            turned[labels.index(body)] = [columns[body, axis] for axis in self.turn[0]]
        return labels, chosen, turned

    def _numbers(
        self, rows: Rows, columns: Sequence[int], path: Path
    ) -> tuple[FloatArray, list[int]]:
        """Columns (T, C) of rows of numbers, NaN for empty cells, and the line numbers of rows."""
        values, lines = [], []
        for line, row in enumerate(rows[self.first :], start=self.first + 1):
            if not any(row):
                continue
            sampled = self.seconds is not None and self.rate is not None
            if sampled and len(row) < self.width and not any(map(any, rows[line:])):
                log.warning("%s: the last line, %d, is cut off, and left out.", path.name, line)
                break
            if len(row) < self.width or any(row[self.width :]):
                raise DataFileError(
                    f"{path}, line {line}: {len(row)} cells where the other lines have "
                    f"{self.width}; the file is cut off or damaged there: export it again."
                )
            numbers = [
                np.nan if row[column].lower() in _OCCLUDED else number(row[column])
                for column in columns
            ]
            if None in numbers:
                column = columns[numbers.index(None)]
                raise DataFileError(
                    f"{path}, line {line}, column {column + 1}: {row[column]!r} is not a number; "
                    "write numbers with a decimal point, "
                    "and leave the cells of an occluded marker empty."
                )
            values.append(numbers)
            lines.append(line)
        if len(values) < _LEAST_FRAMES:
            raise DataFileError(
                f"{path} holds {len(values)} frames: a recording needs two or more."
            )
        return np.array(values, dtype=np.float64), lines


def _switched_on(driven: FloatArray, lines: Sequence[int], path: Path) -> FloatArray:
    """Channels (T', C) from (T, C), cut off where one of them ends.

    Missing first values equal the first known one.

    A log may begin before the actuators are switched on, and end after they are switched off.
    """
    known = np.isfinite(driven)
    if np.isinf(driven).any() or not known.any(axis=0).all():
        row = int(np.argmax((np.isinf(driven) | ~known.any(axis=0)).any(axis=1)))
        raise DataFileError(
            f"{path}, line {lines[row]}: an actuation is missing or infinite; "
            "every frame needs one."
        )
    first = known.argmax(axis=0)
    end = len(driven) - int(known[::-1].argmax(axis=0).max())
    frames = np.arange(end)[:, None]
    filled = np.where(frames < first, driven[first, np.arange(driven.shape[1])], driven[:end])
    missing = np.isnan(filled).any(axis=1)
    if missing.any():
        raise DataFileError(
            f"{path}, line {lines[int(missing.argmax())]}: an actuation is missing; every frame "
            "between the first and the last one that has it needs one."
        )
    if first.any() or end < len(driven):
        log.warning(
            "%s has no actuation in its first %d frames, which get its first known value, nor in "
            "its last %d, which are left out.",
            path.name,
            int(first.max()),
            len(driven) - end,
        )
    if end < _LEAST_FRAMES:
        raise DataFileError(
            f"{path} has an actuation in {end} frames: a recording needs two or more."
        )
    return np.asarray(filled)


def is_data(row: Sequence[str]) -> bool:
    """Whether a line holds positions: it begins with a digit,
    and most cells are numbers or empty.
    """
    filled = [cell for cell in row if cell.lower() not in _OCCLUDED]
    begins = (
        bool(filled)
        and filled[0].lstrip("+-.")[:1].isdecimal()
        and (row[0] != "" or 2 * len(filled) > len(row))
    )
    return (
        len(row) >= 3
        and begins
        and 2 * sum(number(cell) is not None for cell in filled) > len(filled)
    )


def has_numbers(row: Sequence[str]) -> bool:
    """Whether half of the cells of a line or more, and two at least,
    are numbers, after words such as a state.
    """
    filled = [cell for cell in row if cell]
    return max(2, 0.5 * len(filled)) <= sum(number(cell) is not None for cell in filled)


def _check_rise(stamps: FloatArray, lines: Sequence[int], path: Path) -> None:
    """Refuses times or frame numbers that do not rise."""
    known = np.abs(stamps) <= _LARGEST_STAMP
    wrong = np.append(~known[0], ~(np.diff(np.where(known, stamps, np.nan)) > 0.0))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataFileError(
            f"{path}, line {lines[row]}: the time or frame does not rise (from "
            f"{stamps[max(row - 1, 0)]:g} to {stamps[row]:g}), or is no number below 1e12; sort "
            "the lines and fill it in, or write what follows into a file of its own if the "
            "clock begins anew there."
        )


def _foreign(stamps: FloatArray, row: int, lines: Sequence[int], path: Path) -> DataFileError:
    """Returns the error of two lines that do not belong together."""
    return DataFileError(
        f"{path}, line {lines[row]}: from the line before on, time or frame passes from "
        f"{stamps[row - 1]:g} to {stamps[row]:g}, so that both do not belong to one recording; "
        "check that column."
    )


def _check_span(stamps: FloatArray, interval: float, lines: Sequence[int], path: Path) -> None:
    """Refuses times or frame numbers of which few were recorded, from their usual interval."""
    if _LEAST_RECORDED * float(stamps[-1] - stamps[0]) > interval * len(stamps):
        raise _foreign(stamps, int(np.argmax(np.diff(stamps))) + 1, lines, path)


def _frames(
    stamps: FloatArray, timed: bool, lines: Sequence[int], path: Path
) -> tuple[IntArray, float | None]:
    """Returns the frame index of every row from its frame number or time [s],
    and the rate [Hz] from times.
    """
    _check_rise(stamps, lines, path)
    steps = np.diff(stamps)
    interval, span = float(np.median(steps)) if timed else 1.0, float(stamps[-1] - stamps[0])

    _check_span(stamps, interval, lines, path)
    if timed:  # Times may be rounded, and frames may be missing.
        single = float(steps[steps < _NEXT * interval].mean())
        interval = span / float(np.round(steps / single).sum())
    exact = (stamps - stamps[0]) / interval
    exact -= np.median(exact - np.round(exact))
    frames = np.round(exact).astype(np.int64)
    uneven = np.abs(exact - frames) > _UNEVEN
    if uneven.any():
        raise DataFileError(
            f"{path}, line {lines[int(np.argmax(uneven))]}: the frames are not evenly spaced; "
            "export the recording at a constant frame rate."
        )
    if (np.diff(frames) < 1).any():
        raise _foreign(stamps, int(np.argmax(np.diff(frames) < 1)) + 1, lines, path)
    if not timed:
        return frames, None
    rate = 1.0 / interval
    whole = rate < _LARGEST_STAMP and abs(rate - round(rate)) < _WHOLE * rate
    return frames, float(round(rate)) if whole else rate
