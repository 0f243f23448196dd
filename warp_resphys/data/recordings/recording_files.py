"""Recordings in files: C3D, NumPy archives and HDF5.

Other modules read text and bags (docs/recordings.md).
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ...io.arrays import FloatArray
from ...io.decoding import Arrays, decode
from ...io.errors import DataFileError, DecodingError, InputError, listed
from ...io.safe_files import FORMAT, atomic_hdf5, create, hdf5_error, read_arrays
from ...io.text import decoded
from ...settings.data_kinds import BagSettings, TableSettings
from ..base_motion import since_first
from .bag import SUFFIXES, is_bag, read_bag, topics_of
from .recording import SI_PER_ACTUATION_UNIT, Recording, hide_zeros, in_metres, without_subject
from .text_exports import read_text_export

_KIND = "recording"
_UNITS = {"positions": "units", "actuation": "actuation_units"}
_SENSED = ("positions", "actuation", "quaternions", "loads", "sensors")
_NAMES = (*_SENSED, "labels", "rate_hz", "rest", "base", "start", *_UNITS.values())
_C3D_MAGIC = 0x50
_SGI_PROCESSOR = 86


def read_recording(
    path: str | Path,
    units: str | None = None,
    rate: float | None = None,
    labels: Sequence[str] | None = None,
    table: TableSettings | None = None,
    bag: BagSettings | None = None,
) -> Recording:
    """Reads a recording in the format of its file name extension. docs/recordings.md describes the
    layouts.

    Args:
        path: A C3D, CSV, TSV, npz or HDF5 file, or a ROS bag: a file, or the folder of a ROS 2 bag.
        units: m, cm or mm, where missing or wrong in the file.
        rate: Frames a second [Hz], where missing or wrong in the file.
        labels: A name for every marker in the file's order, in place of those in the file.
        table: Columns of a CSV, TSV or text file without a header or with an unknown one.
        bag: Topics of a bag.

    Raises:
        DataFileError: The file is missing, damaged, of an unknown format, or incomplete.
        InputError: An argument is invalid.
    """
    path = Path(path)
    if not is_recording(path):
        raise DataFileError(
            f"{path} is no recording that can be read: give a file that ends in "
            f"{', '.join((*READERS, *SUFFIXES))}, as docs/recordings.md has them."
        )
    reader = None if is_bag(path) else READERS[path.suffix.lower()]
    if table is not None and reader is not read_text_export:
        raise DataFileError(
            f"{path} is no text, so that data.table cannot tell what its columns are: leave that "
            "out."
        )
    if reader is not None:
        return in_metres(
            reader(path) if table is None else read_text_export(path, table), units, rate, labels
        )
    if bag is None:
        raise InputError(
            f"{path} is a bag: name topics in data.bag (docs/recordings.md). It has "
            f"{topics_of(path)}."
        )
    return in_metres(read_bag(path, bag), units, bag.rate or rate, labels)


def is_recording(path: Path) -> bool:
    """Whether the name of a path is that of a recording that can be read."""
    return is_bag(path) or path.suffix.lower() in READERS


def write_recording(
    path: str | Path, recording: Recording, attributes: Mapping[str, Any] | None = None
) -> None:
    """Writes the HDF5 layout, in metres; `read_recording` returns the same recording.

    Attributes are further properties of the trial, such as a load. Missing folders are created.

    Raises:
        DataFileError: The file cannot be written.
    """
    known = {"labels": list(recording.labels), "rate_hz": recording.rate, "start": recording.start}
    with atomic_hdf5(
        path, _KIND, {**(attributes or {}), **known, "source": recording.source.name}
    ) as file:
        create(file, "positions", recording.positions, units="m")
        if recording.rest is not None:
            create(file, "rest", recording.rest, units="m")
        if recording.actuation is not None:
            create(file, "actuation", recording.actuation, units="1")
        if recording.loads:
            create(file, "loads", np.stack([*recording.loads.values()], 1), units="N, N m")
            file.attrs["sensors"] = [*recording.loads]
        if recording.base is not None:
            quaternions = Rotation.from_rotvec(recording.base[:, 3:]).as_quat()[:, [3, 0, 1, 2]]
            create(
                file,
                "base",
                np.concatenate([recording.base[:, :3], quaternions], axis=1),
                units="m, 1",
            )


def numbers(arrays: Arrays, name: str, path: Path) -> FloatArray:
    """Returns an array of a file.

    Raises DataFileError if it is missing or does not hold numbers.
    """
    if name not in arrays:
        raise DataFileError(
            f"{path} has no array '{name}'; it has {', '.join(arrays) or 'none'}: check the "
            "path, or see docs/recordings.md."
        )
    if arrays[name].dtype.kind not in "fiu":
        raise DataFileError(
            f"{path}: '{name}' does not hold numbers (it is {arrays[name].dtype}); save numbers "
            "there."
        )
    return np.asarray(arrays[name], dtype=np.float64)


def _read_npz(path: Path) -> Recording:
    """Reads a NumPy archive without unpickling."""
    arrays = read_arrays(path, _NAMES)
    if "" in arrays:
        raise DataFileError(f"{path} is a single array, not an archive: save it with numpy.savez.")
    return _assembled(arrays, path)


def _read_hdf5(path: Path) -> Recording:
    """Reads an HDF5 file of any origin: every name of the layout may be a dataset
    or an attribute of the root.
    """
    try:
        # The library's error for a file that cannot be opened has no cause.
        path.open("rb").close()
        arrays = decode("h5py", path, "format", "kind", *_NAMES)
    except (OSError, DecodingError) as error:
        raise hdf5_error(path, error) from error
    kind = _word(arrays, "kind")
    if _word(arrays, "format") == FORMAT and kind != _KIND:
        raise DataFileError(f"{path} holds '{kind}' where '{_KIND}' is needed: check the path.")
    for name, unit in _UNITS.items():
        if f"{name}.units" in arrays:
            arrays[unit] = arrays[f"{name}.units"]
    return _assembled(arrays, path)


def _assembled(arrays: Arrays, path: Path) -> Recording:
    """Returns the recording of arrays of the layout, by name."""
    words = ("labels", "sensors", *_UNITS.values())
    found = {
        name: numbers(arrays, name, path) for name in _NAMES if name in arrays and name not in words
    }
    for name in ("rate_hz", "start"):
        if name in found and found[name].size != 1:
            raise DataFileError(
                f"{path}: '{name}' has the shape {found[name].shape}; it must be one number."
            )
    unit = _word(arrays, "actuation_units") or "1"
    if "actuation" in found:
        if unit not in SI_PER_ACTUATION_UNIT:
            raise DataFileError(
                f"{path} gives its actuation in '{unit}': give it in one of "
                f"{', '.join(SI_PER_ACTUATION_UNIT)}."
            )
        with np.errstate(over="ignore"):
            found["actuation"] = found["actuation"] * SI_PER_ACTUATION_UNIT[unit]
    sensors = [_text(name) for name in np.ravel(arrays["sensors"])] if "sensors" in arrays else []
    loads = found.get("loads", np.zeros((0, len(sensors), 6)))
    if loads.ndim != 3 or loads.shape[1] != len(sensors):
        raise DataFileError(
            f"{path}: loads has the shape {loads.shape}, and sensors names "
            f"{listed(sensors) or 'none'}: loads are (frames, sensors, 6), forces and moments of "
            "each sensor [N, N m], NaN where they were not measured."
        )
    alone = "loads" in found and "positions" not in arrays
    positions = np.zeros((len(loads), 0, 3)) if alone else numbers(arrays, "positions", path)
    base = found.get("base")
    if base is not None and base.shape != (len(positions), 7):
        raise DataFileError(
            f"{path}: base has the shape {base.shape}; it needs a place and a quaternion (w, x, "
            f"y, z) for each of the {len(positions)} frames."
        )
    return Recording(
        labels=tuple(_text(label) for label in np.ravel(arrays["labels"]))
        if "labels" in arrays
        else (),
        positions=positions,
        rate=found["rate_hz"].item() if "rate_hz" in found else np.nan,
        source=path,
        actuation=found.get("actuation"),
        rest=found.get("rest"),
        base=None if base is None else since_first(base[:, :3], base[:, 3:], path),
        start=found["start"].item() if "start" in found else 0.0,
        unit=_word(arrays, "units") or "m",
        turns=found.get("quaternions"),
        loads={name: loads[:, number] for number, name in enumerate(sensors)},
    )


def _word(arrays: Arrays, name: str) -> str | None:
    return _text(arrays[name].item()) if name in arrays and arrays[name].size == 1 else None


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _read_c3d(path: Path) -> Recording:
    """Reads the markers of a C3D file, decoded by ezc3d in a process of its own."""
    try:
        content = path.read_bytes()
        if len(content) < 2 or content[1] != _C3D_MAGIC:
            raise DataFileError(
                f"{path} is not a C3D file: give a motion-capture recording in C3D format."
            )
        processor_at = (content[0] - 1) * 512 + 3
        if len(content) < 512 or content[0] == 0 or len(content) <= processor_at:
            raise DataFileError(
                f"{path} is truncated: it ends after {len(content)} bytes; copy or export it again."
            )
        if content[processor_at] == _SGI_PROCESSOR:
            raise DataFileError(
                f"{path} has the byte order of SGI (MIPS) computers, which is not read: export "
                "it in that of Intel."
            )
        arrays = decode("ezc3d", path)
    except OSError as error:
        raise DataFileError(
            f"Cannot read {path}: {error.strerror}; check the path of the recording."
        ) from error
    except DecodingError as error:
        raise DataFileError(
            f"{path} cannot be decoded ({error}): copy or export it again."
        ) from error
    points = arrays["points"]
    if points.ndim != 3 or points.shape[1] == 0 or points.shape[2] == 0:
        raise DataFileError(f"{path} holds no marker trajectories: give a C3D file with 3D points.")
    first, last = struct.unpack_from("<2H", content, 6)
    if points.shape[2] < last - first + 1:  # The decoder silently corrects the header.
        raise DataFileError(
            f"{path} is truncated: it holds {points.shape[2]} of the {last - first + 1} frames "
            "that its header declares; copy or export it again."
        )
    raw_labels = arrays["labels"][: points.shape[1]].tolist()
    labels = [decoded(label.encode(errors="surrogateescape")) or "" for label in raw_labels]
    labels += [""] * (points.shape[1] - len(labels))
    chosen = [column for column, label in enumerate(labels) if label not in arrays["computed"]]
    recording = Recording(
        labels=tuple(without_subject([labels[column].strip() for column in chosen])),
        positions=points[:3, chosen].transpose(2, 1, 0),
        rate=float(arrays["rate"][0]) if arrays["rate"].size else np.nan,
        source=path,
        unit=str(arrays["units"][0]) if arrays["units"].size else "",
    )
    return hide_zeros(recording)


READERS: Final[Mapping[str, Callable[[Path], Recording]]] = {
    ".c3d": _read_c3d,
    **dict.fromkeys((".csv", ".tsv", ".txt"), read_text_export),
    ".npz": _read_npz,
    **dict.fromkeys((".h5", ".hdf5"), _read_hdf5),
}
