"""Laws of silicones that come with the package, by name: ``scripts/silicone_laws.py`` writes most of them."""

import re
from pathlib import Path
from typing import Any, Final

from ..io.safe_files import read_json

SILICONE: Final = "silicone"  # model of a material that has the law of a silicone by its name
_LAWS: Final = Path(__file__).parents[1] / "laws"
_OF_ROBOTS: Final = ("mass_damping",)


def silicone_files() -> dict[str, Path]:
    """Returns the files of the laws by name."""
    return {path.stem: path for path in sorted(_LAWS.glob("*.json"))}


def silicone_name(product: str) -> str:
    """Returns the name of a silicone, such as ecoflex_00_30 for Ecoflex 00-30.

    Raises:
        ValueError: it has no law here.
    """
    name = re.sub(r"[^a-z0-9]+", "_", product.lower()).strip("_")
    if name not in (known := silicone_files()):
        raise ValueError(f"name is {product!r}: choose from {', '.join(known)}, or identify the law of a tensile test.")
    return name


def silicone_values(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the values of a material whose model is ``silicone``, with the parameters of the law of its ``name``.

    Raises:
        ValueError: there is no such silicone.
    """
    if values.get("model") != SILICONE:
        return values
    law = read_json(silicone_files()[silicone_name(str(values.get("name", "")))])
    parameters = {name: value for name, value in law["parameters"].items() if name not in _OF_ROBOTS}
    return {**parameters, **{k: x for k, x in values.items() if k != "name"}, "model": law["model"]}
