"""Recordings as arrays: NumPy archives (.npz) and HDF5 files, with the layout of docs/recordings.md."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...io.decoding import DecodingError, decode
from ...io.errors import DataFileError
from ...io.files import FORMAT, atomic_hdf5, create, hdf5_error, read_arrays
from .recording import SI_PER_ACTUATION_UNIT, RawRecording, Recording

KIND = "recording"
_NAMES = ("positions", "labels", "rate_hz", "units", "actuation", "actuation_units", "rest", "base", "start")


def read_raw_npz(path: Path) -> RawRecording:
    """Reads a NumPy archive without running anything that is in it.

    Raises:
        DataFileError: The file is missing, no archive or damaged, holds Python objects, or an array is missing or
            wrong.
    """
    found = read_arrays(path, _NAMES)
    if "" in found:
        raise DataFileError(f"{path} is a single array, not an archive: save it with numpy.savez.")
    return _assemble(found.get, path)


def read_raw_hdf5(path: Path) -> RawRecording:
    """Reads an HDF5 file of any origin: each name of the layout may be a dataset or an attribute of the root.

    Raises:
        DataFileError: The file is missing, no HDF5 file or damaged, refers to other files, was written for something
            else by this program, or an array is missing or wrong.
    """
    try:
        path.open("rb").close()
        found = decode("h5py", path, "format", "kind", *_NAMES)
    except (OSError, DecodingError) as error:
        raise hdf5_error(path, error) from error
    kind = _word(found.get("kind"))
    if _word(found.get("format")) == FORMAT and kind != KIND:
        raise DataFileError(f"{path} holds '{kind}' where '{KIND}' is needed: check the path.")
    for name, unit in (("positions", "units"), ("actuation", "actuation_units")):
        if f"{name}.units" in found:
            found[unit] = found[f"{name}.units"]
    return _assemble(found.get, path)


def write_recording(path: str | Path, recording: Recording, attributes: Mapping[str, Any] | None = None) -> None:
    """Writes the HDF5 layout, in metres, so that `read_recording` gives the same recording back.

    Args:
        path: Where to write; missing folders are made.
        recording: What to write.
        attributes: What else is known of the trial, such as a load, as attributes of the root.

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


def _assemble(find: Callable[[str], NDArray[Any] | None], path: Path) -> RawRecording:
    """A recording from arrays of the layout, by name."""
    positions = _floats(find, "positions", path)
    if positions is None:
        raise DataFileError(f"{path} has no array 'positions' (frames, markers, 3): see docs/recordings.md.")
    actuation = _floats(find, "actuation", path)
    if actuation is not None:
        unit = _word(find("actuation_units")) or "1"
        if unit not in SI_PER_ACTUATION_UNIT:
            raise DataFileError(
                f"{path} gives its actuation in '{unit}': give it in one of {', '.join(SI_PER_ACTUATION_UNIT)}."
            )
        with np.errstate(over="ignore"):
            actuation = actuation * SI_PER_ACTUATION_UNIT[unit]
    labels = find("labels")
    rate, start = _number(find, "rate_hz", path), _number(find, "start", path)
    return RawRecording(
        positions=positions,
        labels=None if labels is None else tuple(_text(label) for label in np.ravel(labels)),
        unit=_word(find("units")) or "m",
        rate=rate,
        actuation=actuation,
        rest=_floats(find, "rest", path),
        base=_floats(find, "base", path),
        start=start or 0.0,
    )


def _floats(find: Callable[[str], NDArray[Any] | None], name: str, path: Path) -> NDArray[np.float64] | None:
    array = find(name)
    if array is None:
        return None
    if array.dtype.kind not in "fiu":
        raise DataFileError(f"{path}: '{name}' does not hold numbers (it is {array.dtype}); save numbers there.")
    return np.asarray(array, dtype=np.float64)


def _number(find: Callable[[str], NDArray[Any] | None], name: str, path: Path) -> float | None:
    array = _floats(find, name, path)
    if array is not None and array.size != 1:
        raise DataFileError(f"{path}: '{name}' has the shape {array.shape}; it must be one number.")
    return None if array is None else array.item()


def _word(array: NDArray[Any] | None) -> str | None:
    return None if array is None or array.size != 1 else _text(array.item())


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
