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
from ..stepping.quantity import Quantity

# By group, and the word of its key ``commanded``: the input.
_COMMANDED: Final[Mapping[str, Mapping[str, Quantity]]] = {
    "tendons": {"tension": TENSION, "contraction": CONTRACTION},
    "muscles": {"stress": STRESS, "contraction": MUSCLE_CONTRACTION},
}
DRIVING_QUANTITIES: Final[Mapping[str, Quantity]] = {
    quantity.name: quantity for quantity in (PRESSURE, *(q for group in _COMMANDED.values() for q in group.values()))
}


def build_actuators(config: Mapping[str, Any], mesh: Mesh) -> list[Energy]:
    """The energies of ``chambers``, ``fibres``, ``tendons``, ``muscles``, ``medium`` and ``payload_string``.

    Raises:
        InputError: fibres without chambers, another number of chambers than the mesh has, tendons or muscles that do
            not fit, two inputs, or a string that is tied to nothing.
    """
    driving_quantity(config)
    chambers, fibres = build_chambers(config.get("chambers"), mesh), config.get("fibres")
    if fibres is not None and not chambers:
        raise InputError("fibres are wound around chambers, but there is no group chambers: leave the fibres out.")
    energies: list[Energy] = [Pressure(chambers)] if chambers else []
    if fibres is not None:
        energies.append(Fibres(chambers, axis=config["chambers"]["axis"], **fibres))
    if config.get("tendons") is not None:
        energies.append(build_tendons(config["tendons"]))
    if config.get("muscles") is not None:
        energies.append(build_muscles(config["muscles"], mesh))
    if config.get("medium") is not None:
        energies.append(Medium(**{str(key): value for key, value in config["medium"].items()}))
    if config.get("payload_string") is not None:
        place = config["data"].get("payload_at")
        if place is None:
            raise InputError("payload_string is set, but data.payload_at is not: name the vertices that carry it.")
        string = {str(key): value for key, value in config["payload_string"].items()}
        energies.append(Strings([select_vertices(mesh, **place)], **string))
    return energies


def build_chambers(config: Mapping[str, Any] | None, mesh: Mesh) -> tuple[Chamber, ...]:
    """The closed chambers of a mesh, from the group ``chambers``; none without the group.

    Raises:
        InputError: the mesh has another number of them.
    """
    if config is None:
        return ()
    found = find_chambers(mesh, config["axis"])
    if len(found) != config["count"]:
        raise InputError(
            f"the mesh has {len(found)} closed chambers, but chambers.count is {config['count']}: a chamber that is "
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


def driving_quantity(config: Mapping[str, Any]) -> Quantity | None:
    """Which input of the body is driven; None for a body without actuators.

    Raises:
        InputError: there are two.
    """
    found = {"chambers": PRESSURE} if config.get("chambers") is not None else {}
    for group, quantities in _COMMANDED.items():
        commanded = (config.get(group) or {}).get("commanded")
        if commanded is not None:
            found[group] = quantities[commanded]
    if len(found) > 1:
        first, second, *_ = found
        raise InputError(f"a body with {first} and {second} has two inputs, but recordings drive one: take one out.")
    return next(iter(found.values()), None)


def driven_parts(config: Mapping[str, Any]) -> int:
    """How many values the driven input has."""
    if config.get("chambers") is not None:
        return int(config["chambers"]["count"])
    (group,) = (group for group in _COMMANDED if (config.get(group) or {}).get("commanded") is not None)
    return len(config[group]["routes" if group == "tendons" else "bundles"])


def drive_of(config: Mapping[str, Any], body: Body) -> Drive | None:
    """The input that drives a body; None for one without actuators."""
    quantity = driving_quantity(config)
    if quantity is None:
        return None
    (energy,) = (each for each in cast(Sequence[Energy], body.energies) if quantity in each.inputs)
    return Drive(quantity, energy.names)


def build_tendons(config: Mapping[str, Any]) -> Tendons:
    """The tendons of a group: every straight piece of a route is divided into as many as asked for, and its offsets.

    Raises:
        InputError: see `Tendons`; or a contraction that nothing would pull.
    """
    if config["commanded"] == "contraction" and not config["stiffness"] > 0.0:
        raise InputError(
            "tendons.stiffness is 0, but their contraction is commanded, which acts through it: set it, in N/m."
        )
    more: dict[str, Any] = {key: config[key] for key in ("toe", "reach") if key in config}
    routes, directions = [], []
    for name, route in config["routes"].items():
        guides, pieces = np.asarray(route["guides"], dtype=np.float64), route.get("pieces", 1)
        routes.append(_divided(guides, pieces))
        own = [np.asarray(each, dtype=np.float64) for each in route.get("offsets", ())]
        for each in own:
            if each.shape not in ((3,), guides.shape):
                raise InputError(
                    f"tendons.routes.{name}.offsets has a direction of shape {each.shape}: give three numbers, or "
                    f"three for each of its {len(guides)} guides."
                )
        directions.append([_divided(np.broadcast_to(each, guides.shape), pieces) for each in own])
    if any(directions):
        more["directions"] = directions
    return Tendons(routes, config["stiffness"], labels=tuple(config["routes"]), **more)


def _divided(values: NDArray[np.float64], pieces: int) -> NDArray[np.float64]:
    """(G, 3) values at guides, and so many times as many between them."""
    share = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    return np.concatenate([*(first + share * (last - first) for first, last in pairwise(values)), values[-1:]])


def build_muscles(config: Mapping[str, Any], mesh: Mesh) -> Muscles:
    """The muscles of a group, through the cells whose centres lie within their boxes.

    Raises:
        InputError: see `Muscles`; a contraction that nothing would pull, or fibres that do nothing.
        MeshError: no cell lies within a box.
    """
    if config["commanded"] != "stress" and not config["stiffness"] > 0.0:
        why = "their contraction is commanded" if config["commanded"] else "nothing is commanded"
        raise InputError(f"muscles.stiffness is 0, but {why}: set it, in Pa.")
    found = [
        Muscle(select_cells(mesh, **each.get("within", {})), each["direction"], name)
        for name, each in config["bundles"].items()
    ]
    return Muscles(found, config["stiffness"], **{key: config[key] for key in ("toe",) if key in config})
