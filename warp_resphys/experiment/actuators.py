"""What drives a body: its chambers, tendons and muscles from their groups of a configuration, and which input acts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from ..energies.base import Energy
from ..energies.fibres import Fibres
from ..energies.medium import Medium
from ..energies.muscles import CONTRACTION as MUSCLE_CONTRACTION
from ..energies.muscles import STRESS, Muscle, Muscles
from ..energies.pressure import PRESSURE, Pressure
from ..energies.strings import Strings
from ..energies.tendons import CONTRACTION, TENSION, Tendons
from ..fem.body import Body
from ..io.errors import InputError
from ..mesh.chambers import Chamber, find_chambers
from ..mesh.mesh import Mesh, select_cells, select_vertices
from ..settings.body import BodySettings, ChamberSettings, MuscleSettings, PlaceSettings, TendonSettings
from ..settings.stages import PlayedSettings
from ..stepping.quantity import Quantity

Actuated = BodySettings | PlayedSettings  # settings with the groups of what drives a body

# By group, and the word of its key ``commanded``: the input.
_COMMANDED: Final[Mapping[str, Mapping[str, Quantity]]] = {
    "tendons": {"tension": TENSION, "contraction": CONTRACTION},
    "muscles": {"stress": STRESS, "contraction": MUSCLE_CONTRACTION},
}
DRIVING_QUANTITIES: Final[Mapping[str, Quantity]] = {
    quantity.name: quantity for quantity in (PRESSURE, *(q for group in _COMMANDED.values() for q in group.values()))
}


def build_actuators(settings: BodySettings, mesh: Mesh, payload_at: PlaceSettings | None) -> list[Energy]:
    """The energies of ``chambers``, ``fibres``, ``tendons``, ``muscles``, ``medium`` and ``payload_string``.

    Args:
        settings: of the body.
        mesh: of the body.
        payload_at: vertices that the string is tied to.

    Raises:
        InputError: another number of chambers than the mesh has, or tendons or muscles that do not fit.
    """
    chambers = build_chambers(settings.chambers, mesh)
    energies: list[Energy] = [Pressure(chambers)] if chambers else []
    if settings.fibres is not None:
        if settings.chambers is None:
            raise InputError("fibres are wound around chambers, but chambers is null: leave the fibres out.")
        energies.append(Fibres(chambers, axis=settings.chambers.axis, **dict(settings.fibres)))
    if settings.tendons is not None:
        energies.append(build_tendons(settings.tendons))
    if settings.muscles is not None:
        energies.append(build_muscles(settings.muscles, mesh))
    if settings.medium is not None:
        energies.append(Medium(**dict(settings.medium)))
    if settings.payload_string is not None:
        if payload_at is None:
            raise InputError("payload_string is set, but data.payload_at is not: name the vertices that carry it.")
        energies.append(Strings([select_vertices(mesh, **payload_at.arguments())], **dict(settings.payload_string)))
    return energies


def build_chambers(settings: ChamberSettings | None, mesh: Mesh) -> tuple[Chamber, ...]:
    """The closed chambers of a mesh, from the group ``chambers``; none without the group.

    Raises:
        InputError: the mesh has another number of them.
    """
    if settings is None:
        return ()
    found = find_chambers(mesh, settings.axis)
    if len(found) != settings.count:
        raise InputError(
            f"the mesh has {len(found)} closed chambers, but chambers.count is {settings.count}: a chamber that is "
            "open to the outside is none, so close it in the mesh, or set chambers.count."
        )
    return found


@dataclass(frozen=True)
class Drive:
    """The input that recordings and simulated laboratories drive a body by."""

    quantity: Quantity
    parts: tuple[str, ...]  # that have a value each, such as chambers

    @property
    def per(self) -> str:
        """What a part is, such as chamber."""
        return self.quantity.per


def driving_quantity(settings: Actuated) -> Quantity | None:
    """The input of the body that is driven; None for a body without actuators."""
    if settings.chambers is not None:
        return PRESSURE
    for group, quantities in _COMMANDED.items():
        own = getattr(settings, group)
        if own is not None and own.commanded is not None:
            return quantities[own.commanded]
    return None


def driven_parts(settings: Actuated) -> int:
    """Number of values of the driven input."""
    if settings.chambers is not None:
        return settings.chambers.count
    if settings.tendons is not None:
        return len(settings.tendons.routes)
    assert settings.muscles is not None
    return len(settings.muscles.bundles)


def drive_of(settings: Actuated, body: Body) -> Drive | None:
    """The input that drives a body; None for one without actuators."""
    quantity = driving_quantity(settings)
    if quantity is None:
        return None
    (energy,) = (each for each in cast(Sequence[Energy], body.energies) if quantity in each.inputs)
    return Drive(quantity, energy.names)


def build_tendons(settings: TendonSettings) -> Tendons:
    """The tendons of a group: every straight piece of a route is divided into as many as asked for, and its offsets.

    Raises:
        InputError: see `Tendons`.
    """
    routes, directions = [], []
    for route in settings.routes.values():
        guides = np.asarray(route.guides, dtype=np.float64)
        routes.append(_divided(guides, route.pieces))
        own = [np.broadcast_to(np.asarray(each, dtype=np.float64), guides.shape) for each in route.offsets]
        directions.append([_divided(each, route.pieces) for each in own])
    more: dict[str, Any] = {"directions": directions} if any(directions) else {}
    labels = tuple(settings.routes)
    return Tendons(routes, settings.stiffness, labels=labels, toe=settings.toe, reach=settings.reach, **more)


def _divided(values: NDArray[np.float64], pieces: int) -> NDArray[np.float64]:
    """(G, 3) values at guides, and so many times as many between them."""
    share = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    return np.concatenate([*(first + share * (last - first) for first, last in pairwise(values)), values[-1:]])


def build_muscles(settings: MuscleSettings, mesh: Mesh) -> Muscles:
    """The muscles of a group, through the cells whose centres lie within their boxes.

    Raises:
        InputError: see `Muscles`.
        MeshError: no cell lies within a box.
    """
    found = [
        Muscle(select_cells(mesh, **each.within.arguments()), each.direction, name)
        for name, each in settings.bundles.items()
    ]
    return Muscles(found, settings.stiffness, toe=settings.toe)
