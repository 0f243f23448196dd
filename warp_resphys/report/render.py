"""Pictures and films of bodies, as layers in views that another process draws off screen with pyvista.

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
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..io.errors import ResphysError
from ..io.progress import Progress
from ..mesh.mesh import Mesh, boundary_faces, boundary_triangles

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
LONGER_SIDE: Final = 1100  # Of a picture of a deformed body [px].
MARGIN: Final = 0.02  # Around the bodies, as the lengths below relative to the longer side of what is seen.
LINE_WIDTHS: Final = {"outline": 0.0034, "edges": 0.0018}
NUDGE: Final = 0.005  # The outline is drawn this far behind the body where they coincide.
TOWARDS_VIEWER: Final = (0.40, -1.0, 0.40)  # A body along x is seen from the side, the end of high x nearer.
TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
SHADE: Final = 0.25  # Share of the colour that depends on the light; the rest stays readable as a value.
FEATURE_ANGLE: Final = 30.0  # Faces that meet at a sharper angle [degrees] share an edge of the outline.
_RINGS: Final = {3: [0, 1, 2], 4: [0, 1, 2, 3], 6: [0, 3, 1, 4, 2, 5]}  # Nodes along the rim of a face.
_DIVERGED: Final = 10.0  # Distance from the target, relative to the body's, beyond which nothing is drawn.


class DrawingError(ResphysError):
    """A picture that cannot be drawn on this machine."""


@dataclass(frozen=True, eq=False)
class Layer:
    """One thing to draw; what moves has a first axis of F frames, and is not drawn where it is not finite.

    Attributes:
        kind: surface, lines, balls, rings (towards the viewer), slice or slice_edges (of solid cells, by a plane).
        points: (P, 3) or (F, P, 3) [m] corners, or centres of balls and rings, which come and go by themselves.
        cells: (S, 3) triangles, (E, 2) lines or (C, 4 | 8) solid cells.
        colour: Where nothing is painted.
        paint: (P,) values in [0, 1] in the colours of `COLOUR_MAP`, or (S, 3) red, green and blue, 0 to 255.
        size: Radius of balls and rings [m], or width of lines [px].
        opacity: In [0, 1].
        light: Shares of the ambient and of the scene's light; None for the colour as it is.
        shift: How far it is moved towards the viewer [m].
        plane: (2, 3) normal and a point of the plane that cuts it; of a surface, what is behind it is drawn.
        width: Of the lines of rings [px].
    """

    kind: str
    points: FloatArray
    cells: IntArray | None = None
    colour: str = INK
    paint: NDArray[Any] | None = None
    size: float = 1.0
    opacity: float = 1.0
    light: tuple[float, float] | None = None
    shift: float = 0.0
    plane: FloatArray | None = None
    width: float = 2.5


@dataclass(frozen=True, eq=False)
class View:
    """What one of the views side by side shows.

    Attributes:
        layers: In the order in which they are drawn.
        axes: (3, 3) rows: to the right, up, towards the viewer.
        focus: (3,) or (F, 3) [m] what is in the middle.
        half_height: Of what is seen [m]; with perspective as a tangent.
        distance: Of the eye [m], for perspective; None without it.
    """

    layers: Sequence[Layer]
    axes: FloatArray
    focus: FloatArray
    half_height: float
    distance: float | None = None


class Body(NamedTuple):
    """A drawn body.

    Attributes:
        pixels: (H, W, 4) red, green, blue and opacity in [0, 1]; what is around the body is transparent.
        largest: Distance from the target [m] that has the last colour of `COLOUR_MAP`; 0 has the first.
    """

    pixels: NDArray[np.float32]
    largest: float


def draw_bodies(mesh: Mesh, positions: Mapping[str, FloatArray], target: FloatArray) -> dict[str, Body | None]:
    """Draw deformed bodies, coloured by the distance from the target's vertices, in pictures of one size.

    Args:
        mesh: The undeformed body, drawn as an outline.
        positions: (N, 3) deformed positions [m] by name.
        target: (N, 3) the target's [m].

    Returns:
        A drawn body by name; None for one that has diverged.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    size = np.ptp(mesh.vertices, axis=0).max()
    shown = {name: q for name, q in positions.items() if np.all(np.abs(q - target) < _DIVERGED * size)}
    if not shown:
        return dict.fromkeys(positions)
    errors = np.stack([np.linalg.norm(q - target, axis=1) for q in shown.values()])  # (B, N) [m]
    largest = np.maximum(errors.max(axis=1), 1e-15)
    axes = view_axes(TOWARDS_VIEWER)
    seen = np.concatenate([mesh.vertices, *shown.values()]) @ axes.T  # (P, 3) [m] to the right, up, towards the viewer
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    length = (upper - lower)[:2].max()  # [m]
    extent = (upper - lower)[:2] + 2.0 * MARGIN * length
    pixels = np.ceil(extent * LONGER_SIDE / extent.max()).astype(int)
    triangles, edges = boundary_triangles(mesh), face_edges(mesh)
    widths = {name: each * LONGER_SIDE for name, each in LINE_WIDTHS.items()}
    sharp = sharp_edges(mesh.vertices, triangles)
    rest = Layer("lines", mesh.vertices, sharp, OUTLINE, size=widths["outline"], shift=-NUDGE * length)
    views = []
    for q, values in zip(shown.values(), errors / largest[:, None], strict=True):
        surface = Layer("surface", q, triangles, paint=values, light=(1.0 - SHADE, SHADE))
        rims = Layer("lines", q, edges, "black", size=widths["edges"], opacity=0.35, shift=0.2 * NUDGE * length)
        views.append(View([surface, rims, rest], axes, 0.5 * (lower + upper) @ axes, 0.5 * extent[1]))
    (picture,) = draw(views, pixels, samples=8)
    parts = np.split(picture.astype(np.float32) / np.float32(255.0), len(shown), axis=1)
    drawn = {name: Body(*each) for name, *each in zip(shown, parts, largest.tolist(), strict=True)}
    return {name: drawn.get(name) for name in positions}


def face_edges(mesh: Mesh) -> IntArray:
    """(E, 2) vertices of the lines around the faces of the boundary, each line once."""
    sides = boundary_faces(mesh)
    rims = sides[:, _RINGS[sides.shape[1]]]
    edges = np.sort(np.stack([rims, np.roll(rims, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    found: IntArray = np.unique(edges, axis=0)
    return found


def sharp_edges(points: FloatArray, triangles: IntArray, angle: float = FEATURE_ANGLE) -> IntArray:
    """(E, 2) vertices of the edges at which triangles meet at more than an angle, or at which a surface ends.

    Args:
        points: (P, 3) [m].
        triangles: (S, 3).
        angle: Between the normals [degrees].
    """
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, which, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    together = np.zeros((len(edges), 3))
    np.add.at(together, which.ravel(), np.repeat(normals, 3, axis=0))
    # Two unit vectors at an angle a have a sum of length 2 cos(a / 2).
    smooth = (count == 2) & (np.linalg.norm(together, axis=1) >= 2.0 * np.cos(0.5 * np.radians(angle)))
    found: IntArray = edges[~smooth]
    return found


def view_axes(towards_viewer: Sequence[float]) -> FloatArray:
    """(3, 3) orthonormal rows: to the right, up, towards the viewer; z points up."""
    towards = np.asarray(towards_viewer) / np.linalg.norm(towards_viewer)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def draw(views: Sequence[View], size: Sequence[int] | IntArray, **options: Any) -> Pixels:
    """Draw views side by side.

    Args:
        views: V of them.
        size: (2,) width and height of each [px].
        **options: See `_OPTIONS`.

    Returns:
        (F, H, V * W, 3 | 4) red, green, blue and, without a background, opacity, 0 to 255.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    with TemporaryDirectory() as folder:
        target = Path(folder) / "frames.npy"
        _run(views, size, options, target)
        frames: Pixels = np.load(target, allow_pickle=False)
    return frames


def film(views: Sequence[View], size: Sequence[int] | IntArray, progress: Progress, **options: Any) -> bytes:
    """Return a film (MP4, H.264) of views side by side.

    Args:
        views: V of them.
        size: (2,) width and height of each [px], even.
        progress: Of the frames.
        **options: See `_OPTIONS`; `fps` among them.

    Raises:
        DrawingError: There is no pyvista, no OpenGL driver that works off screen, or no encoder.
    """
    with TemporaryDirectory() as folder:
        target = Path(folder) / "film.mp4"
        _run(views, size, {"background": "white", **options}, target, progress)
        return target.read_bytes()


_OPTIONS: Final[dict[str, Any]] = {
    "background": None,  # A colour; None for a transparent one.
    "samples": 4,  # A pixel; 0 where surfaces are translucent, which are then drawn in their order.
    "towards_light": TOWARDS_LIGHT,
    "intensity": 1.0,  # Of the light.
    "texts": [],  # One a frame, in the first view.
    "legend": [],  # Texts and colours, beside it.
    "fps": 25.0,  # Of a film.
}


def _run(
    views: Sequence[View],
    size: Sequence[int] | IntArray,
    options: Mapping[str, Any],
    target: Path,
    progress: Progress | None = None,
) -> None:
    """Have another process draw, and count the frames that it says are done."""
    arrays: dict[str, NDArray[Any]] = {}
    names: dict[int, str] = {}

    def plain(value: Any) -> Any:
        """What JSON can hold; arrays are stored beside it, each of them once."""
        if isinstance(value, View | Layer):
            return {name: plain(each) for name, each in vars(value).items()}
        if isinstance(value, np.ndarray):
            if id(value) not in names:
                names[id(value)] = f"array_{len(names)}"
                arrays[names[id(value)]] = value
            return names[id(value)]
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        return float(value) if isinstance(value, np.floating) else value

    spec = {**_OPTIONS, **options, "size": [int(each) for each in size], "views": plain(list(views))}
    source = target.with_name("scene.npz")
    np.savez(source, spec=np.array(json.dumps(spec)), **arrays)  # type: ignore[arg-type]
    try:
        process = subprocess.Popen(
            [*COMMAND, str(source), str(target)],
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
    except OSError as error:
        raise failure(error.strerror or str(error)) from error
    said = _listen(process, progress)
    if process.returncode:
        _LOG.debug("the drawing process wrote: %s", said)
        if process.returncode == UNWRITTEN:
            raise DrawingError(
                "the deformed body cannot be drawn, since there was no room in the temporary folder "
                f"{target.parent.parent} ({_last_words(UNWRITTEN, said)}): free some space there"
            )
        raise failure(_last_words(process.returncode, said))


def _listen(process: "subprocess.Popen[str]", progress: Progress | None) -> str:
    """What a process wrote to stderr until it ended; it has only so much time."""
    late = threading.Event()

    def end() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(TIME_OUT, end)
    timer.start()
    said: list[str] = []
    try:
        with process:
            listener = threading.Thread(target=lambda: said.append(process.stderr.read() if process.stderr else ""))
            listener.start()
            for line in process.stdout or ():
                if progress is not None and line.startswith("frame"):
                    progress.advance()
            listener.join()
    except BaseException:
        with suppress(ProcessLookupError):
            process.kill()
        raise
    finally:
        timer.cancel()
    if late.is_set():
        raise failure(f"not done after {TIME_OUT:g} s")
    return "".join(said)


def _environment() -> dict[str, str]:
    """That of a process that draws."""
    environment = dict(os.environ)
    if sys.platform == "linux":  # Neither X nor OSMesa is looked for where there is none.
        environment.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    return environment


def failure(reason: str) -> DrawingError:
    """Return the error for a body that cannot be drawn for this reason."""
    return DrawingError(
        f"pyvista cannot draw the deformed body on this machine ({reason}): install the Python package pyvista and "
        "an OpenGL driver that works without a display, such as libegl1 and libgl1-mesa-dri on Debian and Ubuntu"
    )


def _last_words(code: int, stderr: str) -> str:
    """Why a process ended: the signal, which tells more than VTK does before it, or the last line that it wrote."""
    if code < 0:
        return signal.strsignal(-code) or f"signal {-code}"
    return (stderr.strip().splitlines() or [f"exit code {code}"])[-1].rstrip(".")
