"""A plugin of pytest that hides all that stands on the core: `-p support.core_alone`."""

import sys
from importlib.abc import MetaPathFinder
from pathlib import Path

import warp_resphys

CORE = {"__init__", "core", "energies", "io", "kernels", "mesh", "moved"}
ABOVE = {path.stem for path in Path(warp_resphys.__file__).parent.iterdir()} - CORE


class Hidden(MetaPathFinder):
    """Finds nothing of the floors above."""

    def find_spec(self, fullname, path=None, target=None):
        package, _, module = fullname.partition(".")
        if package == "warp_resphys" and module.partition(".")[0] in ABOVE:
            raise ImportError(f"{fullname} is hidden: the core must not import it")


loaded = {name for name in sys.modules if name.startswith("warp_resphys.")}
assert not {name for name in loaded if name.split(".")[1] in ABOVE}, loaded
sys.meta_path.insert(0, Hidden())
