"""Pictures of a scene in a folder: the places of their cameras, masks of the body, depths, and tracked points.

A scene's `camera.json` has `frames`, each with an `image` (a file beside it), `world_to_camera` (4 x 4, row-major,
metres; camera axes: x right, y down, z forward) and perhaps a `mask`, a file whose pixels are bright where the body is,
a `depth` image, the name of its `lens` and its `time` [s]; perhaps `frame_rate` [Hz], which gives the times of frames
by their number; perhaps `fixed`, a list of clamps with the numbers of their `vertices`; and perhaps `world_to_cloud`,
the same matrix for the axes of a scan. docs/pictures.md has an example. Tracked points are
tables of DeepLabCut, or any with the columns `frame`, `tip.x` and `tip.y`, or files of NumPy with the arrays `tracks`
(T, M, 2) and perhaps `visibility` (T, M), as those of CoTracker.
"""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from matplotlib.colors import rgb_to_hsv
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from ..io.errors import DataFileError, InputError, listed
from ..io.files import read_arrays

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_MOVING = 3  # frames after a release, from which its motion is seen
_SPECKS = 2  # px, of an opening that removes them
_HEADS = ("scorer", "individuals", "bodyparts", "coords")
_RIGID = 1e-3  # of a rotation


@dataclass(frozen=True)
class Colours:
    """The colours of a body: an interval of hues, which may pass 360, and the least saturation and value."""

    hue: tuple[float, float]  # [degrees]
    saturation: float  # 0 to 1
    value: float  # 0 to 1

    def mask(self, image: NDArray[np.uint8]) -> Mask:
        """Returns the largest connected part of a picture (H, W, 3) with these colours, its holes filled.

        Raises:
            InputError: no part has these colours.
        """
        hue, saturation, value = np.moveaxis(rgb_to_hsv(image[..., :3] / 255.0), -1, 0)
        first, last = self.hue
        right = (360.0 * hue - first) % 360.0 <= ((last - first) % 360.0 if last - first < 360.0 else 360.0)
        right &= (saturation >= self.saturation) & (value >= self.value)
        parts, count = scipy.ndimage.label(scipy.ndimage.binary_opening(right, iterations=_SPECKS))
        if not count:
            raise InputError(
                f"no part has a hue from {first:g} to {last:g} degrees, a saturation of {self.saturation:g} and a "
                f"value of {self.value:g}: widen the colours of the mask."
            )
        largest = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
        whole = scipy.ndimage.binary_dilation(largest, iterations=_SPECKS, mask=right)  # with its corners
        return np.asarray(scipy.ndimage.binary_fill_holes(whole))


@dataclass(frozen=True)
class Frame:
    """An entry of a scene's `camera.json`."""

    number: int
    image: Path
    pose: FloatArray | None  # (4, 4) world_to_camera; None where a tag shows it
    mask: Path | None = None
    depth: Path | None = None
    lens: str = ""  # name of the lens; empty for a single one
    time: float | None = None  # at which row 0 is exposed [s]

    @property
    def files(self) -> tuple[Path, ...]:
        """Its files; the first is the most telling."""
        return tuple(path for path in (self.depth, self.mask, self.image) if path is not None)


@dataclass(frozen=True)
class SceneFile:
    """Content of a scene's `camera.json`."""

    path: Path
    frames: tuple[Frame, ...]
    clamps: tuple[NDArray[np.int64], ...]  # vertices in each
    scan_pose: FloatArray  # (4, 4) world_to_cloud


def read_scene(path: Path, scanned: bool = False) -> SceneFile:
    """Reads a `camera.json`.

    Args:
        path: of the file.
        scanned: whether there is a scan, so that there may be no frames, or no such file at all.

    Raises:
        DataFileError: it is missing or damaged, or an entry is missing or of a wrong shape.
    """
    if scanned and not path.exists():
        return SceneFile(path, (), (), np.eye(4))
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataFileError(f"cannot read {path} ({error.strerror}): check data.folder and data.poses.") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DataFileError(f"{path} is no JSON ({error}): write the cameras of its pictures anew.") from error
    frames = content.get("frames", [] if scanned else None) if isinstance(content, dict) else None
    if not isinstance(frames, list) or not (frames or scanned):
        raise DataFileError(f"{path} has no list 'frames': give an entry for every picture (docs/pictures.md).")
    groups = content.get("fixed", [])
    try:
        clamps = tuple(np.array(group["vertices"], dtype=np.int64).ravel() for group in groups)
    except (KeyError, TypeError, ValueError) as error:
        raise DataFileError(f"{path}: 'fixed' is a list of clamps, each with its 'vertices': {error}.") from error
    if not all(len(clamp) for clamp in clamps):
        raise DataFileError(f"{path}: a clamp of 'fixed' has no 'vertices': leave it out.")
    scan_pose = _pose(f"{path}", "world_to_cloud", content)
    rate = content.get("frame_rate")
    if rate is not None and not (isinstance(rate, int | float) and math.isfinite(rate) and rate > 0.0):
        raise DataFileError(f"{path}: 'frame_rate' is {rate!r}: give a positive number, in Hz.")
    shown = tuple(_frame(path, number, entry, rate) for number, entry in enumerate(frames))
    return SceneFile(path, shown, clamps, np.eye(4) if scan_pose is None else scan_pose)


def _frame(path: Path, number: int, entry: Any, rate: float | None) -> Frame:
    image = entry.get("image", entry.get("depth")) if isinstance(entry, dict) else None
    if not isinstance(image, str):
        raise DataFileError(f"{path}: frame {number} has no 'image', the name of a file beside it.")
    mask, depth = (None if entry.get(key) is None else path.parent / str(entry[key]) for key in ("mask", "depth"))
    pose = _pose(f"{path}: frame {number}", "world_to_camera", entry)
    time = entry.get("time", None if rate is None else number / rate)
    if time is not None and not (isinstance(time, int | float) and math.isfinite(time)):
        raise DataFileError(f"{path}: frame {number} has the 'time' {time!r}: give a number, in s.")
    return Frame(number, path.parent / image, pose, mask, depth, str(entry.get("lens", "")), time)


def check_times(scene: SceneFile, release: float) -> None:
    """Checks the times of frames of a body that is released.

    Args:
        scene: with the frames that are used.
        release: time of the release [s].

    Raises:
        DataFileError: frames have no times, these do not increase, or fewer than three are after the release.
    """
    last: dict[str, tuple[int, float]] = {}
    for frame in scene.frames:
        if frame.time is None:
            raise DataFileError(
                f"{scene.path}: frame {frame.number} has no 'time', and its body is released: give it in s, or the "
                "'frame_rate' of all frames in Hz."
            )
        before = last.get(frame.lens)
        if before is not None and not frame.time > before[1]:
            raise DataFileError(
                f"{scene.path}: frame {frame.number} has the time {frame.time:g} s, and frame {before[0]} before it "
                f"{before[1]:g} s: the times of a camera must increase."
            )
        last[frame.lens] = (frame.number, frame.time)
    if sum(frame.time is not None and frame.time > release for frame in scene.frames) < _LEAST_MOVING:
        raise DataFileError(
            f"{scene.path} has fewer than {_LEAST_MOVING} different frames after the release at {release:g} s: check "
            "the times, the release (data.poses) and the chosen frames, or leave the release out of a body at rest."
        )


def _pose(where: str, key: str, entry: Mapping[str, Any]) -> FloatArray | None:
    """A rigid motion (4, 4) of an entry; None without."""
    try:
        given = entry.get(key)
        pose = None if given is None else np.array(given, dtype=np.float64).reshape(4, 4)
        rigid = pose is None or (
            np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=_RIGID)
            and np.linalg.det(pose[:3, :3]) > 0.0
            and np.allclose(pose[3], (0.0, 0.0, 0.0, 1.0), atol=_RIGID)
        )
    except (TypeError, ValueError) as error:
        raise DataFileError(f"{where}: '{key}' has 4 rows of 4 numbers ({error}).") from error
    if not rigid:
        raise DataFileError(
            f"{where}: '{key}' is no rotation with a shift, above 0, 0, 0, 1: write it row by row, for right-handed "
            "axes."
        )
    return pose


def read_picture(path: Path, mode: str = "RGB") -> NDArray[np.uint8]:
    """Reads a picture (H, W, 3), red, green and blue, as it is meant to be seen, or in another mode of Pillow.

    Raises:
        DataFileError: it is missing or no picture.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(ImageOps.exif_transpose(image).convert(mode))
    except (OSError, UnidentifiedImageError) as error:
        raise DataFileError(f"cannot read the picture {path} ({error}).") from error


def read_mask(frame: Frame, colours: Colours | None) -> Mask:
    """Returns where a picture shows the body (H, W): of its mask, or by colours.

    Raises:
        DataFileError: a file is missing, or there is neither a mask nor colours.
        InputError: no part has these colours.
    """
    if frame.mask is not None:
        drawn = read_picture(frame.mask, "RGBA")
        bright = np.minimum(drawn[..., :3].max(-1), 255 * (drawn[..., 3] > 127))
        return np.asarray(bright > 0.5 * bright.max(initial=1))  # as masks are 0 and 1, or 0 and 255, or JPEG
    if colours is None:
        raise DataFileError(
            f"{frame.image} has no mask: name one in camera.json, or give the colours of the body in data.mask."
        )
    try:
        return colours.mask(read_picture(frame.image))
    except InputError as error:
        raise InputError(f"{frame.image}: {error}") from None


def read_depth(path: Path, unit: float) -> FloatArray:
    """Reads a depth image (H, W), along the axis of the lens [m]; zero or not finite where there is none.

    Args:
        path: of a picture of 16-bit integers, or of a .npy file, in metres where its numbers are no integers.
        unit: length that an integer stands for [m].

    Raises:
        DataFileError: it is missing, or has no single number at each pixel.
    """
    if path.suffix == ".npy":
        values = read_arrays(path)[""]
    else:
        try:
            with Image.open(path) as image:
                values = np.asarray(image)
        except (OSError, UnidentifiedImageError) as error:
            raise DataFileError(f"cannot read the depth image {path} ({error}).") from error
        if values.dtype == np.uint8:
            raise DataFileError(f"{path} has 8 bits: write depths as a PNG of 16-bit integers, or as .npy in m.")
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise DataFileError(f"{path} has the shape {values.shape}: a depth image has one number at each pixel.")
    return np.asarray(values, dtype=np.float64) * (1.0 if values.dtype.kind == "f" else unit)


def read_tracked(path: Path, names: Sequence[str], least: float, frames: Sequence[int]) -> FloatArray:
    """Reads the pixels (F, M, 2) of M points in F frames, NaN where one was not seen.

    Args:
        path: table or file of NumPy, see the module.
        names: of the points; the columns of a file of NumPy are in their order.
        least: likelihood or visibility below which a point counts as not seen.
        frames: numbers of the frames, from 0.

    Raises:
        DataFileError: the file is missing or damaged, or lacks a point or a frame.
    """
    try:
        if path.suffix == ".npz":
            arrays = read_arrays(path)
            tracks = np.asarray(arrays["tracks"], dtype=np.float64)
            if tracks.ndim != 3 or tracks.shape[1:] != (len(names), 2):
                raise ValueError(f"its tracks have the shape {tracks.shape}, not (frames, {len(names)}, 2)")
            sure = np.asarray(arrays.get("visibility", np.ones(tracks.shape[:2])), dtype=np.float64)
            tracks = np.where(sure.reshape(*tracks.shape[:2], 1) >= least, tracks, np.nan)
            rows = dict(enumerate(tracks))
        else:
            rows = _table(path, names, least)
    except (OSError, KeyError, IndexError, ValueError) as error:
        raise DataFileError(f"cannot read tracked points from {path} ({error}).") from error
    if missing := [frame for frame in frames if frame not in rows]:
        raise DataFileError(f"{path} has no row of frame {missing[0]}.")
    return np.stack([rows[frame] for frame in frames])


def _table(path: Path, names: Sequence[str], least: float) -> dict[int, FloatArray]:
    """Pixels (M, 2) by frame of a table whose first column has the numbers of the frames."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = [[cell.strip() for cell in row] for row in csv.reader(file) if row]
    heads, first = rows[0], 1
    if heads[0] == "scorer":
        of_head = {row[0]: row for row in rows[: len(_HEADS)] if row[0] in _HEADS}
        parts = of_head["bodyparts"]
        if len({*of_head.get("individuals", ["", ""])[1:]}) > 1:  # several animals
            parts = [f"{animal}.{part}" for animal, part in zip(of_head["individuals"], parts, strict=True)]
        heads = ["frame", *(f"{part}.{axis}" for part, axis in zip(parts[1:], of_head["coords"][1:], strict=True))]
        first = len(of_head)
    if heads[0] != "frame":
        raise ValueError(f"its first column is '{heads[0]}', not 'frame'")
    if missing := [name for name in names if f"{name}.x" not in heads or f"{name}.y" not in heads]:
        there = dict.fromkeys(head.rpartition(".")[0] for head in heads[1:])
        raise ValueError(f"it has no columns x and y of {listed(missing)}, but of {listed([*there])}")
    result = {}
    for row in rows[first:]:
        values = {head: float(cell) if cell else np.nan for head, cell in zip(heads, row, strict=True)}
        points = np.array([[values[f"{name}.x"], values[f"{name}.y"]] for name in names])
        sure = np.array([values.get(f"{name}.likelihood", 1.0) for name in names])
        result[int(values["frame"])] = np.where(sure[:, None] >= least, points, np.nan)
    return result
