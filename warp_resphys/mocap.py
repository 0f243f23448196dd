"""Motion capture: reading C3D recordings, occlusions, the moment of release.

Positions are (T, M, 3) in metres, T frames of M labelled markers, NaN where a marker was not seen.
Nothing here knows about a body or a simulator.
"""

import dataclasses
import io
import struct
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import median_filter

from warp_resphys.errors import DataFileError

FloatArray = NDArray[np.float64]

_METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_C3D_MAGIC = 0x50
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


@dataclasses.dataclass(frozen=True)
class Recording:
    """Markers followed over time.

    Attributes:
        labels: Names of the M markers.
        positions: (T, M, 3) [m], NaN where a marker is occluded.
        rate: Frames a second [Hz].
        source: The file it came from.
    """

    labels: tuple[str, ...]
    positions: FloatArray
    rate: float
    source: Path

    def select(self, labels: Sequence[str]) -> "Recording":
        """The same recording with these markers only, in this order.

        Raises:
            DataFileError: A marker is not in the recording.
        """
        missing = [label for label in labels if label not in self.labels]
        if missing:
            raise DataFileError(
                f"{self.source} has no marker named {_listed(missing)}; it has {_listed(self.labels)}: "
                "set the marker names in the configuration to those of the recording."
            )
        columns = [self.labels.index(label) for label in labels]
        return dataclasses.replace(self, labels=tuple(labels), positions=self.positions[:, columns])


@dataclasses.dataclass(frozen=True)
class Release:
    """When a body that was held still began to move.

    Attributes:
        frame: The moment of release, in frames and parts of a frame.
        rest: First and past-the-last frame of the quiet stretch before it, in which the body was held.
    """

    frame: float
    rest: tuple[int, int]


def read_c3d(path: str | Path) -> Recording:
    """Reads the marker trajectories of a C3D file.

    Args:
        path: The file. Its own unit (m, cm or mm) is converted to metres; occluded samples become NaN.

    Raises:
        DataFileError: The file is missing, not C3D, damaged, truncated, or holds no marker trajectories.
    """
    path = Path(path)
    declared_frames = _declared_frames(path)
    decoded = _decode(path)
    points, labels = decoded["points"], tuple(str(label) for label in decoded["labels"])
    if points.ndim != 3 or points.shape[1] == 0 or points.shape[2] == 0:
        raise DataFileError(f"{path} holds no marker trajectories: give a C3D file with 3D points.")
    if points.shape[2] < declared_frames:
        raise DataFileError(
            f"{path} is truncated: it holds {points.shape[2]} of the {declared_frames} frames that its "
            "header declares; copy or export it again."
        )
    if len(labels) < points.shape[1]:
        raise DataFileError(f"{path} names {len(labels)} of its {points.shape[1]} markers: export it with labels.")
    unit = str(decoded["units"][0]).strip() if decoded["units"].size else ""
    if unit not in _METRES_PER_UNIT:
        raise DataFileError(f"{path} gives positions in '{unit}': export it in m, cm or mm.")
    rate = float(decoded["rate"][0]) if decoded["rate"].size else 0.0
    if not (np.isfinite(rate) and rate > 0.0):
        raise DataFileError(f"{path} gives a frame rate of {rate} Hz: export it with its rate.")
    positions = np.ascontiguousarray(points[:3].transpose(2, 1, 0)) * _METRES_PER_UNIT[unit]
    return Recording(labels[: points.shape[1]], positions, rate, path)


def fill_gaps(recording: Recording, longest: int = 5) -> Recording:
    """Interpolates short occlusions by a cubic spline through the frames in which the marker was seen.

    A gap at either end of the recording is filled with the nearest sample, as nothing lies beyond it.

    Args:
        recording: What to fill.
        longest: The longest gap that may be filled, in frames.

    Raises:
        DataFileError: A marker is occluded for longer.
    """
    positions = recording.positions.copy()
    frames = np.arange(len(positions))
    for column, label in enumerate(recording.labels):
        seen = np.isfinite(positions[:, column]).all(axis=1)
        for start, stop in _runs(~seen):
            if stop - start > longest or np.count_nonzero(seen) < 2:
                raise DataFileError(
                    f"{recording.source}: marker {label} is occluded in frames {start} to {stop - 1}, longer "
                    f"than the {longest} frames that are interpolated; leave it out or raise the limit."
                )
        if not seen.all():
            known = frames[seen]
            inside = np.clip(frames[~seen], known[0], known[-1])
            positions[~seen, column] = CubicSpline(known, positions[seen, column])(inside)
    return dataclasses.replace(recording, positions=positions)


def find_release(path: FloatArray, rate: float, *, quiet: float = 0.2, least_drop: float = 1e-3) -> Release:
    """Finds when a point that was held still was let go.

    The point moves fast for the first time where one frame's step reaches a third of the largest (of a path
    through a three-frame median, which a sample gone astray does not pass). The body was held in the last
    stretch before that which is quiet: it spreads by less than 2 % of the later excursion. A body let go from
    rest first moves by s = a (t - t0)^2 / 2, so sqrt(s) of the first three frames of motion is a line, and
    its zero is the release.

    Args:
        path: (T, 3) [m], without NaN; a mean of several markers is best.
        rate: Frames a second [Hz].
        quiet: How long the body must have been still [s].
        least_drop: The smallest excursion that counts as a release [m].

    Raises:
        DataFileError: The path has no such moment.
    """
    length = max(2, round(quiet * rate))
    smooth = median_filter(path, size=(3, 1), mode="nearest")
    steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
    fast = int(np.argmax(3.0 * steps >= steps.max(initial=0.0))) + 1 if len(steps) else 0
    before = path[max(fast - 1, 0)] if len(path) else np.zeros(3)
    drop = float(np.linalg.norm(smooth[fast:] - before, axis=1).max(initial=0.0))
    if drop < least_drop:
        raise DataFileError(
            f"No release found: the tip never moves by more than {1e3 * drop:.2f} mm; give a recording in "
            "which the body is let go."
        )
    for stop in range(fast - 1, length - 1, -1):
        if np.ptp(path[stop - length : stop], axis=0).max() < 0.02 * drop:
            rest = (stop - length, stop)
            return Release(_onset(path, rest, fast, drop), rest)
    raise DataFileError(
        f"No release found: the tip is not still for {length} frames before it first moves fast, "
        f"in frame {fast}; give a recording that begins with the body held at rest."
    )


def _declared_frames(path: Path) -> int:
    """Number of frames in the C3D header (its first 512 bytes), which the decoder silently corrects."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataFileError(f"Cannot read {path}: {error.strerror}; check the path of the recording.") from error
    if len(content) < 2 or content[1] != _C3D_MAGIC:
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


def _onset(path: FloatArray, rest: tuple[int, int], fast: int, drop: float) -> float:
    """The release in frames, by a line through sqrt(s) of the first three frames of motion."""
    held = path[slice(*rest)]
    centre = np.median(held, axis=0)
    direction = (path[fast] - centre) / np.linalg.norm(path[fast] - centre)
    travelled = (path - centre) @ direction  # (T,) [m]
    noise = float(np.std(travelled[slice(*rest)]))
    still = np.flatnonzero(travelled[rest[0] : fast] < max(4.0 * noise, 0.005 * drop))
    last_still = rest[0] + int(still[-1])
    moving = np.arange(last_still + 1, min(last_still + 4, len(path)))
    root = np.sqrt(np.maximum(travelled[moving], 0.0))
    if len(moving) < 2 or root[-1] <= root[0]:
        return float(last_still)
    slope, intercept = np.polyfit(moving, root, 1)
    return float(np.clip(-intercept / slope, last_still, last_still + 1))


def _runs(mask: ArrayLike) -> list[tuple[int, int]]:
    """First and past-the-last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.pad(np.asarray(mask, dtype=np.int8), 1)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names) if names else "none"
