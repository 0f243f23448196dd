"""Kinds of configured values."""

import math
import numbers
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..io.errors import InputError


def is_word(value: Any) -> bool:
    """Whether it is text."""
    return isinstance(value, str)


def is_whole_number(value: Any) -> bool:
    """Whether it is an integer, and no truth value."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a real number, and no truth value."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether it is a finite number."""
    return is_number(value) and math.isfinite(value)


def is_list(value: Any) -> bool:
    """Whether it is a list of numbers."""
    return isinstance(value, list) and all(is_number(each) for each in value)


@dataclass(frozen=True)
class Kind:
    """What the value of a key must be.

    Attributes:
        fits: tells whether a value is of the kind.
        wanted: the kind in words, as in "it must be a word".
        optional: whether it may be null.
    """

    fits: Callable[[Any], bool]
    wanted: str
    optional: bool = False


WORD = Kind(is_word, "a word")
GROUP = Kind(lambda value: isinstance(value, Mapping), "a group of settings")
FINITE = Kind(is_finite, "a finite number")
POSITIVE = Kind(lambda value: is_finite(value) and value > 0.0, "a positive number")
NOT_NEGATIVE = Kind(lambda value: is_finite(value) and value >= 0.0, "a number, zero or more")
NATURAL = Kind(lambda value: is_whole_number(value) and value > 0, "a whole number, one or more")
COUNT = Kind(lambda value: is_whole_number(value) and value >= 0, "a whole number, zero or more")
NATURALS = Kind(
    lambda value: isinstance(value, list) and bool(value) and all(map(NATURAL.fits, value)),
    "a list of whole numbers, one or more",
)
TRUTH_VALUE = Kind(lambda value: isinstance(value, bool), "true or false")


def one_of(*words: str) -> Kind:
    """One of some words."""
    return Kind(lambda value: is_word(value) and value in words, f"one of {', '.join(words)}")


def optional(kind: Kind) -> Kind:
    """The same, or null."""
    return replace(kind, optional=True)


def check_keys(group: str, settings: Any, kinds: Mapping[str, Kind], others: Sequence[str] = ()) -> None:
    """Checks that a group of settings has certain keys and no more, each with a value of its kind.

    Args:
        group: its dotted name, for messages.
        settings: the group.
        kinds: of the keys that it must have.
        others: keys that it may have, with any value.

    Raises:
        InputError: it is no group, a key is unknown or missing, or a value is of another kind.
    """
    if not isinstance(settings, Mapping):
        raise InputError(f"{group} is {settings!r}: it must be {GROUP.wanted}.")
    for key in settings:
        if key not in kinds and key not in others:
            raise InputError(f"unknown key '{group}.{key}': {group} has {', '.join(kinds)}.")
    for key, kind in kinds.items():
        if key not in settings:
            raise InputError(f"{group}.{key} is missing: {group} needs {', '.join(kinds)}.")
        check_kind(f"{group}.{key}", settings[key], kind)


def check_kind(name: str, value: Any, kind: Kind) -> None:
    """Raises InputError if a value is not of its kind."""
    if not (value is None and kind.optional) and not kind.fits(value):
        raise InputError(f"{name} is {value!r}: it must be {kind.wanted}.")


def dotted(groups: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested settings."""
    for key, value in groups.items():
        if isinstance(value, Mapping) and value:
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
