"""Conversion of the published recordings of a pneumatic segment under steps of pressure.

docs/recordings.md says where they are published. The segment hangs along -z from its clamp at
z = 0. The inflated chamber is on the side of +x, so that the tip moves towards -x.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from ...io.errors import DataFileError
from ...io.safe_files import read_arrays
from .processing import valve_opening
from .recording import SI_PER_ACTUATION_UNIT, Recording, in_metres
from .recording_files import numbers, write_recording

BASE_LABELS: Final = tuple(f"Base - {number}" for number in range(1, 5))
TIP_LABELS: Final = tuple(f"Tip - {number}" for number in range(1, 4))
SEGMENT_LABELS: Final = (*BASE_LABELS, *TIP_LABELS)
MARKERS: Final = (0, 3, 2, 1, 4, 6, 5)  # index of the recorded marker of every label


def read_published_segment(path: str | Path) -> dict[int, Recording]:
    """Reads the recordings of the segment, by pressure in mbar.

    Time zero is the opening of the valve, from `valve_opening`; the actuation is the commanded
    pressure, a step. `rest` is the median of the frames before. Repeated frames were not measured,
    and are NaN.

    Args:
        path: an archive of `pressure_mbar` (R,), `markers` (R, T, 7, 3) [m] and `rate_hz`.

    Raises:
        DataFileError: the file is missing, damaged or holds Python objects; the arrays are missing
            or have other shapes; two trials have the same pressure; or the valve's opening is not
            found.
    """
    path = Path(path)
    arrays, recordings = read_arrays(path), dict[int, Recording]()
    pressure, markers, rate = (
        numbers(arrays, name, path) for name in ("pressure_mbar", "markers", "rate_hz")
    )
    if (
        markers.ndim != 4
        or markers.shape[2:] != (7, 3)
        or pressure.shape != markers.shape[:1]
        or rate.size != 1
    ):
        raise DataFileError(
            f"{path}: markers {markers.shape}, pressure_mbar {pressure.shape} and rate_hz "
            f"{rate.shape} must have the shapes (trials, frames, 7, 3), "
            "(trials,) and (): check the path."
        )
    if not np.isfinite(pressure).all() or len({*np.rint(pressure).tolist()}) < len(pressure):
        raise DataFileError(
            f"{path}: 'pressure_mbar' is not finite, "
            "or two trials have the same pressure, to a mbar."
        )
    for mbar, frames in zip(pressure.tolist(), markers[:, :, list(MARKERS)], strict=True):
        recording = mask_repeats(in_metres(Recording(SEGMENT_LABELS, frames, rate.item(), path)))
        recording = replace(recording, start=-valve_opening(recording, TIP_LABELS))
        opened = recording.time >= 0.0
        step = np.where(opened, mbar * SI_PER_ACTUATION_UNIT["mbar"], 0.0)[:, None]  # (T, 1) [Pa]
        rest = np.nanmedian(recording.positions[~opened], axis=0)
        recordings[round(mbar)] = replace(recording, actuation=step, rest=rest)
    return recordings


def convert_segment(source: str | Path, folder: str | Path) -> None:
    """Writes each trial into a folder as a recording of its own:
    segment_050.h5 for 50 mbar, and so on.

    Raises:
        DataFileError: see `read_published_segment`, or a file cannot be written.
    """
    for mbar, recording in read_published_segment(source).items():
        attributes = {"pressure_mbar": mbar, "valve_opening_s": -recording.start}
        write_recording(Path(folder) / f"segment_{mbar:03d}.h5", recording, attributes)


def mask_repeats(recording: Recording) -> Recording:
    """Masks frames (NaN) in which all seen markers have exactly their positions in the frame
    before.

    Measured positions always differ by their noise. Equal ones come from a stream that was read
    faster than it was updated.
    """
    positions = recording.positions
    equal = (positions[1:] == positions[:-1]) | (np.isnan(positions[1:]) & np.isnan(positions[:-1]))
    repeated = np.concatenate([[False], equal.all(axis=(1, 2))])
    return replace(recording, positions=np.where(repeated[:, None, None], np.nan, positions))
