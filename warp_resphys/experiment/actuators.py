"""Energies of a configured body: actuators, the input that drives them,
a fluid, and contact with obstacles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

from ..core.energies.base import Energy
from ..core.energies.contact.obstacle_contact import Contact
from ..core.energies.contact.surface_contact import SurfaceContact
from ..core.energies.fibres import Fibres
from ..core.energies.medium import Medium
from ..core.energies.muscles import CONTRACTION as MUSCLE_CONTRACTION
from ..core.energies.muscles import STRESS, Muscle, Muscles
from ..core.energies.pressure import PRESSURE, Pressure
from ..core.energies.tendons import CONTRACTION, TENSION, Tendons
from ..core.fem.bodies import Body
from ..core.mesh.chambers import Chamber, find_chambers, outer_surface
from ..core.mesh.place import Place
from ..core.mesh.readers import read_surfaces
from ..core.mesh.selection import faces_at, select_cells
from ..core.mesh.volume_mesh import Mesh
from ..core.stepping.quantity import Quantity
from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError, MeshError, naming
from ..settings.body import BodySettings, MuscleSettings
from ..settings.meshing import FileMesh

# Driving input by group and the value of its key ``commanded``.
_COMMANDED: Final[Mapping[str, Mapping[str, Quantity]]] = {
    "tendons": {"tension": TENSION, "contraction": CONTRACTION},
    "muscles": {"stress": STRESS, "contraction": MUSCLE_CONTRACTION},
}
_QUANTITIES: Final = (PRESSURE, *_COMMANDED["tendons"].values(), *_COMMANDED["muscles"].values())
DRIVING_QUANTITIES: Final[Mapping[str, Quantity]] = {
    quantity.name: quantity for quantity in _QUANTITIES
}


def build_actuators(settings: BodySettings, mesh: Mesh) -> list[Energy]:
    """Builds the energies of a body besides its material.

    Those of ``chambers``, ``fibres``, ``tendons``, ``muscles``, ``medium``, ``obstacles`` and
    ``self_contact``, and ``energies`` of other packages.

    Args:
        settings: of the body.
        mesh: of the body.

    Raises:
        InputError: the number of chambers differs from the mesh, or tendons or muscles do not fit.
    """
    chambers = build_chambers(settings, mesh)
    energies: list[Energy] = [Pressure(chambers)] if chambers else []
    if settings.fibres is not None:
        if settings.chambers is None:
            raise InputError(
                "fibres is set, but chambers is null: fibres need chambers, so leave them out."
            )
        closed = chambers[: settings.chambers.count]
        around = (
            closed
            if settings.fibres.around == "chambers"
            else (outer_surface(mesh, settings.chambers.axis),)
        )
        wound = {key: value for key, value in settings.fibres if key != "around"}
        energies.append(Fibres(around, axis=settings.chambers.axis, **wound))
    if settings.tendons is not None:
        energies.append(
            Tendons(**{key: value for key, value in settings.tendons if key != "commanded"})
        )
    if settings.muscles is not None:
        energies.append(build_muscles(settings.muscles, mesh))
    if settings.medium is not None:
        energies.append(Medium(**dict(settings.medium)))
    if settings.obstacles:
        energies.append(Contact(settings.obstacles, **dict(settings.contact)))
    if settings.self_contact is not None:
        energies.append(SurfaceContact(**dict(settings.self_contact)))
    return energies + list(energies_of_packages(settings).values())


def energies_of_packages(settings: BodySettings) -> dict[str, Energy]:
    """Builds the ``energies`` of other packages, by name.

    Raises:
        InputError: see `ClassSettings.factory`.
    """
    return {
        name: energy.factory(Energy, f"energies.{name}")()
        for name, energy in settings.energies.items()
    }


def build_chambers(settings: BodySettings, mesh: Mesh) -> tuple[Chamber, ...]:
    """Finds the closed chambers of a mesh, and the open faces after them,
    if the group ``chambers`` is set.

    Raises:
        InputError: their number differs from ``chambers.count``, or open faces have the name of one
            of them.
        MeshError: no face lies at a place, or the mesh has no such surface.
    """
    group = settings.chambers
    if group is None:
        return ()
    closed = find_chambers(mesh, group.axis)
    if len(closed) != group.count:
        raise InputError(
            f"the mesh has {len(closed)} closed chambers, but chambers.count is {group.count}: "
            "open chambers do not count, so close them in the mesh, name them in "
            "chambers.faces, or change chambers.count."
        )
    twice = group.faces.keys() & {chamber.name for chamber in closed}
    if twice:
        raise InputError(
            f"chambers.faces.{min(twice)}: a closed chamber has this name: choose another."
        )
    return *closed, *(Chamber(name, _open_faces(settings, mesh, name)) for name in group.faces)


def _open_faces(settings: BodySettings, mesh: Mesh, name: str) -> IntArray:
    """Returns the faces (F, n) of an entry of ``chambers.faces``,
    by their place or the surface of the mesh file.
    """
    assert settings.chambers is not None
    place = settings.chambers.faces[name]
    with naming(f"chambers.faces.{name}: "):
        if isinstance(place, Place):
            return faces_at(mesh, place)
        if not isinstance(settings.mesh, FileMesh):
            raise MeshError(
                "only meshes from a file have named surfaces: "
                "give the place of the faces, as in {z: 0.0}"
            )
        surfaces = read_surfaces(**settings.mesh.arguments())
        if place not in surfaces:
            raise MeshError(
                f"the mesh has no surface {place!r}; it has "
                f"{', '.join(surfaces) or 'none with a name'}"
            )
        return surfaces[place]


@dataclass(frozen=True)
class Drive:
    """Input that drives a body in recordings and simulated laboratories."""

    quantity: Quantity
    parts: tuple[str, ...]  # names of the driven parts, e.g. chambers

    @property
    def per(self) -> str:
        """Noun for a part, e.g. chamber."""
        return self.quantity.per


def _driving(settings: BodySettings) -> tuple[Quantity, int] | None:
    """Input of a body with its number of values; None without.

    Of energies of other packages it is the first.

    Raises:
        InputError: the body has several.
    """
    driving: dict[str, tuple[Quantity, int]] = {}
    if settings.chambers is not None:
        driving["chambers"] = PRESSURE, settings.chambers.count + len(settings.chambers.faces)
    if settings.tendons is not None:
        driving["tendons"] = (
            _COMMANDED["tendons"][settings.tendons.commanded],
            len(settings.tendons.routes),
        )
    if settings.muscles is not None and settings.muscles.commanded is not None:
        driving["muscles"] = (
            _COMMANDED["muscles"][settings.muscles.commanded],
            len(settings.muscles.bundles),
        )
    for name, energy in energies_of_packages(settings).items():
        if energy.inputs:
            driving[f"energies.{name}"] = energy.inputs[0], energy.count
    if len(driving) > 1:
        raise InputError(
            f"{' and '.join([*driving][:2])} are two inputs of the body, "
            "but recordings have one: take one out."
        )
    return next(iter(driving.values()), None)


def driving_quantity(settings: BodySettings) -> Quantity | None:
    """Quantity that drives the body; None without actuators."""
    driving = _driving(settings)
    return None if driving is None else driving[0]


def driven_parts(settings: BodySettings) -> int:
    """Number of values of the driving input."""
    driving = _driving(settings)
    assert driving is not None
    return driving[1]


def drive_of(settings: BodySettings, body: Body) -> Drive | None:
    """Input that drives a body; None without actuators."""
    quantity = driving_quantity(settings)
    if quantity is None:
        return None
    names = next(
        energy.names
        for energy in cast(Sequence[Energy], body.energies)
        if quantity in energy.inputs
    )
    return Drive(quantity, names)


def build_muscles(settings: MuscleSettings, mesh: Mesh) -> Muscles:
    """Builds the muscles of a group from the cells whose centres lie within their boxes.

    Raises:
        InputError: see `Muscles`.
        MeshError: no cell lies within a box.
    """
    muscles = [
        Muscle(select_cells(mesh, **bundle.within.arguments()), bundle.direction, name)
        for name, bundle in settings.bundles.items()
    ]
    return Muscles(muscles, settings.stiffness, toe=settings.toe)


def routes_of(body: Body) -> dict[str, FloatArray]:
    """Returns (G, 3) guides of the body's tendons, and lines through its muscles [m], by name."""
    routes: dict[str, FloatArray] = {}
    for energy in body.energies:
        if isinstance(energy, Tendons):
            routes |= dict(zip(energy.names, energy.guides, strict=True))
        elif isinstance(energy, Muscles):
            routes |= energy.lines(body.mesh)
    return routes
