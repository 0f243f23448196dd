"""One function for every kind of recording."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from ...io.errors import DataFileError
from .arrays import read_raw_hdf5, read_raw_npz
from .c3d import read_raw_c3d
from .recording import RawRecording, Recording, to_recording
from .text import Table, read_raw_text

READERS: Final[Mapping[str, Callable[[Path], RawRecording]]] = {
    ".c3d": read_raw_c3d,
    ".csv": read_raw_text,
    ".tsv": read_raw_text,
    ".txt": read_raw_text,
    ".npz": read_raw_npz,
    ".h5": read_raw_hdf5,
    ".hdf5": read_raw_hdf5,
}


def read_recording(
    path: str | Path,
    units: str | None = None,
    rate: float | None = None,
    labels: Sequence[str] | None = None,
    table: Table | None = None,
) -> Recording:
    """Reads a recording; the end of its name tells the format. docs/recordings.md describes the layouts.

    Args:
        path: A C3D, CSV, TSV, npz or HDF5 file.
        units: m, cm or mm, where the file does not say it, or says it wrongly.
        rate: Frames a second [Hz], where the file does not say it, or says it wrongly.
        labels: A name for each marker in the file's order, in place of those in the file.
        table: What the columns of a CSV, TSV or text file are, where it has no header, or another.

    Raises:
        DataFileError: The file is missing, of another format, damaged, or lacks something that was not given.
        InputError: What was given cannot be used.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise DataFileError(
            f"{path} is no recording that can be read: give a file that ends in {', '.join(READERS)}, as "
            "docs/recordings.md has them."
        )
    if table is not None and reader is not read_raw_text:
        raise DataFileError(f"{path} is no text, so that data.table cannot tell what its columns are: leave that out.")
    raw = reader(path) if table is None else read_raw_text(path, table)
    return to_recording(raw, path, units, rate, labels)
