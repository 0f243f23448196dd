"""The most memory that this process and its workers have taken."""

import re
import resource
import sys
from pathlib import Path

_largest_worker = 0.0  # [GiB]


def peak_memory_gib() -> float:
    """The most resident memory that this process has had [GiB]."""
    status = Path("/proc/self/status")  # Without what the parent had before, which getrusage includes.
    known = re.search(r"^VmHWM:\s+(\d+) kB$", status.read_text(), re.MULTILINE) if status.is_file() else None
    if known:
        return int(known[1]) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


def count_worker(peak: float) -> None:
    """Keeps what a worker says of its own `peak_memory_gib`."""
    global _largest_worker
    _largest_worker = max(_largest_worker, peak)


def peak_of_workers_gib() -> float:
    """The most that any worker has said [GiB], 0 without any."""
    return _largest_worker
