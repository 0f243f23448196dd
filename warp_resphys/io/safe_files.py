"""Reads and writes JSON, HDF5, NumPy and safetensors files,
none of which can run code when it is opened.

All are written atomically. HDF5 files are built in memory first, because the HDF5 library cannot
close a file on a full disk and crashes the interpreter at exit; a file should fit into memory two
or three times. Interrupted work resumes from checkpoints.
"""

from __future__ import annotations

import contextlib
import json
import logging
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

from .atomic import atomic_path, read_error
from .decoding import refuse_data_elsewhere
from .errors import DataFileError, DecodingError

if TYPE_CHECKING:
    import torch

log = logging.getLogger(__name__)

FORMAT = "warp_resphys"
FORMAT_VERSION = 1
CHUNK_STEPS = 64
LARGEST_ARRAYS = 4 << 30  # bytes in one file
# Errors of numpy.load for a file that is damaged or malicious.
_ARRAY_FAULTS = (
    EOFError,
    LookupError,
    MemoryError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    *(struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)


def to_plain(data: Any) -> Any:
    """Converts mappings, sequences, NumPy values, paths and settings to JSON types.

    Others raise TypeError.
    """
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
    if hasattr(data, "plain"):  # Settings, without importing pydantic
        return data.plain()
    raise TypeError(f"{type(data).__name__} cannot be written as JSON")


def write_json(path: str | Path, data: Any) -> None:
    """Writes standard JSON atomically; NaN and infinite numbers become null."""
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
        raise read_error(path, error) from error
    except ValueError as error:
        raise DataFileError(f"{path} is not a JSON file ({error}): delete or rewrite it") from error


@contextlib.contextmanager
def atomic_hdf5(
    path: str | Path, kind: str, attributes: Mapping[str, Any] | None = None
) -> Iterator[h5py.File]:
    """Yields an HDF5 file in memory, which is written to `path` atomically when the block ends.

    Args:
        path: Path of the file; missing folders are created.
        kind: Kind of content, such as "trajectories"; `read_hdf5` checks it.
        attributes: Further attributes of the file's root (numbers, strings, small arrays).
    """
    in_memory = {"driver": "core", "backing_store": False, "block_size": 1 << 20}
    with (
        atomic_path(path) as partial,
        h5py.File(partial.name, "w", libver=("v110", "v110"), **in_memory) as file,
    ):
        file.attrs.update(
            {**(attributes or {}), "format": FORMAT, "version": FORMAT_VERSION, "kind": kind}
        )
        file.attrs["complete"] = False
        yield file
        file.attrs["complete"] = True
        file.flush()
        partial.write_bytes(file.id.get_file_image())


def create(
    group: h5py.Group, name: str, array: npt.ArrayLike, units: str = "1", time_axis: int = 0
) -> h5py.Dataset:
    """Stores an array as a dataset, in chunks of 64 steps along `time_axis`, each with a checksum.

    Args:
        group: Group of the dataset.
        name: Name of the dataset; a path creates the groups in between.
        array: Numbers of any shape.
        units: SI units of the values, stored as an attribute; "1" for numbers without a unit.
        time_axis: The axis of the steps.
    """
    values = np.asarray(array)
    chunks = None  # one index before the time axis, up to 64 steps, and all indices after it
    if values.size and values.shape:
        steps = min(CHUNK_STEPS, values.shape[time_axis])
        chunks = (*(1,) * time_axis, steps, *values.shape[time_axis + 1 :])
    dataset = group.create_dataset(name, data=values, chunks=chunks, fletcher32=chunks is not None)
    dataset.attrs["units"] = units
    return dataset


def hdf5_error(path: Path, error: Exception) -> DataFileError:
    """Returns the error to raise for an error of h5py, or of decoding with it, in a file."""
    message = str(error)
    if "data elsewhere" in message:
        return DataFileError(f"{path}: {message}: use a file that contains its own data")
    if "signature not found" in message:
        return DataFileError(f"{path} is not an HDF5 file: check the path")
    if "truncated" in message:
        return DataFileError(f"{path} is truncated: delete it, then write or download it again")
    if "unable to lock" in message:
        return DataFileError(
            f"{path} is being written by another process: wait until that has ended"
        )
    if isinstance(error, OSError) and error.filename is not None:
        return read_error(path, error)
    detail = message.splitlines()[0] if message else type(error).__name__
    return DataFileError(
        f"{path} is damaged ({detail}): delete it, then write or download it again"
    )


@contextlib.contextmanager
def read_hdf5(path: str | Path, expected_kind: str) -> Iterator[h5py.File]:
    """Opens a file of `atomic_hdf5`.

    Raises:
        DataFileError: the file is missing, unreadable or damaged, refers to other files (external
            links, external storage, virtual datasets), is of another program, kind or version, or
            unfinished.
    """
    path = Path(path)
    with contextlib.ExitStack() as stack:
        try:
            # The library's error for a file that cannot be opened has no cause.
            path.open("rb").close()
            file = stack.enter_context(h5py.File(path, "r"))
            refuse_data_elsewhere(file)
        except (DecodingError, OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            raise hdf5_error(path, error) from error
        try:
            names = ("format", "version", "kind", "complete")
            origin, version, kind, complete = (str(file.attrs.get(name)) for name in names)
            if origin != FORMAT:
                raise DataFileError(f"{path} was not written by {FORMAT}: check the path")
            if version != str(FORMAT_VERSION):
                raise DataFileError(
                    f"{path} has format version {version}, this program reads version "
                    f"{FORMAT_VERSION}: write it again or use the program that wrote it"
                )
            if kind != expected_kind:
                raise DataFileError(
                    f"{path} contains '{kind}' where '{expected_kind}' is needed: check the path"
                )
            if complete != "True":
                raise DataFileError(
                    f"{path} is unfinished: delete it and run the stage that writes it again"
                )
            yield file
        except OSError as error:
            if error.filename is not None:
                raise
            raise hdf5_error(path, error) from error


def read_arrays(
    path: str | Path, names: Sequence[str] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Reads the arrays of a .npz file by name, or the array of a .npy file under the name "".

    No pickled objects.

    Args:
        path: the file.
        names: the arrays to read; all by default.

    Raises:
        DataFileError: the file is missing, damaged or not of NumPy, contains Python objects, or is
            too large.
    """
    try:
        with open(path, "rb") as file:
            content = np.load(file, allow_pickle=False)
            if isinstance(content, np.ndarray):
                return {"": content}
            if sum(member.file_size for member in content.zip.infolist()) > LARGEST_ARRAYS:
                raise ValueError(f"its arrays are larger than {LARGEST_ARRAYS >> 30} GiB")
            return {name: content[name] for name in content.files if names is None or name in names}
    except OSError as error:
        raise read_error(path, error) from error
    except _ARRAY_FAULTS as error:
        reason = (
            "it contains Python objects, which can run code"
            if "allow_pickle" in str(error)
            else str(error)
        )
        raise DataFileError(
            f"{path} is not a NumPy file of plain arrays, or is damaged ({reason}): save or "
            "download it again"
        ) from error


def read_array(
    group: h5py.Group, name: str, shape: tuple[int | None, ...] | None = None, index: Any = ()
) -> npt.NDArray[Any]:
    """Reads a dataset, or the part of it that `index` selects.

    Args:
        group: Group of the dataset.
        name: Name of the dataset.
        shape: Required shape of the whole dataset; None for an axis of any length.
        index: The part to read, as for a NumPy array.

    Raises:
        DataFileError: the dataset is missing, damaged or has another shape.
    """
    path = group.file.filename
    try:
        dataset = group.get(name)
        if not isinstance(dataset, h5py.Dataset):
            raise DataFileError(f"{path} has no dataset '{name}': check the path")
        stored = dataset.shape
        if shape is not None and (
            len(stored) != len(shape)
            or any(b not in (a, None) for a, b in zip(stored, shape, strict=True))
        ):
            wanted = " x ".join("any" if length is None else str(length) for length in shape)
            raise DataFileError(
                f"'{name}' of {path} has the shape {stored} "
                f"where {wanted} is needed: check the path"
            )
        return np.asarray(dataset[index])
    except OSError as error:
        raise hdf5_error(Path(path), error) from error


def read_attribute(file: h5py.File, name: str) -> Any:
    """Reads an attribute of a file, or raises DataFileError where it is missing."""
    if name not in file.attrs:
        raise DataFileError(
            f"{file.filename} has no attribute '{name}': write the file again, or check the path"
        )
    return file.attrs[name]


def write_checkpoint(
    path: str | Path, kind: str, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]
) -> None:
    """Writes tensors and plain metadata as a safetensors file, atomically.

    Raises:
        DataFileError: the file cannot be written.
    """
    from safetensors.torch import save

    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    text = json.dumps(to_plain(metadata))
    header = {"format": FORMAT, "version": str(FORMAT_VERSION), "kind": kind, "metadata": text}
    with atomic_path(path) as partial:
        partial.write_bytes(save(copies, metadata=header))


def read_checkpoint(
    path: str | Path, expected_kind: str
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Reads the tensors, on the CPU, and the metadata of a file of `write_checkpoint`.

    Raises:
        DataFileError: the file is missing, unreadable, damaged, or of another program, kind or
            version.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise DataFileError(f"{path} was not written by {FORMAT}: check the path")
            kind, version = header.get("kind"), header.get("version")
            if (kind, version) != (expected_kind, str(FORMAT_VERSION)):
                raise DataFileError(
                    f"{path} contains '{kind}', version {version}, where '{expected_kind}', "
                    f"version {FORMAT_VERSION}, is needed: check the path"
                )
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            return tensors, json.loads(header["metadata"])
    except OSError as error:
        raise read_error(path, error) from error
    except (SafetensorError, ValueError, KeyError) as error:
        raise DataFileError(
            f"{path} is not a complete safetensors file ({error}): "
            "delete it and run the same command again"
        ) from error


def is_final(path: Path, kind: str, fingerprint: str) -> bool:
    """Whether an HDF5 file with this fingerprint exists.

    Raises:
        DataFileError: the file is damaged, or of another program.
    """
    if not path.is_file():
        return False
    with read_hdf5(path, kind) as file:
        return str(file.attrs.get("fingerprint")) == fingerprint


def resume_checkpoint(
    path: Path, kind: str, fingerprint: str
) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """Reads a checkpoint of work with this fingerprint; None if there is none that can be used."""
    if not path.exists():
        return None
    try:
        tensors, metadata = read_checkpoint(path, kind)
    except DataFileError as error:
        log.warning("a checkpoint cannot be used: %s", error)
        return None
    if metadata.get("fingerprint") != fingerprint:
        log.warning("%s is not used: it belongs to other settings", path)
        return None
    return tensors, metadata
