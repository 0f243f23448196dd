"""Settings of energies, observations and networks of other packages (`io.entry_points`).

A package has a class of settings for each, with a method that builds the object. A configuration names it with its
keys, and they are checked as the others are:

    energies: {magnet: {field_direction: [0, 0, 1], magnetisation: 60e3}}

Materials have no class of settings: their constants are their keys.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from inspect import isabstract
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator

from ..io.entry_points import Extension, extension
from ..io.errors import InputError
from ..io.settings import Settings, parse


class EnergySettings(Settings):
    """Settings of an energy or an actuator of another package."""

    @abstractmethod
    def build(self, mesh: Any) -> Any:
        """Returns the `energies.base.Energy` of a body with a `mesh.mesh.Mesh`."""

    @property
    def drive(self) -> Any:
        """The input, a `stepping.quantity.Quantity`, that drives the body in recordings; None for none."""
        return None

    @property
    def driven_parts(self) -> int:
        """Number of values of that input."""
        return 1


class ObservationSettings(Settings):
    """Settings of the observation of markers by another package."""

    @abstractmethod
    def build(self, mesh: Any, places: Any, labels: Any) -> Any:
        """Returns the `data.markers.Markers` at places (m, 3) of the undeformed body [m], with their m labels."""


class CoreSettings(Settings):
    """Settings of the trained part of a network, between its coders, of another package."""

    @abstractmethod
    def build(self, inputs: int, outputs: int) -> Any:
        """Returns the `torch.nn.Module` that maps standardised (S, inputs) to standardised (S, outputs)."""


_CLASSES: Mapping[str, type[Settings]] = {
    "energies": EnergySettings,
    "observations": ObservationSettings,
    "networks": CoreSettings,
}


def own_settings(kind: str, name: str, values: Mapping[str, Any]) -> Any:
    """Returns the settings of an extension, with defaults of keys that are left out.

    Raises:
        InputError: it is unknown, its package cannot be imported, or has a class of another kind, or a wrong key.
    """
    source = extension(kind, name)
    wanted, settings = _CLASSES[kind], source.load()
    if not (isinstance(settings, type) and issubclass(settings, wanted)):
        raise InputError(
            f"{name} of the package {source} is {settings!r}: its entry point must name a subclass of "
            f"warp_resphys.settings.extensions.{wanted.__name__}."
        )
    if isabstract(settings):
        raise InputError(f"{name} of the package {source}: {settings.__name__} has no method build: add it.")
    with _naming(source):
        return parse(settings, values)


def driving_settings(energies: Mapping[str, Mapping[str, Any]]) -> EnergySettings | None:
    """Returns the settings of the energy whose input drives the body in recordings; None without one."""
    own: list[EnergySettings] = [own_settings("energies", name, values) for name, values in energies.items()]
    return next((settings for settings in own if settings.drive is not None), None)


def built(kind: str, name: str, values: Mapping[str, Any], result: type[Any], *arguments: Any) -> Any:
    """Builds the object of an extension.

    Args:
        kind: one of `io.entry_points.KINDS`.
        name: of the entry point.
        values: its keys.
        result: class that the object must have.
        arguments: of ``build``.

    Raises:
        InputError: see `own_settings`; or the package refuses the arguments, or builds another object.
    """
    settings, source = own_settings(kind, name, values), extension(kind, name)
    with _naming(source):
        made = settings.build(*arguments)
    if not isinstance(made, result):
        raise InputError(
            f"{name} of the package {source} builds {type(made).__name__}: its method build must return a subclass of "
            f"{result.__module__}.{result.__name__}."
        )
    return made


@contextmanager
def _naming(source: Extension) -> Iterator[None]:
    """Names the package in errors."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{source.point.name} of the package {source}: {error}") from error


def _without_null(values: Any) -> Any:
    return {key: own for key, own in values.items() if own is not None} if isinstance(values, Mapping) else values


def _whole(kind: str, values: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Returns checked keys with their defaults."""
    return {name: own_settings(kind, name, own).plain() for name, own in values.items()}


def _one(values: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    if len(values) > 1:
        raise ValueError(f"{' and '.join(values)} are given: choose one, as {{{next(iter(values))}: {{...}}}}.")
    return values


_Groups = Annotated[dict[str, dict[str, Any]], BeforeValidator(_without_null)]
OwnEnergies = Annotated[_Groups, AfterValidator(partial(_whole, "energies"))]
OwnObservation = Annotated[_Groups, AfterValidator(_one), AfterValidator(partial(_whole, "observations"))]
OwnCore = Annotated[_Groups, AfterValidator(_one), AfterValidator(partial(_whole, "networks"))]
