"""Pictures and films of bodies: scenes, their views, and the process that draws them with pyvista, off screen.

Without a working OpenGL driver, VTK ends its process. Hence pyvista is imported in a separate process only,
`warp_resphys.report.render_process`, which reads scenes and returns frames through pipes of this process alone.
"""

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..io.arrays import FloatArray, IntArray
from ..io.atomic import atomic_path
from ..io.errors import ResphysError
from ..io.progress import Progress
from ..mesh.mesh import Mesh

Pixels = NDArray[np.uint8]

_LOG = logging.getLogger(__name__)
COMMAND: Final = (sys.executable, "-P", "-m", "warp_resphys.report.render_process")
TIME_OUT: Final = 300.0  # [s] for a scene; a picture takes about one.
LARGEST_RATE: Final = 25.0  # Frames a second of a film, at most.
BODY: Final = "#a9bccf"
CLAMPED: Final = "#33485e"
MEASURED: Final = "#d55e00"  # Vermilion of Okabe and Ito (2008).
INK: Final = "#1c2127"
OUTLINE: Final = "#808891"  # Of the undeformed body: a grey that is visible on light and dark pages.
TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
_FRAME: Final = 0.06  # Margin around the points in a view, over their longer side.
_TILT: Final = (0.30, 0.30)  # Of the view, to the right and upwards.
_HANGING: Final = 0.7  # Least cosine between gravity and the axis of a hanging body.
_LEVEL: Final = 1.2  # Tilt of the view of a path in a level plane, towards its near side.
_UPRIGHT: Final = 0.3  # Tilt of the view of a path in an upright plane, upwards.
_CODEC: Final = ["-f", "mp4", "-crf", "23", "-preset", "fast", "-threads", "1", "-movflags", "+faststart", "-bitexact"]


class DrawingError(ResphysError):
    """A picture that cannot be drawn on this machine."""


@dataclass(frozen=True, eq=False)
class Layer:
    """An object of a scene. Moving points have a first axis of F frames; it is not drawn where they are not finite."""

    kind: str  # surface, lines, balls, rings (towards the viewer), slice or slice_edges (of solid cells, by a plane).
    points: FloatArray  # (P, 3) or (F, P, 3) [m] corners, or centres of balls and rings, which are hidden one by one.
    cells: IntArray | None = None  # (S, 3) triangles, (E, 2) lines or (C, 4 | 8) solid cells.
    colour: str = INK
    size: float = 1.0  # Radius of balls and rings [m], or width of lines [px].
    opacity: float = 1.0
    light: tuple[float, float] | None = None  # Shares of ambient and scene light; None draws the plain colour.
    shift: float = 0.0  # Towards the viewer [m].
    plane: FloatArray | None = None  # (2, 3) normal and point of a plane; of a surface, the part behind it is drawn.


@dataclass(frozen=True, eq=False)
class View:
    """A view of layers, by parallel projection."""

    layers: Sequence[Layer]  # In the order in which they are drawn.
    axes: FloatArray  # (3, 3) rows: to the right, up, towards the viewer.
    focus: FloatArray  # (3,) or (F, 3) [m] point in the middle.
    half_height: float  # Of the view [m].
    legend: Sequence[tuple[str, str]] = ()  # Texts and colours, at the top.


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Views side by side, and their drawing options."""

    views: Sequence[View]
    size: Sequence[int]  # (2,) width and height of each view [px]; even for a film.
    background: str | None = None  # A colour; None for a transparent one.
    sorts: bool = False  # Whether translucent surfaces are sorted by depth, which excludes smooth edges.
    texts: Sequence[str] = ()  # One for each frame, in the first view, before its legend.
    fps: float = LARGEST_RATE  # Of a film.


def view_axes(towards_viewer: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """Return orthonormal rows (3, 3): to the right, up, towards the viewer."""
    towards = np.array(towards_viewer, dtype=np.float64)
    right = np.cross(np.array(up, dtype=np.float64), towards)
    rows = np.stack([right, np.cross(towards, right), towards])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def upwards(gravity: FloatArray) -> FloatArray:
    """Return the direction (3,) against gravity; z where there is no gravity."""
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def hangs(mesh: Mesh, fixed: IntArray, gravity: FloatArray) -> tuple[bool, FloatArray]:
    """Return whether a body hangs from its clamp, and the distances (N,) of its vertices from the clamp [m]."""
    start = mesh.vertices[fixed].mean(axis=0) if len(fixed) else mesh.vertices[0]
    away = mesh.vertices - start
    axis = away.mean(axis=0)
    size = float(np.linalg.norm(axis) * np.linalg.norm(gravity))
    return bool(size > 0.0 and axis @ gravity > _HANGING * size), np.linalg.norm(away, axis=1)


def motion_axes(gravity: FloatArray, positions: FloatArray) -> FloatArray:
    """Return axes (3, 3) as `view_axes`, whose right is the direction of largest extent or motion across gravity.

    Args:
        gravity: (3,) direction of gravity; -z is taken for zero.
        positions: (T, N, 3) [m], the first frame at rest; NaN is left out.
    """
    up = upwards(gravity)
    points = positions[np.isfinite(positions).all(axis=2)]
    flat = points - np.outer(points @ up, up)
    _, _, directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    right = directions[0] - (directions[0] @ up) * up
    right /= np.linalg.norm(right)
    moved = np.nanmax(np.linalg.norm(positions - positions[0], axis=2), axis=0)  # (N,)
    towards_end = moved @ (positions[0] - positions[0].mean(axis=0))
    right = -right if towards_end @ right < 0.0 else right
    return view_axes(np.cross(right, up) + _TILT[0] * right + _TILT[1] * up, up)


def axes_from_below(axes: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return axes (3, 3) of a view from below with the same right as the given axes.

    Args:
        axes: (3, 3) of a view in which gravity points down or away.
        gravity: (3,) direction of gravity; -z is taken for zero.
    """
    towards = -upwards(gravity)
    return np.stack([axes[0], np.cross(towards, axes[0]), towards])


def path_axes(plane: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return axes (3, 3) as `view_axes`, in which letters in a plane are readable.

    Args:
        plane: (2, 3) directions to the right and upwards in the plane.
        gravity: (3,) direction of gravity.
    """
    up, normal = upwards(gravity), np.cross(*plane)
    normal /= np.linalg.norm(normal)
    level = float(normal @ up)
    near = plane[1] / np.linalg.norm(plane[1])
    return view_axes(normal - _LEVEL * level * near + _UPRIGHT * (1.0 - level**2) * up, up)


def frame_of(points: FloatArray, axes: FloatArray, margin: float = _FRAME) -> tuple[FloatArray, FloatArray]:
    """Return the middle (3,) of points (P, 3), and half the width and height (2,) of a view that contains them [m].

    Args:
        points: [m]; those that are not finite are left out.
        axes: (3, 3) of the view.
        margin: On each side, over the longer side of the points.
    """
    turned = points[np.isfinite(points).all(axis=1)] @ axes.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = (high - low)[:2] + 2.0 * margin * (high - low)[:2].max()
    return 0.5 * (low + high) @ axes, 0.5 * extent


def picture_size(half: FloatArray, longer_side: float) -> list[int]:
    """Return width and height [px] of a picture of a view, from half its width and height (2,) [m]."""
    return [int(side) for side in np.ceil(longer_side * half / half.max())]


def height_of(half: FloatArray, size: tuple[int, int]) -> float:
    """Return half the height of a view of a size [px] that contains half a width and height (2,)."""
    return float(max(half[1], half[0] * size[1] / size[0]))


def chain(count: int) -> IntArray:
    """Return lines (count - 1, 2) from points to the next ones."""
    return np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)


class Renderer:
    """A process that draws scenes one after the other, which the first scene starts; a context manager."""

    def __init__(self) -> None:
        self._end: Callable[[], object] | None = None  # Ends the process, if there is one.

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process, as does garbage collection of the renderer; a further scene starts another."""
        if self._end is not None:
            self._end()
            self._end = None

    def _start(self) -> None:
        environment = dict(os.environ)
        if sys.platform == "linux":  # Skips the search for X and OSMesa.
            environment.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
        self._messages = TemporaryFile()  # noqa: SIM115
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._messages}
        try:
            self._process = subprocess.Popen(COMMAND, env=environment, **pipes)
        except OSError as error:
            raise _failure(error.strerror or str(error)) from error
        self._end = weakref.finalize(self, _end, self._process, self._messages)

    def frames(self, scene: RenderScene) -> Iterator[Pixels]:
        """Yield frames (H, V * W, 3 | 4): red, green, blue and, without a background, opacity, from 0 to 255.

        All of them are to be taken before those of another scene.

        Raises:
            DrawingError: There is no pyvista, no OpenGL driver that works off screen, or drawing takes too long.
        """
        if self._end is None:
            self._start()
        end = time.monotonic() + TIME_OUT
        timer = threading.Timer(TIME_OUT, self._process.kill)
        timer.start()
        try:
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            pickle.dump(scene, self._process.stdin)
            self._process.stdin.flush()
            while (frame := pickle.load(self._process.stdout)) is not None:
                yield frame
        except (BrokenPipeError, EOFError, pickle.UnpicklingError):
            reason = self._reason(late=time.monotonic() >= end)
            self.close()
            raise _failure(reason) from None
        finally:
            timer.cancel()

    def _reason(self, *, late: bool) -> str:
        """Why the process has ended."""
        code = self._process.wait()
        self._messages.seek(0)
        said = self._messages.read().decode(errors="replace").strip()
        _LOG.debug("the drawing process wrote: %s", said)
        if code < 0:  # The signal is more informative than the messages of VTK before it.
            return f"not done after {TIME_OUT:g} s" if late else str(signal.strsignal(-code))
        return said.rpartition("\n")[2].strip().rstrip(".") or f"exit code {code}"


def _end(process: subprocess.Popen[bytes], messages: IO[bytes]) -> None:
    process.kill()
    process.wait()
    messages.close()
    for pipe in (process.stdin, process.stdout):
        with suppress(BrokenPipeError):  # Data that the process has not read.
            if pipe is not None:
                pipe.close()


def draw(scene: RenderScene, renderer: Renderer | None = None) -> Pixels:
    """Return the frames (F, H, V * W, 3 | 4) of a scene, as from `Renderer.frames`.

    Args:
        scene: What is drawn.
        renderer: Process that draws further scenes later, in place of a new one that ends with this scene.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    with Renderer() if renderer is None else nullcontext(renderer) as used:
        return np.stack(list(used.frames(scene)))


def write_film(path: Path, scene: RenderScene, renderer: Renderer | None = None) -> None:
    """Write a film (MP4, H.264) of a scene with a background and a text for every frame; shows its progress.

    Args:
        path: Of the file.
        scene: With a background and a text for every frame.
        renderer: Process that draws it, in place of a new one; it ends with the film.

    Raises:
        DrawingError: There is no pyvista, no OpenGL driver that works off screen, or no encoder.
        DataFileError: The file cannot be written.
    """
    size = (scene.size[0] * len(scene.views), scene.size[1])
    options: dict[str, Any] = {"codec": "libx264", "quality": None, "ffmpeg_log_level": "error"}
    progress = Progress("video", len(scene.texts), "frames")
    with atomic_path(path) as target, progress, renderer or Renderer() as used:
        frames = used.frames(scene)
        first = next(frames)
        target.touch()  # Raises an error where the folder cannot be written.
        try:
            import imageio_ffmpeg

            encoder = imageio_ffmpeg.write_frames(str(target), size, fps=scene.fps, output_params=_CODEC, **options)
            encoder.send(None)
            encoder.send(np.ascontiguousarray(first))
            progress.advance()
            for frame in frames:
                encoder.send(np.ascontiguousarray(frame))
                progress.advance()
            encoder.close()
        except (ImportError, RuntimeError, OSError) as error:
            reason = str(error).strip().rpartition("\n")[2].rstrip(".")
            raise DrawingError(
                f"the film cannot be encoded ({reason}): install the Python package imageio-ffmpeg, and make room for "
                f"it in {path.parent}"
            ) from error


def pace(times: FloatArray, slower: float) -> tuple[IntArray, float]:
    """Return the frames of a film of a motion at times (T,) [s], and its frame rate [Hz]."""
    step = float(np.median(np.diff(times)))
    every = max(1, round(1.0 / (slower * step * LARGEST_RATE)))
    return np.arange(0, len(times), every), 1.0 / (slower * step * every)


def _failure(reason: str) -> DrawingError:
    return DrawingError(
        f"pyvista cannot draw the deformed body on this machine ({reason}): install the Python package pyvista and "
        "an OpenGL driver that works without a display, such as libegl1 and libgl1-mesa-dri on Debian and Ubuntu"
    )
