"""Reader of recordings in all supported formats."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from ...io.errors import DataFileError, InputError
from .arrays import read_raw_hdf5, read_raw_npz
from .bag import SUFFIXES, Bag, is_bag, read_raw_bag, topics_of
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
    bag: Bag | None = None,
) -> Recording:
    """Reads a recording in the format of its file name extension. docs/recordings.md describes the layouts.

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
    reader = None if is_bag(path) else READERS.get(path.suffix.lower())
    if reader is None and not is_bag(path):
        raise DataFileError(
            f"{path} is no recording that can be read: give a file that ends in {', '.join((*READERS, *SUFFIXES))}, as "
            "docs/recordings.md has them."
        )
    if table is not None and reader is not read_raw_text:
        raise DataFileError(f"{path} is no text, so that data.table cannot tell what its columns are: leave that out.")
    if reader is not None:
        raw = reader(path) if table is None else read_raw_text(path, table)
        return to_recording(raw, path, units, rate, labels)
    if bag is None:
        raise InputError(f"{path} is a bag: name topics in data.bag (docs/recordings.md). It has {topics_of(path)}.")
    return to_recording(read_raw_bag(path, bag), path, units, bag.rate or rate, labels)
