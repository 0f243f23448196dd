"""Materials by the names that they have in configurations."""

from typing import Any, Final

from ..io.classes import imported
from ..io.errors import InputError
from .materials import ConvexMaterial, Corotated, Gent, Material, MooneyRivlin, StableNeoHookean

MATERIALS: Final[dict[str, type[Material]]] = {
    kind.model: kind for kind in (Corotated, StableNeoHookean, MooneyRivlin, Gent, ConvexMaterial)
}


def make_material(model: str = "corotated", **constants: Any) -> Material:
    """Returns the named material.

    Args:
        model: its name, or for one of another package module and class, such as ``my_physics.Fung``.
        constants: by name.

    Raises:
        InputError: an unknown name, a constant that the material does not have, or a value out of range.
    """
    if model in MATERIALS:
        return MATERIALS[model].from_constants(constants)
    if "." not in model:
        raise InputError(
            f"material model is {model!r}: choose one of {', '.join(MATERIALS)}, or give your own class as _target_."
        )
    material: Material = imported(model, Material).from_constants(constants)
    return material
