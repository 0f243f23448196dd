"""Reading and writing files: each one appears whole or not at all, and none can run code when it is opened.

A file is written under another name, brought to the disk and then renamed. HDF5 files are built in memory
first: an HDF5 library that meets a full disk cannot close its file any more and crashes the interpreter at
exit. A file should therefore fit into memory two or three times. Long computations write step by step: see
`resumable`.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import numpy.typing as npt

from .decoding import DecodingError, refuse_data_elsewhere
from .errors import DataFileError

if TYPE_CHECKING:
    import torch

FORMAT = "warp_resphys"
FORMAT_VERSION = 1
CHUNK_STEPS = 64
USER_BLOCK = 512  # bytes before an HDF5 file's own, which hold a checksum of those
_CHECKSUM = b"warp_resphys, CRC-32 of what follows the first 512 bytes: "
LARGEST_ARRAYS = 4 << 30  # bytes in one file
# What numpy.load raises for a file that is damaged or made up.
_ARRAY_FAULTS = (
    *(EOFError, LookupError, MemoryError, OverflowError, RuntimeError, SyntaxError, TypeError, ValueError),
    *(struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_disk_full(error: BaseException) -> bool:
    """Whether an error says, by number or text, that a disk, a quota or a file-size limit is exhausted."""
    message = str(error).lower()
    return getattr(error, "errno", None) in _DISK_FULL or any(
        os.strerror(code).lower() in message for code in _DISK_FULL
    )


def disk_full_error(path: str | Path, kept: str | Path | None = None) -> DataFileError:
    """The error to raise when there was no space for `path`; `kept` is where the work done so far lies."""
    rest = "" if kept is None else f"; what was computed is kept in {kept}"
    return DataFileError(f"disk is full while writing {path}: free some space and run the same command again{rest}")


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Gives a temporary path; what is written there takes the place of `path` when the block ends without an error.

    Raises:
        DataFileError: the disk is full, or the place cannot be written to.
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
                f"cannot write {path} ({error.strerror}): make the place writable or choose another one"
            ) from error
        raise


def _sync(path: Path) -> None:
    """Waits until the file or folder has reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def digest(path: str | Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def to_plain(data: Any) -> Any:
    """Turns mappings, sequences, NumPy values, paths and settings into what JSON knows; others raise TypeError."""
    if isinstance(data, Mapping):
        return {str(key): to_plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [to_plain(value) for value in data]
    if isinstance(data, (np.ndarray, np.generic)):
        return to_plain(data.tolist())
    if isinstance(data, Path):
        return str(data)
    if data is None or isinstance(data, (str, bool, int, float)):
        return data
    if hasattr(data, "plain"):  # Settings, without importing pydantic for them
        return data.plain()
    raise TypeError(f"{type(data).__name__} cannot be written as JSON")


def write_json(path: str | Path, data: Any) -> None:
    """Writes standard JSON as `write_text` does; a number that is NaN or infinite becomes null, as JSON has none."""
    plain = json.loads(json.dumps(to_plain(data)), parse_constant=lambda _: None)
    write_text(path, json.dumps(plain, indent=2) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file (UTF-8) atomically; raises DataFileError when it cannot be written."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Reads a JSON file; raises DataFileError when it is missing, cannot be read or is not JSON."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise _read_error(path, error) from error
    except ValueError as error:
        raise DataFileError(f"{path} is not a JSON file ({error}): delete it or write it again") from error


def _read_error(path: str | Path, error: OSError) -> DataFileError:
    if isinstance(error, FileNotFoundError):
        return DataFileError(f"{path} does not exist: check the path, or run the stage that writes it")
    if isinstance(error, (PermissionError, IsADirectoryError)):
        return DataFileError(f"cannot read {path} ({error.strerror}): check the path and its permissions")
    return DataFileError(f"cannot read {path} ({error}): make or fetch it again")


@contextlib.contextmanager
def atomic_hdf5(path: str | Path, kind: str, attributes: Mapping[str, Any] | None = None) -> Iterator[h5py.File]:
    """Gives an HDF5 file to fill in memory; it appears at `path` as by `atomic_path`.

    Args:
        path: Where the file is to appear; missing folders are made.
        kind: What the file holds, such as "trajectories"; `read_hdf5` asks for it.
        attributes: Further attributes of the file's root (numbers, strings, small arrays).
    """
    in_memory = {"driver": "core", "backing_store": False, "block_size": 1 << 20}
    with (
        atomic_path(path) as partial,
        open(partial, "wb") as output,
        h5py.File(partial.name, "w", libver=("v110", "v110"), userblock_size=USER_BLOCK, **in_memory) as file,
    ):
        file.attrs.update({**(attributes or {}), "format": FORMAT, "version": FORMAT_VERSION, "kind": kind})
        file.attrs["complete"] = False
        yield file
        file.attrs["complete"] = True
        file.flush()
        content = file.id.get_file_image()  # without the first block
        output.write(_first_block(zlib.crc32(content)))
        output.write(content)


def create(group: h5py.Group, name: str, array: npt.ArrayLike, units: str = "1", time_axis: int = 0) -> h5py.Dataset:
    """Stores an array as a checksummed dataset, in chunks of 64 steps along `time_axis`.

    Args:
        group: Where to store it.
        name: The dataset's name; a path makes the groups in between.
        array: Numbers of any shape.
        units: SI units of the values, stored as an attribute; "1" for numbers without a unit.
        time_axis: The axis that counts steps; see `chunk_shape`.
    """
    values = np.asarray(array)
    chunks = chunk_shape(values.shape, time_axis)
    dataset = group.create_dataset(name, data=values, chunks=chunks, fletcher32=chunks is not None)
    dataset.attrs["units"] = units
    return dataset


def chunk_shape(shape: tuple[int, ...], time_axis: int = 0) -> tuple[int, ...] | None:
    """One index of the axes before the one of time, all of those after it; no chunks for scalars and empty arrays."""
    if not shape or 0 in shape:
        return None
    return (*(1,) * time_axis, min(CHUNK_STEPS, shape[time_axis]), *shape[time_axis + 1 :])


@contextlib.contextmanager
def open_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """Opens an HDF5 file of any origin for reading; it may not point to data outside of itself.

    Raises:
        DataFileError: the file is missing, unreadable, truncated, damaged or no HDF5 file, or it refers to
            other files (external links, external storage, virtual datasets).
    """
    path = Path(path)
    with contextlib.ExitStack() as stack:
        try:
            with open(path, "rb"):
                file = stack.enter_context(h5py.File(path, "r"))
            refuse_data_elsewhere(file)
        except (DecodingError, OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            raise hdf5_error(path, error) from error
        try:
            yield file
        except OSError as error:
            if error.filename is not None:
                raise
            raise hdf5_error(path, error) from error


def hdf5_error(path: Path, error: Exception) -> DataFileError:
    """The error to raise for one of h5py, or of decoding with it, in this file."""
    message = str(error)
    if "data elsewhere" in message:
        return DataFileError(f"{path}: {message}: use a file that holds its own data")
    if "signature not found" in message:
        return DataFileError(f"{path} is not an HDF5 file: check the path")
    if "truncated" in message:
        return DataFileError(f"{path} is truncated: delete it and make or fetch it again")
    if "unable to lock" in message:
        return DataFileError(f"{path} is being written by another process: wait until that has ended")
    if isinstance(error, OSError) and error.filename is not None:
        return _read_error(path, error)
    detail = message.splitlines()[0] if message else type(error).__name__
    return DataFileError(f"{path} is damaged ({detail}): delete it and make or fetch it again")


def _check(path: Path) -> None:
    """Refuses a file that does not match the checksum before it; files of earlier versions have none."""
    try:
        with path.open("rb") as file:
            head, crc = file.read(USER_BLOCK), 0
            if not head.startswith(_CHECKSUM):
                return
            while part := file.read(1 << 20):
                crc = zlib.crc32(part, crc)
    except OSError as error:
        raise _read_error(path, error) from error
    if head != _first_block(crc):
        raise hdf5_error(path, ValueError("it does not match its checksum"))


def _first_block(crc: int) -> bytes:
    return (_CHECKSUM + b"%08x" % crc).ljust(USER_BLOCK, b"\n")


@contextlib.contextmanager
def read_hdf5(path: str | Path, expected_kind: str) -> Iterator[h5py.File]:
    """Opens a file that `atomic_hdf5` wrote.

    HDF5 itself has no checksum of texts of variable length, and reading damaged ones may not end.

    Raises:
        DataFileError: as `open_hdf5`; also a file of another program, kind or newer version, or an unfinished
            one.
    """
    _check(Path(path))
    with open_hdf5(path) as file:
        origin, version, kind, complete = (
            str(file.attrs.get(name)) for name in ("format", "version", "kind", "complete")
        )
        if origin != FORMAT:
            raise DataFileError(f"{path} was not written by {FORMAT}: check the path")
        if version != str(FORMAT_VERSION):
            raise DataFileError(
                f"{path} has format version {version}, this program reads version {FORMAT_VERSION}: make the "
                f"file again or use the program that wrote it"
            )
        if kind != expected_kind:
            raise DataFileError(f"{path} holds '{kind}' where '{expected_kind}' is needed: check the path")
        if complete != "True":
            raise DataFileError(f"{path} is unfinished: delete it and run the stage that writes it again")
        yield file


def read_arrays(path: str | Path, names: Sequence[str] | None = None) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a .npz file by name, or that of a .npy file by no name; nothing in it is run.

    Args:
        path: the file.
        names: those to read, where there are more; all of them by default.

    Raises:
        DataFileError: the file is missing, damaged or no such file, holds Python objects, or is too large.
    """
    try:
        with open(path, "rb") as file:
            content = np.load(file, allow_pickle=False)
            if isinstance(content, np.ndarray):
                return {"": content}
            if sum(member.file_size for member in content.zip.infolist()) > LARGEST_ARRAYS:
                raise ValueError(f"its arrays take more than {LARGEST_ARRAYS >> 30} GiB")
            return {name: content[name] for name in content.files if names is None or name in names}
    except OSError as error:
        raise _read_error(path, error) from error
    except _ARRAY_FAULTS as error:
        reason = "it holds Python objects, which can run code" if "allow_pickle" in str(error) else str(error)
        raise DataFileError(
            f"{path} is no NumPy archive of plain arrays, or a damaged one ({reason}): save or fetch it again"
        ) from error


def read_array(
    group: h5py.Group, name: str, shape: tuple[int | None, ...] | None = None, index: Any = ()
) -> npt.NDArray[Any]:
    """Reads a dataset, or the part of it that `index` selects.

    Args:
        group: Where the dataset is.
        name: Its name.
        shape: The shape that the whole dataset must have; None for an axis of any length.
        index: What to read, as for a NumPy array.

    Raises:
        DataFileError: the dataset is missing, damaged or has another shape.
    """
    path = group.file.filename
    try:
        dataset = group.get(name)
        if not isinstance(dataset, h5py.Dataset):
            raise DataFileError(f"{path} has no dataset '{name}': it is not the file that is needed here")
        found = dataset.shape
        if shape is not None and (
            len(found) != len(shape) or any(b not in (a, None) for a, b in zip(found, shape, strict=True))
        ):
            wanted = " x ".join("any" if length is None else str(length) for length in shape)
            raise DataFileError(f"'{name}' of {path} has the shape {found} where {wanted} is needed: check the path")
        return np.asarray(dataset[index])
    except OSError as error:
        raise hdf5_error(Path(path), error) from error


def write_checkpoint(
    path: str | Path, kind: str, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]
) -> None:
    """Writes tensors and plain metadata as a safetensors file with a checksum, atomically.

    Raises:
        DataFileError: the file cannot be written.
    """
    from safetensors.torch import save

    own = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    text = json.dumps(to_plain(metadata))
    header = {"format": FORMAT, "version": str(FORMAT_VERSION), "kind": kind}
    with atomic_path(path) as partial:
        partial.write_bytes(save(own, metadata={**header, "metadata": text, "checksum": _checksum(own, text)}))


def _checksum(tensors: Mapping[str, torch.Tensor], metadata: str) -> str:
    """CRC-32 of the metadata and of the tensors with their names, types and shapes."""
    import torch

    crc = zlib.crc32(metadata.encode())
    for name, tensor in sorted(tensors.items()):
        crc = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), crc)
        crc = zlib.crc32(tensor.flatten().view(torch.uint8).numpy().tobytes(), crc)
    return f"{crc:08x}"


def read_checkpoint(path: str | Path, expected_kind: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Reads what `write_checkpoint` wrote: the tensors, on the CPU, and the metadata.

    Raises:
        DataFileError: the file is missing, unreadable, truncated, damaged, of another program, kind or version.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with open(path, "rb"), safe_open(path, framework="pt", device="cpu") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise DataFileError(f"{path} was not written by {FORMAT}: check the path")
            found = (header.get("kind"), header.get("version"))
            if found != (expected_kind, str(FORMAT_VERSION)):
                raise DataFileError(
                    f"{path} holds '{found[0]}', version {found[1]}, where '{expected_kind}', version "
                    f"{FORMAT_VERSION}, is needed: check the path"
                )
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            checksum = _checksum(tensors, header["metadata"])
            if header.get("checksum", checksum) != checksum:  # Files of earlier versions have none.
                raise DataFileError(
                    f"{path} is damaged (it does not match its checksum): delete it and run the same command again"
                )
            return tensors, json.loads(header["metadata"])
    except OSError as error:
        raise _read_error(path, error) from error
    except (SafetensorError, ValueError, KeyError) as error:
        raise DataFileError(
            f"{path} is no complete safetensors file ({error}): delete it and run the same command again"
        ) from error
