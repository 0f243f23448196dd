"""Differentiable soft-body simulation on NVIDIA Warp, with learned residual physics.

The public names are in `names`, of which the first use imports all, so that importing the package
is fast; further ones are in `mesh`, `energies`, `learning` and `pictures`.
"""

import importlib.util
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from .io.process import collector_paused

# In a copy of the repository without an editable installation, kernels/ and conf/ are next to this
# folder.
if importlib.util.find_spec(f"{__name__}.kernels") is None:
    __path__.append(str(Path(__file__).parents[1]))

_PARTS: Final = ("energies", "learning", "mesh", "pictures")


def _public(name: str) -> Any:
    """Returns a public name, `__all__` or `__version__`."""
    if name == "__version__":
        return _version()
    if name in _PARTS:
        return import_module(f"{__name__}.{name}")
    if name == "__all__" or (
        name[:1] != "_" and importlib.util.find_spec(f"{__name__}.{name}") is None
    ):
        with collector_paused():
            public = {
                key: value
                for key, value in vars(import_module(f"{__name__}.names")).items()
                if key[:1] != "_"
            }
        if name == "__all__":
            return [*public]
        if name in public:
            return public[name]
        for part in _PARTS:
            if hasattr(import_module(f"{__name__}.{part}"), name):
                raise AttributeError(
                    f"module {__name__!r} has no attribute {name!r}: it is in {__name__}.{part}"
                )
    # A module is imported by its statement.
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*_public("__all__"), *_PARTS, "__version__"]


def _version() -> str:
    """The installed version; 0+unknown for a copy of the repository without an installation."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("warp-resphys")
    except PackageNotFoundError:
        return "0+unknown"


if TYPE_CHECKING:
    from . import energies as energies
    from . import learning as learning
    from . import mesh as mesh
    from . import pictures as pictures
    from .names import *  # noqa: F403

    __version__: str
else:
    __getattr__ = _public
