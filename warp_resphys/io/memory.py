"""Peak memory of a process, and available memory."""

import re
import sys
from pathlib import Path

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]


def peak_memory_gib() -> float:
    """Peak resident memory of this process [GiB]; 0 on Windows, which is not asked."""
    # Unlike getrusage, without the memory of the parent process.
    if peaks := _kibibytes("/proc/self/status", "VmHWM"):
        return peaks[0] / 2**20
    if resource is None:
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def available_memory_gib() -> float:
    """Memory that this process may still use [GiB]: free memory within a container's limit; infinite if unknown."""
    limits = [kibibytes / 2**20 for kibibytes in _kibibytes("/proc/meminfo", "MemAvailable")]
    limit = Path("/sys/fs/cgroup/memory.max")
    if limit.is_file() and (text := limit.read_text().strip()).isdigit():
        limits.append(int(text) / 2**30)
    return min(limits, default=float("inf"))


def _kibibytes(path: str, key: str) -> list[int]:
    """The value of a key in a file of /proc; empty if it is missing."""
    text = Path(path).read_text() if Path(path).is_file() else ""
    return [int(value) for value in re.findall(rf"^{key}:\s+(\d+) kB$", text, re.MULTILINE)]
