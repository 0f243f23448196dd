"""Classes of other installed packages, by the names that configurations give them.

A package lists them as entry points, in a group for each kind, and they are imported when a configuration names them:

    [project.entry-points."warp_resphys.materials"]
    arruda_boyce = "my_robot_physics.material:ArrudaBoyce"
"""

import functools
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from typing import Any, Final

from .errors import DataFileError, InputError

KINDS: Final[Mapping[str, str]] = {  # in words, by the group below ``warp_resphys.``
    "materials": "material",
    "energies": "energy",
    "observations": "observation",
    "networks": "network",
}


@dataclass(frozen=True)
class Extension:
    """A class of another package, which is not imported yet."""

    kind: str  # one of `KINDS`
    point: EntryPoint

    @property
    def package(self) -> str:
        """Name of the package."""
        return self.point.dist.name if self.point.dist is not None else self.point.module.partition(".")[0]

    @property
    def version(self) -> str:
        """Version of the package."""
        return self.point.dist.version if self.point.dist is not None else "unknown"

    def __str__(self) -> str:
        """Returns the package and its version."""
        return f"{self.package} {self.version}"

    def load(self) -> Any:
        """Imports the class.

        Raises:
            InputError: the package cannot be imported.
        """
        try:
            return self.point.load()
        except Exception as error:
            raise InputError(
                f"the {KINDS[self.kind]} {self.point.name!r} of the package {self} cannot be imported from "
                f"{self.point.value} ({type(error).__name__}: {error}): correct or update the package."
            ) from error


def extensions(kind: str) -> list[Extension]:
    """Returns the classes of a kind in all installed packages, by name, without importing them."""
    return _scanned(kind, tuple(sys.path))


@functools.cache
def _scanned(kind: str, places: tuple[str, ...]) -> list[Extension]:
    """Scans the places of packages, which takes tens of milliseconds."""
    del places
    found = [Extension(kind, point) for point in entry_points(group=f"warp_resphys.{kind}")]
    return sorted(found, key=lambda own: (own.point.name, own.package))


def extension(kind: str, name: str, known: Iterable[str] = (), said: str = "") -> Extension:
    """Returns the class of a name.

    Args:
        kind: one of `KINDS`.
        name: of the entry point.
        known: names that this package has itself, for the message.
        said: beginning of the message for an unknown name; by default the name, and that no package has it.

    Raises:
        InputError: no package has it, or several have it.
    """
    every = extensions(kind)
    own = [candidate for candidate in every if candidate.point.name == name]
    if not own:
        choices = [*known, *(f"{candidate.point.name} (of {candidate.package})" for candidate in every)]
        choose = f"choose one of {', '.join(choices)}, or " if choices else ""
        said = said or f"{name}: no installed package has this {KINDS[kind]}"
        raise InputError(f"{said}: {choose}install the package that has it.")
    if len(own) > 1:
        packages = " and ".join(map(str, own))
        raise InputError(f"the {KINDS[kind]} {name!r} is in {packages}: uninstall one, or rename it there.")
    return own[0]


def check_packages(packages: Mapping[str, str], where: object) -> None:
    """Checks the packages that a run or a file was made with.

    Args:
        packages: their versions, by name.
        where: the run or the file, for the message.

    Raises:
        DataFileError: one is not installed, or in a version with other numbers before the second point.
    """
    for name, made in packages.items():
        try:
            here = version(name)
        except PackageNotFoundError:
            raise DataFileError(
                f"{where} was made with {name} {made}, a package that is not installed: install it, then try again."
            ) from None
        if here.split(".")[:2] != made.split(".")[:2]:
            raise DataFileError(
                f"{where} was made with {name} {made}, and this is {name} {here}: install the version that made it, or "
                "make it again."
            )
