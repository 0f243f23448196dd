"""What a configuration may hold: the kind, the range and the unit of every value, each in one place."""

import math
import numbers
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ..io.errors import InputError


def is_whole_number(value: Any) -> bool:
    """Whether it is an integer, and no truth value."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a real number, and no truth value."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether it is a finite number."""
    return is_number(value) and math.isfinite(value)


@dataclass(frozen=True)
class Kind:
    """What the value of a key must be.

    Attributes:
        fits: tells whether a value is of the kind.
        wanted: the kind in words, as in "it must be a word".
        optional: whether it may be null.
        absent: whether its key may be left out.
    """

    fits: Callable[[Any], bool]
    wanted: str
    optional: bool = False
    absent: bool = False


@dataclass(frozen=True)
class Group:
    """What a group of settings must be.

    Attributes:
        keys: by name, what their values must be.
        each: what the values of any other keys must be; None where there are none.
        optional: whether it may be null.
        absent: whether its key may be left out.
        short: whether a word may stand for it.
    """

    keys: Mapping[str, "Kind | Group"] = field(default_factory=dict)
    each: "Kind | Group | None" = None
    optional: bool = False
    absent: bool = False
    short: bool = False


Spec = Kind | Group


def optional(spec: Any) -> Any:
    """The same, or null."""
    return replace(spec, optional=True)


def absent(spec: Any) -> Any:
    """The same, or left out."""
    return replace(spec, absent=True)


def one_of(*words: Any) -> Kind:
    """One of some words."""
    return Kind(lambda value: isinstance(value, str) and value in words, f"one of {', '.join(words)}")


def _number(fits: Callable[[Any], bool], wanted: str) -> Kind:
    return Kind(lambda value: is_finite(value) and fits(value), wanted)


def _whole(least: int, wanted: str, most: float = math.inf) -> Kind:
    return Kind(lambda value: is_whole_number(value) and least <= value <= most, wanted)


def _list(each: Kind, wanted: str, counts: Sequence[int] | None = None, different: bool = False) -> Kind:
    """A list of values of a kind, of any length or one of these counts."""

    def fits(value: Any) -> bool:
        if not isinstance(value, list) or not all(map(each.fits, value)):
            return False
        return (counts is None or len(value) in counts) and not (different and len({*value}) < len(value))

    return Kind(fits, wanted)


def _is_word(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and all(_list(FINITE, "", [len(value)]).fits(row) for row in value)


def _is_place(value: Any) -> bool:
    return _list(FINITE, "", [3]).fits(value)


def at_most(limit: int) -> Kind:
    """A whole number from one on, up to a limit beyond which nothing fits a machine."""
    return _whole(1, f"a whole number from 1 to {limit:,}", limit)


WORD: Final = Kind(_is_word, "a word")
NAME: Final = Kind(
    lambda value: isinstance(value, str) and re.fullmatch(r"[\w-]+", value) is not None,
    "letters, digits, _ and - alone, as a folder is named so",
)
ANYTHING: Final = Kind(lambda _: True, "anything", optional=True)
TRUTH_VALUE: Final = Kind(lambda value: isinstance(value, bool), "true or false")
NUMBER: Final = Kind(is_number, "a number")
FINITE: Final = Kind(is_finite, "a finite number")
POSITIVE: Final = _number(lambda value: value > 0.0, "a positive number")
NOT_NEGATIVE: Final = _number(lambda value: value >= 0.0, "a number, zero or more")
SHARE: Final = _number(lambda value: 0.0 < value <= 1.0, "more than 0 and at most 1")
NATURAL: Final = _whole(1, "a whole number, one or more")
COUNT: Final = _whole(0, "a whole number, zero or more")
_SOME: Final = range(1, sys.maxsize)
NATURALS: Final = _list(NATURAL, "a list of whole numbers, one or more", _SOME)
COUNTS: Final = _list(COUNT, "a list of different whole numbers, zero or more each", different=True)
NUMBERS: Final = _list(NUMBER, "a list of numbers")
_TOLERANCE: Final = _number(lambda value: 0.0 < value <= 0.1, "more than 0 and at most 0.1")
_STEP: Final = _number(lambda value: 0.0 < value <= 10.0, "positive and at most 10, in s")
_PLACE: Final = Kind(_is_place, "three numbers, in metres")
_FORCE: Final = Kind(_is_place, "three numbers, in N")
_AXIS: Final = Kind(lambda value: _is_place(value) and any(value), "three numbers, not all zero")
_PLACES: Final = Kind(
    lambda value: isinstance(value, list) and len(value) > 1 and all(map(_is_place, value)),
    "a list of two or more places of three numbers, in m",
)
_RADII: Final = Kind(
    lambda value: (
        POSITIVE.fits(value)
        or (isinstance(value, list) and all(_list(FINITE, "", [2, 3]).fits(each) for each in value))
    ),
    "a positive number, or a list of arc lengths with one or two radii there, in m",
)
_POSITIVES: Final = _list(POSITIVE, "a list of positive numbers")
_COLUMNS: Final = _list(NATURAL, "a list of different chambers, tendons or muscles, from 1", _SOME, different=True)
_ORDER: Final = Kind(lambda value: value in (1, 2), "1 or 2")
_TRIALS: Final = Kind(
    lambda value: COUNT.fits(value) or (isinstance(value, list) and all(map(_is_word, value))),
    "a number of trials, or a list of their names",
)

_SPAN: Final = Kind(
    lambda value: _list(FINITE, "", [2]).fits(value) and value[0] <= value[1], "two rising numbers, in m"
)
_AT: Final = Kind(lambda value: FINITE.fits(value) or _SPAN.fits(value), "a finite number or two rising ones, in m")
PLACE: Final = Group({key: absent(optional(_AT)) for key in ("x", "y", "z")} | {"tolerance": absent(POSITIVE)})
MATERIAL: Final = Group({"model": absent(WORD)}, each=NUMBER)


def check(name: str, value: Any, spec: Spec) -> None:
    """Compares a value, or a whole group of settings, with what it must be.

    Args:
        name: its dotted key, for messages; empty for a whole configuration.
        value: to be compared.
        spec: what it must be.

    Raises:
        InputError: a group that is none, a key that is unknown or missing, or a value of another kind or out of range.
    """
    if value is None and spec.optional:
        return
    if isinstance(spec, Kind):
        if not spec.fits(value):
            null = ", or null" if spec.optional and not spec.wanted.endswith("null") else ""
            raise InputError(f"{name} is {value!r}: it must be {spec.wanted}{null}.")
        return
    if spec.short and _is_word(value):
        return
    if not isinstance(value, Mapping):
        raise InputError(f"{name} is {value!r}: it must be a group of settings.")
    at = f"{name}." if name else ""
    for key, each in value.items():
        if key in spec.keys:
            check(f"{at}{key}", each, spec.keys[key])
        elif spec.each is not None:
            check(f"{at}{key}", each, spec.each)
        else:
            known = f": {name} has {', '.join(spec.keys)}" if name else ""
            raise InputError(f"unknown key '{at}{key}'{known}.")
    for key, each_spec in spec.keys.items():
        if key not in value and not each_spec.absent:
            raise InputError(f"{at}{key} is missing{f': {name} needs it' if name else ''}.")


def dotted(groups: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested settings."""
    for key, value in groups.items():
        if isinstance(value, Mapping) and value:
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
