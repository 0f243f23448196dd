"""The recordings that were published beside the paper: their layout, and the way into ours.

Both sets are others' data; docs/recordings.md says where they are offered. Shapes, units and orders are those of the
publication.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ...io.decoding import Arrays
from ...io.errors import DataFileError
from ...io.files import read_arrays, write_json
from ...io.progress import Progress
from ..rigid import kabsch, root_mean_square
from .arrays import decoded, numbers, write_recording
from .recording import SI_PER_ACTUATION_UNIT, FloatArray, RawRecording, Recording, to_recording

RATE: Final = 100.0  # [Hz]
CHAMBERS: Final = (5, 4, 2, 0, 1, 3)
MARKERS: Final = (1, 2, 0, 4, 3, 6, 5, 7, 8, 9, 10, 12, 11, 14, 13)
# [m] where the markers should be: the arm hangs along -z from z = 0, the beam lies along x, clamped at x = 0.
ARM_NOMINAL: Final = 1e-3 * np.array(
    [
        *((-62.9, -23.0, -8.2), (-62.9, 22.0, -8.2), (31.3, -21.6, -8.2)),
        *((18.0, -17.0, -128.0), (21.0, 9.0, -128.0), (-8.0, 21.0, -128.0), (-21.0, 10.0, -128.0)),
        *((-20.0, -20.0, -128.0), (18.0, 10.0, -146.0), (-26.0, 8.0, -146.0), (-3.0, -29.0, -146.0)),
        *((11.0, -10.0, -266.0), (-6.0, 14.0, -266.0), (-21.0, -10.0, -266.0), (-8.0, -20.0, -266.0)),
    ]
) + np.array([0.0, 0.0, 2.92047e-3])
BEAM_NOMINAL: Final = np.array(
    [
        *((0.0247, 0.0, 0.015), (0.0447, 0.0, 0.015), (0.0648, 0.0, 0.015)),
        *((0.0447, 0.015, 0.03), (0.0648, 0.006, 0.03), (0.0648, 0.024, 0.03)),
        *((0.0247, 0.03, 0.006), (0.0247, 0.03, 0.024), (0.0447, 0.03, 0.006), (0.0648, 0.03, 0.015)),
    ]
)
BEAM_LABELS: Final = tuple(f"Beam - {number}" for number in range(1, 11))
ARM_LABELS: Final = (*(f"Base - {number}" for number in (1, 2, 3)), *(f"Arm - {number}" for number in range(1, 13)))
# [kg] by trial; trial 1 was not published.
WEIGHTS: Final = (
    *(0.05, 0.06, 0.07, 0.10, 0.09, 0.08, 0.11, 0.12, 0.15),
    *(0.09, 0.13, 0.14, 0.16, 0.17, 0.20, 0.18, 0.22, 0.21),
)
SPLITS: Final = {"train": (0, 3, 4, 6, 8, 10, 12, 13, 17), "validation": (5, 15), "test": (2, 7, 11, 14, 16)}
_TRIAL = re.compile(r"qs_real(\d+)_reorder\.npy")
_TRIAL_ARRAYS = "q_data_reorder.npz"


def read_published_arm(path: str | Path) -> list[Recording]:
    """Reads the recordings of the pneumatic arm.

    Markers and chambers come out in the order of the mesh: three markers on the base, twelve on the arm, six pressures
    [Pa]. The first frame of each trajectory, without pressure, is its rest shape.

    Args:
        path: A pickled dictionary of `data` (R, T, 15, 3) [m] and `p` (R, T, 6) [mbar].

    Raises:
        DataFileError: The file is missing, damaged or names anything but NumPy's arrays; or the arrays are missing or
            have other shapes.
    """
    path = Path(path)
    arrays = decoded("pickle", path)
    data, pressure = numbers(arrays, "data", path), numbers(arrays, "p", path)
    if data.ndim != 4 or data.shape[2:] != (15, 3) or pressure.shape != (*data.shape[:2], 6):
        raise DataFileError(
            f"{path}: data {data.shape} and p {pressure.shape} must have the shapes (trials, frames, 15, 3) and "
            "(trials, frames, 6): check the path."
        )
    # `MARKERS` says which marker of the mesh each recorded one is; `CHAMBERS` which recorded one each of the mesh is.
    in_mesh_order = data[:, :, np.argsort(MARKERS)]
    driven = pressure[:, :, list(CHAMBERS)] * SI_PER_ACTUATION_UNIT["mbar"]
    return [
        to_recording(RawRecording(markers, ARM_LABELS, "m", RATE, driven[trial], markers[0]), path)
        for trial, markers in enumerate(in_mesh_order)
    ]


def read_published_beam(folder: str | Path) -> dict[int, Recording]:
    """Reads the recordings of the beam, from the release on, by trial.

    Args:
        folder: With `qs_real{i}_reorder.npy`, each (10, 3, T) [mm], and, for the rest shapes, `q_data_reorder.npz`, the
            last frame of whose `arr_{i}` is that of trial i.

    Raises:
        DataFileError: There is no recording in the folder, or one is damaged or has another shape.
    """
    folder = Path(folder)
    files = {int(found[1]): file for file in folder.glob("*.npy") if (found := _TRIAL.fullmatch(file.name))}
    if not files:
        raise DataFileError(f"{folder} holds no file qs_real0_reorder.npy or the like: check the path.")
    rest_file = folder / _TRIAL_ARRAYS
    rests = read_arrays(rest_file) if rest_file.exists() else {}
    recordings = {}
    for trial, file in sorted(files.items()):
        frames = _beam_frames(read_arrays(file), "", file)
        rest = _beam_frames(rests, f"arr_{trial}", rest_file)[-1] if f"arr_{trial}" in rests else None
        recordings[trial] = to_recording(RawRecording(frames, BEAM_LABELS, "mm", RATE, rest=rest), file)
    return recordings


def convert_arm(path: str | Path, folder: Path) -> list[dict[str, Any]]:
    """Writes each trajectory of the arm as arm_000.h5 and so on, and index.json; returns what that says of each."""
    no_more: dict[str, Any] = {}
    trials = [(trial, recording, no_more) for trial, recording in enumerate(read_published_arm(path))]
    return write_trials(folder, "arm", trials, ARM_NOMINAL)


def convert_beam(source: str | Path, folder: Path) -> list[dict[str, Any]]:
    """Writes each trial of the beam as beam_000.h5 and so on, and index.json; returns what that says of each."""
    trials = []
    for trial, recording in read_published_beam(source).items():
        split = next((name for name, members in SPLITS.items() if trial in members), "none")
        weight = {"weight_kg": WEIGHTS[trial]} if trial < len(WEIGHTS) else {}
        trials.append((trial, recording, {"split": split, **weight}))
    return write_trials(folder, "beam", trials, BEAM_NOMINAL)


def write_trials(
    folder: Path, name: str, trials: Sequence[tuple[int, Recording, Mapping[str, Any]]], nominal: FloatArray
) -> list[dict[str, Any]]:
    """Writes the recordings, and how far their rest shape is from the nominal markers: large if the order is wrong."""
    index = []
    with Progress(f"convert {name}", total=len(trials), unit="recordings") as progress:
        for trial, recording, known in trials:
            file = f"{name}_{trial:03d}.h5"
            write_recording(folder / file, recording, {"trial": trial, **known})
            residual = None
            if recording.rest is not None and np.isfinite(recording.rest).all():
                residual = 1e3 * root_mean_square(kabsch(recording.rest, nominal).apply(recording.rest) - nominal)
            frames = len(recording.positions)
            index.append(
                {"file": file, "trial": trial, **known, "frames": frames, "registration_residual_mm": residual}
            )
            progress.advance()
    write_json(folder / "index.json", index)
    return index


def _beam_frames(arrays: Arrays, name: str, path: Path) -> FloatArray:
    """(T, 10, 3) from (10, 3, T)."""
    array = numbers(arrays, name, path)
    if array.ndim != 3 or array.shape[:2] != (10, 3) or not array.shape[2]:
        raise DataFileError(
            f"{path}: an array has the shape {array.shape} where (10, 3, frames) is needed: check the path."
        )
    return array.transpose(2, 0, 1)
