"""Differentiable soft-body simulation on NVIDIA Warp, with learned residual physics.

Public names are imported when they are first used, so that importing the package is fast. `__init__.pyi` lists them.
"""

import importlib
import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

from .io.imports import uncollected

# In a copy of the repository without an editable installation, kernels/ and conf/ are next to this folder.
if importlib.util.find_spec(f"{__name__}.kernels") is None:
    __path__.append(str(Path(__file__).parents[1]))

# The module of each public name, read from the stub for type checkers, which has one name per line.
_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_MODULES = {name: module for module, name in re.findall(r"^from \.([\w.]+) import \w+ as (\w+)$", _STUB, re.MULTILINE)}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if (module := f"{__name__}.{_MODULES[name]}") not in sys.modules:
        with uncollected():
            importlib.import_module(module)
    return getattr(sys.modules[module], name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _version() -> str:
    """The installed version; 0+unknown for a copy of the repository without an installation."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("warp-resphys")
    except PackageNotFoundError:
        return "0+unknown"
