"""Processes that work in one folder and can tell whether the others are alive.

A worker holds a file of its own: locked for as long as it lives, and rewritten every few seconds. Under the same
kernel, the lock says at once that it died, whatever it died of. Across machines, and for a process that is stopped,
the file does: it no longer changes. Clocks are never compared.
"""

from __future__ import annotations

import fcntl
import logging
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from ...io.errors import DataFileError

log = logging.getLogger(__name__)

_BEATS_UNTIL_STALE = 5
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def kernel_name() -> str:
    """What two processes have in common if, and only if, they see each other's locks at once."""
    return _BOOT_ID.read_text(encoding="ascii").strip() if _BOOT_ID.is_file() else socket.gethostname()


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Holds a lock file, waiting for whoever holds it; the system lets go of it however the process ends.

    Raises:
        DataFileError: the file cannot be written, or its file system has no locks.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise DataFileError(f"cannot write {path} ({error.strerror}): make the folder writable") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError as error:
            raise DataFileError(f"cannot lock {path} ({error.strerror}): choose a folder on another disk") from error
        yield
    finally:
        os.close(descriptor)


class Worker:
    """This process among the workers of a folder; use it as a context manager.

    Attributes:
        identity: what others need to find out whether it lives: ``token``, ``host``, ``pid`` and ``kernel``.
    """

    def __init__(self, folder: Path, stale_after: float) -> None:
        """Describes the worker.

        Args:
            folder: where all workers of the same work have their files; made where it is missing.
            stale_after: seconds without a sign of life after which the others take it for dead [s].
        """
        self.identity: dict[str, Any] = {
            "token": uuid.uuid4().hex,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "kernel": kernel_name(),
        }
        self._path = folder / f"{self.identity['token']}.alive"
        self._every = stale_after / _BEATS_UNTIL_STALE
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="signs of life", daemon=True)
        self._descriptor = -1

    def __enter__(self) -> Worker:
        """Starts to give signs of life.

        Raises:
            DataFileError: the folder cannot be written, or its file system has no locks.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX)
            self._sign(0)
        except OSError as error:
            raise DataFileError(
                f"cannot write or lock {self._path} ({error.strerror}): choose a run folder on another disk"
            ) from error
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves: what this worker had begun is free for the others."""
        self._stopped.set()
        self._thread.join()
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)

    def _beat(self) -> None:
        count = 0
        while not self._stopped.wait(self._every):
            count += 1
            try:
                self._sign(count)
            except OSError as error:  # On a full disk the others may take over; the owner finds that out.
                log.warning("cannot write a sign of life to %s: %s", self._path, error.strerror)

    def _sign(self, count: int) -> None:
        os.pwrite(self._descriptor, f"{count:12d}\n".encode(), 0)
        os.fsync(self._descriptor)


class Watch:
    """Tells which workers of a folder live."""

    def __init__(self, folder: Path, stale_after: float) -> None:
        """Describes where to look.

        Args:
            folder: as for `Worker`.
            stale_after: seconds without a change after which a worker is taken for dead [s].
        """
        self._folder, self._stale_after = folder, stale_after
        self._kernel = kernel_name()
        self._seen: dict[str, tuple[bytes, float]] = {}

    def is_alive(self, identity: Mapping[str, Any]) -> bool:
        """Whether a worker lives, as far as can be known.

        Args:
            identity: of the worker.
        """
        path = self._folder / f"{identity['token']}.alive"
        try:
            descriptor = os.open(path, os.O_RDONLY)  # Opening it asks a network's server for what is there now.
        except FileNotFoundError:
            return False
        try:
            if identity["kernel"] == self._kernel and _is_free(descriptor):
                return False
            content = os.pread(descriptor, 64, 0)
        finally:
            os.close(descriptor)
        now = time.monotonic()
        before = self._seen.get(identity["token"])
        if before is None or before[0] != content:
            self._seen[identity["token"]] = (content, now)
            return True
        return now - before[1] <= self._stale_after


def _is_free(descriptor: int) -> bool:
    """Whether nobody holds the lock of an open file."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
