"""The energies of a simulator, from its bodies and their materials."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from ..fem.bodies import Body
from ..fem.integration_points import Points
from ..io.errors import InputError
from .base import Energy
from .hysteresis import Hysteresis
from .materials import Material
from .rigid import PointInertia, rigid_energies
from .solid import solids_of

Materials = Mapping[str, Any]  # by name of a region or body: a material, or the materials of its regions


@dataclass(frozen=True)
class PlacedEnergy:
    """An energy, its points in the simulator, and the prefix of its names there, such as ``tip_``."""

    energy: Energy
    points: tuple[Points, ...]  # points with operators on control vertices (`fem.coordinates`)
    prefix: str = ""
    all_points: tuple[Points, ...] | None = None  # points with operators on all vertices; None if they are the same
    body: Body | None = None  # body of the energy
    first: int = 0  # index of that body's first vertex in the simulator

    @classmethod
    def of(
        cls, whole: Body, body: Body, first: int, energy: Energy, points: Sequence[Points], prefix: str = ""
    ) -> "PlacedEnergy":
        """Places an energy of a body in a simulator.

        Args:
            whole: the simulator's body or scene.
            body: the body.
            first: index of its first vertex in the simulator.
            energy: the energy.
            points: points of the energy, with the body's own vertex numbers.
            prefix: prefix of the energy's names.
        """
        shifted = tuple(own.shifted(first) for own in points)
        return cls(energy, tuple(map(whole.coordinates.compose, shifted)), prefix, shifted, body, first)


def joined_names(materials: Material | Materials) -> dict[str, Material]:
    """Returns materials of bodies and regions by joined names, as ``finger_tip``; a single one has an empty name."""
    if isinstance(materials, Material):
        return {"": materials}
    return {
        f"{name}_{region}" if region else name: value
        for name, own in materials.items()
        for region, value in joined_names(own).items()
    }


def place_energies(whole: Body, material: Material | Materials) -> list[PlacedEnergy]:
    """Returns the energies of all bodies: solids and their hysteresis, rigid parts, and the bodies' own energies.

    Args:
        whole: a body, or a `fem.scene.Scene`.
        material: one for all bodies, or by region of the mesh, or by body of a scene.

    Raises:
        InputError: a body or a cell without material.
    """
    placed: list[PlacedEnergy] = []
    for name, body, first in whole.members:
        prefix = f"{name}_" if name else ""
        solids = solids_of(body, _material_of(material, body, name))
        energies: list[tuple[Energy, str]] = [(solid, f"{prefix}{region}") for solid, region in solids]
        sliding = [(Hysteresis(solid), f"{prefix}{region}") for solid, region in solids if solid.material.hysteresis]
        energies += sliding
        for part in body.controls:
            energies += [(energy, f"{prefix}{part}_") for energy in rigid_energies(body, part, body.rigid[part])]
        items: list[tuple[Energy, Any, str]] = [(energy, energy.points(body.mesh), own) for energy, own in energies]
        given = zip(cast(Sequence[Energy], body.energies), body.energy_points, strict=True)
        items += [(energy, points, prefix) for energy, points in given]
        placed += [PlacedEnergy.of(whole, body, first, *item) for item in items]
    if (contact := getattr(whole, "contact", None)) is not None:
        placed.append(PlacedEnergy.of(whole, whole, 0, contact, contact.points(whole.mesh)))
    if whole.coordinates:
        placed.append(PlacedEnergy(PointInertia(whole.coordinates.points), (whole.coordinates.points,), "dependent_"))
    return placed


def _material_of(material: Material | Materials, body: Body, name: str) -> Material | Materials:
    """Returns the material of a body, none for a rigid one, or raises InputError."""
    if not name or isinstance(material, Material):
        return material
    if name not in material:
        if body.soft_cells is not None and not len(body.soft_cells):
            return {}
        raise InputError(f"The body {name!r} has no material. Give one: there are {', '.join(material) or 'none'}.")
    own: Material | Materials = material[name]
    return own
