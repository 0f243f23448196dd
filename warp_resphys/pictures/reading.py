"""Pictures of a scene in a folder: the places of their cameras, masks of the body, and points tracked in them.

A scene's `camera.json` has `frames`, each with an `image` (a file beside it), its `time` [s], `world_to_camera` (4 x 4,
row-major, metres; camera axes: x right, y down, z forward) and perhaps a `mask`, a file whose pixels are not black
where the body is; and perhaps `fixed`, a list of clamps with the numbers of their `vertices`. docs/recordings.md has an
example. Tracked points are tables of DeepLabCut, or any with the columns `frame`, `tip.x`, `tip.y`, or files of NumPy
with the arrays `tracks` (T, M, 2) and perhaps `visibility` (T, M), as those of CoTracker.
"""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from matplotlib.colors import rgb_to_hsv
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ..io.errors import DataFileError, InputError, listed
from ..io.files import read_arrays

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SPECKS = 2  # px, of an opening that removes them
_COORDINATES = ("x", "y", "likelihood")


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
        right = (360.0 * hue - first) % 360.0 <= (last - first) % 360.0
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

    image: Path
    time: float  # [s]
    pose: FloatArray  # (4, 4) world_to_camera
    mask: Path | None = None


@dataclass(frozen=True)
class SceneFile:
    """What a scene's `camera.json` says."""

    path: Path
    frames: tuple[Frame, ...]
    clamps: tuple[NDArray[np.int64], ...]  # vertices in each


def read_scene(path: Path) -> SceneFile:
    """Reads a `camera.json`.

    Raises:
        DataFileError: it is missing or damaged, or an entry is missing or of a wrong shape.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DataFileError(f"cannot read {path} ({error}): give the cameras of a scene as JSON.") from error
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise DataFileError(f"{path} has no list 'frames': give an entry for every picture (docs/recordings.md).")
    groups = content.get("fixed", [])
    try:
        clamps = tuple(np.array(group["vertices"], dtype=np.int64).ravel() for group in groups)
    except (KeyError, TypeError, ValueError) as error:
        raise DataFileError(f"{path}: 'fixed' is a list of clamps, each with its 'vertices': {error}.") from error
    return SceneFile(path, tuple(_frame(path, number, entry) for number, entry in enumerate(frames)), clamps)


def _frame(path: Path, number: int, entry: Any) -> Frame:
    if not isinstance(entry, dict) or not isinstance(entry.get("image"), str):
        raise DataFileError(f"{path}: frame {number} has no 'image', the name of a file beside it.")
    try:
        pose = np.array(entry["world_to_camera"], dtype=np.float64).reshape(4, 4)
        time = float(entry.get("time", 0.0))
    except (KeyError, TypeError, ValueError) as error:
        raise DataFileError(
            f"{path}: frame {number} needs 'world_to_camera', 4 rows of 4 numbers, and 'time' in s ({error})."
        ) from error
    mask = entry.get("mask")
    return Frame(path.parent / entry["image"], time, pose, None if mask is None else path.parent / str(mask))


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Reads a picture (H, W, 3), red, green, blue.

    Raises:
        DataFileError: it is missing or no picture.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError) as error:
        raise DataFileError(f"cannot read the picture {path} ({error}).") from error


def read_mask(frame: Frame, colours: Colours | None) -> Mask:
    """Returns where a picture shows the body (H, W): of its mask, or by colours.

    Raises:
        DataFileError: a file is missing, or there is neither a mask nor colours.
        InputError: no part has these colours.
    """
    if frame.mask is not None:
        return np.asarray(read_picture(frame.mask).max(-1) > 0)
    if colours is None:
        raise DataFileError(
            f"{frame.image} has no mask: name one in camera.json, or give the colours of the body in data.mask."
        )
    try:
        return colours.mask(read_picture(frame.image))
    except InputError as error:
        raise InputError(f"{frame.image}: {error}") from None


def read_tracked(path: Path, names: Sequence[str], least: float) -> FloatArray:
    """Reads the pixels (T, M, 2) of M points in T frames, NaN where one was not seen.

    Args:
        path: table or file of NumPy, see the module.
        names: of the points; the columns of a file of NumPy are in their order.
        least: likelihood or visibility below which a point counts as not seen.

    Raises:
        DataFileError: the file is missing or damaged, or lacks a point.
    """
    try:
        if path.suffix == ".npz":
            arrays = read_arrays(path)
            tracks = np.asarray(arrays["tracks"], dtype=np.float64)
            sure = np.asarray(arrays["visibility"], dtype=np.float64) if "visibility" in arrays else None
        else:
            tracks, sure = _table(path, names)
    except (OSError, KeyError, ValueError) as error:
        raise DataFileError(f"cannot read tracked points from {path} ({error}).") from error
    if tracks.ndim != 3 or tracks.shape[1:] != (len(names), 2):
        raise DataFileError(
            f"{path} has tracks of shape {tracks.shape}: the {len(names)} points of data.points need (frames, "
            f"{len(names)}, 2)."
        )
    return tracks if sure is None else np.where(sure.reshape(*tracks.shape[:2], 1) >= least, tracks, np.nan)


def _table(path: Path, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Pixels (T, M, 2) and likelihoods (T, M) of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row]
    if not rows:
        raise ValueError("it is empty")
    if rows[0][0] == "scorer":
        of_head = dict(zip((row[0] for row in rows[:4]), rows[:4], strict=True))
        heads = [f"{name}.{axis}" for name, axis in zip(of_head["bodyparts"], of_head["coords"], strict=True)]
        first = 1 + max(number for number, row in enumerate(rows[:4]) if row[0] in ("scorer", "bodyparts", "coords"))
    else:
        heads, first = [cell.strip() for cell in rows[0]], 1
    missing = [name for name in names if f"{name}.x" not in heads or f"{name}.y" not in heads]
    if missing:
        raise ValueError(f"it has no columns x and y of {listed(missing)}")
    values = np.array([[float(cell) if cell.strip() else np.nan for cell in row[1:]] for row in rows[first:]])
    columns = [
        [heads.index(f"{name}.{axis}") - 1 if f"{name}.{axis}" in heads else -1 for axis in _COORDINATES]
        for name in names
    ]
    tracks = np.stack([values[:, own[:2]] for own in columns], 1)
    sure = np.stack([values[:, own[2]] if own[2] >= 0 else np.ones(len(values)) for own in columns], 1)
    return tracks, sure
