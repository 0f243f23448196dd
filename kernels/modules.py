"""Where kernels are compiled: one Warp module a scalar type and a part, so that a run compiles what it launches."""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp


def decorators(scalar: type, part: str = "") -> tuple[Callable[..., Any], Callable[..., Any]]:
    """``wp.kernel`` and ``wp.func`` for a part's module; nothing is differentiated by Warp itself."""
    module = ".".join(filter(None, ("warp_resphys", scalar.__name__, part)))
    return functools.partial(wp.kernel, module=module, enable_backward=False), functools.partial(wp.func, module=module)
