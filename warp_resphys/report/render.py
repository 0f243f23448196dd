"""Pictures and films of scenes, drawn with pyvista off screen in a process of their own.

Without a working OpenGL driver, VTK ends its process. Hence pyvista is imported in a separate
process only, whose program is `main`: it reads scenes from stdin until that is closed, and writes
the pixels of every frame to stdout, and None after each scene.
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
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from ..io.arrays import FloatArray
from ..io.atomic import atomic_path
from ..io.errors import ResphysError
from ..io.progress import Progress
from .layers import INK, OUTLINE, Layer, RenderScene

Pixels = NDArray[np.uint8]

_LOG = logging.getLogger(__name__)
COMMAND: Final = (sys.executable, "-P", "-m", "warp_resphys.report.render")
TIME_OUT: Final = 300.0  # [s] for a scene; a picture takes about one.
TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
_FAR: Final = 20.0  # Distance of the eye, in half heights of the view.
_PEELS: Final = 12  # Sorted layers of translucent surfaces.
_SAMPLES: Final = 8  # Samples a pixel, in scenes that are not sorted.
_CORNERS: Final = 48  # Of a ring.
_RING_WIDTH: Final = 2.5  # [px]
_CODEC: Final = [
    "-f",
    "mp4",
    "-crf",
    "23",
    "-preset",
    "fast",
    "-threads",
    "1",
    "-movflags",
    "+faststart",
    "-bitexact",
]


class DrawingError(ResphysError):
    """A picture that cannot be drawn on this machine."""


class Renderer:
    """A process that draws scenes one after the other, which the first scene starts.

    A context manager.
    """

    def __init__(self) -> None:
        self._end: Callable[[], object] | None = None  # Ends the process, if there is one.

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the process, as does garbage collection of the renderer.

        A further scene starts another.
        """
        if self._end is not None:
            self._end()
            self._end = None

    def _start(self) -> None:
        environment = dict(os.environ)
        if sys.platform == "linux":  # Skips the search for X and OSMesa.
            environment.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
        self._messages = TemporaryFile()  # noqa: SIM115
        pipes: dict[str, Any] = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "stderr": self._messages,
        }
        try:
            self._process = subprocess.Popen(COMMAND, env=environment, **pipes)
        except OSError as error:
            raise _failure(error.strerror or str(error)) from error
        self._end = weakref.finalize(self, _end, self._process, self._messages)

    def frames(self, scene: RenderScene) -> Iterator[Pixels]:
        """Yields frames (H, V * W, 3 | 4): red, green, blue and,
        without a background, opacity, from 0 to 255.

        All of them are to be taken before those of another scene.

        Raises:
            DrawingError: There is no pyvista, no OpenGL driver that works off screen, or drawing
                takes too long.
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
        """Returns why the process has ended."""
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
    """Returns the frames (F, H, V * W, 3 | 4) of a scene,
    as from `Renderer.frames`, whose errors it raises.

    Args:
        scene: What is drawn.
        renderer: Process that draws further scenes later, in place of a new one that ends with this
            scene.
    """
    with Renderer() if renderer is None else nullcontext(renderer) as used:
        return np.stack(list(used.frames(scene)))


def write_film(path: Path, scene: RenderScene, renderer: Renderer | None = None) -> None:
    """Writes a film (MP4, H.264) of a scene with a background and a text for every frame.

    Shows its progress.

    Args:
        path: Of the file.
        scene: With a background and a text for every frame.
        renderer: Process that draws it, in place of a new one.

    Raises:
        DrawingError: There is no pyvista, no OpenGL driver that works off screen, or no encoder.
        DataFileError: The file cannot be written.
    """
    size = (scene.size[0] * len(scene.views), scene.size[1])
    options: dict[str, Any] = {"codec": "libx264", "quality": None, "ffmpeg_log_level": "error"}
    progress = Progress("video", len(scene.texts), "frames")
    with (
        atomic_path(path) as target,
        progress,
        Renderer() if renderer is None else nullcontext(renderer) as used,
    ):
        frames = used.frames(scene)
        first = next(frames)
        target.touch()  # Raises an error where the folder cannot be written.
        try:
            import imageio_ffmpeg

            encoder = imageio_ffmpeg.write_frames(
                str(target), size, fps=scene.fps, output_params=_CODEC, **options
            )
            encoder.send(None)
            for frame in chain([first], frames):
                encoder.send(np.ascontiguousarray(frame))
                progress.advance()
            encoder.close()
        except (ImportError, RuntimeError, OSError) as error:
            reason = str(error).strip().rpartition("\n")[2].rstrip(".")
            raise DrawingError(
                f"the film cannot be encoded ({reason}): install the Python package "
                f"imageio-ffmpeg, and make room for it in {path.parent}"
            ) from error


def _failure(reason: str) -> DrawingError:
    return DrawingError(
        f"pyvista cannot draw the deformed body on this machine ({reason}): install the Python "
        "package pyvista and an OpenGL driver that works without a display, such as libegl1 and "
        "libgl1-mesa-dri on Debian and Ubuntu"
    )


def main() -> None:
    """Draws scenes until there are no more."""
    target = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # Keeps messages of VTK out of the frames.
    source: Any = sys.stdin.buffer
    drawer = _Drawer()
    while source.peek(1):
        for frame in drawer.frames(pickle.load(source)):
            pickle.dump(np.ascontiguousarray(frame), target)
        pickle.dump(None, target)
        target.flush()


class _Drawer:
    """Draws scenes into a window, which is reused for scenes of the same layout."""

    def __init__(self) -> None:
        self._layout: tuple[Any, ...] = ()
        self._plotter: Any = None

    def _window(self, scene: RenderScene) -> Any:
        """An empty window with a light."""
        import pyvista

        (width, height), count = scene.size, len(scene.views)
        if self._layout != (layout := (width, height, count, scene.sorts)):
            size = [count * width, height]
            self._plotter = pyvista.Plotter(
                shape=(1, count), off_screen=True, border=False, lighting="none", window_size=size
            )
            self._layout = layout
            if scene.sorts:
                self._plotter.render_window.SetMultiSamples(0)  # Depth peeling needs whole pixels.
            else:
                self._plotter.enable_anti_aliasing(
                    "msaa", multi_samples=_SAMPLES, all_renderers=True
                )
        self._plotter.clear()
        # Smooth edges of transparent pictures have a share of the background's colour.
        self._plotter.set_background(scene.background or OUTLINE, all_renderers=True)
        light = {
            "light_type": "scene light",
            "position": TOWARDS_LIGHT,
            "focal_point": (0.0, 0.0, 0.0),
        }
        self._plotter.add_light(pyvista.Light(**light))
        return self._plotter

    def frames(self, scene: RenderScene) -> Iterator[Pixels]:
        """Yields the pixels (H, V * W, 3 | 4) of each frame."""
        plotter, layers = self._window(scene), []
        plotter.suppress_rendering = True  # A reused window would render after each added object.
        for column, view in enumerate(scene.views):
            plotter.subplot(0, column)
            layers += [_DrawnLayer(plotter, layer, view.axes) for layer in view.layers]
            if scene.sorts:
                plotter.enable_depth_peeling(_PEELS)
        time = _add_texts(plotter, scene) if scene.texts else None
        plotter.suppress_rendering = False
        for frame in range(max(len(scene.texts), *(len(layer.points) for layer in layers))):
            for layer in layers:
                layer.move(frame)
            if time is not None:
                time.input = scene.texts[frame]
            for column, view in enumerate(scene.views):
                plotter.subplot(0, column)
                focus, distance = _at(np.atleast_2d(view.focus), frame), _FAR * view.half_height
                plotter.camera.position = focus + distance * view.axes[2]
                plotter.camera.focal_point, plotter.camera.up = focus, view.axes[1]
                plotter.enable_parallel_projection()
                plotter.camera.parallel_scale = view.half_height
                plotter.camera.clipping_range = (0.05 * distance, 2.0 * distance)
            plotter.render()
            picture = plotter.screenshot(
                None, transparent_background=not scene.background, return_img=True
            )
            if not scene.background and not picture[..., 3].any():
                raise RuntimeError("the picture is empty")
            yield picture


def _at(values: FloatArray, frame: int) -> Any:
    """The value of a frame, of constant (1, ...) or moving (F, ...) values."""
    return values[min(frame, len(values) - 1)]


class _DrawnLayer:
    """A layer in the current view, with corners or centres at its points (1 | F, P, 3)."""

    def __init__(self, plotter: Any, layer: Layer, axes: FloatArray) -> None:
        points = layer.points if layer.points.ndim == 3 else layer.points[None]
        self.points = points + layer.shift * axes[2]
        self.around: FloatArray | None = None  # (Q, 3) of a ball or ring around its centre.
        cells = layer.cells
        if layer.kind in ("balls", "rings"):
            self.around, corners = (
                _ball(layer.size) if layer.kind == "balls" else _ring(layer.size, axes)
            )
            cells = np.concatenate(
                [corners + len(self.around) * place for place in range(points.shape[1])]
            )
        self.mesh = _mesh(layer, self._places(0), cells)
        style = {
            "color": layer.colour,
            "opacity": layer.opacity,
            "smooth_shading": layer.kind == "balls",
        }
        style["lighting"] = layer.light is not None
        if layer.light is not None:
            style |= {"ambient": layer.light[0], "diffuse": layer.light[1]}
        if layer.kind in ("lines", "rings", "slice_edges"):
            style["line_width"] = _RING_WIDTH if layer.kind == "rings" else layer.size
        if layer.kind == "slice_edges":
            style["style"] = "wireframe"
        if self.mesh.n_cells:
            plotter.add_mesh(self.mesh, **style)

    def _places(self, frame: int) -> FloatArray:
        """Positions (P Q, 3) of its points in a frame.

        Points that are not finite are shrunk to zero size.
        """
        points = _at(self.points, frame)
        whole = np.isfinite(points).all(axis=1, keepdims=True)
        if self.around is None:
            return points if whole.all() else np.zeros_like(points)
        centres = np.where(whole, points, 0.0)[:, None]
        return (centres + np.where(whole[:, None], self.around, 0.0)).reshape(-1, 3)

    def move(self, frame: int) -> None:
        """Moves the layer to its positions in a frame."""
        if len(self.points) > 1:
            self.mesh.points = self._places(frame)


def _mesh(layer: Layer, points: FloatArray, cells: Any) -> Any:
    """The pyvista object of a layer."""
    import pyvista

    if layer.kind.startswith("slice"):
        assert layer.plane is not None
        solid = pyvista.CellType.HEXAHEDRON if cells.shape[1] == 8 else pyvista.CellType.TETRA
        return pyvista.UnstructuredGrid({solid: cells}, points).slice(
            normal=layer.plane[0], origin=layer.plane[1]
        )
    if cells.shape[1] == 2:  # VTK expects the number of points before each line.
        return pyvista.PolyData(points, lines=np.insert(cells, 0, 2, axis=1).ravel())
    surface = pyvista.PolyData.from_regular_faces(points, cells)
    return (
        surface
        if layer.plane is None
        else surface.clip(normal=layer.plane[0], origin=layer.plane[1])
    )


def _ball(radius: float) -> tuple[FloatArray, Any]:
    """Corners (Q, 3) and triangles (S, 3) of a ball."""
    import pyvista

    ball = pyvista.Sphere(radius=radius, theta_resolution=20, phi_resolution=20)
    return np.asarray(ball.points), ball.regular_faces


def _ring(radius: float, axes: FloatArray) -> tuple[FloatArray, Any]:
    """Corners (Q, 3) and lines (Q, 2) of a ring that faces the viewer."""
    angle = 2.0 * np.pi * np.arange(_CORNERS)[:, None] / _CORNERS
    count = np.arange(_CORNERS)
    return radius * (np.cos(angle) * axes[0] + np.sin(angle) * axes[1]), np.stack(
        [count, np.roll(count, -1)], axis=1
    )


def _add_texts(plotter: Any, scene: RenderScene) -> Any:
    """Adds time and legends at the top, where controls
    of players do not hide them, and returns the time.
    """
    top = scene.size[1] - 36
    for column, view in enumerate(scene.views):
        plotter.subplot(0, column)
        left = 14 if column else 100
        for name, colour in view.legend:
            text = plotter.add_text(name, position=(left, top), font_size=12, color=colour)
            text.prop.background_color, text.prop.background_opacity = "white", 0.75
            left += 24 + 12 * len(name)
    plotter.subplot(0, 0)
    return plotter.add_text(scene.texts[0], position=(14, top), font_size=12, color=INK)


if __name__ == "__main__":
    main()
