"""Tables of material tests: columns of time, strain or displacement, and stress or force; of membranes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ..io.arrays import Brief, FloatArray
from ..io.errors import DataFileError, did_you_mean, listed
from ..io.text import Rows, number, read_rows, read_text
from ..settings.data_kinds import TableSettings
from .recordings.recording import METRES_PER_UNIT

_PRESSURES: Final = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "psi": 6894.757}
_UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "time": {"s": 1.0, "min": 60.0, "ms": 1e-3},
    "strain": {"": 1.0, "%": 0.01},
    "displacement": {**METRES_PER_UNIT, "in": 0.0254},
    "stress": _PRESSURES,
    "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "lbf": 4.448222, "kgf": 9.80665, "gf": 9.80665e-3},
}
_SPELLED: Final = {"sec": "s", "seconds": "s", "N/mm²": "MPa", "N/mm2": "MPa", "mm/mm": "", "1": "", "inch": "in"}
_CELL: Final = re.compile(r"(.*?)[\s_]*(?:[\[(](.*)[\])])?")
_ALL_UNITS: Final = {*_SPELLED, *(unit for units in _UNITS.values() for unit in units)}
_PAIRS: Final = (("strain", "displacement"), ("stress", "force"))


def read_test(path: Path, table: TableSettings | None = None) -> dict[str, FloatArray]:
    """Returns the columns (N,) of a table in SI units, by their names; lines without a number are left out.

    Args:
        path: of the text file, whose header has ``time [s]``, ``strain`` or ``displacement [mm]``, and ``stress [kPa]``
            or ``force [N]``, of the undeformed section and length.
        table: columns of a file with another header.

    Raises:
        DataFileError: the file is no table, a column is missing, or a unit is not known.
    """
    rows = read_rows(path)
    first, named = _header(rows, path) if table is None else _described(rows, table, path)
    factors, names = dict[int, float](), dict[int, str]()
    for column, cell in named.items():
        name, unit = _name_and_unit(cell)
        if (known := _UNITS.get(name)) is None:
            if table is None:
                continue
            raise DataFileError(f"{path}: data.table has the column {cell!r}: choose from {', '.join(_UNITS)}.")
        if unit not in known:
            missing = f"the column {cell!r} has {'the unit ' + repr(unit) if unit else 'no unit'}"
            raise DataFileError(f"{path}: {missing}: write it as in '{name} [{'], ['.join(filter(None, known))}]'.")
        if name in names.values():
            raise DataFileError(f"{path} has two columns of {name}: leave one of them out in data.table.")
        names[column], factors[column] = name, known[unit]
    for pair in _PAIRS:
        if (present := [name for name in pair if name in names.values()]) != present[:1] or not present:
            raise DataFileError(
                f"{path} has {len(present)} of the columns {' and '.join(pair)}, of which a test has one. It has "
                f"{listed([*named.values()])}: name them in its header, as in 'time [s], strain, stress [kPa]', or in "
                "data.table."
            )
    values = [[number(row[column]) if column < len(row) else None for column in names] for row in rows[first:]]
    kept = np.array([one for one in values if None not in one], dtype=np.float64).reshape(-1, len(names))
    return {name: kept[:, k] * factors[column] for k, (column, name) in enumerate(names.items())}


_MEMBRANE: Final = ("thickness", "contact_radius", "ring1_radius", "ring1_width", "ring2_radius", "ring2_width")
_LIFTED: Final = ("height_mm", "pressure_Pa", "lifted_force_N")


@dataclass(frozen=True)
class MembraneTable(Brief):
    """Pressures at which an inflated membrane lifts a cap, in SI units."""

    thickness: float  # [m]
    cap: float  # radius of the cap [m]
    rings: tuple[tuple[float, float], ...]  # mean radius and half-width of each stiff ring [m]
    height: FloatArray  # (N,) of the cap above its place at rest [m]
    pressure: FloatArray  # (N,) [Pa]
    force: FloatArray  # (N,) weight of the cap [N]


def read_membrane(path: Path) -> MembraneTable:
    """Returns a table of membranes as published with arXiv 2504.01156.

    The first line, ``# thickness_mm,... = [2.0, ...]``, has thickness, radius of the cap, and mean radius and
    half-width of two rings, nan without them; the second one names the columns, height, pressure and force.

    Raises:
        DataFileError: the file is no such table.
    """
    lines = read_text(path).splitlines()
    head, _, tail = lines[0].partition("=") if lines else ("", "", "")
    names = [name.strip().removesuffix("_mm") for name in head.lstrip("# ").split(",")]
    values = [number(cell) for cell in tail.strip(" []").split(",")]
    sizes = {name: value for name, value in zip(names, values, strict=False) if value is not None}
    if lost := [name for name in _MEMBRANE if name not in sizes]:
        raise DataFileError(
            f"{path}, line 1 has no {lost[0]}_mm: begin the table of a membrane with '# {'_mm,'.join(_MEMBRANE)}_mm = "
            "[2.0, 25.4, nan, nan, nan, nan]'."
        )
    header = [cell.strip() for cell in lines[1].split(",")] if len(lines) > 1 else []
    if lost := [name for name in _LIFTED if name not in header]:
        raise DataFileError(f"{path}, line 2 has no column {lost[0]}: name the columns {', '.join(_LIFTED)}.")
    rows = [[number(cell) for cell in line.split(",")] for line in lines[2:] if line.strip()]
    if bad := [k for k, row in enumerate(rows, start=3) if len(row) != len(header) or None in row]:
        raise DataFileError(f"{path}, line {bad[0]}: give a number for each of the columns {', '.join(header)}.")
    table = np.array(rows, dtype=np.float64).reshape(-1, len(header))
    height, pressure, force = (table[:, header.index(name)] for name in _LIFTED)
    rings = [(1e-3 * sizes[f"ring{k}_radius"], 1e-3 * sizes[f"ring{k}_width"]) for k in (1, 2)]
    return MembraneTable(
        thickness=1e-3 * sizes["thickness"],
        cap=1e-3 * sizes["contact_radius"],
        rings=tuple(ring for ring in rings if np.isfinite(ring).all()),
        height=1e-3 * height,
        pressure=pressure,
        force=force,
    )


def _name_and_unit(cell: str) -> tuple[str, str]:
    """Returns name, in small letters, and unit of a column such as `Force (N)`; the unit may be empty."""
    match = _CELL.fullmatch(cell.strip())
    assert match is not None
    unit = (match[2] or "").strip()
    return match[1].lower(), _SPELLED.get(unit, unit)


def _header(rows: Rows, path: Path) -> tuple[int, dict[int, str]]:
    """Returns the number of the first line of numbers, and the cells of the line before, by column."""
    for line, row in enumerate(rows):
        filled = [cell for cell in row if cell]
        if line and len(filled) > 1 and all(number(cell) is not None for cell in filled):
            head, units = rows[line - 1], [""] * len(row)
            if line > 1 and all(cell.strip("[]()") in _ALL_UNITS for cell in head if cell):
                head, units = rows[line - 2], [cell.strip("[]()") for cell in head]  # units have a line of their own
            beside = {column: f" [{unit}]" if unit else "" for column, unit in enumerate(units)}
            return line, {column: cell + beside.get(column, "") for column, cell in enumerate(head) if cell}
    raise DataFileError(f"{path} has no line of numbers below a header: export it as CSV, with names of its columns.")


def _described(rows: Rows, table: TableSettings, path: Path) -> tuple[int, dict[int, str]]:
    """Returns the number of the first line of numbers, and the names of the columns by settings."""
    if not table.names:
        return table.header_lines, {column: cell for column, cell in enumerate(table.columns) if cell}
    header = rows[table.header_lines] if len(rows) > table.header_lines else []
    if lost := [name for name in table.names if header.count(name) != 1]:
        known = did_you_mean(lost[0], header) or f"; it has {listed([cell for cell in header if cell])}."
        raise DataFileError(f"{path}, line {table.header_lines + 1}: no single column is named {lost[0]!r}{known}")
    return table.header_lines + 1, {header.index(name): cell for name, cell in table.names.items()}
