"""Pictures of a scene in a folder: places of their cameras,
masks of the body, depths, tracked points, and scans.

A scene's `camera.json` has `frames`, each with an `image` (a file beside it), `world_to_camera` (4
x 4, row-major, metres; camera axes: x right, y down, z forward) and perhaps a `mask`, a file whose
pixels are bright where the body is, a `depth` image, the name of its `lens` and its `time` [s];
perhaps `frame_rate` [Hz], which gives the times of frames by their number; perhaps `fixed`, a list
of clamps with the numbers of their `vertices`; and perhaps `world_to_cloud`, the same matrix for
the axes of a scan. docs/pictures.md has an example. Tracked points are tables of DeepLabCut, or any
with the columns `frame`, `tip.x` and `tip.y`, or files of NumPy with the arrays `tracks` (T, M, 2)
and perhaps `visibility` (T, M), as those of CoTracker.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy.ndimage
import torch
from matplotlib.colors import rgb_to_hsv
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from pydantic import ConfigDict, Strict

from ..data.camera import PlacedCamera
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import DataFileError, InputError, listed
from ..io.safe_files import read_arrays
from ..io.settings import Count, Many, Positive, Settings, Some, Word, parse
from ..io.text import read_rows, read_text
from ..settings.pictures import ColourSettings

Mask = BoolArray

_LEAST_MOVING = 3  # frames after a release, from which its motion is seen
_SPECKS = 2  # px, of an opening that removes them
_HEADS = ("scorer", "individuals", "bodyparts", "coords")
_READ_BY_TRIMESH = (".ply", ".xyz", ".obj", ".off", ".stl")
_SAMPLED = 20_000  # points on the triangles of a scanned surface
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


def colour_mask(image: NDArray[np.uint8], colours: ColourSettings) -> Mask:
    """Returns the largest connected part of a picture (H, W, 3)
    with the colours of a body, its holes filled.

    Raises:
        InputError: no part has these colours.
    """
    hue, saturation, value = np.moveaxis(rgb_to_hsv(image[..., :3] / 255.0), -1, 0)
    first, last = colours.hue
    right = (360.0 * hue - first) % 360.0 <= (
        (last - first) % 360.0 if last - first < 360.0 else 360.0
    )
    right &= (saturation >= colours.saturation) & (value >= colours.value)
    parts, count = scipy.ndimage.label(scipy.ndimage.binary_opening(right, iterations=_SPECKS))
    if not count:
        raise InputError(
            f"no part has a hue from {first:g} to {last:g} degrees, a saturation of "
            f"{colours.saturation:g} and a value of {colours.value:g}: "
            "widen the colours of the mask."
        )
    largest = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    # With its corners.
    whole = scipy.ndimage.binary_dilation(largest, iterations=_SPECKS, mask=right)
    return np.asarray(scipy.ndimage.binary_fill_holes(whole))


_Row = Annotated[tuple[float, float, float, float], Strict(False)]
_Pose = Annotated[tuple[_Row, _Row, _Row, _Row], Strict(False)]


class _Entry(Settings):
    model_config = ConfigDict(extra="ignore")

    image: Word | None = None
    mask: Word | None = None
    depth: Word | None = None
    lens: str = ""
    time: float | None = None
    world_to_camera: _Pose | None = None


class _Clamp(Settings):
    model_config = ConfigDict(extra="ignore")

    vertices: Some[Count]


class _Scene(Settings):
    model_config = ConfigDict(extra="ignore")

    frames: Many[_Entry] = ()
    fixed: Many[_Clamp] = ()
    frame_rate: Positive | None = None
    world_to_cloud: _Pose | None = None


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
    clamps: tuple[IntArray, ...]  # vertices in each
    scan_pose: FloatArray  # (4, 4) world_to_cloud


def read_scene(path: Path, scanned: bool = False) -> SceneFile:
    """Reads a `camera.json`.

    Args:
        path: of the file.
        scanned: whether there is a scan, so that there may be no frames, or no such file at all.

    Raises:
        DataFileError: it is missing or damaged, or an entry is missing or of a wrong shape.
    """
    try:
        content = json.loads(read_text(path)) if path.exists() or not scanned else {}
        scene = parse(_Scene, content if isinstance(content, dict) else {})
    except json.JSONDecodeError as error:
        raise DataFileError(
            f"{path} is no JSON ({error}): write the cameras of its pictures anew."
        ) from error
    except InputError as error:
        raise DataFileError(f"{path}: {error}") from None
    if not (scene.frames or scanned):
        raise DataFileError(
            f"{path} has no list 'frames': give an entry for every picture (docs/pictures.md)."
        )
    frames = []
    for number, entry in enumerate(scene.frames):
        image = entry.image or entry.depth
        if image is None:
            raise DataFileError(
                f"{path}: frame {number} has no 'image', the name of a file beside it."
            )
        mask, depth = (
            None if name is None else path.parent / name for name in (entry.mask, entry.depth)
        )
        pose = None if entry.world_to_camera is None else _rigid(entry.world_to_camera, path)
        time = number / scene.frame_rate if entry.time is None and scene.frame_rate else entry.time
        frames.append(Frame(number, path.parent / image, pose, mask, depth, entry.lens, time))
    clamps = tuple(np.array(clamp.vertices) for clamp in scene.fixed)
    return SceneFile(
        path, tuple(frames), clamps, _rigid(scene.world_to_cloud or np.eye(4).tolist(), path)
    )


def _rigid(pose: Sequence[Sequence[float]], path: Path) -> FloatArray:
    """A pose (4, 4) of a file, refused by the camera that has it if it is no rigid motion."""
    try:
        return np.asarray(PlacedCamera(None, torch.tensor(pose, dtype=torch.float64)).pose.numpy())
    except InputError as error:
        raise DataFileError(f"{path}: {error}") from None


def check_times(scene: SceneFile, release: float) -> None:
    """Checks the times of frames of a body that is released.

    Args:
        scene: with the frames that are used.
        release: time of the release [s].

    Raises:
        DataFileError: frames have no times, these do not increase, or fewer than three are after
            the release.
    """
    last: dict[str, tuple[int, float]] = {}
    for frame in scene.frames:
        if frame.time is None:
            raise DataFileError(
                f"{scene.path}: frame {frame.number} has no 'time', and its body is released: "
                "give it in s, or the 'frame_rate' of all frames in Hz."
            )
        before = last.get(frame.lens)
        if before is not None and not frame.time > before[1]:
            raise DataFileError(
                f"{scene.path}: frame {frame.number} has the time {frame.time:g} s, and frame "
                f"{before[0]} before it {before[1]:g} s: the times of a camera must increase."
            )
        last[frame.lens] = (frame.number, frame.time)
    if (
        sum(frame.time is not None and frame.time > release for frame in scene.frames)
        < _LEAST_MOVING
    ):
        raise DataFileError(
            f"{scene.path} has fewer than {_LEAST_MOVING} different frames after the release at "
            f"{release:g} s: check the times, the release (data.poses) and the chosen frames, or "
            "leave the release out of a body at rest."
        )


def read_picture(path: Path, mode: str = "RGB") -> NDArray[np.uint8]:
    """Reads a picture (H, W, 3), red, green and blue,
    as it is meant to be seen, or in another mode of Pillow.

    Raises:
        DataFileError: it is missing or no picture.
    """
    try:
        with Image.open(path) as image:
            return np.asarray(ImageOps.exif_transpose(image).convert(mode))
    except (OSError, UnidentifiedImageError) as error:
        raise DataFileError(f"cannot read the picture {path} ({error}).") from error


def read_mask(frame: Frame, colours: ColourSettings | None) -> Mask:
    """Returns where a picture shows the body (H, W): of its mask, or by colours.

    Raises:
        DataFileError: a file is missing, or there is neither a mask nor colours.
        InputError: no part has these colours.
    """
    if frame.mask is not None:
        drawn = read_picture(frame.mask, "RGBA")
        bright = np.minimum(drawn[..., :3].max(-1), 255 * (drawn[..., 3] > 127))
        # As masks are 0 and 1, or 0 and 255, or JPEG.
        return np.asarray(bright > 0.5 * bright.max(initial=1))
    if colours is None:
        raise DataFileError(
            f"{frame.image} has no mask: name one in camera.json, or give the colours of the "
            "body in data.mask."
        )
    try:
        return colour_mask(read_picture(frame.image), colours)
    except InputError as error:
        raise InputError(f"{frame.image}: {error}") from None


def read_depth(path: Path, unit: float) -> FloatArray:
    """Reads a depth image (H, W), along the axis of the lens [m].

    Zero or not finite where there is none.

    Args:
        path: of a picture of 16-bit integers, or of a .npy file, in metres where its numbers are no
            integers.
        unit: length that an integer stands for [m].

    Raises:
        DataFileError: it is missing, or has no single number at each pixel.
    """
    if path.suffix.lower() == ".npy":
        values = read_arrays(path)[""]
    else:
        try:
            with Image.open(path) as image:
                values = np.asarray(image)
        except (OSError, UnidentifiedImageError) as error:
            raise DataFileError(f"cannot read the depth image {path} ({error}).") from error
        if values.dtype == np.uint8:
            raise DataFileError(
                f"{path} has 8 bits: write depths as a PNG of 16-bit integers, or as .npy in m."
            )
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise DataFileError(
            f"{path} has the shape {values.shape}: a depth image has one number at each pixel."
        )
    return np.asarray(values, dtype=np.float64) * (1.0 if values.dtype.kind == "f" else unit)


def read_tracked(
    path: Path, names: Sequence[str], least: float, frames: Sequence[int]
) -> FloatArray:
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
        if path.suffix.lower() == ".npz":
            arrays = read_arrays(path)
            tracks = np.asarray(arrays["tracks"], dtype=np.float64)
            if tracks.ndim != 3 or tracks.shape[1:] != (len(names), 2):
                raise ValueError(
                    f"its tracks have the shape {tracks.shape}, not (frames, {len(names)}, 2)"
                )
            sure = np.asarray(arrays.get("visibility", np.ones(tracks.shape[:2])), dtype=np.float64)
            tracks = np.where(sure.reshape(*tracks.shape[:2], 1) >= least, tracks, np.nan)
            rows = dict(enumerate(tracks))
        else:
            rows = _table(path, names, least)
    except (OSError, KeyError, IndexError, ValueError) as error:
        raise DataFileError(f"cannot read tracked points from {path} ({error}).") from error
    missing = [frame for frame in frames if frame not in rows]
    if missing:
        raise DataFileError(f"{path} has no row of frame {missing[0]}.")
    return np.stack([rows[frame] for frame in frames])


def _table(path: Path, names: Sequence[str], least: float) -> dict[int, FloatArray]:
    """Pixels (M, 2) by frame of a table whose first column has the numbers of the frames."""
    rows = [row for row in read_rows(path) if any(row)]
    heads, first = rows[0], 1
    if heads[0] == "scorer":
        of_head = {row[0]: row for row in rows[: len(_HEADS)] if row[0] in _HEADS}
        parts = of_head["bodyparts"]
        if len({*of_head.get("individuals", ["", ""])[1:]}) > 1:  # several animals
            parts = [
                f"{animal}.{part}"
                for animal, part in zip(of_head["individuals"], parts, strict=True)
            ]
        heads = [
            "frame",
            *(
                f"{part}.{axis}"
                for part, axis in zip(parts[1:], of_head["coords"][1:], strict=True)
            ),
        ]
        first = len(of_head)
    if heads[0] != "frame":
        raise ValueError(f"its first column is '{heads[0]}', not 'frame'")
    missing = [name for name in names if not {f"{name}.x", f"{name}.y"} <= {*heads}]
    if missing:
        there = dict.fromkeys(head.rpartition(".")[0] for head in heads[1:])
        raise ValueError(
            f"it has no columns x and y of {listed(missing)}, but of {listed([*there])}"
        )
    result = {}
    for row in rows[first:]:
        values = {
            head: float(cell) if cell else np.nan for head, cell in zip(heads, row, strict=True)
        }
        points = np.array([[values[f"{name}.x"], values[f"{name}.y"]] for name in names])
        sure = np.array([values.get(f"{name}.likelihood", 1.0) for name in names])
        result[int(values["frame"])] = np.where(sure[:, None] >= least, points, np.nan)
    return result


def read_scan(path: str | Path, unit: float, seed: int = 0) -> tuple[FloatArray, FloatArray | None]:
    """Reads the points (P, 3) of a scan [m], and its outer unit normals (P, 3).

    None without triangles.

    Of a surface of triangles, points are spread evenly over these, which must be counter-clockwise
    from outside.

    Args:
        path: the file; its extension determines the format.
        unit: length of a unit of the file [m].
        seed: of the points on triangles.

    Raises:
        DataFileError: it is missing or damaged, or has no points.
    """
    import trimesh

    path, normals = Path(path), None
    try:
        if path.suffix.lower() == ".npy":
            points = np.asarray(read_arrays(path)[""], dtype=np.float64)
        elif path.suffix.lower() == ".pcd":
            points = _pcd(path)
        elif path.suffix.lower() in _READ_BY_TRIMESH:
            if not path.is_file():
                raise ValueError("there is no such file")
            read: Any = trimesh.load(str(path), process=False)
            read = read.to_mesh() if isinstance(read, trimesh.Scene) else read
            points = np.asarray(read.vertices, dtype=np.float64)
            if isinstance(read, trimesh.Trimesh) and len(read.faces):
                points, faces = trimesh.sample.sample_surface(read, _SAMPLED, seed=seed)
                points = np.asarray(points, dtype=np.float64)
                normals = np.asarray(read.face_normals[faces])
        else:
            known = ", ".join((".npy", ".pcd", *_READ_BY_TRIMESH))
            raise ValueError(f"its extension is none of {known}")
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"it has the shape {points.shape}, not (points, 3)")
    except DataFileError:
        raise
    except Exception as error:  # readers raise all kinds of errors on damaged files
        raise DataFileError(
            f"cannot read a scan from {path} ({error}): export it as .ply again."
        ) from error
    seen = np.isfinite(points).all(1)
    if not seen.any():
        raise DataFileError(
            f"{path} has no points: scan again, or leave data.poses.NAME.cloud out."
        )
    return unit * points[seen], None if normals is None else normals[seen]


def _pcd(path: Path) -> FloatArray:
    """Points of a file of the Point Cloud Library, as text or binary."""
    content, start = path.read_bytes(), 0
    head = dict[str, list[str]]()
    while "DATA" not in head:
        end = content.index(b"\n", start)
        key, *values = content[start:end].decode("ascii").split() or ["#"]
        head[key], start = values, end + 1
    counts = [int(count) for count in head.get("COUNT", ["1"] * len(head["FIELDS"]))]
    if head["DATA"] == ["ascii"]:
        column = dict(zip(head["FIELDS"], np.cumsum([0, *counts]), strict=False))
        rows = np.array(
            [line.split() for line in content[start:].decode("ascii").splitlines() if line],
            dtype=float,
        )
        return np.asarray(rows[:, [column[axis] for axis in "xyz"]])
    if head["DATA"] != ["binary"]:
        raise ValueError(f"its data are {' '.join(head['DATA'])}, and must be ascii or binary")
    fields = [
        (f"{number}_{name}" if name == "_" else name, f"<{_PCD_TYPES[kind]}{size}", (count,))
        for number, (name, kind, size, count) in enumerate(
            zip(head["FIELDS"], head["TYPE"], head["SIZE"], counts, strict=True)
        )
    ]
    rows = np.frombuffer(content, np.dtype(fields), int(head["POINTS"][0]), start)
    return np.concatenate([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
