"""Files of identified laws: those that runs write, and those of silicones that come with the package."""

from pathlib import Path
from typing import Any, Final

from ..io.errors import DataFileError, listed
from ..io.files import read_json
from .catalogue import make_material
from .materials import Material

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
    content: dict[str, Any] = read_json(path)
    whole = isinstance(content.get("constants"), dict) and isinstance(content.get("model"), str)
    if content.get("format") != LAW_FORMAT or not whole:
        raise DataFileError(
            f"{path} is not a law of this version: give a law.json that a run with the group law has written."
        )
    return content


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
    return make_material(law["model"], **{key: x for key, x in law["constants"].items() if key != "mass_damping"})
