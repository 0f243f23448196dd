"""Settings: a frozen class for each group of a configuration, with type,
range, unit, description and default of keys.

    class Swing(Settings):
        '''A harmonic motion.'''

        frequency: Positive = setting(unit="Hz")
        phase: float = setting(0.0, "at time zero", unit="rad")

A class is the only place where a key is declared. `parse` converts nested plain data, as read from
YAML, to an object, and raises an error of one sentence for an invalid value. Types are strict:
booleans and strings are not numbers, but integers are accepted as floating-point numbers, and lists
become tuples. Relations between keys are checked in a ``model_validator`` that raises a ValueError;
its message begins with a key of the class, which `parse` completes to the dotted key.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic_core import PydanticUndefined

from .errors import InputError
from .setting_errors import sentence

T = TypeVar("T")
S = TypeVar("S", bound="Settings")

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]
Natural = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
Word = Annotated[str, Field(min_length=1)]
Many = Annotated[tuple[T, ...], Strict(False)]  # a list of any length
Some = Annotated[tuple[T, ...], Strict(False), Field(min_length=1)]  # a list of one or more
Pair = Annotated[tuple[T, T], Strict(False)]
Vector = Annotated[tuple[float, float, float], Strict(False)]

_KIND = ("kind", "shape")  # keys that choose among classes


class Settings(BaseModel):
    """Base of all settings classes. Objects are immutable and compared by content."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
        protected_namespaces=(),
    )

    def __init__(self, /, *places: Any, **values: Any) -> None:
        """Checks the keys.

        NumPy's numbers and arrays of one or two axes are taken as numbers and lists.

        Raises:
            InputError: as `parse`; the message names the class. Or values without keys.
        """
        if places:
            kind, first = type(self).__name__, next(iter(type(self).model_fields), "key")
            raise InputError(
                f"{kind} is given {places[0]!r} without a name: name it, as in "
                f"{kind}({first}={places[0]!r})."
            )
        values = {
            name: value.tolist() if getattr(value, "ndim", 3) < 3 else value
            for name, value in values.items()
        }
        with _in_words(type(self), values, type(self).__name__):
            self.__pydantic_validator__.validate_python(values, self_instance=self)

    # Groups within others are not made by it.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def __hash__(self) -> int:  # Of other orders as well, as bodies are cached by it.
        return hash(self.model_dump_json())

    def plain(self) -> dict[str, Any]:
        """Returns nested data of JSON types."""
        return self.model_dump(mode="json", by_alias=True)

    def arguments(self) -> dict[str, Any]:
        """Returns the keys that are not null and choose no kind, as arguments of a function."""
        return {
            name: value
            for name, value in dict(self).items()
            if value is not None and name not in _KIND
        }

    def content(self) -> Any:
        """Returns the data that a fingerprint covers, of JSON types: all keys."""
        return self.plain()

    def packages(self) -> dict[str, str]:
        """Returns the versions of the other packages
        whose classes these settings and all their groups name.
        """
        return packages_of(dict(self))

    def changed(self, **values: Any) -> Self:
        """Returns a copy with other values of some keys.

        Raises:
            InputError: an invalid value.
        """
        return type(self)(**{**dict(self), **values})

    @classmethod
    def of(cls, source: "Settings", **values: Any) -> Self:
        """Returns settings of this class with the keys that another object shares,
        and ``values`` for the others.
        """
        shared = {name: getattr(source, name) for name in cls.model_fields if hasattr(source, name)}
        return cls(**{**shared, **values})


def without_null(values: Any) -> Any:
    """Returns a mapping without the keys that are null; other values unchanged."""
    return (
        {key: value for key, value in values.items() if value is not None}
        if isinstance(values, dict)
        else values
    )


def packages_of(value: Any) -> dict[str, str]:
    """Returns `Settings.packages` of all settings in nested data."""
    if isinstance(value, Settings):
        return value.packages()
    parts = (
        value.values()
        if isinstance(value, Mapping)
        else value
        if isinstance(value, (list, tuple))
        else ()
    )
    return {name: version for part in parts for name, version in packages_of(part).items()}


def setting(
    default: Any = PydanticUndefined, description: str = "", unit: str = "", **limits: Any
) -> Any:
    """Declares a key of a class of settings.

    Args:
        default: value of an omitted key; without a default, the key is required.
        description: for the reference page and for editors.
        unit: such as ``m/s^2``; also used in error messages.
        limits: further arguments of `pydantic.Field`, such as ``gt`` or ``le``.
    """
    more: dict[str, Any] = {"json_schema_extra": {"unit": unit}} if unit else {}
    return Field(default, description=description or None, **more, **limits)


def parse(settings: type[S], values: Any, where: str = "") -> S:
    """Converts nested plain data to an object of a settings class.

    Args:
        settings: class of the object.
        values: mapping of its keys; omitted keys get their default.
        where: dotted key of the group, for messages; empty for a whole configuration.

    Raises:
        InputError: an unknown or missing key, a value of another type or out of range, or values
            that contradict each other. The message has the dotted key, the value, and what it must
            be.
    """
    with _in_words(settings, values, where):
        return settings.model_validate(values)


@contextmanager
def _in_words(settings: type[Settings], values: Any, where: str) -> Iterator[None]:
    """Raises one sentence in place of an error of pydantic; see `parse`."""
    try:
        yield
    except ValidationError as error:
        schema = settings.model_json_schema()
        raise InputError(sentence(schema, values, where, error.errors(include_url=False))) from None
