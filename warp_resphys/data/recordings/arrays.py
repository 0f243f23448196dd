"""Recordings as arrays: NumPy archives (.npz) and HDF5 files, with the layout of docs/recordings.md."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...io.decoding import Arrays, DecodingError, decode
from ...io.errors import DataFileError
from ...io.files import FORMAT, atomic_hdf5, create, hdf5_error, read_arrays
from .recording import SI_PER_ACTUATION_UNIT, FloatArray, RawRecording, Recording

KIND = "recording"
_NAMES = (
    "positions",
    "labels",
    "rate_hz",
    "units",
    "actuation",
    "actuation_units",
    "rest",
    "base",
    "start",
    "quaternions",
)


def read_raw_npz(path: Path) -> RawRecording:
    """Reads a NumPy archive without unpickling.

    Raises:
        DataFileError: The file is missing, no archive or damaged, holds Python objects, or an array is missing or
            wrong.
    """
    arrays = read_arrays(path, _NAMES)
    if "" in arrays:
        raise DataFileError(f"{path} is a single array, not an archive: save it with numpy.savez.")
    return _assemble(arrays, path)


def read_raw_hdf5(path: Path) -> RawRecording:
    """Reads an HDF5 file of any origin: every name of the layout may be a dataset or an attribute of the root.

    Raises:
        DataFileError: The file is missing, no HDF5 file or damaged, refers to other files, was written for something
            else by this program, or an array is missing or wrong.
    """
    try:
        path.open("rb").close()  # The library's error for a file that cannot be opened has no cause.
        arrays = decode("h5py", path, "format", "kind", *_NAMES)
    except (OSError, DecodingError) as error:
        raise hdf5_error(path, error) from error
    kind = _word(arrays.get("kind"))
    if _word(arrays.get("format")) == FORMAT and kind != KIND:
        raise DataFileError(f"{path} holds '{kind}' where '{KIND}' is needed: check the path.")
    for name, unit in (("positions", "units"), ("actuation", "actuation_units")):
        if f"{name}.units" in arrays:
            arrays[unit] = arrays[f"{name}.units"]
    return _assemble(arrays, path)


def decoded(library: str, path: Path) -> Arrays:
    """Returns the result of `io.decoding.decode`; raises DataFileError where it cannot read the file."""
    try:
        return decode(library, path)
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path.") from error
    except DecodingError as error:
        raise DataFileError(f"{path} cannot be decoded ({error}): copy or export it again.") from error


def write_recording(path: str | Path, recording: Recording, attributes: Mapping[str, Any] | None = None) -> None:
    """Writes the HDF5 layout, in metres; `read_recording` returns the same recording.

    Attributes are further properties of the trial, such as a load. Missing folders are created.

    Raises:
        DataFileError: The file cannot be written.
    """
    known = {"labels": list(recording.labels), "rate_hz": recording.rate, "start": recording.start}
    with atomic_hdf5(path, KIND, {**(attributes or {}), **known, "source": recording.source.name}) as file:
        create(file, "positions", recording.positions, units="m")
        if recording.rest is not None:
            create(file, "rest", recording.rest, units="m")
        if recording.actuation is not None:
            create(file, "actuation", recording.actuation, units="1")
        if recording.base is not None:
            quaternions = Rotation.from_rotvec(recording.base[:, 3:]).as_quat()[:, [3, 0, 1, 2]]
            create(file, "base", np.concatenate([recording.base[:, :3], quaternions], axis=1), units="m, 1")


def numbers(arrays: Arrays, name: str, path: Path) -> FloatArray:
    """Returns an array of a file; raises DataFileError if it is missing or does not hold numbers."""
    if name not in arrays:
        raise DataFileError(
            f"{path} has no array '{name}'; it has {', '.join(arrays) or 'none'}: check the path, or see "
            "docs/recordings.md."
        )
    if arrays[name].dtype.kind not in "fiu":
        raise DataFileError(f"{path}: '{name}' does not hold numbers (it is {arrays[name].dtype}); save numbers there.")
    return np.asarray(arrays[name], dtype=np.float64)


def _assemble(arrays: Arrays, path: Path) -> RawRecording:
    """Returns the recording of arrays of the layout, by name."""
    actuation = numbers(arrays, "actuation", path) if "actuation" in arrays else None
    if actuation is not None:
        unit = _word(arrays.get("actuation_units")) or "1"
        if unit not in SI_PER_ACTUATION_UNIT:
            raise DataFileError(
                f"{path} gives its actuation in '{unit}': give it in one of {', '.join(SI_PER_ACTUATION_UNIT)}."
            )
        with np.errstate(over="ignore"):
            actuation = actuation * SI_PER_ACTUATION_UNIT[unit]
    labels = arrays.get("labels")
    return RawRecording(
        positions=numbers(arrays, "positions", path),
        labels=None if labels is None else [_text(label) for label in np.ravel(labels)],
        unit=_word(arrays.get("units")) or "m",
        rate=_number(arrays, "rate_hz", path),
        actuation=actuation,
        rest=numbers(arrays, "rest", path) if "rest" in arrays else None,
        base=numbers(arrays, "base", path) if "base" in arrays else None,
        start=_number(arrays, "start", path) or 0.0,
        turns=numbers(arrays, "quaternions", path) if "quaternions" in arrays else None,
    )


def _number(arrays: Arrays, name: str, path: Path) -> float | None:
    array = numbers(arrays, name, path) if name in arrays else None
    if array is not None and array.size != 1:
        raise DataFileError(f"{path}: '{name}' has the shape {array.shape}; it must be one number.")
    return None if array is None else array.item()


def _word(array: NDArray[Any] | None) -> str | None:
    return None if array is None or array.size != 1 else _text(array.item())


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
