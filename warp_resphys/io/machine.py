"""Hardware and code version of a result, to compare computing times; devices by name; memory."""

import os
import platform
import re
import shutil
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import torch

from .errors import InputError

_CPU_INFO = Path("/proc/cpuinfo")
try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def find_device(name: str | torch.device, choices: str = "cpu or cuda") -> torch.device:
    """Returns the named device, or raises InputError if it is unknown or unavailable."""
    if not re.fullmatch(r"(cpu|cuda)(:\d+)?", str(name)):
        raise InputError(f"device is {name!r}: choose {choices}.")
    device, count = torch.device(name), torch.cuda.device_count()
    if device.type == "cuda" and not count:
        raise InputError(f"device is {name!r}, but torch finds no CUDA device: choose device=cpu.")
    if device.type == "cuda" and (device.index or 0) >= count:
        raise InputError(f"device is {name!r}, but torch finds {count} CUDA devices.")
    return device


def hardware() -> dict[str, str]:
    """Describes processor, usable cores, GPU and operating system."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return {
        "processor": _processor(),
        "cores used": f"{available_cores()} of {os.cpu_count()}",
        "GPU": gpu,
        "system": f"{platform.system()} {platform.machine()}",
    }


def _processor() -> str:
    if _CPU_INFO.is_file():
        for line in _CPU_INFO.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


@lru_cache
def made_on() -> dict[str, str]:
    """Describes hardware and commit, as they were at the first call."""
    return {**hardware(), "commit": commit() or "not known"}


def commit() -> str | None:
    """Commit of the running code, with "and changes" if files differ.

    None outside a git repository.
    """
    folder = Path(__file__).parent
    if (
        shutil.which("git") is None
        or _git(folder, "ls-files", "--error-unmatch", Path(__file__).name) is None
    ):
        return None
    name = _git(folder, "rev-parse", "--short=10", "HEAD")
    return (
        f"{name} and changes"
        if _git(folder, "status", "--porcelain", "--untracked-files=no")
        else name
    )


def _git(folder: Path, *arguments: str) -> str | None:
    result = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    return result.stdout.strip() if result.returncode == 0 else None


def peak_memory_gib() -> float:
    """Peak resident memory of this process [GiB]; 0 on Windows, which is not asked."""
    # Unlike getrusage, without the memory of the parent process.
    peaks = _kibibytes("/proc/self/status", "VmHWM")
    if peaks:
        return peaks[0] / 2**20
    if resource is None:
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        2**30 if sys.platform == "darwin" else 2**20
    )


def available_memory_gib() -> float:
    """Memory that this process may still use [GiB]: free memory within a container's limit.

    Infinite if unknown.
    """
    limits = [kibibytes / 2**20 for kibibytes in _kibibytes("/proc/meminfo", "MemAvailable")]
    limit = Path("/sys/fs/cgroup/memory.max")
    text = limit.read_text().strip() if limit.is_file() else ""
    if text.isdigit():
        limits.append(int(text) / 2**30)
    return min(limits, default=float("inf"))


def _kibibytes(path: str, key: str) -> list[int]:
    """The value of a key in a file of /proc; empty if it is missing."""
    text = Path(path).read_text() if Path(path).is_file() else ""
    return [int(value) for value in re.findall(rf"^{key}:\s+(\d+) kB$", text, re.MULTILINE)]
