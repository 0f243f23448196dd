"""Warp's cache of compiled kernels: a temporary folder
if Warp's own is not writable, as in many containers.
"""

import atexit
import os
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Final

import torch
import warp as wp

from .errors import InputError

_STARTING: Final = Lock()


@cache
def start_quietly() -> None:
    """Initialises Warp without a message of its library on a machine without an NVIDIA driver."""
    wp.config.log_level = wp.LOG_WARNING
    if torch.cuda.is_available():
        wp.init()
        return
    with _STARTING:
        shown = os.dup(2)
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)  # The library writes to it itself.
            wp.init()
        finally:
            os.dup2(shown, 2)
            os.close(shown)


def ensure_kernel_cache() -> None:
    """Sets a temporary cache for this process and its children if Warp's own is not writable.

    Call it before Warp is initialised, which would fail. Kernels in a read-only cache are copied.

    Raises:
        InputError: temporary files cannot be written either.
    """
    cache = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
    if cache is None:
        if sys.platform != "linux":
            return
        cache = os.path.join(
            os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache")), "warp"
        )
    folder = Path(cache)
    if folder.name != wp.config.version:
        folder /= wp.config.version
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError as error:
        reason = f"Warp's cache {folder} is not writable ({error.strerror})"
    try:
        temporary = tempfile.mkdtemp(prefix="warp_resphys-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        for kernels in folder.glob("wp_warp_resphys*"):
            shutil.copytree(kernels, Path(temporary, wp.config.version, kernels.name))
    except OSError:
        raise InputError(
            f"{reason}, nor is a temporary one: set WARP_CACHE_PATH to a writable folder."
        ) from None
    wp.config.kernel_cache_dir = os.environ["WARP_CACHE_PATH"] = temporary
    print(
        f"warning: {reason}: kernels are compiled into a temporary folder in every run; set "
        "WARP_CACHE_PATH to a writable folder.",
        file=sys.stderr,
        flush=True,
    )
