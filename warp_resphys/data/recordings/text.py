"""Recordings as text: plain tables, and exports of Qualisys Track Manager, OptiTrack Motive and Vicon Nexus.

docs/recordings.md describes the layouts. A cell that is empty or NaN is an occlusion. Each layout says which columns
hold which coordinate, and `_read_columns` reads them.
"""

import csv
import io
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ...io.errors import DataFileError, did_you_mean, listed
from ...settings.trials import TableSettings
from .recording import METRES_PER_UNIT, SI_PER_ACTUATION_UNIT, FloatArray, RawRecording

log = logging.getLogger(__name__)

Rows = list[list[str]]

_AXES = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_OCCLUDED = ("", "nan", "null")
_QUALISYS_KEYS = ("FILE_VERSION", "NO_OF_FRAMES", "NO_OF_MARKERS", "FREQUENCY", "MARKER_NAMES")
_MOTIVE_UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
# A column in a length is a misspelt marker rather than an actuation.
_CHANNEL_UNITS = [unit for unit in SI_PER_ACTUATION_UNIT if unit not in METRES_PER_UNIT]
_CLOCKS = ("time", "frame")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_VICON = ("Trajectories", "Devices", "Joints", "Model Outputs", "Segments")  # sections
_UNEVEN = 0.25  # of a frame: largest error of a time stamp
_LARGEST_STAMP = 1e12  # [s or 1] largest valid time or frame number
_LEAST_FRAMES = 2  # of a recording
_LEAST_RECORDED = 0.1  # of the frames between the first and the last


def read_raw_text(path: Path, table: TableSettings | None = None) -> RawRecording:
    """Reads a table, a Qualisys TSV, a Motive or a Vicon CSV, detected from its first line.

    Args:
        path: of the file.
        table: description of the file, in place of its first line.

    Raises:
        DataFileError: The file is missing, empty or not text, has an unknown layout, or a cell or row is invalid.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path of the recording.") from error
    except UnicodeDecodeError as error:
        raise DataFileError(f"{path} is not a text file: export it as CSV or TSV again.") from error
    lines, before = text.splitlines(), 0 if table is None else table.header_lines
    first = "".join(lines[:1])
    try:
        head = "".join(lines[before : before + 1])
        delimiter = max("\t,;", key=(head if any(map(head.count, "\t,;")) else text[:10_000]).count)
        rows = list(csv.reader(io.StringIO(text), delimiter=delimiter))
    except csv.Error as error:
        raise DataFileError(f"{path} is no table ({error}): export it as CSV or TSV again.") from error
    rows = [[cell.strip() for cell in row] for row in rows]
    if delimiter == ";":
        rows = [[cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in row] for row in rows]
    if table is not None:
        return _read_described(rows, table, path)
    if first.split("\t")[0].strip() in _QUALISYS_KEYS:
        return _read_qualisys(rows, path)
    if first.startswith("Format Version"):
        return _read_motive(rows, path)
    if rows and rows[0][:1] and rows[0][0] in _VICON:
        return _read_vicon(rows, path)
    columns = [_name_and_unit(cell) for cell in rows[0]] if rows else []
    if not columns or columns[0][0].lower() not in _CLOCKS or len(columns) < 4:
        raise DataFileError(
            f"{path} has no header that is known: its first line must be 'time [s]' or 'frame', then "
            "'<marker>.x', '<marker>.y' and '<marker>.z' for each marker; or say in data.table what its columns are."
        )
    return _read_table(rows, 1, dict(enumerate(columns)), _CHANNEL_UNITS, len(columns), path)


def _read_described(rows: Rows, table: TableSettings, path: Path) -> RawRecording:
    """Reads a table with described columns; a column in a length that is not of a marker is a channel."""
    first, width = table.header_lines, len(table.columns)
    header = rows[first] if len(rows) > first else []
    if table.names:
        for name in table.names:
            if header.count(name) != 1:
                known = did_you_mean(name, header) or f"; it has {listed([cell for cell in header if cell])}."
                raise DataFileError(
                    f"{path}, line {first + 1}: data.table.names has {name!r}, which {header.count(name)} columns are "
                    f"named{known} data.table.header_lines is the number of lines before the header."
                )
        columns = {header.index(name): _name_and_unit(cell) for name, cell in table.names.items()}
        first, width = first + 1, len(header)
    else:
        if len(header) < width or any(header[width:]):
            raise DataFileError(
                f"{path}, line {first + 1}: {len(header)} cells, but data.table.columns names {width}: name each "
                "column of the file, null for one that is not read."
            )
        columns = {number: _name_and_unit(cell) for number, cell in enumerate(table.columns) if cell}
    without_ends = [row if any(row[width:]) else row[:width] for row in rows[first:]]
    units = list(SI_PER_ACTUATION_UNIT)
    return _read_table([*rows[:first], *without_ends], first, columns, units, width, path, planar=True)


def _read_table(
    rows: Rows,
    first: int,
    columns: Mapping[int, tuple[str, str | None]],
    channel_units: Sequence[str],
    width: int,
    path: Path,
    planar: bool = False,
) -> RawRecording:
    """Reads columns `time [s]` or `frame`, `<marker>.x`, `.y` and `.z`, of a rigid body `.qw` to `.qz`, and channels.

    Args:
        rows: all lines.
        first: number of the first line of numbers.
        columns: names and units by number.
        channel_units: units in brackets of the columns that are channels.
        width: number of cells of a line.
        path: of the file.
        planar: whether a coordinate that no marker has a column for is zero.
    """
    clocks = [number for number, (name, _) in columns.items() if name.lower() in _CLOCKS]
    if len(clocks) > 1:
        raise DataFileError(f"{path}: columns {clocks[0] + 1} and {clocks[1] + 1} both tell the time: read one only.")
    clock, seconds = clocks[0] if clocks else None, None
    if clock is not None and columns[clock][0].lower() == "time":
        unit = columns[clock][1]
        stamps = [row[clock] for row in rows[first:] if len(row) > clock and row[clock]]
        if unit == "iso" or (unit is None and stamps and _number(stamps[0]) is None):
            rows, unit = _since_first(rows, first, clock, path), "s"
        if (seconds := _SECONDS.get(unit or "s")) is None:
            raise DataFileError(
                f"{path} gives its time in '{unit}': it must be in s, ms, us, ns or iso, as in 'time [s]'."
            )
    places, units, channels = list[tuple[str, str, int]](), set[str](), dict[int, float]()
    for number, (name, unit) in columns.items():
        if number == clock:
            continue
        label, axis = _of_marker(name, unit, [other for other, _ in columns.values()])
        if label and axis in (*_AXES, *_QUATERNION):
            places.append((label, axis, number))
            units |= {unit} if unit and axis in _AXES else set()
        elif unit is not None and unit in channel_units:
            channels[number] = SI_PER_ACTUATION_UNIT[unit]
        else:
            raise DataFileError(
                f"{path}: column {number + 1} is named '{name}', which is neither '<marker>.x', '.y' or '.z' nor a "
                f"channel with a unit in brackets ({', '.join(channel_units)}); rename it or leave it out (data.table)."
            )
    if len(units) > 1:
        raise DataFileError(f"{path} gives positions in {listed(sorted(units))}: give all of them in one unit.")
    unit = next(iter(units), None)
    return _read_columns(rows, first, width, places, path, unit, clock, seconds, channels=channels, planar=planar)


def _since_first(rows: Rows, first: int, column: int, path: Path) -> Rows:
    """Replaces dates and times (ISO 8601) by seconds since the first."""
    result, start = list(rows), None
    for line, row in enumerate(rows[first:], start=first):
        if len(row) <= column or not any(row):
            continue
        try:
            moment = datetime.fromisoformat(row[column])
            start = start or moment
            seconds = (moment - start).total_seconds()
        except (ValueError, TypeError):  # TypeError: with and without a time zone
            raise DataFileError(
                f"{path}, line {line + 1}, column {column + 1}: {row[column]!r} is no date and time as the others: "
                "write them as 2026-01-31T12:00:00.010, all with or all without a time zone, or numbers of seconds."
            ) from None
        result[line] = [*row[:column], repr(seconds), *row[column + 1 :]]
    return result


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    """Splits `name [unit]`; the unit is None without brackets at the end."""
    name, bracket, unit = cell.removesuffix("]").rpartition("[")
    return (name.rstrip(), unit) if bracket and cell.endswith("]") else (cell, None)


def _of_marker(name: str, unit: str | None, names: Sequence[str]) -> tuple[str, str]:
    """Returns label and axis in the name of a column, as in tip.x, or as in tip_x or tip X if all three axes are there.

    Args:
        name: of the column.
        unit: of the column; with one that is no length it is no coordinate but as in tip.x.
        names: of all columns.
    """
    label, _, axis = name.rpartition(".")
    if not label and unit in (None, *METRES_PER_UNIT) and (found := re.fullmatch(r"(.+)[ _]([xyzXYZ])", name)):
        beside = {other[-1:].lower() for other in names if other[:-1] == name[:-1]}
        if beside >= {*_AXES}:
            label, axis = found[1], found[2]
    return label, axis.lower()


def _read_qualisys(rows: Rows, path: Path) -> RawRecording:
    """Reads lines of a key and its values, an optional line of column names, and one line for every frame; millimetres.

    A line may begin with its frame number, or with frame number and time. Qualisys writes 0.000 for all three
    coordinates of an occluded marker, or leaves them empty.
    """
    first = next((number for number, row in enumerate(rows) if _is_data(row)), len(rows))
    keys = {row[0]: row[1:] for row in rows[:first] if row}
    labels = [label for label in keys.get("MARKER_NAMES", []) if label]
    if not labels:
        raise DataFileError(f"{path} has no MARKER_NAMES: export it from Qualisys Track Manager with its header.")
    data = [row for row in rows[first:] if any(row)]
    width = max(map(len, data), default=0)
    leading = width - 3 * len(labels)
    if "Frame" in keys:  # There is a line of column names.
        leading = 2 if keys["Frame"][:1] == ["Time"] else 1
    elif leading > 0 and not any(any(row[width - 1 :]) for row in data):  # Every line ends in a tab.
        leading -= 1
    if leading not in (0, 1, 2) or width - leading - 3 * len(labels) not in (0, 1):
        raise DataFileError(
            f"{path}, line {first + 1}: {width} numbers do not fit {len(labels)} markers; export 3D data with column "
            "names, and with nothing but the frame and its time before the positions."
        )
    declared = "".join(keys.get("NO_OF_FRAMES", [])[:1])
    if not leading and declared and declared != str(len(data)):
        raise DataFileError(
            f"{path} has {len(data)} of the {declared} frames of its NO_OF_FRAMES, and no column tells which: "
            "export it again, with the frame and its time before the positions."
        )
    # Labels may occur twice.
    places = [(f"{n}", axis, leading + 3 * n + at) for n in range(len(labels)) for at, axis in enumerate(_AXES)]
    rate, clock = _number("".join(keys.get("FREQUENCY", [])[:1])), 0 if leading else None
    raw = _read_columns(rows, first, width, places, path, "mm", clock, rate=rate, labels=labels)
    raw.positions[(raw.positions == 0.0).all(axis=2)] = np.nan
    return replace(raw, start=_number(data[0][1]) or 0.0) if leading == 2 else raw


def _read_motive(rows: Rows, path: Path) -> RawRecording:
    """Reads a line of keys and values, lines of Type, Name and others, a line of axes, and one line for every frame.

    Columns of Type Marker are read, measured markers and not those of a solved rigid body, and of Type Rigid Body,
    where rotations are quaternions.
    """
    keys = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    axes_line = next((number for number, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if axes_line is None:
        raise DataFileError(f"{path} has no line that begins with 'Frame': export it from Motive with its header.")
    head = [row for row in rows[1:axes_line] if any(row)]
    at = next((number for number, row in enumerate(head[:-1]) if {"Marker", "Rigid Body"} & {*row}), None)
    places = dict[str, list[tuple[str, str, int]]](Marker=[], Body=[])
    axes = [cell.lower() for cell in rows[axes_line]]
    if at is not None:
        for number, (kind, name, part, axis) in enumerate(zip(head[at], head[at + 1], head[-1], axes, strict=False)):
            if kind == "Rigid Body" and (part == "Rotation" or axis in _AXES):
                places["Body"].append((name, f"q{axis}" if part == "Rotation" else axis, number))
            elif kind == "Marker" and axis in _AXES:
                places["Marker"].append((name, axis, number))
    known = {(name, axis) for name, axis, _ in places["Body"]}
    whole = {name for name, _ in known if {(name, "qw"), (name, "x")} <= known}
    if left := {name for name, _ in known} - whole:
        log.warning(
            "%s: rigid bodies without a position and a quaternion are not read (%s): let Motive export both.",
            *(path.name, listed(sorted(map(str, left)))),
        )
    read = [*places["Marker"], *(place for place in places["Body"] if place[0] in whole)]
    if not read:
        raise DataFileError(f"{path} holds no markers: export it from Motive with its markers.")
    rate = _number(keys.get("Export Frame Rate") or keys.get("Capture Frame Rate") or "")
    unit = keys.get("Length Units") or None
    unit = _MOTIVE_UNITS.get((unit or "").lower(), unit)
    return _read_columns(rows, axes_line + 1, len(axes), read, path, unit, 0, rate=rate)


def _read_vicon(rows: Rows, path: Path) -> RawRecording:
    """Reads the section Trajectories: its rate, names, axes and units, and a line for every frame until an empty one.

    Markers lose the name of their subject where there is one subject. Velocities and accelerations are not read.
    """
    at = next((line for line, row in enumerate(rows) if row[:1] == ["Trajectories"]), None)
    if at is None or len(rows) < at + 6 or "Frame" not in rows[at + 3][:1]:
        raise DataFileError(
            f"{path} has no whole section 'Trajectories': export it from Vicon Nexus with its trajectories and header."
        )
    names, axes, units = (rows[at + k] for k in (2, 3, 4))
    label, places = "", list[tuple[str, str, int]]()
    for column, axis in enumerate(axes):
        label = names[column] if column < len(names) and names[column] else label
        if column > 1 and axis.lower() in _AXES:
            places.append((label, axis.lower(), column))
    if not places:
        raise DataFileError(f"{path} has no markers in its section 'Trajectories': export it again.")
    if len({label.rpartition(":")[0] for label, *_ in places}) == 1:
        places = [(label.rpartition(":")[2], axis, column) for label, axis, column in places]
    unit = {units[column] for *_, column in places if column < len(units)}
    if len(unit) != 1:
        raise DataFileError(f"{path}, line {at + 5}: positions are in {listed(sorted(unit))}: export them in one unit.")
    data = [*takewhile(any, rows[at + 5 :])]
    width = max(map(len, data), default=0)
    filled = [*rows[: at + 5], *(row + [""] * (width - len(row)) for row in data)]  # Empty ends are occlusions.
    return _read_columns(filled, at + 5, width, places, path, unit.pop(), 0, rate=_number("".join(rows[at + 1][:1])))


def _read_columns(
    rows: Rows,
    first: int,
    width: int,
    places: Iterable[tuple[str, str, int]],
    path: Path,
    unit: str | None,
    clock: int | None,
    seconds: float | None = None,
    rate: float | None = None,
    labels: Sequence[str] | None = None,
    channels: Mapping[int, float] = MappingProxyType({}),
    planar: bool = False,
) -> RawRecording:
    """Reads the lines from ``first`` on.

    Args:
        rows: all lines.
        first: number of the first line of numbers.
        width: number of cells of a line.
        places: label, axis (x, y, z, or qw, qx, qy, qz of a rigid body) and column of every coordinate.
        path: of the file.
        unit: of positions.
        clock: column of the frame number or time; None if every line is a frame.
        seconds: unit of the time [s]; None for frame numbers.
        rate: of the frames [Hz], where there is no time.
        labels: in place of those of ``places``.
        channels: factors to SI units of the columns of the actuation.
        planar: whether a coordinate that no marker has a column for is zero.
    """
    markers, chosen, turned = _markers(places, path, planar)
    others = [number for columns in turned.values() for number in columns] + ([] if clock is None else [clock])
    known = sorted({*chosen, *others, *channels} - {-1})
    read, lines = _numbers(rows, first, known, width, path)
    values = np.zeros((len(read), max(known, default=0) + 2))  # The last column stays zero, for planar markers.
    values[:, known] = read
    stamps = np.arange(len(values), dtype=np.float64) if clock is None else values[:, clock] * (seconds or 1.0)
    frames, measured_rate = _frames(stamps, seconds is not None, lines, path)
    actuation = None
    if channels:
        with np.errstate(over="ignore"):
            driven = values[:, list(channels)] * list(channels.values())
        driven = _switched_on(driven, lines, path)
        values, frames = values[: len(driven)], frames[: len(driven)]
        grid = np.arange(frames[-1] + 1)
        actuation = np.stack([np.interp(grid, frames, channel) for channel in driven.T], axis=1)
    positions = np.full((frames[-1] + 1, len(markers), 3), np.nan)  # NaN in frames that were not recorded
    positions[frames] = values[:, chosen].reshape(len(values), -1, 3)
    turns = np.full((*positions.shape[:2], 4), np.nan)
    for marker, columns in turned.items():
        turns[frames, marker] = values[:, columns]
    start = 0.0 if seconds is None else float(stamps[0])
    return RawRecording(
        *(positions, labels or markers, unit, rate if seconds is None else measured_rate, actuation),
        start=start,
        turns=turns if turned else None,
    )


def _markers(
    places: Iterable[tuple[str, str, int]], path: Path, planar: bool
) -> tuple[list[str], list[int], dict[int, list[int]]]:
    """Returns labels, the columns of their x, y and z, and those of quaternions by the index of the rigid body.

    The column of the axis that planar markers do not have is -1.
    """
    columns: dict[tuple[str, str], int] = {}
    for label, axis, column in places:
        if (label, axis) in columns:
            raise DataFileError(f"{path} has two columns named '{label}.{axis}': rename one of these markers.")
        columns[label, axis] = column
    labels = list(dict.fromkeys(label for label, axis in columns if axis in _AXES))
    axes = {axis for _, axis in columns if axis in _AXES}
    optional = {*_AXES} - axes if planar and len(axes) == 2 else set()
    bodies = dict.fromkeys(label for label, axis in columns if axis in _QUATERNION)
    wanted = [(label, axis) for label in labels for axis in _AXES if axis not in optional]
    wanted += [(label, axis) for label in bodies for axis in (*_AXES, *_QUATERNION)]
    for label, axis in wanted:
        if (label, axis) not in columns:
            what, lacks = ("rigid body", " (x, y, z, qw, qx, qy and qz)") if label in bodies else ("marker", "")
            raise DataFileError(
                f"{path}: {what} {label} has no column '{label}.{axis}'; export it again with all{lacks}."
            )
    chosen = [columns.get((label, axis), -1) for label in labels for axis in _AXES]
    return labels, chosen, {labels.index(label): [columns[label, axis] for axis in _QUATERNION] for label in bodies}


def _switched_on(driven: FloatArray, lines: Sequence[int], path: Path) -> FloatArray:
    """Channels (T', C) from (T, C), cut off where one of them ends; missing first values equal the first known one.

    A log may begin before the actuators are switched on, and end after they are switched off.
    """
    known = np.isfinite(driven)
    if np.isinf(driven).any() or not known.any(axis=0).all():
        row = int(np.argmax((np.isinf(driven) | ~known.any(axis=0)).any(axis=1)))
        raise DataFileError(f"{path}, line {lines[row]}: an actuation is missing or infinite; every frame needs one.")
    first = known.argmax(axis=0)
    end = len(driven) - int(known[::-1].argmax(axis=0).max())
    frames = np.arange(end)[:, None]
    filled = np.where(frames < first, driven[first, np.arange(driven.shape[1])], driven[:end])
    if (missing := np.isnan(filled).any(axis=1)).any():
        raise DataFileError(
            f"{path}, line {lines[int(missing.argmax())]}: an actuation is missing; every frame between the first and "
            "the last one that has it needs one."
        )
    if first.any() or end < len(driven):
        log.warning(
            "%s has no actuation in its first %d frames, which get its first known value, nor in its last %d, which "
            "are left out.",
            *(path.name, int(first.max()), len(driven) - end),
        )
    if end < _LEAST_FRAMES:
        raise DataFileError(f"{path} has an actuation in {end} frames: a recording needs two or more.")
    return np.asarray(filled)


def _is_data(row: Sequence[str]) -> bool:
    """Whether a line holds positions: numbers and empty cells only."""
    numbers = [cell for cell in row if cell.lower() not in _OCCLUDED]
    return len(row) >= 3 and bool(numbers) and all(_number(cell) is not None for cell in numbers)


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _numbers(rows: Rows, first: int, columns: Sequence[int], width: int, path: Path) -> tuple[FloatArray, list[int]]:
    """Returns columns (T, C) of the rows from `first` on, NaN for empty cells, and the line numbers of the rows."""
    values, lines = [], []
    for line, row in enumerate(rows[first:], start=first + 1):
        if not any(row):
            continue
        if len(row) != width:
            raise DataFileError(
                f"{path}, line {line}: {len(row)} cells where the other lines have {width}; the file is cut off or "
                "damaged there: export it again."
            )
        numbers = [np.nan if row[column].lower() in _OCCLUDED else _number(row[column]) for column in columns]
        if None in numbers:
            column = columns[numbers.index(None)]
            raise DataFileError(
                f"{path}, line {line}, column {column + 1}: {row[column]!r} is not a number; write numbers with a "
                "decimal point, and leave the cells of an occluded marker empty."
            )
        values.append(numbers)
        lines.append(line)
    if len(values) < _LEAST_FRAMES:
        raise DataFileError(f"{path} holds {len(values)} frames: a recording needs two or more.")
    return np.array(values, dtype=np.float64), lines


def _frames(
    stamps: FloatArray, timed: bool, lines: Sequence[int], path: Path
) -> tuple[NDArray[np.int64], float | None]:
    """Returns the frame index of every row from its frame number or time [s], and the rate [Hz] from times."""
    known = np.abs(stamps) <= _LARGEST_STAMP
    steps = np.diff(np.where(known, stamps, np.nan))
    wrong = np.append(~known[0], ~(steps > 0.0))
    if wrong.any():
        raise DataFileError(
            f"{path}, line {lines[int(np.argmax(wrong))]}: the time or frame does not rise, or is no number below "
            "1e12; sort the lines and fill it in."
        )
    interval, span = float(np.median(steps)) if timed else 1.0, float(stamps[-1] - stamps[0])

    def foreign(row: int) -> DataFileError:
        return DataFileError(
            f"{path}, line {lines[row]}: from the line before on, time or frame passes from {stamps[row - 1]:g} to "
            f"{stamps[row]:g}, so that both do not belong to one recording; check that column."
        )

    if _LEAST_RECORDED * span > interval * len(stamps):
        raise foreign(int(np.argmax(steps)) + 1)
    if timed:  # The whole recording gives the interval more precisely than rounded times.
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
        raise foreign(int(np.argmax(np.diff(frames) < 1)) + 1)
    if not timed:
        return frames, None
    rate = 1.0 / interval
    whole = rate < _LARGEST_STAMP and abs(rate - round(rate)) < 1e-3 * rate
    return frames, float(round(rate)) if whole else rate
