"""Materials by the names that they have in configurations."""

from typing import Any

from ..io.errors import InputError
from .materials import ConvexMaterial, Corotated, Gent, Material, MooneyRivlin, StableNeoHookean
from .neural import NeuralMaterial

MATERIALS: dict[str, type[Material]] = {
    kind.model: kind for kind in (Corotated, StableNeoHookean, MooneyRivlin, Gent, ConvexMaterial, NeuralMaterial)
}


def make_material(model: str = "corotated", **constants: Any) -> Material:
    """Returns the named material.

    Raises:
        InputError: an unknown name, a constant that the material does not have, or a value out of range.
    """
    if model not in MATERIALS:
        raise InputError(f"material model is {model!r}: choose one of {', '.join(MATERIALS)}.")
    return MATERIALS[model].from_constants(constants)
