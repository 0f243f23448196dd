"""Laws of silicones that come with the package, by name:
``scripts/silicone_laws.py`` writes most of them.
"""

import re
from pathlib import Path
from typing import Any, Final

from ...io.errors import did_you_mean
from ...io.safe_files import read_json

SILICONE: Final = "silicone"  # model of a material that has the law of a silicone by its name
_LAWS: Final = Path(__file__).parents[2] / "laws"
_OF_ROBOTS: Final = ("mass_damping",)


def silicone_files() -> dict[str, Path]:
    """Returns the files of the laws by name."""
    return {path.stem: path for path in sorted(_LAWS.glob("*.json"))}


def silicone_name(product: str) -> str:
    """Returns the name of a silicone, such as ecoflex_00_30 for Ecoflex 00-30.

    Raises:
        ValueError: it has no law here.
    """
    known = {_letters(name): name for name in silicone_files()}
    wanted = _letters(product)
    if wanted not in known:
        near = (
            did_you_mean(product, [*known.values()])
            or f": choose from {', '.join(known.values())}."
        )
        raise ValueError(f"name is {product!r}, which has no law here{near}")
    return known[wanted]


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "", name.lower())


def silicone_values(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the values of a material whose model is ``silicone``,
    with the parameters of the law of its ``name``.

    Raises:
        ValueError: there is no such silicone.
    """
    if values.get("model") != SILICONE:
        return values
    law = read_json(silicone_files()[silicone_name(str(values.get("name", "")))])
    parameters = {
        name: value for name, value in law["parameters"].items() if name not in _OF_ROBOTS
    }
    return {**parameters, **{k: x for k, x in values.items() if k != "name"}, "model": law["model"]}
