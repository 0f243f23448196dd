"""Files of identified laws: those that runs write, and those of silicones that come with the package."""

import math
from pathlib import Path
from typing import Any, Final

from ..io.errors import DataFileError, listed
from ..io.files import read_json
from .catalogue import make_material
from .materials import MASS_DAMPING, ConvexMaterial, Material

LAW_FORMAT: Final = 1
_LAWS: Final = Path(__file__).parents[1] / "laws"


def law_path(name: str) -> Path:
    """Path of a law: a file, or the name of a silicone whose law comes with the package.

    Raises:
        DataFileError: there is neither.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return path
    known = {shipped.stem: shipped for shipped in _LAWS.glob("*.json")}
    if name not in known:
        raise DataFileError(f"there is no law {name}: give the law.json of a run, or one of {listed(sorted(known))}.")
    return known[name]


def read_law(name: str) -> dict[str, Any]:
    """Contents of a law that `identify_law` wrote, with at least its ``model`` and its ``constants``.

    Args:
        name: as for `law_path`.

    Raises:
        DataFileError: the file is missing, damaged or of another version.
    """
    path = law_path(name)
    content = read_json(path)
    known = content if isinstance(content, dict) else {}
    constants, of_today = known.get("constants"), known.get("format") == LAW_FORMAT and known["format"] is not True
    if not (of_today and isinstance(known.get("model"), str) and isinstance(constants, dict) and constants):
        raise DataFileError(
            f"{path} is not a law of this version: give a law.json that a run with the group law has written."
        )
    for key, value in constants.items():
        if type(value) not in (int, float) or not math.isfinite(value):
            raise DataFileError(
                f"{path}: constants.{key} is {value!r}: a law has a finite number there; identify it again."
            )
    absent = dict.fromkeys(("c10", "bulk_1"), 0.0) if known["model"] == ConvexMaterial.model else {}
    return {**known, "constants": absent | constants}


def read_material(name: str) -> Material:
    """The material of a law: the law.json of a run, or a silicone whose law comes with the package.

    Args:
        name: path of the file, or name of the silicone, such as ``dragon_skin_10``.

    Returns:
        The material, with the density of the law; its damping by mass, which is of the robot, is left out.

    Raises:
        DataFileError: the file is missing, damaged or of another version.
        InputError: a constant that the material does not have, or a value out of range.
    """
    law = read_law(name)
    return make_material(law["model"], **{key: x for key, x in law["constants"].items() if key != MASS_DAMPING})
