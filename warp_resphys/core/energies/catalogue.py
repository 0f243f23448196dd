"""Materials by name, and files of identified laws: those of runs,
and of silicones that come with the package.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from ...io.classes import imported
from ...io.errors import DataFileError, InputError, checks_types, listed
from ...io.safe_files import read_json
from ..fem.integration_points import LODE, principal_stretches, share_outside
from ..mesh.volume_mesh import Mesh
from .convex_material import ConvexMaterial
from .materials import MASS_DAMPING, Corotated, Gent, Material, MooneyRivlin, StableNeoHookean
from .silicones import silicone_files, silicone_name

MATERIALS: Final[dict[str, type[Material]]] = {
    kind.model: kind for kind in (Corotated, StableNeoHookean, MooneyRivlin, Gent, ConvexMaterial)
}
LAW_FORMAT: Final = 2
_UNITS: Final = {
    "density": "kg/m^3",
    "mass": "1/s",
    "damping": "s",
    "viscosity": "Pa s",
    "time": "s",
    "azimuth": "rad",
    "elevation": "rad",
    "ratio": "",
    "slack": "",
    "toe": "",
}


def make_material(model: str = "corotated", **parameters: Any) -> Material:
    """Returns the named material.

    Args:
        model: its name, or for one of another package module and class, such as
            ``my_physics.Fung``.
        parameters: by name.

    Raises:
        InputError: an unknown name, a parameter that the material does not have, or a value out of
            range.
    """
    if model in MATERIALS:
        return MATERIALS[model].from_parameters(parameters)
    if "." not in model:
        raise InputError(
            f"material model is {model!r}: choose one of {', '.join(MATERIALS)}, or give your "
            "own class as _target_."
        )
    material: Material = imported(model, Material).from_parameters(parameters)
    return material


def law_path(name: str) -> Path:
    """Path of a law: a file, or the name of a silicone whose law comes with the package.

    Raises:
        DataFileError: there is neither.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return path
    known = silicone_files()
    if name not in known:
        raise DataFileError(
            f"there is no law {name}: give the law.json of a run, or one of "
            f"{listed(sorted(known))}."
        )
    return known[name]


class LawTest(TypedDict):
    """Errors of a law on the trials that it was tested on,
    root mean squares over the amplitude of the motion.
    """

    trials: list[str]
    split: str  # that they belong to
    law: float | None  # with the law; None where the simulation failed
    below: float | None  # without it


class TriedClass(TypedDict):
    """A class of laws that was tried."""

    groups: list[str]
    parameters: dict[str, float]
    residual: float | None  # of the weak form
    validation: float | None  # as `LawTest.law`


class LawContent(TypedDict):
    """Content of law.json; only the model and the parameters of a law are needed to use it."""

    model: str
    parameters: dict[str, float]
    format: NotRequired[int]
    units: NotRequired[dict[str, str]]  # by parameter
    accepted: NotRequired[bool]  # whether it helps on the trials that it was tested on
    others: NotRequired[dict[str, float]]  # parameters identified beside it
    deviation: NotRequired[dict[str, float]]  # standard deviations of both
    shear_deviation: NotRequired[float]  # that of the shear modulus at small strains [Pa]
    at_bounds: NotRequired[list[str]]
    validation: NotRequired[LawTest]
    groups: NotRequired[list[str]]  # of terms, besides the modulus
    loss: NotRequired[float]
    classes: NotRequired[list[TriedClass]]
    stretches: NotRequired[list[float]]  # least and largest in the trials of its identification
    modes: NotRequired[list[str]]  # of loading, see `fem.integration_points.LODE`; default: all
    data: NotRequired[dict[str, str | list[str]]]  # `name` of its run, and the training `trials`
    versions: NotRequired[dict[str, str]]
    file: NotRequired[str]  # of a law of another run
    accepted_there: NotRequired[bool]


def law_content(model: str, parameters: Mapping[str, float]) -> LawContent:
    """Returns the content of a law's file, see `read_law`."""
    units = {name: unit_of(name) for name in parameters}
    return {"format": LAW_FORMAT, "model": model, "parameters": dict(parameters), "units": units}


def read_law(name: str) -> LawContent:
    """Reads a law that `identify_law` wrote.

    Args:
        name: as for `law_path`.

    Raises:
        DataFileError: the file is missing, damaged or of another version.
    """
    path = law_path(name)
    content = read_json(path)
    known = content if isinstance(content, dict) else {}
    parameters = known.get("parameters")
    of_today = known.get("format") == LAW_FORMAT and known["format"] is not True
    if not (
        of_today
        and isinstance(known.get("model"), str)
        and isinstance(parameters, dict)
        and parameters
    ):
        raise DataFileError(
            f"{path} is not a law of this version: "
            "give a law.json that a run with the group law has written."
        )
    units = known.get("units", {})
    if not isinstance(units, dict):
        raise DataFileError(
            f"{path}: units is {units!r}: give the unit of each parameter, or leave it out."
        )
    for key, value in parameters.items():
        if type(value) not in (int, float) or not math.isfinite(value):
            raise DataFileError(
                f"{path}: parameters.{key} is {value!r}: a law has a finite number there; "
                "identify it again."
            )
        unit = units.get(key, unit_of(key))
        if unit != unit_of(key):
            raise DataFileError(
                f"{path}: units.{key} is {unit!r}: a law has {unit_of(key)!r} there."
            )
    match known.get("stretches", [1.0, 1.0]):
        case [float() | int() as low, float() | int() as high]:
            ordered = bool not in (type(low), type(high)) and 0.0 < low <= high < math.inf
        case _:
            ordered = False
    if not ordered:
        raise DataFileError(
            f"{path}: stretches is {known['stretches']!r}: give the least and the largest "
            "stretch, or leave it out."
        )
    modes = known.get("modes", [*LODE])
    if not isinstance(modes, list) or not modes or not {*map(str, modes)} <= LODE.keys():
        raise DataFileError(
            f"{path}: modes is {modes!r}: give a list of {listed([*LODE])}, or leave it out."
        )
    absent = dict.fromkeys(("c10", "bulk_1"), 0.0) if known["model"] == ConvexMaterial.model else {}
    return {**known, "model": known["model"], "parameters": absent | parameters}


def unit_of(name: str) -> str:
    """Unit of a parameter of a law."""
    return next((unit for word, unit in _UNITS.items() if word in name.split("_")), "Pa")


def share_outside_law(name: str, mesh: Mesh, positions: NDArray[np.float64]) -> float:
    """The share of cells and states in which a law extrapolates,
    by stretches and loading at the centres of cells.

    Args:
        name: as for `law_path`.
        mesh: undeformed mesh.
        positions: (S, N, 3) vertices of some states [m], of which at most 400 are looked at, evenly
            chosen.

    Raises:
        DataFileError: as for `read_law`, or the file does not have the stretches.
        InputError: no state is finite.
    """
    law = read_law(name)
    if "stretches" not in law:
        raise DataFileError(
            f"{law_path(name)} has no stretches: identify the law again, which writes them."
        )
    stretches = principal_stretches(mesh, positions)
    if not np.isfinite(stretches).any():
        raise InputError(
            "positions has no finite state, "
            "so that there are no stretches: give states of a motion."
        )
    return share_outside(stretches, law["stretches"], modes_of(law))


def modes_of(law: LawContent) -> list[str]:
    """Returns the loading modes of the range of a law."""
    return law.get("modes", [*LODE])


@checks_types
def read_material(name: str) -> Material:
    """The material of a law: the law.json of a run, or a silicone whose law comes with the package.

    Args:
        name: path of the file, or name of the silicone, such as ``dragon_skin_10``.

    Returns:
        The material, with the density of the law; its damping by mass, which is of the robot, is
        left out.

    Raises:
        DataFileError: the file is missing, damaged or of another version.
        InputError: a parameter that the material does not have, or a value out of range.
    """
    law = read_law(name)
    return make_material(
        law["model"], **{key: x for key, x in law["parameters"].items() if key != MASS_DAMPING}
    )


@checks_types
def silicone(product: str) -> Material:
    """Returns the material of a silicone, by its law that comes with the package
    (docs/results/silicones.md).

    Batches differ, by mixing, cure and age, as do laboratories: identify the law of your own
    (`identify_from_tests`), or the factor of the stiffness on your robot.

    Args:
        product: name, such as ``Ecoflex 00-30`` or ``ecoflex_00_30``.

    Raises:
        InputError: the package has no law of it.
    """
    try:
        name = silicone_name(product)
    except ValueError as error:
        raise InputError(f"silicone: {error}") from error
    return read_material(name)
