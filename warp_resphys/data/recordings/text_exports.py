"""Recordings as text: plain tables, and exports of Qualisys Track Manager,
OptiTrack Motive, Vicon Nexus and Tracker.

docs/recordings.md describes the layouts. Each function here finds the columns of the coordinates,
which `columns.Layout` then reads.
"""

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from itertools import pairwise, product, takewhile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...io.arrays import FloatArray
from ...io.errors import DataFileError, did_you_mean, listed
from ...io.text import Rows, number, read_rows
from ...settings.data_kinds import TableSettings
from .column_names import (
    SECONDS,
    UNIT_NAMES,
    Columns,
    coordinates_of,
    is_channel,
    load_of,
    name_and_unit,
    unit_of,
)
from .columns import AXES, QUATERNION, Layout, Place, Turn, has_numbers, is_data, quaternions
from .recording import SI_PER_ACTUATION_UNIT, Recording, hide_zeros, without_subject

log = logging.getLogger(__name__)

_TIMES = ("time", "t", "timestamp", "zeit", "temps", "tiempo", "tempo")
_FRAMES = ("frame", "frame#", "frames", "frame number", "frame_number", "index", "sample")
_OF_DAY = re.compile(r"^(\d{1,2})(:.*)")
_QUALISYS_KEYS = (
    "FILE_VERSION",
    "NO_OF_FRAMES",
    "NO_OF_MARKERS",
    "NO_OF_BODIES",
    "FREQUENCY",
    "MARKER_NAMES",
)
_ANGLES, _MATRIX = ("roll", "pitch", "yaw"), tuple(f"rot[{entry}]" for entry in range(9))
_VICON = ("Trajectories", "Objects", "Devices", "Joints", "Model Outputs", "Segments")  # sections
_VICON_AXES = {"tx": "x", "ty": "y", "tz": "z"} | {
    axis: axis for axis in (*AXES, "rx", "ry", "rz", "rw")
}


def read_text_export(path: Path, table: TableSettings | None = None) -> Recording:
    """Reads a table, as described or with a header, or an export of Qualisys,
    Motive or Vicon, by its first line.

    Raises:
        DataFileError: The file is missing, empty or not text, has an unknown layout, or a cell or
            row is invalid.
    """
    rows = read_rows(path)
    if table is not None:
        return _read_described(rows, table, path)
    first = next((row[0] for row in rows if any(row)), "")
    if first in _QUALISYS_KEYS:
        return _read_qualisys(rows, path)
    if first == "Format Version":
        return _read_motive(rows, path)
    return _read_vicon(rows, path) if first.title() in _VICON else _read_named(rows, path)


def _read_named(rows: Rows, path: Path) -> Recording:
    """Reads a table with a header.

    Names of markers above their axes, and units below, may have lines of their own.
    """
    first = next(
        (line for form in (is_data, has_numbers) for line, row in enumerate(rows) if form(row)),
        len(rows),
    )
    above = [row for row in rows[:first] if any(row)] or [[""]]
    head = [[cell.lstrip("# ") for cell in row] for row in above]
    units: list[str] = []
    if len(head) > 1 and all(unit_of(cell.strip("[]()")) in {"", *UNIT_NAMES} for cell in head[-1]):
        units = [cell.strip("[]()") for cell in head.pop()]
    named = {column: name_and_unit(cell) for column, cell in enumerate(head[-1]) if cell}
    labels = _filled(head[-2], len(head[-1])) if len(head) > 1 else [""] * len(head[-1])
    columns = dict[int, tuple[str, str | None]]()
    for column, (name, unit) in named.items():
        of_marker = f"{labels[column]}.{name}" if labels[column] and name.lower() in AXES else name
        columns[column] = (
            of_marker,
            unit or (unit_of(units[column]) if column < len(units) else "") or None,
        )
    clocks = [
        column
        for words in (_TIMES, _FRAMES)
        for column in columns
        if columns[column][0].lower() in words
    ]
    for column in clocks[1:]:  # A frame number beside the time says nothing new.
        del columns[column]
    if first == len(rows) or not (
        coordinates_of(columns) or any(load_of(*one, path) for one in columns.values())
    ):
        raise DataFileError(
            f"{path} has no header that is known: write 'time [s]' or 'frame', then "
            "'<marker>.x', '<marker>.y' and '<marker>.z' for each marker above its numbers, or "
            "name all columns in data.table, for inspect and convert as in "
            '\'recording.table={columns: ["time [s]", null, "tip.x [mm]", "tip.y [mm]"]}\'.'
        )
    return _read_table(rows, first, columns, is_channel, max(*columns, *clocks) + 1, path)


def _filled(row: Sequence[str], width: int) -> list[str]:
    """Returns the cells of a line, where an empty one means the last one before it."""
    filled, last = list[str](), ""
    for column in range(width):
        last = row[column] if column < len(row) and row[column] else last
        filled.append(last)
    return filled


def _read_described(rows: Rows, table: TableSettings, path: Path) -> Recording:
    """Reads a table with described columns.

    A column in a length that is not of a marker is a channel.
    """
    first, width = table.header_lines, len(table.columns)
    header = rows[first] if len(rows) > first else []
    if table.names:
        for name in table.names:
            if header.count(name) != 1:
                known = (
                    did_you_mean(name, header)
                    or f"; it has {listed([cell for cell in header if cell])}."
                )
                raise DataFileError(
                    f"{path}, line {first + 1}: data.table.names has {name!r}, which "
                    f"{header.count(name)} columns are named{known} data.table.header_lines is "
                    "the number of lines before the header."
                )
        columns = {header.index(name): name_and_unit(cell) for name, cell in table.names.items()}
        first, width = first + 1, max(column for column, cell in enumerate(header) if cell) + 1
    else:
        if len(header) < width or any(header[width:]):
            raise DataFileError(
                f"{path}, line {first + 1}: {len(header)} cells, but data.table.columns names "
                f"{width}: name each column of the file, null for one that is not read."
            )
        columns = {column: name_and_unit(cell) for column, cell in enumerate(table.columns) if cell}
    clocks = [
        column for column, (name, _) in columns.items() if name.lower() in (*_TIMES, *_FRAMES)
    ]
    if len(clocks) > 1:
        raise DataFileError(
            f"{path}: columns {clocks[0] + 1} "
            f"and {clocks[1] + 1} both tell the time: read one only."
        )
    return _read_table(
        rows, first, columns, lambda _, unit: unit in SI_PER_ACTUATION_UNIT, width, path, table.rate
    )


def _read_table(
    rows: Rows,
    first: int,
    columns: Columns,
    accepts: Callable[[str, str | None], bool],
    width: int,
    path: Path,
    rate: float | None = None,
) -> Recording:
    """Reads columns `time [s]` or `frame`, `<marker>.x` to `.z`,
    of rigid bodies `.qw`, forces `.fx`, and channels.

    Args:
        rows: all lines.
        first: number of the first line of numbers.
        columns: names and units by number, at most one of them a time or frame.
        accepts: whether a column with a name and a unit is a channel.
        width: number of cells of a line.
        path: of the file.
        rate: at which uneven times are sampled again [Hz]; None: they are even.
    """
    clock = next(
        (column for column, (name, _) in columns.items() if name.lower() in (*_TIMES, *_FRAMES)),
        None,
    )
    seconds = None
    if clock is not None and columns[clock][0].lower() in _TIMES:
        unit = columns[clock][1]
        stamps = [row[clock] for row in rows[first:] if len(row) > clock and row[clock]]
        if unit == "iso" or (unit is None and stamps and number(stamps[0]) is None):
            rows, unit = _since_first(rows, first, clock, path), "s"
        known = [value for value in map(number, stamps) if value is not None]
        if unit is None and len(known) > 1 and known[-1] - known[0] > len(known):
            raise DataFileError(
                f"{path} does not say in which unit its time is, which rises by more than 1 a "
                "line: write 'time [ms]' or 'time [s]' above it."
            )
        seconds = SECONDS.get((unit or "s").lower())
        if seconds is None:
            raise DataFileError(
                f"{path} gives its time in '{unit}': it must be in s, "
                "ms, us, ns or iso, as in 'time [s]'."
            )
    places = list[Place]()
    units = set[str]()
    channels = dict[int, float]()
    coordinates = coordinates_of(columns)
    readings = {column: load_of(*one, path) for column, one in columns.items()}
    loads = {column: load for column, load in readings.items() if load is not None}
    words = list[str]()
    for column, (name, unit) in columns.items():
        cells = [row[column] for row in rows[first:] if len(row) > column and row[column]]
        if column in coordinates and column not in loads:
            label, axis = coordinates[column]
            places.append((label, axis, column))
            units |= {unit} if unit and axis in AXES else set()
        elif unit is not None and column not in loads and accepts(name, unit):
            channels[column] = SI_PER_ACTUATION_UNIT[unit]
        elif (
            column != clock
            and column not in loads
            and any(number(cell) is not None for cell in cells)
        ):
            kept = {
                *coordinates,
                *loads,
                clock,
                *(other for other, one in columns.items() if accepts(*one)),
            }
            heads = {
                other: head if unit is None else f"{head} [{unit}]"
                for other, (head, unit) in columns.items()
            }
            read = [f'"{heads[other]}"' if other in kept else "null" for other in range(width)]
            raise DataFileError(
                f"{path}: column {column + 1} is named '{name}', which is neither '<marker>.x', "
                "'.y' or '.z', nor '<sensor>.fx [N]' to '.tz [N m]', nor a channel with a unit "
                f"in brackets ({', '.join(SI_PER_ACTUATION_UNIT)}; of lengths, as in 'tendon "
                "[mm]'); rename it, or leave it out by naming the others: "
                f"'recording.table={{columns: [{', '.join(read)}], header_lines: {first}}}' for "
                "inspect and convert, data.table in a configuration."
            )
        elif column != clock and column not in loads and cells:
            words.append(name)
    if words:
        log.warning("%s: columns of text are not read: %s.", path.name, listed(words))
    if len(units) > 1:
        raise DataFileError(
            f"{path} gives positions in {listed(sorted(units))}: give all of them in one unit."
        )
    layout = Layout(
        first,
        width,
        places,
        next(iter(units), None),
        clock,
        seconds,
        rate,
        channels,
        loads,
        planar=True,
    )
    return layout.read(rows, path)


def _since_first(rows: Rows, first: int, column: int, path: Path) -> Rows:
    """Replaces dates and times (ISO 8601), or times of a day, by seconds since the first."""
    result, start = list(rows), None
    for line, row in enumerate(rows[first:], start=first):
        if len(row) <= column or not any(row):
            continue
        try:
            moment = datetime.fromisoformat(
                _OF_DAY.sub(lambda day: f"2000-01-01T{day[1]:0>2}{day[2]}", row[column])
            )
            start = start or moment
            seconds = (moment - start).total_seconds()
        except (ValueError, TypeError):  # TypeError: with and without a time zone
            raise DataFileError(
                f"{path}, line {line + 1}, column {column + 1}: {row[column]!r} is no date and "
                "time as the others: write them as 2026-01-31T12:00:00.010, all with or all "
                "without a time zone, or numbers of seconds."
            ) from None
        result[line] = [*row[:column], repr(seconds), *row[column + 1 :]]
    return result


def _read_qualisys(rows: Rows, path: Path) -> Recording:
    """Reads lines of a key and its values, an optional line of column names,
    and one line for every frame; millimetres.

    A line may begin with its frame number, or with frame number and time. Qualisys writes zeros for
    an occluded marker or rigid body, or leaves the cells empty.
    """
    first = next((line for line, row in enumerate(rows) if is_data(row)), len(rows))
    keys = {row[0]: row[1:] for row in rows[:first] if row}
    labels = [label for label in (keys.get("BODY_NAMES") or keys.get("MARKER_NAMES", [])) if label]
    if not labels:
        raise DataFileError(
            f"{path} has no MARKER_NAMES or BODY_NAMES: "
            "export it from Qualisys Track Manager with its header."
        )
    data = [row for row in rows[first:] if any(row)]
    head = next((row for row in reversed(rows[:first]) if any(row)), [])
    axes = [cell.lower().split(" ")[-1] for cell in head if cell]
    leading = [axis for axis in axes[:2] if axis in ("frame", "time")]
    if not {*AXES} <= {*axes}:  # There is no line of column names.
        width = max(map(len, data), default=0)
        width -= not any(any(row[width - 1 :]) for row in data)  # Every line ends in a tab.
        kinds = (*AXES, *_ANGLES, "residual", *_MATRIX) if "BODY_NAMES" in keys else AXES
        extra = width - len(kinds) * len(labels)
        leading = ["frame", "time"][: max(extra, 0)]
        axes = [*leading, *kinds * len(labels)] if extra in (0, 1, 2) else []
    if axes.count("x") != len(labels):
        raise DataFileError(
            f"{path}, line {first + 1}: {len(rows[first]) if data else 0} numbers do not fit "
            f"{len(labels)} markers; export 3D or 6D data with column names, and with nothing "
            "but the frame and its time before the positions."
        )
    declared = "".join(keys.get("NO_OF_FRAMES", [])[:1])
    if not leading and declared and declared != str(len(data)):
        raise DataFileError(
            f"{path} has {len(data)} of the {declared} frames of its NO_OF_FRAMES, and no column "
            "tells which: export it again, with the frame and its time before the positions."
        )
    unique = [
        f"{label} #{place}" if labels.count(label) > 1 else label
        for place, label in enumerate(labels, start=1)
    ]
    places = [
        (unique[axes[: column + 1].count("x") - 1], axis, column)
        for column, axis in enumerate(axes)
    ]
    rate, clock = number("".join(keys.get("FREQUENCY", [])[:1])), 0 if leading else None
    turn = [axis for axis in (*_MATRIX, *_ANGLES) if axis in axes], _quaternions_of_qualisys
    layout = Layout(first, len(axes), places[len(leading) :], "mm", clock, rate=rate, turn=turn)
    recording = hide_zeros(replace(layout.read(rows, path), labels=tuple(labels)))
    return replace(recording, start=number(data[0][1]) or 0.0) if len(leading) == 2 else recording


def _quaternions_of_qualisys(numbers: FloatArray) -> FloatArray:
    """Returns quaternions (T, 4) of matrices by their columns and angles roll,
    pitch and yaw [degrees] (T, 12).

    There may be matrices (T, 9) or angles (T, 3) alone. Rows of zeros were not seen. Qualisys has
    the rotation Rx(roll) Ry(pitch) Rz(yaw) by default; matrices that agree with it by their rows,
    not their columns, are read so.
    """

    def rotations(seen: FloatArray) -> Rotation:
        by_angles = Rotation.from_euler("XYZ", seen[:, -3:], degrees=True)
        if seen.shape[1] == 3:
            return by_angles
        by_rows = seen[:, :9].reshape(-1, 3, 3)
        by_columns = by_rows.swapaxes(1, 2)
        if seen.shape[1] == 12:
            columns_err, rows_err = (
                np.abs(turn - by_angles.as_matrix()).max() for turn in (by_columns, by_rows)
            )
            by_columns = by_rows if rows_err < 0.01 < columns_err else by_columns
        return Rotation.from_matrix(by_columns)

    hidden = ~numbers[:, :9].any(axis=1, keepdims=True) & (numbers.shape[1] > 3)
    return quaternions(np.where(hidden, np.nan, numbers), rotations)


def _read_motive(rows: Rows, path: Path) -> Recording:
    """Reads a line of keys and values, lines of Type, Name and others,
    a line of axes, and one line for every frame.

    Measured markers and rigid bodies are read; markers of solved rigid bodies only if there is
    nothing else.
    """
    keys = dict(reversed([*pairwise(rows[0])]))  # The name of the take may have commas.
    axes_line = next((line for line, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if axes_line is None:
        raise DataFileError(
            f"{path} has no line that begins with 'Frame': export it from Motive with its header."
        )
    head = [row for row in rows[1:axes_line] if any(row)]
    at = next(
        (
            line
            for line, row in enumerate(head[:-1])
            if {"Marker", "Rigid Body", "Rigid Body Marker"} & {*row}
        ),
        0,
    )
    axes, order = [cell.lower() for cell in rows[axes_line]], keys.get("Rotation Type", "")
    places: dict[str, list[Place]] = {"Marker": [], "Rigid Body": [], "Rigid Body Marker": []}
    for column, (kind, name, part, axis) in enumerate(
        zip(*head[at : at + 2], head[-1], axes, strict=False)
    ):
        if kind in places and (part == "Rotation" or axis in AXES):
            places[kind].append((name, f"q{axis}" if part == "Rotation" else axis, column))
    turn = QUATERNION
    if sorted(order) == ["X", "Y", "Z"]:  # angles about the axes of the body, in degrees
        rotations = partial(Rotation.from_euler, order, degrees=True)
        turn = [f"q{axis.lower()}" for axis in order], partial(quaternions, rotations=rotations)
    known = {(name, axis) for name, axis, _ in places["Rigid Body"]}
    bodies = {name for name, _ in known}
    whole = {name for name in bodies if known.issuperset(product([name], ("x", *turn[0])))}
    left = bodies - whole
    if left:
        log.warning(
            "%s: rigid bodies without a position and a quaternion are not read (%s): "
            "let Motive export both.",
            path.name,
            listed(sorted(map(str, left))),
        )
    read = [*places["Marker"], *(place for place in places["Rigid Body"] if place[0] in whole)]
    read = read or places["Rigid Body Marker"]
    if not read:
        raise DataFileError(f"{path} holds no markers: export it from Motive with its markers.")
    rate = number(keys.get("Export Frame Rate") or keys.get("Capture Frame Rate") or "")
    unit = keys.get("Length Units") or None
    return Layout(axes_line + 1, len(axes), read, unit, 0, rate=rate, turn=turn).read(rows, path)


def _read_vicon(rows: Rows, path: Path) -> Recording:
    """Reads the sections Objects (rigid bodies of Tracker) and Trajectories (markers),
    or Segments without these.

    Angles are rotation vectors ("helical"), unless there are quaternions.
    """
    found = {
        row[0].title(): line for line, row in enumerate(rows) if row and row[0].title() in _VICON
    }
    wanted = {"Objects", "Trajectories"} & {*found} or {"Segments"} & {*found}
    starts = [found[name] for name in sorted(wanted)]
    sections = [_vicon_section(rows, start, path) for start in starts]
    places, units = list[Place](), dict[int, str]()
    table, width = dict[str, list[str]](), 1
    for first, section, of_columns in sections:
        data = [*takewhile(any, rows[first:])]
        for row in data:  # with the same frame of another section
            cells = table.setdefault(row[0], [row[0]])
            cells += [""] * (width - len(cells)) + row
        labels = list(dict.fromkeys(label for label, *_ in section))
        taken = {label for label, *_ in places}
        short = {
            label: name
            for label, name in zip(labels, without_subject(labels), strict=True)
            if name not in taken
        }
        places += [
            (short.get(label, label), axis, width + column) for label, axis, column in section
        ]
        units |= {width + column: cell for column, cell in enumerate(of_columns)}
        width += max(map(len, data), default=0)
    lengths = {units.get(column, "") for _, axis, column in places if axis in AXES}
    rates = {number("".join(rows[start + 1][:1])) for start in starts}
    if len(lengths) != 1 or len(rates) != 1:
        raise DataFileError(
            f"{path} has no markers in one unit and at one rate (units: "
            f"{listed(sorted(lengths))}; rates: {listed(sorted(map(str, rates)))} Hz): export it "
            "from Vicon with its section 'Trajectories' or 'Objects'."
        )
    scale = (
        np.pi / 180.0
        if "deg" in {units.get(column) for _, axis, column in places if axis == "rx"}
        else 1.0
    )
    turn: Turn = (
        ("rx", "ry", "rz"),
        partial(quaternions, rotations=lambda v: Rotation.from_rotvec(scale * v)),
    )
    if any(axis == "rw" for _, axis, _ in places):
        turn = ("rw", "rx", "ry", "rz"), QUATERNION[1]
    first = sections[0][0]
    # Empty: occlusions.
    filled = [*rows[:first], *(cells + [""] * (width - len(cells)) for cells in table.values())]
    return Layout(first, width, places, lengths.pop(), 0, rate=rates.pop(), turn=turn).read(
        filled, path
    )


def _vicon_section(rows: Rows, at: int, path: Path) -> tuple[int, list[Place], list[str]]:
    """Returns the number of the first line of numbers in a section,
    the places of its coordinates, and its units.

    The lines before are its name, rate, names, axes, also of velocities, and in newer versions
    units.
    """
    if len(rows) < at + 6 or not "".join(rows[at + 3][:1]).startswith(("Frame", "Field")):
        raise DataFileError(
            f"{path} has no whole section '{rows[at][0]}': "
            "export it from Vicon Nexus or Tracker with its header."
        )
    axes, places = [_VICON_AXES.get(cell.lower(), "") for cell in rows[at + 3]], list[Place]()
    for column, name in enumerate(_filled(rows[at + 2], len(axes))):
        label = re.sub(r"^(?:Global|Local) Angle ", "", name)
        subject, _, segment = label.partition(":")
        if axes[column]:
            places.append((segment if subject == segment else label, axes[column], column))
    old = is_data(rows[at + 4])
    return at + 5 - old, places, [] if old else rows[at + 4]
