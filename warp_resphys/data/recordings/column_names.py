"""Names of the columns of tables: which are coordinates of markers,
readings of force sensors, or channels, and units.

Loggers write the force of a sensor `load` along z as load.fz, load_fz, load/Fz, wrench.force.z or
Fz; moments are t or m. What has the unit of a force and no axis may be an input or a reading, and
is refused.
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from ...io.errors import DataFileError
from ..force_sensors import AXES as FORCES
from ..force_sensors import UNITS
from .recording import METRES_PER_UNIT, SI_PER_ACTUATION_UNIT, SI_PER_LOAD_UNIT, length_unit

Columns = Mapping[int, tuple[str, str | None]]  # names and units by number

AXES: Final = ("x", "y", "z")
SECONDS: Final = {
    **{"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3},
    **{"us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9},  # two letters, which look alike
}
_SPELLED: Final = {
    unit.lower(): unit for unit in ("px", "iso", *SI_PER_ACTUATION_UNIT, *SECONDS, *METRES_PER_UNIT)
}
UNIT_NAMES: Final = {*_SPELLED.values(), *SI_PER_LOAD_UNIT}
_NAMED_UNITS: Final = {*_SPELLED.values()} - {"1", "N"}  # of columns without square brackets
_PRODUCT: Final = re.compile(r"\s*[\s\u00b7\u22c5\u2219\u00d7*.-]\s*")
_AXIS: Final = r"(?P<axis>q?[xyz]|qw)"
DOTTED: Final = re.compile(rf"(?P<label>.+)\.{_AXIS}", re.IGNORECASE)
_FORMS: Final = (  # of names of coordinates; all but the first need a second axis beside them
    DOTTED,
    re.compile(rf"(?P<label>.+)[ _/]{_AXIS}", re.IGNORECASE),  # tip_x
    re.compile(r"(?P<axis>[xyz])[ _]?(?P<label>.+)", re.IGNORECASE),  # x1
    re.compile(r"(?P<label>.*)(?P<axis>[xyz])", re.IGNORECASE),  # tipX, x
)
_LOAD: Final = re.compile(  # of a force sensor
    r"(?:(?P<name>.+?)(?P<mark>[._/\s-]))?"
    r"(?:(?P<word>force|torque|moment)[._/\s-]?|(?P<kind>[ftm]))"
    r"(?P<axis>[xyz])",
    re.IGNORECASE,
)
_SENSED: Final = re.compile(
    r"^f[ _]?\d*$|force|load|cell|sensor|kraft|reaction|wrench", re.IGNORECASE
)
_DRIVEN: Final = re.compile(  # what moves by a length
    r"tendon|cable|wire|rope|string|winch|spool|motor|servo|muscle|actuator|stroke|piston|syringe",
    re.IGNORECASE,
)
UNNAMED: Final = "load"  # name of a sensor that has none


def unit_of(text: str) -> str:
    """Returns the usual spelling of a unit in any case; others stay."""
    unit = length_unit(text).removeprefix("in ")
    product = _PRODUCT.sub(" ", unit)
    known = {" ".join(sorted(word.split())): word for word in SI_PER_LOAD_UNIT}
    return _SPELLED.get(unit.lower(), known.get(" ".join(sorted(product.split())), unit))


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """Splits `name [unit]`, and `name (unit)` or `name_unit` with a known unit.

    None where there is no unit.
    """
    for opening, closing in (("[", "]"), ("(", ")"), ("_", ""), (" ", "")):
        name, bracket, text = cell.removesuffix(closing).rpartition(opening)
        unit, name = unit_of(text), name.rstrip()
        is_load = unit in SI_PER_LOAD_UNIT and (opening == "(" or _LOAD.fullmatch(name) is not None)
        if (
            bracket
            and cell.endswith(closing)
            and (opening == "[" or unit in _NAMED_UNITS or is_load)
        ):
            return name, unit
    return cell, None


def coordinates_of(columns: Columns) -> dict[int, tuple[str, str]]:
    """Returns label and axis by the number of those columns that are coordinates:
    tip.x, or tip_x, tip X, x1, tipX, x.

    Names that are not as in tip.x must have another axis beside them, and a length as their unit if
    they have one.
    """
    found = defaultdict[int, list[tuple[int, str, str]]](list)
    beside = defaultdict[tuple[int, str], set[str]](set)
    for column, (name, unit) in columns.items():
        for form, pattern in enumerate(_FORMS):
            match = pattern.fullmatch(name)
            if match and (pattern is DOTTED or unit in (None, "px", *METRES_PER_UNIT)):
                found[column].append((form, match["label"], match["axis"].lower()))
                beside[form, match["label"]].add(match["axis"].lower())
    result = dict[int, tuple[str, str]]()
    for column, options in found.items():
        for form, label, axis in options:
            if form == 0 or len(beside[form, label] & {*AXES}) > 1:
                result[column] = label, axis
                break
    return result


def load_of(head: str, unit: str | None, path: Path) -> tuple[str, int, float] | None:
    """Returns the sensor, index in `force_sensors.AXES` and factor to SI units of a column.

    None for another column.

    Raises:
        DataFileError: a force has the unit of a moment, or a moment that of a force, or neither has
            one; or a column in N has no axis.
    """
    kind, factor = SI_PER_LOAD_UNIT.get(unit or "", ("", 0.0))
    match = _LOAD.fullmatch(head)
    if match is None:
        if kind and _SENSED.search(head) and not _DRIVEN.search(head):
            raise DataFileError(
                f"{path}: the column '{head} [{unit}]' may be a reading of a force sensor or an "
                f"input: write '{UNNAMED}.fz [{unit}]' for a sensor, with its axis, or 'tendon "
                f"[{unit}]' for an input."
            )
        return None
    certain = match["name"] is None or match["mark"] == "." or match["word"] is not None
    other = (
        not certain
        if unit is None
        else unit != "1" and unit in {*SI_PER_ACTUATION_UNIT, *METRES_PER_UNIT, "px"}
    )
    if not kind and other:
        return None
    axis = ("f" if (match["word"] or match["kind"])[0].lower() == "f" else "t") + match[
        "axis"
    ].lower()
    name = match["name"] or UNNAMED
    if kind != axis[0]:
        given = "no unit" if unit is None else f"the unit '{unit}'"
        known = ", ".join(word for word, (of, _) in SI_PER_LOAD_UNIT.items() if of == axis[0])
        marker = (
            f", or '{head[:-1]}.{head[-1].lower()} [mm]' for a marker"
            if unit is None and len(head) == 2
            else ""
        )
        raise DataFileError(
            f"{path}: the column {head} of a force sensor has {given}: give one of {known} in "
            f"brackets, as in '{name}.{axis} [{UNITS[axis]}]'{marker}."
        )
    return name, FORCES.index(axis), factor


def is_channel(name: str, unit: str | None) -> bool:
    """Whether a column of a header is an input: by its unit,
    in a length also by its name, unlike misspelt markers.
    """
    return unit in SI_PER_ACTUATION_UNIT and (
        unit not in METRES_PER_UNIT or _DRIVEN.search(name) is not None
    )
