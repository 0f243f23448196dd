"""Errors that the user can fix: each is one sentence, and the command line exits with code 2; and warnings."""

import difflib
import inspect
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from types import NoneType, UnionType
from typing import (
    Any,
    Final,
    Literal,
    ParamSpec,
    SupportsFloat,
    SupportsIndex,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

_LONGEST = 1000
# Types that count as others, and words for some.
_WIDER: Final[dict[Any, Any]] = {Sequence: Iterable, float: SupportsFloat, int: SupportsIndex}
_WORDS: Final[dict[Any, str]] = {Sequence: "a list", Mapping: "a mapping", Callable: "a function", NoneType: "None"}
P = ParamSpec("P")
R = TypeVar("R")


class ResphysError(Exception):
    """Base of all errors whose message is written for the user: what was wrong, where, and what to do.

    Messages may quote files and libraries; they are reduced to one line of limited length without control characters.
    """

    def __init__(self, message: object = "") -> None:
        line = "".join(letter if letter.isprintable() else " " for letter in str(message))
        super().__init__(line if len(line) <= _LONGEST else f"{line[:500]} ... {line[-300:]}")


class ResphysWarning(UserWarning):
    """Values that can be simulated and look like a mistake; `warnings.filterwarnings` with this class silences them."""


class InputError(ResphysError, ValueError):
    """An invalid argument or configuration value."""


class MeshError(InputError):
    """A mesh that cannot be read or is not valid for finite elements."""


class DataFileError(ResphysError):
    """A data file that is missing, damaged, of another program, or cannot be written."""


class DerivativeError(ResphysError, RuntimeError):
    """A derivative that a simulation does not have: of second order, in forward mode, or by ``torch.func``."""


class DecodingError(Exception):
    """A file that cannot be decoded; the message is the reason, without the file's name."""


class ConvergenceError(ResphysError, RuntimeError):
    """A solve that did not reach its tolerance.

    Attributes:
        positions: (B, N, 3) last iterate, on its device [m].
        report: iterations, residual and convergence of each environment.
    """

    def __init__(self, message: str, positions: Any, report: Any) -> None:
        super().__init__(message)
        self.positions = positions
        self.report = report


def warn(message: str) -> None:
    """Issues a `ResphysWarning` at the line of the user's program that led to it."""
    package, depth, frame = __name__.partition(".")[0], 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(f"{package}."):
        frame, depth = frame.f_back, depth + 1
    warnings.warn(message, ResphysWarning, stacklevel=depth)


def listed(names: Sequence[str]) -> str:
    """Returns names in quotation marks, separated by commas, for a message."""
    return ", ".join(f"'{name}'" for name in names) or "none"


def number_of(count: int, what: str) -> str:
    """Returns a number of things: "1 trial", "2 trials", "2 rigid bodies"."""
    return f"{count} {what}" if count == 1 else f"{count} {what[:-1]}ies" if what.endswith("y") else f"{count} {what}s"


def did_you_mean(wanted: str, known: Sequence[str], preferred: Sequence[str] = ()) -> str:
    """Returns ", did you mean ...?" with the names most similar to an unknown one; empty if none is similar.

    Args:
        wanted: the unknown name.
        known: existing names.
        preferred: existing names that are offered in any case.
    """
    offered = [name for name in dict.fromkeys(preferred) if name != wanted][:3]
    matches = offered or difflib.get_close_matches(wanted, [name for name in known if name != wanted], n=3, cutoff=0.6)
    return f", did you mean {' or '.join(repr(match) for match in matches)}?" if matches else ""


@contextmanager
def naming(group: str) -> Iterator[None]:
    """Prefixes errors with the name of a group."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{group}{error}") from error


def checks_types(function: Callable[P, R]) -> Callable[P, R]:
    """Returns a function that raises InputError for arguments of other types than it declares."""
    signature = inspect.signature(function)

    @wraps(function)
    def call(*given: P.args, **options: P.kwargs) -> R:
        hints = get_type_hints(function)
        for name, value in signature.bind(*given, **options).arguments.items():
            if get_origin(hints[name]) is Literal:
                choices = get_args(hints[name])
                if value not in choices:
                    raise InputError(f"{function.__name__}: {name} is {value!r}: choose {' or '.join(choices)}.")
                continue
            parts = get_args(hints[name]) if get_origin(hints[name]) in (Union, UnionType) else (hints[name],)
            kinds = [Mapping if is_typeddict(kind) else get_origin(kind) or kind for kind in parts]
            letters = isinstance(value, str) and str not in kinds  # which are no list of names
            if Any not in kinds and (letters or not isinstance(value, tuple(_WIDER.get(kind, kind) for kind in kinds))):
                words = " or ".join(_WORDS.get(kind, f"{kind.__module__}.{kind.__name__}") for kind in kinds)
                words = words.replace("builtins.", "")
                raise InputError(f"{function.__name__}: {name} is {in_short(value)}: it must be {words}.")
        return function(*given, **options)

    return call


def in_short(value: object) -> str:
    """Returns what a value is, for a message: the shape of an array, otherwise its type."""
    shape = getattr(value, "shape", None)
    return f"of type {type(value).__name__}" if shape is None else f"an array of shape {tuple(shape)}"
