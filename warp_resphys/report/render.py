"""Pictures and films of layers in views, which another process draws off screen with pyvista.

Where there is no OpenGL driver, VTK ends the process that asks for a picture. Hence pyvista is only ever imported in a
process of its own, `warp_resphys.report.render_scene`.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..io.errors import ResphysError
from ..io.progress import Progress

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Pixels = NDArray[np.uint8]

_LOG = logging.getLogger(__name__)
COMMAND: Final = (sys.executable, "-P", "-m", "warp_resphys.report.render_scene")
UNWRITTEN: Final = 74  # What a drawing process returns that found no room for its frames.
TIME_OUT: Final = 300.0  # [s]; a picture takes about one.
COLOUR_MAP: Final = "viridis"
BODY: Final = "#a9bccf"
CLAMPED: Final = "#33485e"
MEASURED: Final = "#d55e00"  # Vermilion of Okabe and Ito (2008).
INK: Final = "#1c2127"
OUTLINE: Final = "#808891"  # Of the undeformed body: one grey that reads on a light and on a dark page.
TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)


class DrawingError(ResphysError):
    """A picture that cannot be drawn on this machine."""


@dataclass(frozen=True, eq=False)
class Layer:
    """One thing to draw; what moves has a first axis of F frames, and is not drawn where it is not finite."""

    kind: str  # surface, lines, balls, rings (towards the viewer), slice or slice_edges (of solid cells, by a plane).
    points: FloatArray  # (P, 3) or (F, P, 3) [m] corners, or centres of balls and rings, which come and go one by one.
    cells: IntArray | None = None  # (S, 3) triangles, (E, 2) lines or (C, 4 | 8) solid cells.
    colour: str = INK  # Where nothing is painted.
    paint: FloatArray | None = None  # (P,) values in [0, 1] in the colours of `COLOUR_MAP`.
    size: float = 1.0  # Radius of balls and rings [m], or width of lines [px].
    opacity: float = 1.0
    light: tuple[float, float] | None = None  # Shares of the ambient and the scene's light; None: the colour as it is.
    shift: float = 0.0  # How far it is moved towards the viewer [m].
    plane: FloatArray | None = None  # (2, 3) normal and a point of a plane; of a surface, what is behind it is drawn.


@dataclass(frozen=True, eq=False)
class View:
    """What one of the views side by side shows, without perspective."""

    layers: Sequence[Layer]  # In the order in which they are drawn.
    axes: FloatArray  # (3, 3) rows: to the right, up, towards the viewer.
    focus: FloatArray  # (3,) or (F, 3) [m] what is in the middle.
    half_height: float  # Of what is seen [m].
    legend: Sequence[tuple[str, str]] = ()  # Texts and colours, at its top.


@dataclass(frozen=True, eq=False)
class Scene:
    """Views side by side, and how they are drawn."""

    views: Sequence[View]
    size: Sequence[int]  # (2,) width and height of each view [px]; even for a film.
    background: str | None = None  # A colour; None for a transparent one.
    samples: int = 4  # A pixel; 0 where surfaces are translucent, which are then drawn in their order.
    towards_light: Sequence[float] = TOWARDS_LIGHT
    intensity: float = 1.0  # Of the light.
    texts: Sequence[str] = ()  # One a frame, in the first view, before its legend.
    fps: float = 25.0  # Of a film.


def view_axes(towards_viewer: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """(3, 3) orthonormal rows: to the right, up, towards the viewer."""
    towards = np.array(towards_viewer, dtype=np.float64)
    right = np.cross(np.array(up, dtype=np.float64), towards)
    rows = np.stack([right, np.cross(towards, right), towards])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def draw(*scenes: Scene) -> list[Pixels]:
    """Draw scenes, in one process, as its start takes longer than most pictures.

    Returns:
        Of each scene (F, H, V * W, 3 | 4) red, green, blue and, without a background, opacity, 0 to 255.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    with TemporaryDirectory() as folder:
        _run(scenes, Path(folder) / "frames.npz")
        with np.load(Path(folder) / "frames.npz", allow_pickle=False) as frames:
            return [frames[f"arr_{each}"] for each in range(len(scenes))]


def film(scene: Scene, progress: Progress) -> bytes:
    """Return a film (MP4, H.264) of a scene.

    Args:
        scene: With a background.
        progress: Of the frames.

    Raises:
        DrawingError: There is no pyvista, no OpenGL driver that works off screen, or no encoder.
    """
    with TemporaryDirectory() as folder:
        target = Path(folder) / "film.mp4"
        _run([scene], target, progress)
        return target.read_bytes()


def _run(scenes: Sequence[Scene], target: Path, progress: Progress | None = None) -> None:
    """Have another process draw, in so much time, and count the frames that it says are done."""
    source = target.with_name("scenes.npz")
    _write_scenes(source, scenes)
    environment = dict(os.environ)
    if sys.platform == "linux":  # Neither X nor OSMesa is looked for where there is none.
        environment.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    end, said = time.monotonic() + TIME_OUT, []
    try:
        command = [*COMMAND, str(source), str(target)]
        process = subprocess.Popen(command, env=environment, text=True, errors="replace", **pipes)
    except OSError as error:
        raise _failure(error.strerror or str(error)) from error
    timer = threading.Timer(TIME_OUT, process.kill)
    timer.start()
    with process:
        try:
            for line in process.stdout or ():
                if not line.startswith("frame"):
                    said.append(line.strip())
                elif progress is not None:
                    progress.advance()
        except BaseException:
            process.kill()
            raise
        finally:
            timer.cancel()
    if process.returncode:
        _LOG.debug("the drawing process wrote: %s", "\n".join(said))
        reason = ([f"exit code {process.returncode}"] + [line for line in said if line])[-1].rstrip(".")
        if process.returncode < 0:  # The signal that ended it tells more than what VTK says before.
            late = time.monotonic() >= end
            reason = f"not done after {TIME_OUT:g} s" if late else str(signal.strsignal(-process.returncode))
        elif process.returncode == UNWRITTEN:
            raise DrawingError(
                "the deformed body cannot be drawn, since there was no room in the temporary folder "
                f"{target.parent.parent} ({reason}): free some space there"
            )
        raise _failure(reason)


def _write_scenes(path: Path, scenes: Sequence[Scene]) -> None:
    """Write scenes as JSON, with names in place of the arrays, which stand beside it, each of them once."""
    arrays: dict[str, Any] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays[f"array_{id(value)}"] = value
            return f"array_{id(value)}"
        return vars(value) if is_dataclass(value) else value.item()

    spec = json.dumps(scenes, default=plain)
    np.savez(path, spec=np.array(spec), **arrays)


def _failure(reason: str) -> DrawingError:
    return DrawingError(
        f"pyvista cannot draw the deformed body on this machine ({reason}): install the Python package pyvista and "
        "an OpenGL driver that works without a display, such as libegl1 and libgl1-mesa-dri on Debian and Ubuntu"
    )
