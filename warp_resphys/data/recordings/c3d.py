"""C3D files, decoded by ezc3d in a process of its own."""

import struct
from pathlib import Path

from ...io.errors import DataFileError
from .arrays import decoded
from .recording import RawRecording

_MAGIC = 0x50
_BIG_ENDIAN_PROCESSOR = 86


def read_raw_c3d(path: Path) -> RawRecording:
    """Reads the markers of a C3D file, in its own unit.

    Raises:
        DataFileError: The file is missing, not C3D, damaged, truncated, or holds no marker trajectories.
    """
    declared_frames = _declared_frames(path)
    arrays = decoded("ezc3d", path)
    points = arrays["points"]
    if points.ndim != 3 or points.shape[1] == 0 or points.shape[2] == 0:
        raise DataFileError(f"{path} holds no marker trajectories: give a C3D file with 3D points.")
    if points.shape[2] < declared_frames:
        raise DataFileError(
            f"{path} is truncated: it holds {points.shape[2]} of the {declared_frames} frames that its "
            "header declares; copy or export it again."
        )
    return RawRecording(
        positions=points[:3].transpose(2, 1, 0),
        labels=arrays["labels"][: points.shape[1]].tolist(),
        unit=str(arrays["units"][0]).strip() if arrays["units"].size else None,
        rate=float(arrays["rate"][0]) if arrays["rate"].size else None,
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
