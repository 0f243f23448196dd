"""Checks that a table of a material test is one test of one specimen, with a clock and with units.

Limits are those of elastomers: silicones have shear moduli of 10 kPa and more, and of 19 silicones
of a public database none has a curve up to 300 % whose slopes differ by less than a quarter, or up
to 1200 % by less than a factor of two.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from ..io.arrays import BoolArray, Brief, FloatArray, IntArray
from ..io.errors import DataFileError, number_of

LEAST: Final = 5  # lines of a table that may be a test
_SOFTEST: Final = 1e3  # shear modulus below which a strain without a unit is asked about [Pa]
_SOFT: Final = 5e3  # shear modulus [Pa], and strain, of few silicones
_LONG: Final = 12.0
_FAR: Final = 3.0  # strain up to which no curve of an elastomer is straight
_STRAIGHT: Final = (1.25, 2.0)  # ratio of slopes of a straight curve; of one that is soft or long
_PARTS: Final = 5  # of the strains, with a slope each
_BEGINS: Final = 2.0  # steps of a clock from zero, up to which it begins
_AT_ONCE: Final = 10.0  # ratio of a step to the usual one
_PART: Final = 0.15  # of the range of a deformation, of such a step
_LEFT: Final = 0.3  # of a deformation, at most, that another specimen begins with


@dataclass(frozen=True)
class MeasuredTable(Brief):
    """A table of a test.

    Attributes:
        columns: (N,) by name, in SI units.
        lines: (N,) of the file.
        bare: header of a strain without a unit.
        notes: sentences on what was left out.
    """

    columns: dict[str, FloatArray]
    lines: IntArray
    bare: str | None = None
    notes: tuple[str, ...] = ()

    def without(self, rows: BoolArray, why: str) -> "MeasuredTable":
        """Returns the table without some rows (N,), and with a sentence on them."""
        if not rows.any():
            return self
        note = left_out(int(rows.sum()), len(rows), f"{lines_of(self.lines[rows])}, {why}")
        kept = {name: values[~rows] for name, values in self.columns.items()}
        return replace(self, columns=kept, lines=self.lines[~rows], notes=(*self.notes, note))


def left_out(count: int, total: int, which: str) -> str:
    """Returns the sentence on samples that do not count."""
    return f"{count} of {number_of(total, 'sample')} left out: {which}."


def lines_of(lines: Sequence[int] | IntArray) -> str:
    """Returns the first lines of some, for a sentence."""
    shown, more = [str(line) for line in lines[:3]], len(lines) - 3
    words = ", ".join(shown) + (f" and {more} more" if more > 0 else "")
    return f"line{'s' * (len(lines) > 1)} {words}"


def in_time(read: MeasuredTable, shown: str, path: Path) -> MeasuredTable:
    """Returns a table whose times rise: a clock that begins anew goes on from the time before.

    Args:
        read: the table.
        shown: column that shows how far the specimen is deformed.
        path: of the table.

    Raises:
        DataFileError: another specimen begins, where the clock falls or is missing and the
            deformation falls at once.
    """
    seconds = read.columns.get("time")
    steps = np.zeros(0) if seconds is None else np.diff(seconds)
    falls = np.flatnonzero(steps < 0.0) + 1
    length = read.columns[shown]
    begins = [row for row in _restarts(length) if seconds is None or row in falls]
    if begins:
        before, after = length[begins[0] - 1], length[begins[0]]
        raise DataFileError(
            f"{path}, line {read.lines[begins[0]]}: the {shown} falls from {before:.3g} to "
            f"{after:.3g} at once, as where another specimen or cycle begins: write each "
            "specimen into a file of its own, "
            "and cycles with their unloading and the time since the start."
        )
    if seconds is None or not len(steps):
        return read
    usual, repeated = float(np.median(np.abs(steps))), np.append(False, steps == 0.0)
    after = np.append(steps, usual)
    anew = [row for row in falls if 0.0 <= seconds[row] <= _BEGINS * after[row]]
    if len(anew) < len(falls) or 2 * repeated.sum() > len(seconds):
        row = falls[0] if len(falls) else int(np.argmax(repeated))
        what = (
            f"falls from {seconds[row - 1]:g} to {seconds[row]:g} s"
            if len(falls)
            else "stands still"
        )
        note = (
            f"The time {what} in line {read.lines[row]}: "
            "times are not read, which relaxing branches need."
        )
        columns = {name: values for name, values in read.columns.items() if name != "time"}
        return replace(read, columns=columns, notes=(*read.notes, note))
    if anew:
        joined = seconds.copy()
        for row in anew:
            joined[row:] += seconds[row - 1] + (after[row] if seconds[row] == 0.0 else 0.0)
        note = (
            f"The time begins anew in {lines_of(read.lines[anew])}: "
            "it was taken to go on from the line before."
        )
        read = replace(read, columns={**read.columns, "time": joined}, notes=(*read.notes, note))
    return read.without(repeated, "which repeat the time before them")


def _restarts(length: FloatArray) -> list[int]:
    """Returns the rows where a deformation (N,) falls back at once,
    and from where it grows again, but not at once.
    """
    steps = np.diff(length)
    if len(steps) < 2 * LEAST:
        return []
    at_once = np.abs(steps) > max(
        _AT_ONCE * float(np.median(np.abs(steps))), _PART * float(np.ptp(length))
    )
    back = at_once & (np.abs(length[1:]) < _LEFT * np.abs(length[:-1]))
    if (at_once & (np.abs(length[1:]) > np.abs(length[:-1]))).any():
        return []  # steps to and fro
    found = list[int]()
    for row in np.flatnonzero(back) + 1:
        before, after = abs(length[row - 1]), np.abs(length[row:])
        if (
            row >= LEAST
            and len(after) >= LEAST
            and after[:LEAST].max() < 0.5 * before < 5.0 * (after.max() - after[0])
        ):
            found.append(int(row))
    return found


def check_no_stretch(read: MeasuredTable, path: Path) -> None:
    """Refuses a strain that is one where the load is least, and grows or falls from there."""
    strain = read.columns["strain"]
    load = np.abs(read.columns["stress" if "stress" in read.columns else "force"])
    unloaded = float(strain[np.argmin(load)]) if len(load) else 0.0
    if len(strain) < LEAST or not 0.9 <= unloaded <= 1.1:
        return
    away = np.abs(strain - 1.0)
    near = away <= np.median(away)
    grows = np.median(load[near]) < 0.8 * np.median(load[~near]) if not near.all() else False
    if (strain.min() >= 0.9 or strain.max() <= 1.1) and load.min() < 0.2 * load.max() and grows:
        raise DataFileError(
            f"{path}: the strain is {unloaded:.3g} in line {read.lines[np.argmin(load)]}, where "
            "the load is least, as a stretch is: name its column 'stretch', or subtract 1."
        )


def check_unit(read: MeasuredTable, strain: FloatArray, stress: FloatArray, path: Path) -> None:
    """Refuses a strain without a unit that is in per cent by its curve.

    Args:
        read: the table.
        strain: (N,) of the specimen.
        stress: (N,) nominal [Pa].
        path: of the table.

    Raises:
        DataFileError: as the strain would be of a material that is softer than silicones, or whose
            curve is straight where none of an elastomer is.
    """
    most = float(np.abs(strain).max()) if len(strain) else 0.0
    if read.bare is None or not most:
        return
    modulus = float(np.median(np.abs(stress[strain != 0.0] / strain[strain != 0.0]))) / 3.0
    limit = _STRAIGHT[modulus < _SOFT or most > _LONG]
    if modulus < _SOFTEST or (most >= _FAR and _spread(np.abs(strain), np.abs(stress)) < limit):
        raise DataFileError(
            f"{path}: the column {read.bare!r} has no unit and reaches {most:.3g}; if that were "
            f"{100.0 * most:.5g} %, the curve would be none of an elastomer (shear modulus "
            f"{1e-3 * modulus:.2g} kPa): write '{read.bare} [%]' if it is in per cent, "
            f"'{read.bare} [1]' if not."
        )


def _spread(strain: FloatArray, load: FloatArray) -> float:
    """The ratio of the largest and the smallest slope of a curve up to its largest strain."""
    end = int(np.argmax(strain)) + 1
    edges, slopes = np.linspace(strain[:end].min(), strain[:end].max(), _PARTS + 1), list[float]()
    for low, high in pairwise(edges):
        rows = (strain[:end] >= low) & (strain[:end] <= high)
        if rows.sum() < 3 or not np.ptp(strain[:end][rows]):
            return np.inf
        slopes.append(float(np.polyfit(strain[:end][rows], load[:end][rows], 1)[0]))
    return max(slopes) / min(slopes) if min(slopes) > 0.0 else np.inf
