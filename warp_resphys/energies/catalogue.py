"""Materials by the names that they have in configurations."""

from typing import Any, Final

from ..io.entry_points import extension
from ..io.errors import InputError
from .materials import ConvexMaterial, Corotated, Gent, Material, MooneyRivlin, StableNeoHookean

MATERIALS: Final[dict[str, type[Material]]] = {
    kind.model: kind for kind in (Corotated, StableNeoHookean, MooneyRivlin, Gent, ConvexMaterial)
}


def make_material(model: str = "corotated", **constants: Any) -> Material:
    """Returns the named material, of this package or of another one with an entry point in ``warp_resphys.materials``.

    Raises:
        InputError: an unknown name, a constant that the material does not have, or a value out of range.
    """
    if model in MATERIALS:
        return MATERIALS[model].from_constants(constants)
    source = extension("materials", model, MATERIALS, f"material model is {model!r}")
    kind = source.load()
    if not (isinstance(kind, type) and issubclass(kind, Material)):
        raise InputError(f"{model} of the package {source} is {kind!r}: its entry point must name a Material.")
    try:
        return kind.from_constants(constants)
    except InputError as error:
        raise InputError(f"{model} of the package {source}: {error}") from error
