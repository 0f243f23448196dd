"""Kinds of configured values."""

import math
import numbers
from typing import Any


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
