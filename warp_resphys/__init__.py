"""Differentiable soft-body simulation on NVIDIA Warp, with learned residual physics.

The public names are in `names`, those of the simulator in `core.public`. The first use of one
imports them, so that importing the package is fast. Further names are in `mesh`, `energies`,
`learning` and `pictures`.
"""

import importlib.util
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from . import moved
from .io.process import collector_paused

# In a copy of the repository without an editable installation, kernels/ and conf/ are next to this
# folder.
if importlib.util.find_spec(f"{__name__}.kernels") is None:
    __path__.append(str(Path(__file__).parents[1]))

moved.install()

_PARTS: Final = ("energies", "learning", "mesh", "pictures")


def _public(name: str) -> Any:
    """Returns a public name, `__all__` or `__version__`."""
    if name == "__version__":
        return _version()
    if name in _PARTS:
        return import_module(f"{__name__}.{name}")
    if name == "__all__":
        return [*_names_in("names")]
    if name[:1] != "_" and importlib.util.find_spec(f"{__name__}.{name}") is None:
        # Those of the simulator come first, so that it is imported without what stands on it.
        for module in ("core.public", "names"):
            names = _names_in(module)
            if name in names:
                return names[name]
        for part in _PARTS:
            if hasattr(import_module(f"{__name__}.{part}"), name):
                raise AttributeError(
                    f"module {__name__!r} has no attribute {name!r}: it is in {__name__}.{part}"
                )
    # A module is imported by its statement.
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _names_in(module: str) -> dict[str, Any]:
    """Returns the public names of a module."""
    with collector_paused():
        names = vars(import_module(f"{__name__}.{module}"))
    return {name: value for name, value in names.items() if name[:1] != "_"}


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
