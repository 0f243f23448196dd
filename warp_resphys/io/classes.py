"""Classes of other packages in a configuration, in Hydra's notation:
``_target_`` and keyword arguments.

    energies: {magnet: {_target_: my_physics.Magnet, magnetisation: 60e3}}

The arguments are checked by the annotations of the class, as the keys of settings are. A
configuration may come from the file of a robot, so only a subclass of the expected base is called.
"""

import sys
from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from inspect import Parameter, signature
from typing import Any

from pydantic import ConfigDict, Field, PydanticUserError, create_model
from typing_extensions import override

from .errors import DataFileError, InputError
from .settings import Settings, Word, parse


class ClassSettings(Settings):
    """A class of another package.

    The other keys are arguments of the class, or of its class method ``bind``.
    """

    model_config = ConfigDict(extra="allow", populate_by_name=True)

    target: Word = Field(
        alias="_target_", description="module and class, such as my_physics.Magnet"
    )

    @override
    def packages(self) -> dict[str, str]:
        return package_of(self.target)

    def factory(
        self, base: type[Any], where: str, leading: int = 0, method: str = ""
    ) -> Callable[..., Any]:
        """Returns the class, or a class method of it, with the arguments of the configuration.

        Args:
            base: class that it must be derived from.
            where: dotted key of the group, for messages.
            leading: number of positional arguments that the caller adds.
            method: name of the class method; empty for the class itself.

        Raises:
            InputError: the class cannot be imported, is no subclass, is abstract, or does not take
                these arguments.
        """
        kind = imported(self.target, base, f"{where}: ")
        missing = sorted(getattr(kind, "__abstractmethods__", ()))
        if missing:
            raise InputError(
                f"{where}: {self.target} has no method {' and no '.join(missing)}: add it."
            )
        make = getattr(kind, method) if method else kind
        values = {
            name: value for name, value in (self.model_extra or {}).items() if value is not None
        }
        checked = parse(_arguments(make, leading, where), values, where)
        return partial(make, **{name: getattr(checked, name) for name in checked.model_fields_set})


class _Arguments(Settings):
    """Arguments of a class, whose types may be any of Python's, such as tuples."""

    model_config = ConfigDict(strict=False, validate_default=False)


def _arguments(make: Callable[..., Any], leading: int, where: str) -> type[_Arguments]:
    """Returns a class of settings with the arguments after the first ones."""
    try:
        fields: dict[str, Any] = {
            parameter.name: (
                Any if parameter.annotation is Parameter.empty else parameter.annotation,
                ... if parameter.default is Parameter.empty else parameter.default,
            )
            for parameter in [*signature(make, eval_str=True).parameters.values()][leading:]
        }
        return create_model(make.__qualname__, __base__=_Arguments, **fields)
    except (NameError, PydanticUserError) as error:
        reason = str(error).partition(". ")[0]
        raise InputError(
            f"{where}: the arguments of {make.__qualname__} cannot be given in a configuration "
            f"({reason}): annotate them as numbers, words, lists or settings."
        ) from error


def imported(target: str, base: type[Any] | tuple[type[Any], ...], prefix: str = "") -> Any:
    """Imports a class that is derived from another one, or from one of several.

    Errors begin with a prefix.

    Raises:
        InputError: it cannot be imported, or is something else.
    """
    module, _, name = target.rpartition(".")
    try:
        if module.partition(".")[0] in sys.stdlib_module_names:
            raise ImportError("this is a module of Python itself")
        found = getattr(import_module(module), name)
    except Exception as error:  # The module may raise anything.
        raise InputError(
            f"{prefix}{target} cannot be imported ({type(error).__name__}: {error}): correct the "
            "name, or install or correct the package."
        ) from error
    if not (isinstance(found, type) and issubclass(found, base)):
        bases = base if isinstance(base, tuple) else (base,)
        known = " or ".join(f"{one.__module__}.{one.__qualname__}" for one in bases)
        raise InputError(f"{prefix}{target} is no subclass of {known}: name one.")
    return found


def package_of(target: str) -> dict[str, str]:
    """Returns name and version of the installed package that has a class.

    Nothing where no package has it.
    """
    return {
        name: version(name) for name in _packages(tuple(sys.path)).get(target.partition(".")[0], ())
    }


@cache
def _packages(places: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Returns installed packages by their modules, which takes half a second."""
    del places
    return packages_distributions()


def check_packages(packages: Mapping[str, str], where: object) -> None:
    """Checks the packages that a run or a file was made with.

    Args:
        packages: their versions, by name.
        where: the run or the file, for the message.

    Raises:
        DataFileError: one is not installed, or in a version with other numbers before the second
            point.
    """
    for name, made in packages.items():
        try:
            here = version(name)
        except PackageNotFoundError:
            raise DataFileError(
                f"{where} was made with {name} {made}, a package that is not installed: install "
                "it, then try again."
            ) from None
        if here.split(".")[:2] != made.split(".")[:2]:
            raise DataFileError(
                f"{where} was made with {name} {made}, and this is {name} {here}: install the "
                "version that made it, or make it again."
            )
