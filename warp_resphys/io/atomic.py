"""Atomic writes: a file is written under a temporary name,
synchronised to the disk and then renamed.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

from .errors import DataFileError

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path, which is renamed to `path` when the block ends without an error.

    Raises:
        DataFileError: the disk is full, or the folder is not writable.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            _sync(partial)
            os.replace(partial, path)
            _sync(path.parent)
        finally:
            partial.unlink(missing_ok=True)
    except Exception as error:
        if is_disk_full(error):
            raise disk_full_error(path) from error
        places = (str(partial), *(str(folder) for folder in path.parents))
        if isinstance(error, OSError) and str(error.filename) in places:
            raise DataFileError(
                f"cannot write {path} ({error.strerror}): "
                "make its folder writable or choose another path"
            ) from error
        raise


def _sync(path: Path) -> None:
    """Waits until the file or folder has reached the disk.

    Windows has no such order for folders.
    """
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_disk_full(error: BaseException) -> bool:
    """Whether an error means, by number or text, that a disk,
    a quota or a file-size limit is exhausted.
    """
    message = str(error).lower()
    return getattr(error, "errno", None) in _DISK_FULL or any(
        os.strerror(code).lower() in message for code in _DISK_FULL
    )


def disk_full_error(path: str | Path) -> DataFileError:
    """Returns the error to raise when there is no space for a file."""
    return DataFileError(
        f"disk is full while writing {path}: free some space and run the same command again"
    )


def digest(path: str | Path) -> str:
    """SHA-256 of a file's content, or of the names and contents of the files
    in a folder, in hexadecimal.
    """
    folder = Path(path)
    if folder.is_dir():
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        contents = "".join(f"{file.relative_to(folder)} {digest(file)}\n" for file in files)
        return hashlib.sha256(contents.encode()).hexdigest()
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_error(path: str | Path, error: OSError) -> DataFileError:
    """Returns the error to raise when the operating system failed to read a file."""
    if isinstance(error, FileNotFoundError):
        return DataFileError(
            f"{path} does not exist: check the path, or run the stage that writes it"
        )
    if isinstance(error, (PermissionError, IsADirectoryError)):
        return DataFileError(
            f"cannot read {path} ({error.strerror}): check the path and its permissions"
        )
    return DataFileError(f"cannot read {path} ({error}): write or download it again")
