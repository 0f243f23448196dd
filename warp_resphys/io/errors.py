"""Errors that the user can fix: each is one sentence, and the command line exits with code 2.

And warnings.
"""

import difflib
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import cache, wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    Final,
    Literal,
    ParamSpec,
    Protocol,
    SupportsFloat,
    SupportsIndex,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
    runtime_checkable,
)

_LONGEST = 1000


@runtime_checkable
class _Array(Protocol):
    """Object that NumPy takes as an array."""

    def __array__(self) -> Any: ...


# Types that count as others, and words for some.
_WIDER: Final[dict[Any, Any]] = {
    Sequence: Iterable,
    Callable: Callable,
    float: SupportsFloat,
    int: SupportsIndex,
    Path: os.PathLike,
    _Array: (_Array, Sequence, SupportsFloat),
}
_WORDS: Final[dict[Any, str]] = {
    Sequence: "a list",
    Mapping: "a mapping",
    Callable: "a function",
    NoneType: "None",
    _Array: "an array",
}
P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


class ResphysError(Exception):
    """Base of all errors whose message is written for the user:
    what was wrong, where, and what to do.

    Messages may quote files and libraries; they are reduced to one line of limited length without
    control characters.
    """

    def __init__(self, message: object = "") -> None:
        line = "".join(letter if letter.isprintable() else " " for letter in str(message))
        super().__init__(line if len(line) <= _LONGEST else f"{line[:500]} ... {line[-300:]}")


class ResphysWarning(UserWarning):
    """Values that can be simulated and look like a mistake.

    `warnings.filterwarnings` with this class silences them.
    """


class InputError(ResphysError, ValueError):
    """An invalid argument or configuration value."""


class MissingPackageError(InputError, ImportError):
    """A package of an extra is not installed."""


class MeshError(InputError):
    """A mesh that cannot be read or is not valid for finite elements."""


class DataFileError(ResphysError):
    """A data file that is missing, damaged, of another program, or cannot be written."""


class DerivativeError(ResphysError, RuntimeError):
    """A derivative that a simulation does not have:
    of second order, in forward mode, or by ``torch.func``.
    """


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
    package = __name__.partition(".")[0]
    depth, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(
        f"{package}."
    ):
        frame, depth = frame.f_back, depth + 1
    warnings.warn(message, ResphysWarning, stacklevel=depth)


def listed(names: Sequence[str]) -> str:
    """Returns names in quotation marks, separated by commas, for a message."""
    return ", ".join(f"'{name}'" for name in names) or "none"


def number_of(count: int, what: str) -> str:
    """Returns a number of things: "1 trial", "2 trials", "2 rigid bodies"."""
    return (
        f"{count} {what}"
        if count == 1
        else f"{count} {what[:-1]}ies"
        if what.endswith("y")
        else f"{count} {what}s"
    )


def did_you_mean(wanted: str, known: Sequence[str], preferred: Sequence[str] = ()) -> str:
    """Returns ", did you mean ...?" with the names most similar to an unknown one.

    Empty if none is similar.

    Args:
        wanted: the unknown name.
        known: existing names.
        preferred: existing names that are offered in any case.
    """
    offered = [name for name in dict.fromkeys(preferred) if name != wanted][:3]
    matches = offered or difflib.get_close_matches(
        wanted, [name for name in known if name != wanted], n=3, cutoff=0.6
    )
    return f", did you mean {' or '.join(repr(match) for match in matches)}?" if matches else ""


@contextmanager
def naming(group: str) -> Iterator[None]:
    """Prefixes errors with the name of a group."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"{group}{error}") from error


@contextmanager
def needs_extra(extra: str, what: str) -> Iterator[None]:
    """Raises one sentence where an import fails, with the extra to install.

    ``what`` as in "the viewer needs".
    """
    try:
        yield
    except ImportError as error:
        if isinstance(error, MissingPackageError):
            raise
        raise MissingPackageError(
            f"{what} a package that is not installed: pip install 'warp-resphys[{extra}]'."
        ) from error


def checks_types(function: Callable[P, R]) -> Callable[P, R]:
    """Returns a function that raises InputError for arguments of other types,
    places or names than it declares.
    """
    signature, called = inspect.signature(function), function.__qualname__.removesuffix(".__init__")
    hints = cache(lambda: get_type_hints(function))
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    checked = [
        name for name, parameter in signature.parameters.items() if parameter.kind not in several
    ]

    @wraps(function)
    def call(*given: P.args, **options: P.kwargs) -> R:
        try:
            arguments = signature.bind(*given, **options).arguments
        except TypeError as error:
            declared = ", ".join(
                name for name in signature.parameters if name not in ("self", "cls")
            )
            raise InputError(f"{called}: {error}: its arguments are {declared}.") from None
        for name in checked:
            if name in arguments and name in hints():
                check_type(f"{called}: {name}", arguments[name], hints()[name])
        return function(*given, **options)

    return call


def checks_methods(*names: str) -> Callable[[type[T]], type[T]]:
    """Returns a decorator of classes, which applies `checks_types` to some of their methods."""

    def decorated(kind: type[T]) -> type[T]:
        for name in names:
            setattr(kind, name, checks_types(getattr(kind, name)))
        return kind

    return decorated


def check_fields(instance: Any) -> None:
    """Raises InputError for a field of a dataclass of another type than it declares,
    if that is a class or a list.
    """
    for name, hint in _fields_of(instance.__class__).items():
        check_type(f"{type(instance).__name__}: {name}", getattr(instance, name), hint)


@cache
def _fields_of(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in fields(kind) if item.init}


def check_type(name: str, value: object, hint: Any) -> None:
    """Raises InputError for a value that a type hint excludes,
    also in lists and mappings of a class.
    """
    if type(value) is hint:
        return
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise InputError(f"{name} is {value!r}: choose {' or '.join(get_args(hint))}.")
        return
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    kinds: list[Any] = [
        Mapping if is_typeddict(part) else get_origin(part) or part for part in parts
    ]
    if object in kinds or Any in kinds or not all(map(_decides, kinds)):
        return
    groups = [part for part, kind in zip(parts, kinds, strict=True) if kind in (Sequence, Mapping)]
    if any(kind.__module__.startswith("numpy.") for kind in kinds):  # of ArrayLike
        kinds = [
            kind for kind in kinds if kind in (str, NoneType) or kind.__module__.startswith("warp_")
        ] + [_Array]
    letters = isinstance(value, str) and str not in kinds  # which are no list of names
    # Which are no number.
    rows = getattr(value, "shape", ()) != () and {*kinds} <= {int, float, bool, str, NoneType}
    if letters or rows or not isinstance(value, tuple(_WIDER.get(kind, kind) for kind in kinds)):
        words = " or ".join(dict.fromkeys(map(_word, kinds)))
        raise InputError(f"{name} is {in_short(value)}: it must be {words}.")
    item_kind = get_args(groups[0])[-1] if len(groups) == 1 and get_args(groups[0]) else None
    if not isinstance(item_kind, type) or item_kind.__module__ == "builtins":
        return
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list | tuple)
        else ()
    )
    for key, item in items:
        check_type(f"{name}[{key!r}]", item, item_kind)


def _decides(kind: Any) -> bool:
    """Whether a value can be asked for its type."""
    is_checked = getattr(kind, "_is_runtime_protocol", False) or not getattr(
        kind, "_is_protocol", False
    )
    return kind in _WIDER or (isinstance(kind, type) and is_checked)


def _word(kind: Any) -> str:
    """Returns a type in words."""
    if kind in _WORDS:
        return _WORDS[kind]
    return f"{kind.__module__}.{kind.__name__}".removeprefix("builtins.")


def in_short(value: object) -> str:
    """Returns what a value is, for a message: the shape of an array, otherwise its type."""
    shape = getattr(value, "shape", None)
    return (
        f"of type {type(value).__name__}"
        if not isinstance(shape, tuple)
        else f"an array of shape {tuple(shape)}"
    )
