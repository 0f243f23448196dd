"""Processes that work in one folder: who may write, and who is alive.

A worker holds the lock of a file of its own for as long as it lives. The system lets go of it whatever the process died
of; on a network's disk its server does, once it no longer hears of the machine.
"""

import fcntl
import os
import socket
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...io.errors import DataFileError


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Holds a lock file, waiting for whoever holds it; the system lets go of it however the process ends.

    Raises:
        DataFileError: the file cannot be written, or its file system has no locks.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
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


@contextmanager
def at_work(folder: Path) -> Iterator[dict[str, Any]]:
    """Makes this process one of the workers of a folder; gives its ``token``, ``host`` and ``pid``.

    Raises:
        DataFileError: see `held`.
    """
    identity = {"token": uuid.uuid4().hex, "host": socket.gethostname(), "pid": os.getpid()}
    path = folder / f"{identity['token']}.alive"
    with held(path):
        try:
            yield identity
        finally:
            path.unlink(missing_ok=True)


def is_alive(folder: Path, identity: Mapping[str, Any]) -> bool:
    """Whether the worker lives that `at_work` gave this identity: its file is there, and locked."""
    try:
        descriptor = os.open(folder / f"{identity['token']}.alive", os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
