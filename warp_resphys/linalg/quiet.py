"""Keeps warnings that CHOLMOD prints by C out of the standard output; cholespy has no option for that."""

import ctypes
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import IO, Final

_STDOUT: Final = 1  # file descriptor
_WARNING: Final = b"CHOLMOD warning"


class _Redirection:
    """Redirection of the standard output of this process, which its threads share."""

    def __init__(self) -> None:
        self._lock, self._count = Lock(), 0
        self._file: IO[bytes] | None = None
        self._before = -1

    def begin(self) -> None:
        """Redirects, unless another thread has done so."""
        with self._lock:
            if self._count == 0:
                _flush()
                self._file, self._before = tempfile.TemporaryFile(), os.dup(_STDOUT)  # noqa: SIM115
                os.dup2(self._file.fileno(), _STDOUT)
            self._count += 1

    def end(self) -> None:
        """Restores the output after the last thread, and writes all lines to it that are no warnings of CHOLMOD."""
        with self._lock:
            self._count -= 1
            if self._count == 0 and self._file is not None:
                _flush()
                os.dup2(self._before, _STDOUT)
                os.close(self._before)
                self._file.seek(0)
                lines = self._file.readlines()
                self._file.close()
                if kept := b"".join(line for line in lines if not line.startswith(_WARNING)):
                    os.write(_STDOUT, kept)


_redirection: Final = _Redirection()  # one, as the process has one standard output


@contextmanager
def without_warnings_of_cholmod() -> Iterator[None]:
    """Leaves out what CHOLMOD prints meanwhile; other output comes at the end.

    Processes that are started meanwhile lose their output. On Windows, whose C libraries do not share their buffers,
    nothing is left out.
    """
    if os.name == "nt":
        yield
        return
    _redirection.begin()
    try:
        yield
    finally:
        _redirection.end()


def _flush() -> None:
    """Writes what the C library has buffered."""
    ctypes.CDLL(None).fflush(None)
