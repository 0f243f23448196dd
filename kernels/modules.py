"""Where kernels are compiled: one Warp module a part, so that a run compiles what it launches."""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp


def decorators(part: str = "") -> tuple[Callable[..., Any], Callable[..., Any]]:
    """``wp.kernel`` and ``wp.func`` for a part's module; nothing is differentiated by Warp itself."""
    module = f"warp_resphys.{part}" if part else "warp_resphys"
    return functools.partial(wp.kernel, module=module, enable_backward=False), functools.partial(wp.func, module=module)
