"""Where Warp keeps compiled kernels: a temporary folder where its own cannot be written, as in many containers."""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

import warp as wp

from .errors import InputError


def ensure_kernel_cache() -> None:
    """Points Warp, here and in processes started from here, to a temporary cache if its own cannot be written.

    To be called before Warp is initialised, which fails then. Kernels in a cache that can only be read are copied.

    Raises:
        InputError: no place for temporary files can be written either.
    """
    cache = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
    if cache is None:
        if sys.platform != "linux":
            return
        cache = os.path.join(os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache")), "warp")
    folder = Path(cache)
    if folder.name != wp.config.version:
        folder /= wp.config.version
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError as error:
        reason = f"Warp's cache {folder} cannot be written ({error.strerror})"
    try:
        temporary = tempfile.mkdtemp(prefix="warp_resphys-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        for kernels in folder.glob("wp_warp_resphys*"):
            shutil.copytree(kernels, Path(temporary, wp.config.version, kernels.name))
    except OSError:
        raise InputError(f"{reason}, nor can a temporary one: set WARP_CACHE_PATH to a folder that can.") from None
    wp.config.kernel_cache_dir = os.environ["WARP_CACHE_PATH"] = temporary
    print(
        f"warning: {reason}: kernels are compiled into a temporary folder, anew in every run; set WARP_CACHE_PATH to a "
        "folder that can be written.",
        file=sys.stderr,
        flush=True,
    )
