"""The most memory that a process and its workers have taken."""

import re
import resource
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path


@dataclass
class WorkersMemory:
    """What the workers of a piece of work took."""

    gib: float = 0.0  # the peaks of those that ran at once, added up [GiB]; 0 without any

    def count(self, peaks: Iterable[float]) -> None:
        """Keeps what workers that run at once say of their own `peak_memory_gib`, if it is more than before."""
        self.gib = max(self.gib, sum(peaks))


def peak_memory_gib() -> float:
    """The most resident memory that this process has had [GiB]."""
    status = Path("/proc/self/status")  # Without what the parent had before, which getrusage includes.
    known = re.search(r"^VmHWM:\s+(\d+) kB$", status.read_text(), re.MULTILINE) if status.is_file() else None
    if known:
        return int(known[1]) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def forget_peak_memory() -> None:
    """From now on `peak_memory_gib` tells what comes, where the system can do that."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def available_memory_gib() -> float:
    """Memory that this process may still take [GiB]: what is free, within a container's limit; else infinite."""
    found = []
    meminfo = Path("/proc/meminfo")
    known = re.search(r"^MemAvailable:\s+(\d+) kB$", meminfo.read_text(), re.MULTILINE) if meminfo.is_file() else None
    if known:
        found.append(int(known[1]) / 2**20)
    limit = Path("/sys/fs/cgroup/memory.max")
    if limit.is_file() and (text := limit.read_text().strip()).isdigit():
        found.append(int(text) / 2**30)
    return min(found, default=float("inf"))
