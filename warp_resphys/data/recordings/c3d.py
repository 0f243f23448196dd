"""C3D files, decoded by ezc3d in a process of its own."""

import io
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...io.errors import DataFileError
from .recording import RawRecording, Recording, to_recording

_MAGIC = 0x50
_BIG_ENDIAN_PROCESSOR = 86
_DECODE_SECONDS = 120.0
# ezc3d is C++ that a damaged parameter section can crash or hang, so a process of its own decodes the file.
# Whatever the decoder prints goes to stderr, and only the archive to stdout.
_DECODE_PROGRAM = """
import os
import sys
archive = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
import ezc3d
import numpy as np
file = ezc3d.c3d(sys.argv[1])
point = file["parameters"]["POINT"]
np.savez(
    archive,
    points=np.asarray(file["data"]["points"], dtype=np.float64),
    labels=np.array(point["LABELS"]["value"], dtype=np.str_),
    units=np.array(point["UNITS"]["value"] if "UNITS" in point else [], dtype=np.str_),
    rate=np.array(point["RATE"]["value"], dtype=np.float64),
)
"""


def read_c3d(path: str | Path) -> Recording:
    """Reads the marker trajectories of a C3D file.

    Args:
        path: The file. Its own unit (m, cm or mm) is converted to metres; occluded samples become NaN.

    Raises:
        DataFileError: The file is missing, not C3D, damaged, truncated, or holds no marker trajectories.
    """
    path = Path(path)
    return to_recording(read_raw_c3d(path), path)


def read_raw_c3d(path: Path) -> RawRecording:
    """What a C3D file holds, in its own unit; raises DataFileError as `read_c3d`."""
    declared_frames = _declared_frames(path)
    decoded = _decode(path)
    points = decoded["points"]
    if points.ndim != 3 or points.shape[1] == 0 or points.shape[2] == 0:
        raise DataFileError(f"{path} holds no marker trajectories: give a C3D file with 3D points.")
    if points.shape[2] < declared_frames:
        raise DataFileError(
            f"{path} is truncated: it holds {points.shape[2]} of the {declared_frames} frames that its "
            "header declares; copy or export it again."
        )
    return RawRecording(
        positions=points[:3].transpose(2, 1, 0),
        labels=tuple(str(label) for label in decoded["labels"][: points.shape[1]]),
        unit=str(decoded["units"][0]).strip() if decoded["units"].size else None,
        rate=float(decoded["rate"][0]) if decoded["rate"].size else None,
    )


def _declared_frames(path: Path) -> int:
    """Number of frames in the C3D header (its first 512 bytes), which the decoder silently corrects."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path of the recording.") from error
    if len(content) < 2 or content[1] != _MAGIC:
        raise DataFileError(f"{path} is not a C3D file: give a motion-capture recording in C3D format.")
    processor_at = (content[0] - 1) * 512 + 3
    if len(content) < 512 or content[0] == 0 or len(content) <= processor_at:
        raise DataFileError(f"{path} is truncated: it ends after {len(content)} bytes; copy or export it again.")
    order = ">" if content[processor_at] == _BIG_ENDIAN_PROCESSOR else "<"
    first, last = struct.unpack_from(order + "2H", content, 6)
    return int(last - first + 1)


def _decode(path: Path) -> dict[str, NDArray]:
    """Points (4, M, T), labels, units and rate of a C3D file, decoded by ezc3d in a process of its own."""
    command = [sys.executable, "-c", _DECODE_PROGRAM, str(path)]
    try:
        result = subprocess.run(command, capture_output=True, timeout=_DECODE_SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise DataFileError(f"{path} is damaged: decoding it does not end; copy or export it again.") from error
    if result.returncode != 0:
        lines = result.stderr.decode(errors="replace").strip().splitlines()
        reason = lines[-1] if lines and result.returncode > 0 else f"the decoder ended with {result.returncode}"
        raise DataFileError(f"{path} is damaged or truncated ({reason}); copy or export it again.")
    with np.load(io.BytesIO(result.stdout), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
