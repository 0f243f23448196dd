"""The command `inspect extensions`: classes of other packages, with the keys that they take."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from ..energies.materials import Material
from ..io.entry_points import KINDS, Extension, extensions
from ..io.errors import InputError
from ..io.setting_errors import in_words
from ..io.settings import Settings, Some


class ExtensionListing(Settings):
    """The configuration ``inspect_extensions``, which explains its keys."""

    kinds: Some[Literal["materials", "energies", "observations", "networks"]]


def list_extensions(settings: ExtensionListing, folder: Path) -> None:
    """Prints the classes of installed packages; one that cannot be imported is listed with the reason."""
    del folder
    print("\n".join(line for kind in settings.kinds for line in listing(kind)))


def listing(kind: str) -> Iterator[str]:
    """Yields the lines on a kind of class."""
    yield f"{kind}:"
    every = extensions(kind)
    if not every:
        yield f"  none; a package has its own in the entry points warp_resphys.{kind}"
    for own in every:
        yield f"  {own.point.name} (of {own})"
        try:
            yield from (f"    {line}" for line in _keys(own))
        except InputError as error:
            yield f"    {error}"


def _keys(own: Extension) -> Iterator[str]:
    """Yields a line for each key."""
    loaded = own.load()
    if isinstance(loaded, type) and issubclass(loaded, Material):
        for name, quantity in loaded.own_quantities().items():
            yield f"{name}: {quantity.valid_range}"
    elif isinstance(loaded, type) and issubclass(loaded, Settings):
        schema = loaded.model_json_schema()
        for name, key in schema.get("properties", {}).items():
            meaning = f"; {key['description']}" if "description" in key else ""
            yield f"{name}: {in_words(key, schema)}{meaning}"
    else:
        raise InputError(f"its entry point names {loaded!r}, which is no {KINDS[own.kind]}: correct {own.package}.")
