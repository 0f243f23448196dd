"""Recordings as text: a plain table, and the exports of Qualisys Track Manager (TSV) and OptiTrack Motive (CSV).

docs/recordings.md describes the layouts. A cell that is empty or NaN is an occlusion.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...io.errors import DataFileError
from .recording import SI_PER_ACTUATION_UNIT, RawRecording, listed

FloatArray = NDArray[np.float64]
Rows = list[list[str]]

_AXES = ("x", "y", "z")
_OCCLUDED = ("", "nan", "null")
_QUALISYS_KEYS = ("FILE_VERSION", "NO_OF_FRAMES", "NO_OF_MARKERS", "FREQUENCY", "MARKER_NAMES")
_MOTIVE_UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
_UNEVEN = 0.25  # of a frame, that a time stamp may be off
_LARGEST_STAMP = 1e12  # [s or 1], a time or frame number that is believed
_LEAST_RECORDED = 0.1  # of the frames between the first and the last


def read_raw_text(path: Path) -> RawRecording:
    """Reads a table, a Qualisys TSV or a Motive CSV; which one it is, its first line tells.

    Raises:
        DataFileError: The file is missing, empty or no text, has none of the layouts, or a cell or row is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path of the recording.") from error
    except UnicodeDecodeError as error:
        raise DataFileError(f"{path} is not a text file: export it as CSV or TSV again.") from error
    first = text.partition("\n")[0]
    delimiter = max("\t,;", key=first.count)
    try:
        rows = list(csv.reader(io.StringIO(text), delimiter=delimiter))
    except csv.Error as error:
        raise DataFileError(f"{path} is no table ({error}): export it as CSV or TSV again.") from error
    if first.split("\t")[0].strip() in _QUALISYS_KEYS:
        return _read_qualisys(rows, path)
    if first.startswith("Format Version"):
        return _read_motive(rows, path)
    return _read_table(rows, path)


def _read_table(rows: Rows, path: Path) -> RawRecording:
    """A header of `time [s]` or `frame`, then `<marker>.x`, `.y`, `.z` of each marker, and channels `name [unit]`."""
    columns = [_name_and_unit(cell.strip()) for cell in rows[0]] if rows else []
    clock = columns[0][0].lower() if columns else ""
    if clock not in ("time", "frame") or len(columns) < 4:
        raise DataFileError(
            f"{path} has no header that is known: its first line must be 'time [s]' or 'frame', then "
            "'<marker>.x', '<marker>.y' and '<marker>.z' for each marker."
        )
    places, units, channels = _columns_of(columns, path)
    values, lines = _numbers(rows, 1, len(columns), path)
    stamps = values[:, 0]
    if clock == "time" and columns[0][1] not in (None, "s"):
        raise DataFileError(f"{path} gives its time in '{columns[0][1]}': it must be in seconds, 'time [s]'.")
    frames, rate = _frames_of(stamps, None if clock == "frame" else 0.0, lines, path)
    positions = _markers_at(frames, values[:, list(places.values())])
    actuation = None
    if channels:
        with np.errstate(over="ignore"):
            driven = values[:, list(channels)] * list(channels.values())
        if not np.isfinite(driven).all():
            row = int(np.argmin(np.isfinite(driven).all(axis=1)))
            raise DataFileError(
                f"{path}, line {lines[row]}: an actuation is missing or infinite; every frame needs one."
            )
        grid = np.arange(frames[-1] + 1)
        actuation = np.stack([np.interp(grid, frames, channel) for channel in driven.T], axis=1)
    labels = tuple(dict.fromkeys(label for label, _ in places))
    start = float(stamps[0]) if clock == "time" else 0.0
    return RawRecording(positions, labels, units, rate, actuation, start=start)


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    """The parts of `name [unit]`; no unit without brackets at its end."""
    name, bracket, unit = cell.removesuffix("]").rpartition("[")
    return (name.rstrip(), unit) if bracket and cell.endswith("]") else (cell, None)


def _columns_of(
    columns: Sequence[tuple[str, str | None]], path: Path
) -> tuple[dict[tuple[str, str], int], str | None, dict[int, float]]:
    """Column of each marker's axis (x, y, z in turn), the positions' unit, and SI factors of the actuated channels."""
    found: dict[tuple[str, str], int] = {}
    units: set[str] = set()
    channels: dict[int, float] = {}
    for number, (name, unit) in enumerate(columns[1:], start=1):
        label, _, axis = name.rpartition(".")
        if label and axis.lower() in _AXES:
            key = (label, axis.lower())
            if key in found:
                raise DataFileError(f"{path} has two columns named '{name}': rename one of them.")
            found[key] = number
            units |= {unit} if unit else set()
        elif unit in SI_PER_ACTUATION_UNIT:
            channels[number] = SI_PER_ACTUATION_UNIT[unit]
        else:
            raise DataFileError(
                f"{path}: column {number + 1} is named '{name}', which is neither '<marker>.x', '.y' or '.z' nor a "
                f"channel with a unit in brackets ({', '.join(SI_PER_ACTUATION_UNIT)}); rename it or leave it out."
            )
    labels = dict.fromkeys(label for label, _ in found)
    for label in labels:
        absent = [axis for axis in _AXES if (label, axis) not in found]
        if absent:
            raise DataFileError(f"{path}: marker {label} has no column '{label}.{absent[0]}'; add it.")
    if len(units) > 1:
        raise DataFileError(f"{path} gives positions in {listed(sorted(units))}: give all of them in one unit.")
    places = {(label, axis): found[label, axis] for label in labels for axis in _AXES}
    return places, next(iter(units), None), channels


def _read_qualisys(rows: Rows, path: Path) -> RawRecording:
    """Lines of a key and its values, then perhaps a line of column names, then a line a frame; millimetres.

    A line may begin with its frame's number, or with that and its time. Qualisys writes 0.000 for all three
    coordinates of a marker that it did not see, or leaves them empty.
    """
    first = next((number for number, row in enumerate(rows) if _is_data(row)), len(rows))
    keys = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows[:first] if row}
    labels = tuple(label for label in keys.get("MARKER_NAMES", []) if label)
    if not labels:
        raise DataFileError(f"{path} has no MARKER_NAMES: export it from Qualisys Track Manager with its header.")
    width = max((len(row) for row in rows[first:]), default=0)
    values, lines = _numbers(rows, first, width, path)
    leading = width - 3 * len(labels)
    if "Frame" in keys:  # The line of column names.
        leading = 2 if keys["Frame"][:1] == ["Time"] else 1
    elif leading > 0 and np.isnan(values[:, -1]).all():  # Each line ends in a tab.
        leading -= 1
    if leading not in (0, 1, 2) or width - leading - 3 * len(labels) not in (0, 1):
        raise DataFileError(
            f"{path}, line {lines[0]}: {width} numbers do not fit {len(labels)} markers; export 3D data with column "
            "names, and with nothing but the frame and its time before the positions."
        )
    if leading:
        frames, _ = _frames_of(values[:, 0], None, lines, path)
    else:  # Nothing but their number tells whether all of them are there.
        frames = np.arange(len(values))
        declared = "".join(keys.get("NO_OF_FRAMES", [])[:1])
        if declared and declared != str(len(values)):
            raise DataFileError(
                f"{path} has {len(values)} of the {declared} frames of its NO_OF_FRAMES, and no column tells which: "
                "export it again, with the frame and its time before the positions."
            )
    positions = _markers_at(frames, values[:, leading : leading + 3 * len(labels)])
    positions[(positions == 0.0).all(axis=2)] = np.nan
    rate = "".join(keys.get("FREQUENCY", [])[:1])
    start = float(values[0, 1]) if leading == 2 else 0.0
    return RawRecording(positions, labels, "mm", float(rate) if _is_number(rate) else None, start=start)


def _read_motive(rows: Rows, path: Path) -> RawRecording:
    """A line of keys and values, lines of Type, Name and further properties, a line of axes, then a line a frame.

    Of the columns, those of Type Marker are taken: the measured markers, not those of a solved rigid body.
    """
    keys = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    axes_line = next((number for number, row in enumerate(rows) if row and row[0].strip() == "Frame"), None)
    if axes_line is None:
        raise DataFileError(f"{path} has no line that begins with 'Frame': export it from Motive with its header.")
    head = [row for row in rows[1:axes_line] if any(row)]
    kinds = next((row for row in head if "Marker" in row), [])
    named = head[head.index(kinds) + 1 :] if kinds else []
    if not named:
        raise DataFileError(f"{path} holds no markers: export it from Motive with its markers.")
    axes = [cell.strip().lower() for cell in rows[axes_line]]
    places: dict[tuple[str, str], int] = {}
    for number, axis in enumerate(axes):
        inside = number < min(len(kinds), len(named[0]))
        if axis in _AXES and inside and kinds[number].strip() == "Marker":
            key = (named[0][number].strip(), axis)
            if key in places:
                raise DataFileError(f"{path} has more than one marker named '{key[0]}': rename one in Motive.")
            places[key] = number
    labels = tuple(dict.fromkeys(label for label, _ in places))
    if sorted(places) != sorted((label, axis) for label in labels for axis in _AXES):
        raise DataFileError(f"{path}: a marker lacks one of its columns X, Y and Z; export it from Motive again.")
    values, lines = _numbers(rows, axes_line + 1, len(axes), path, only=[0, *places.values()])
    frames, _ = _frames_of(values[:, 0], None, lines, path)
    chosen = [places[label, axis] for label in labels for axis in _AXES]
    positions = _markers_at(frames, values[:, chosen])
    rate = keys.get("Export Frame Rate") or keys.get("Capture Frame Rate") or ""
    unit = keys.get("Length Units", "").strip()
    return RawRecording(
        positions, labels, _MOTIVE_UNITS.get(unit.lower(), unit or None), float(rate) if _is_number(rate) else None
    )


def _is_data(row: Sequence[str]) -> bool:
    """Whether a line holds positions: numbers and empty cells only."""
    cells = [cell.strip() for cell in row]
    numbers = [cell for cell in cells if cell.lower() not in _OCCLUDED]
    return len(cells) >= 3 and bool(numbers) and all(map(_is_number, numbers))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    rows: Rows, first: int, width: int, path: Path, only: Sequence[int] | None = None
) -> tuple[FloatArray, list[int]]:
    """The rows from `first` on as (T, width) numbers, NaN where a cell is empty, and their line numbers.

    Args:
        rows: Cells of the whole file.
        first: Where the numbers begin.
        width: Cells that a row must have.
        path: The file, for messages.
        only: Columns to read; the others stay NaN, whatever they hold.

    Raises:
        DataFileError: A row has more or fewer cells, a cell is no number, or there are fewer than two rows.
    """
    columns = range(width) if only is None else only
    values, lines = [], []
    for number, row in enumerate(rows[first:], start=first + 1):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != width:
            raise DataFileError(
                f"{path}, line {number}: {len(row)} cells where the other lines have {width}; the file is cut off or "
                "damaged there: export it again."
            )
        numbers = np.full(width, np.nan)
        for column in columns:
            cell = row[column].strip()
            if cell.lower() in _OCCLUDED:
                continue
            try:
                numbers[column] = float(cell)
            except ValueError as error:
                raise DataFileError(
                    f"{path}, line {number}, column {column + 1}: {cell!r} is not a number; write numbers with a "
                    "decimal point, and leave the cells of an occluded marker empty."
                ) from error
        values.append(numbers)
        lines.append(number)
    if len(values) < 2:
        raise DataFileError(f"{path} holds {len(values)} frames: a recording needs two or more.")
    return np.stack(values), lines


def _frames_of(
    stamps: FloatArray, time: float | None, lines: Sequence[int], path: Path
) -> tuple[NDArray[np.int64], float | None]:
    """Number of each row's frame, from 0 on, and the rate [Hz] where the stamps are times.

    Args:
        stamps: (T,) frame numbers or times [s].
        time: None if the stamps are frame numbers.
        lines: Line of each row, for messages.
        path: The file, for messages.

    Raises:
        DataFileError: A stamp is missing, does not rise, or is not a whole number of frames after the first.
    """
    known = np.abs(stamps) <= _LARGEST_STAMP
    steps = np.diff(np.where(known, stamps, np.nan))
    wrong = np.append(~known[0], ~(steps > 0.0))
    if wrong.any():
        line = lines[int(np.argmax(wrong))]
        raise DataFileError(
            f"{path}, line {line}: the time or frame does not rise, or is no number below 1e12; sort the "
            "lines and fill it in."
        )
    interval, span = 1.0 if time is None else float(np.median(steps)), float(stamps[-1] - stamps[0])
    foreign = DataFileError(f"{path}: its times or frame numbers do not belong to one recording; check that column.")
    if _LEAST_RECORDED * span > interval * len(stamps):
        raise foreign
    if time is not None:  # The whole recording tells the interval better than times that were rounded.
        interval = span / round(span / interval)
    exact = (stamps - stamps[0]) / interval
    frames = np.round(exact).astype(np.int64)
    uneven = np.abs(exact - frames) > _UNEVEN
    if uneven.any():
        raise DataFileError(
            f"{path}, line {lines[int(np.argmax(uneven))]}: the frames are not evenly spaced; export the recording "
            "at a constant frame rate."
        )
    if (np.diff(frames) < 1).any():
        raise foreign
    rate = None if time is None else 1.0 / interval
    if rate is not None and rate < _LARGEST_STAMP and abs(rate - round(rate)) < 1e-3 * rate and round(rate) > 0:
        rate = float(round(rate))
    return frames, rate


def _markers_at(frames: NDArray[np.int64], values: FloatArray) -> FloatArray:
    """(T, M, 3) positions from (R, 3 M) rows at their frames; a frame that was not recorded is NaN."""
    spread = np.full((int(frames[-1]) + 1, values.shape[1]), np.nan)
    spread[frames] = values
    return spread.reshape(len(spread), -1, 3)
