"""Tables of material tests: columns of time, strain or displacement, and stress or force.

Of membranes.

A line whose cells are no numbers is left out, and named. What says that the table is not one test
is refused: a time that falls, a header that is repeated, a strain that falls back at once, and
strains that no elastomer has.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from ..io.arrays import BoolArray, Brief, FloatArray
from ..io.errors import DataFileError, did_you_mean, listed, warn
from ..io.text import Rows, number, read_rows, read_text
from ..settings.data_kinds import TableSettings
from .material_checks import (
    LEAST,
    MeasuredTable,
    check_no_stretch,
    check_unit,
    in_time,
    left_out,
    lines_of,
)
from .recordings.recording import METRES_PER_UNIT

_PRESSURES: Final = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "psi": 6894.757}
_UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "time": {"s": 1.0, "min": 60.0, "ms": 1e-3},
    "strain": {"1": 1.0, "%": 0.01},
    "stretch": {"1": 1.0},
    "displacement": {**METRES_PER_UNIT, "um": 1e-6, "in": 0.0254},
    "stress": _PRESSURES,
    "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "lbf": 4.448222, "kgf": 9.80665, "gf": 9.80665e-3},
}
_BARE: Final = ("strain", "stretch")  # that may have no unit
# Where no column has the word itself.
_SYNONYMS: Final = {"extension": "displacement", "load": "force"}
_SPELLED: Final = {
    "sec": "s",
    "S": "s",
    "seconds": "s",
    "N/mm²": "MPa",
    "N/mm2": "MPa",
    "inch": "in",
    "\u00b5m": "um",
    "\u03bcm": "um",
} | dict.fromkeys(("mm/mm", "m/m", "in/in", "-", "\u2013"), "1")
_CELL: Final = re.compile(r"(.*?)[\s_]*(?:[\[(](?:in )?(.*)[\])])?")
_SUFFIX: Final = re.compile(r"(\w+?)(?:_|\s*/\s*)([^\s_/]+)")  # Force_N, Kraft / N
_ALL_UNITS: Final = {*_SPELLED}.union(*_UNITS.values())
_PAIRS: Final = (("strain", "displacement", "stretch"), ("stress", "force"))


def read_test(path: Path, table: TableSettings | None = None) -> dict[str, FloatArray]:
    """Returns columns (N,) of a table in SI units, by their names, and warns of what is left out.

    For arguments and errors see `read_measured`.
    """
    read = read_measured(path, table)
    for note in read.notes:
        warn(f"{path}: {note}")
    return read.columns


def read_measured(path: Path, table: TableSettings | None = None) -> MeasuredTable:
    """Reads a table; lines without a number, and those that repeat a time, are left out.

    Args:
        path: of the text file, whose header has ``time [s]``, ``strain``, ``stretch`` or
            ``displacement [mm]``, and ``stress [kPa]`` or ``force [N]``, of the undeformed section
            and length.
        table: columns of a file with another header.

    Raises:
        DataFileError: the file is no table, a column is missing, a unit is not known, the lines are
            not of one test, or strains without a unit are none of an elastomer.
    """
    rows = read_rows(path)
    first, named = _header(rows, path) if table is None else _described(rows, table, path)
    names, factors, bare = _meanings(named, rows[first:], table is None, path)
    read = replace(_numbers(rows, first, names, factors, path), bare=bare)
    if table is None:
        words = [
            cell
            for column, cell in named.items()
            if column not in names and _is_text(rows[first:], column)
        ]
        notes = (
            *read.notes,
            *([f"Columns of text are not read: {listed(words)}."] if words else []),
        )
        read = replace(read, notes=notes)
    read = in_time(read, next(name for name in _PAIRS[0] if name in read.columns), path)
    if "strain" in read.columns:
        check_no_stretch(read, path)
        if "stress" in read.columns:
            check_unit(read, read.columns["strain"], read.columns["stress"], path)
    if "stretch" in read.columns:
        columns = dict(read.columns)
        strain = columns.pop("stretch") - 1.0
        read = replace(
            read, columns={**columns, "strain": strain if strain.sum() > 0.0 else -strain}
        )
    return read


def _meanings(
    named: Mapping[int, str], rows: Rows, by_header: bool, path: Path
) -> tuple[dict[int, str], dict[int, float], str | None]:
    """Quantities and factors to SI units by column, and the header of a strain without a unit."""
    factors, names = dict[int, float](), dict[int, str]()
    bare = None
    cells = {column: _name_and_unit(cell) for column, cell in named.items()}
    words = [name for name, _ in cells.values()]
    for column, (word, unit) in cells.items():
        name = word if _SYNONYMS.get(word, word) in words else _SYNONYMS.get(word, word)
        known = _UNITS.get(name)
        if known is None:
            if by_header:
                continue
            raise DataFileError(
                f"{path}: data.table has the column {named[column]!r}: choose from "
                f"{', '.join(_UNITS)}."
            )
        if unit not in known and not (unit == "" and name in _BARE):
            text = all(number(row[column]) is None for row in rows if column < len(row))
            if by_header and (
                (name == "time" and text)
                or any(w == word and u in known for w, u in cells.values())
            ):
                continue  # a clock in words, or the same quantity in volts
            missing = (
                f"the column {named[column]!r} has "
                f"{'the unit ' + repr(unit) if unit else 'no unit'}"
            )
            raise DataFileError(
                f"{path}: {missing}: write it as in '{name} [{'], ['.join(known)}]'."
            )
        if name in names.values():
            raise DataFileError(
                f"{path} has two columns of {name}: leave one of them out in data.table."
            )
        names[column], factors[column] = name, known[unit or "1"]
        bare = named[column] if name == "strain" and not unit else bare
    for pair in _PAIRS:
        present = [name for name in pair if name in names.values()]
        if len(present) != 1:
            raise DataFileError(
                f"{path} has {len(present)} of the columns {' and '.join(pair[:2])}, of which a "
                f"test has one. It has {listed([*named.values()])}: name them in its header, as "
                "in 'time [s], strain, stress [kPa]', or in data.table."
            )
    return names, factors, bare


def _numbers(
    rows: Rows, first: int, names: Mapping[int, str], factors: Mapping[int, float], path: Path
) -> MeasuredTable:
    """Returns the columns of the lines with numbers."""
    header = rows[first - 1] if first else []
    width = len(header) if any(header) else max(map(len, rows[first : first + 1]), default=0)
    values = list[list[float]]()
    lines, lost = list[int](), list[int]()
    for line, row in enumerate(rows[first:], start=first + 1):
        if not any(row):
            continue
        if row == header:
            raise DataFileError(
                f"{path}, line {line} repeats the header of line {first}: a table has one test "
                "of one specimen; write each into a file of its own."
            )
        if any(row[width:]):
            raise DataFileError(
                f"{path}, line {line} has {len(row)} cells where its header has {width}: leave "
                "out marks between thousands, put text with commas in quotation marks, "
                "and name each column."
            )
        cells = [row[column] if column < len(row) else "" for column in names]
        given = [number(cell) for cell in cells]
        broken = next(
            (k for k, cell in enumerate(cells) if given[k] is None and cell[:1].isdecimal()), None
        )
        if broken is not None:
            name = [*names.values()][broken]
            raise DataFileError(
                f"{path}, line {line}: {cells[broken]!r} in the column of {name} is not a number."
            )
        known = [value for value in given if value is not None and np.isfinite(value)]
        if len(known) == len(names):
            values.append(known)
            lines.append(line)
        elif any(cells):
            lost.append(line)
    kept = np.array(values, dtype=np.float64).reshape(-1, len(names))
    columns = {name: kept[:, k] * factors[column] for k, (column, name) in enumerate(names.items())}
    read = MeasuredTable(columns, np.array(lines, dtype=np.int64))
    if not lost:
        return read
    which = f"{lines_of(lost)}, without a number in each column"
    return replace(read, notes=(left_out(len(lost), len(lost) + len(lines), which),))


def _is_text(rows: Rows, column: int) -> bool:
    """Whether a column has words, and no number."""
    filled = [row[column] for row in rows if column < len(row) and row[column]]
    return bool(filled) and all(number(cell) is None for cell in filled)


_MEMBRANE: Final = (
    "thickness",
    "contact_radius",
    "ring1_radius",
    "ring1_width",
    "ring2_radius",
    "ring2_width",
)
_LIFTED: Final = ("height_mm", "pressure_Pa", "lifted_force_N")
_DIGITS: Final = 3  # of a weight [N]
_SCATTER: Final = 0.01  # of a weight that is measured


@dataclass(frozen=True)
class MembraneTable(Brief):
    """Pressures at which an inflated membrane lifts a cap, in SI units."""

    thickness: float  # [m]
    cap: float  # radius of the cap [m]
    rings: tuple[tuple[float, float], ...]  # mean radius and half-width of each stiff ring [m]
    height: FloatArray  # (N,) of the cap above its place at rest [m]
    pressure: FloatArray  # (N,) [Pa]
    force: FloatArray  # (N,) weight of the cap [N]

    def weights(self) -> tuple[dict[str, tuple[float, BoolArray]], list[str]]:
        """Returns weights [N] and rows (N,) by a name of their own,
        such as '14.7 N', and what was left out.

        A measured force scatters: where values repeat in fewer than five rows, those within 1 % of
        the next are one.
        """
        force, notes = self.force.round(_DIGITS), list[str]()
        values, number_of_row, counts = np.unique(force, return_inverse=True, return_counts=True)
        if (counts < LEAST).any():
            group = np.cumsum(np.append(False, np.diff(values) > _SCATTER * values[1:]))
            number_of_row = group[number_of_row]
            values = np.bincount(number_of_row, force) / np.bincount(number_of_row)
            scatter = max(float(np.ptp(force[number_of_row == k])) for k in range(len(values)))
            if scatter:
                notes.append(
                    f"Forces that differ by less than {100.0 * _SCATTER:g} % count as one weight."
                )
        few = np.bincount(number_of_row)[number_of_row] < LEAST
        if few.any():
            notes.append(
                left_out(
                    int(few.sum()),
                    len(few),
                    f"under {force[few][0]:g} N, fewer than {LEAST} of a weight",
                )
            )
        kept, digits = np.unique(number_of_row[~few]), 3
        while len({f"{values[k]:.{digits}g}" for k in kept}) < len(kept):
            digits += 1
        return {
            f"{values[k]:.{digits}g} N": (float(values[k]), number_of_row == k) for k in kept
        }, notes


def read_membrane(path: Path) -> MembraneTable:
    """Returns a table of membranes as published with arXiv 2504.01156.

    The first line, ``# thickness_mm,... = [2.0, ...]``, has thickness, radius of the cap, and mean
    radius and half-width of two rings, nan without them; the second one names the columns, height,
    pressure and force.

    Raises:
        DataFileError: the file is no such table.
    """
    lines = read_text(path).splitlines()
    head, _, tail = lines[0].partition("=") if lines else ("", "", "")
    names = [name.strip().removesuffix("_mm") for name in head.lstrip("# ").split(",")]
    values = [number(cell) for cell in tail.strip(" []").split(",")]
    sizes = {name: value for name, value in zip(names, values, strict=False) if value is not None}
    lost = [name for name in _MEMBRANE if name not in sizes]
    if lost:
        raise DataFileError(
            f"{path}, line 1 has no {lost[0]}_mm: begin the table of a membrane with '# "
            f"{'_mm,'.join(_MEMBRANE)}_mm = [2.0, 25.4, nan, nan, nan, nan]'."
        )
    header = [cell.strip() for cell in lines[1].split(",")] if len(lines) > 1 else []
    lost = [name for name in _LIFTED if name not in header]
    if lost:
        raise DataFileError(
            f"{path}, line 2 has no column {lost[0]}: name the columns {', '.join(_LIFTED)}."
        )
    written = [line for line in lines[2:] if line.strip()]
    rows = [list(map(number, line.split(","))) for line in written]
    for line, row in enumerate(rows, start=3):
        if len(row) != len(header) or None in row:
            raise DataFileError(
                f"{path}, line {line}: give a number for each of the columns {', '.join(header)}."
            )
    table = np.array(rows, dtype=np.float64).reshape(-1, len(header))
    columns = {name: table[:, header.index(name)] for name in _LIFTED}
    rings = [(1e-3 * sizes[f"ring{k}_radius"], 1e-3 * sizes[f"ring{k}_width"]) for k in (1, 2)]
    return MembraneTable(
        thickness=1e-3 * sizes["thickness"],
        cap=1e-3 * sizes["contact_radius"],
        rings=tuple(ring for ring in rings if np.isfinite(ring).all()),
        height=1e-3 * columns["height_mm"],
        pressure=columns["pressure_Pa"],
        force=columns["lifted_force_N"],
    )


def _name_and_unit(cell: str) -> tuple[str, str]:
    """Returns name, in small letters, and unit of a column such as `Force (N)` or `Force_N`.

    The unit may be empty.
    """
    match = _CELL.fullmatch(cell.strip())
    assert match is not None
    name, unit = match[1].lower(), (match[2] or "").strip()
    suffix = _SUFFIX.fullmatch(cell.strip())
    if not unit and suffix is not None and _SPELLED.get(suffix[2], suffix[2]) in _ALL_UNITS:
        name, unit = suffix[1].lower(), suffix[2]
    return name, _SPELLED.get(unit, unit)


def _header(rows: Rows, path: Path) -> tuple[int, dict[int, str]]:
    """Returns the number of the first line of numbers, and the cells of the line before, by column.

    Of several tables in a file, such as results above the samples, it is the longest with the
    columns of a test.
    """
    starts = [
        line
        for line in range(1, len(rows))
        if _has_numbers(rows[line]) and not _has_numbers(rows[line - 1])
    ]
    found = list[tuple[bool, int, int, dict[int, str]]]()
    for start, stop in pairwise([*starts, len(rows)]):
        above = [line for line in range(start) if any(rows[line])][-2:]
        head, units = rows[above[-1]] if above else [], [""] * len(rows[start])
        if len(above) > 1 and all(cell.strip("[]()") in _ALL_UNITS for cell in head if cell):
            # Units have a line of their own.
            head, units = rows[above[0]], [cell.strip("[]()") for cell in head]
        beside = {column: f" [{unit}]" if unit else "" for column, unit in enumerate(units)}
        cells = {column: cell + beside.get(column, "") for column, cell in enumerate(head) if cell}
        words = {_SYNONYMS.get(word, word) for word, _ in map(_name_and_unit, cells.values())}
        count = sum(map(_has_numbers, rows[start:stop]))
        found.append((all(words & {*pair} for pair in _PAIRS), count, start, cells))
    whole = [one for one in found if one[0] and one[1] >= LEAST]
    if len(whole) > 1:
        raise DataFileError(
            f"{path} has {len(whole)} tables, whose numbers begin in "
            f"{lines_of([one[2] + 1 for one in whole])}: "
            "write each specimen into a file of its own."
        )
    if not found:
        raise DataFileError(
            f"{path} has no line of numbers below a header: "
            "export it as CSV, with names of its columns."
        )
    return max(found, key=lambda one: one[:2])[2:]


def _has_numbers(row: Sequence[str]) -> bool:
    """Whether a line has two numbers or more."""
    return sum(number(cell) is not None for cell in row) > 1


def _described(rows: Rows, table: TableSettings, path: Path) -> tuple[int, dict[int, str]]:
    """Returns the number of the first line of numbers, and the names of the columns by settings."""
    if not table.names:
        return table.header_lines, {
            column: cell for column, cell in enumerate(table.columns) if cell
        }
    header = rows[table.header_lines] if len(rows) > table.header_lines else []
    lost = [name for name in table.names if header.count(name) != 1]
    if lost:
        known = (
            did_you_mean(lost[0], header)
            or f"; it has {listed([cell for cell in header if cell])}."
        )
        raise DataFileError(
            f"{path}, line {table.header_lines + 1}: no single column is named {lost[0]!r}{known}"
        )
    return table.header_lines + 1, {header.index(name): cell for name, cell in table.names.items()}
