"""Modules that have moved: their old names import them until version 0.3, with a warning."""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType
from typing import Final

from typing_extensions import override

from .io.errors import ResphysWarning

# New names by old ones, without the package; modules below them have moved along.
MOVED: Final = {
    "dynamics": "core.dynamics",
    "energies": "core.energies",
    "fem": "core.fem",
    "linalg": "core.linalg",
    "mesh": "core.mesh",
    "settings.mesh": "settings.meshing",
    "settings.silicones": "core.energies.silicones",
    "stepping": "core.stepping",
    "studies.gradient_check": "core.dynamics.gradient_check",
}
_PACKAGE: Final = f"{__package__}."


def install() -> None:
    """Lets imports find moved modules by their old names."""
    if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
        # First, as the folder of a moved package would give second copies of its modules.
        sys.meta_path.insert(0, _OldNames())


def new_name(old: str) -> str | None:
    """Returns the name of a module that has moved; None for others.

    `energies` and `mesh` themselves are still modules, with public names.
    """
    if not old.startswith(_PACKAGE):
        return None
    path = old.removeprefix(_PACKAGE)
    for before, after in MOVED.items():
        if path.startswith(f"{before}.") or (path == before and before not in ("energies", "mesh")):
            return f"{_PACKAGE}{after}{path.removeprefix(before)}"
    return None


class _OldNames(MetaPathFinder, Loader):
    """Finds moved modules; the module itself is imported under its new name, once."""

    @override
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return None if new_name(fullname) is None else spec_from_loader(fullname, self)

    @override
    def create_module(self, spec: ModuleSpec) -> ModuleType:
        new = new_name(spec.name)
        assert new is not None
        module = import_module(new)
        warnings.warn(
            f"the module {spec.name} is now {new}: change the import. The old name goes in 0.3.",
            ResphysWarning,
            stacklevel=2,
        )
        spec.loader_state = module.__spec__
        return module

    @override
    def exec_module(self, module: ModuleType) -> None:
        # It was executed under its new name, which it keeps.
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state
