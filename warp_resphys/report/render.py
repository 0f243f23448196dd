"""Pictures of deformed bodies, coloured by their distance from a target and drawn off screen by pyvista.

Where there is no OpenGL driver, VTK ends the process that asks for a picture. Hence pyvista is only ever
imported in a process of its own, `python -m warp_resphys.report.render scene.npz picture.png`.
"""

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..io.errors import ResphysError
from ..mesh.mesh import Mesh, boundary_faces, boundary_triangles

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LOG = logging.getLogger(__name__)
COMMAND: Final = (sys.executable, "-P", "-m", "warp_resphys.report.render")
TIME_OUT: Final = 120.0  # [s]; it takes about one.
COLOUR_MAP: Final = "viridis"
OUTLINE: Final = "#808891"  # Of the undeformed body: one grey that reads on a light and on a dark page.
LONGER_SIDE: Final = 1600  # Of a picture [px].
MARGIN: Final = 0.02  # Around the bodies, as the lengths below relative to the longer side of what is seen.
LINE_WIDTHS: Final = {"outline": 0.0034, "edges": 0.0015}
NUDGE: Final = 0.005  # The outline is drawn this far behind the body where they coincide.
TOWARDS_VIEWER: Final = (0.40, -1.0, 0.40)  # A body along x is seen from the side, the end of high x nearer.
TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
SHADE: Final = 0.25  # Share of the colour that depends on the light; the rest stays readable as a value.
FEATURE_ANGLE: Final = 30.0  # Faces that meet at a sharper angle [degrees] share an edge of the outline.
_RINGS: Final = {3: [0, 1, 2], 4: [0, 1, 2, 3], 6: [0, 3, 1, 4, 2, 5]}  # Nodes along the rim of a face.
_DIVERGED: Final = 10.0  # Distance from the target, relative to the body's, beyond which nothing is drawn.


class DrawingError(ResphysError):
    """A picture that cannot be drawn on this machine."""


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
    picture = run(
        COMMAND,
        {
            "rest": mesh.vertices,
            "positions": np.stack(list(shown.values())),
            "values": errors / largest[:, None],
            "triangles": boundary_triangles(mesh),
            "edges": face_edges(mesh),
        },
    )
    pixels = np.split(picture, len(shown), axis=1)
    drawn = {name: Body(*each) for name, *each in zip(shown, pixels, largest.tolist(), strict=True)}
    return {name: drawn.get(name) for name in positions}


def face_edges(mesh: Mesh) -> IntArray:
    """(E, 2) vertices of the lines around the faces of the boundary, each line once."""
    sides = boundary_faces(mesh)
    rims = sides[:, _RINGS[sides.shape[1]]]
    edges = np.sort(np.stack([rims, np.roll(rims, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    found: IntArray = np.unique(edges, axis=0)
    return found


def run(command: Sequence[str], scene: Mapping[str, Any]) -> NDArray[np.float32]:
    """The picture that another process draws.

    Args:
        command: What to run; the files of the scene and of the picture follow as its arguments.
        scene: Arrays by name.

    Returns:
        (H, W, 3 | 4) red, green, blue and perhaps opacity in [0, 1].

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    from matplotlib.image import imread

    with TemporaryDirectory() as folder:
        source, picture = Path(folder) / "scene.npz", Path(folder) / "picture.png"
        np.savez(source, **scene)
        try:
            done = subprocess.run(
                [*command, str(source), str(picture)],
                env=drawing_environment(),
                timeout=TIME_OUT,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
            )
        except subprocess.TimeoutExpired as error:
            raise failure(f"not done after {TIME_OUT:g} s") from error
        except OSError as error:
            raise failure(error.strerror or str(error)) from error
        if done.returncode:
            _LOG.debug("the drawing process wrote: %s", done.stderr)
            raise failure(last_words(done.returncode, done.stderr))
        return np.asarray(imread(picture))


def drawing_environment() -> dict[str, str]:
    """Return the environment of a process that draws."""
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


def last_words(code: int, stderr: str) -> str:
    """Return why a process ended: the signal, which tells more than VTK does before it, or the last line it wrote."""
    if code < 0:
        return signal.strsignal(-code) or f"signal {-code}"
    return (stderr.strip().splitlines() or [f"exit code {code}"])[-1].rstrip(".")


def main(source: str, picture: str) -> None:
    """Draw a scene, the bodies side by side.

    Args:
        source: An .npz file with rest (N, 3) and positions (B, N, 3) [m], values (B, N) in [0, 1], triangles
            (F, 3) and edges (E, 2) of the surface.
        picture: The .png file to write.

    Raises:
        RuntimeError: Nothing is to be seen in the picture.
    """
    import pyvista

    with np.load(source, allow_pickle=False) as arrays:
        scene: dict[str, Any] = dict(arrays)
    bodies = scene["positions"]
    axes = view_axes(TOWARDS_VIEWER)
    seen = np.concatenate([scene["rest"], *bodies]) @ axes.T  # (P, 3) [m] to the right, up, towards the viewer
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    extent = upper[:2] - lower[:2]
    length = extent.max()  # [m]
    extent += 2.0 * MARGIN * length
    width, height = np.ceil(extent * LONGER_SIDE / extent.max()).astype(int).tolist()  # [px]
    centre = 0.5 * (lower + upper) @ axes

    plotter: Any = pyvista.Plotter(
        shape=(1, len(bodies)),
        off_screen=True,
        border=False,
        lighting="none",
        window_size=[len(bodies) * width, height],
    )
    plotter.enable_anti_aliasing("msaa", multi_samples=8, all_renderers=True)
    plotter.set_background(OUTLINE, all_renderers=True)  # Transparent, but for a share of it in smooth rims.
    light = pyvista.Light(position=TOWARDS_LIGHT, focal_point=(0.0, 0.0, 0.0), light_type="scene light")
    plotter.add_light(light)  # In all pictures.
    for column in range(len(bodies)):
        plotter.subplot(0, column)
        _add_body(plotter, scene, column, axes[2] * length)
        plotter.camera.focal_point = centre
        plotter.camera.position = centre + axes[2] * 10.0 * length
        plotter.camera.up = axes[1]
        plotter.enable_parallel_projection()
        plotter.camera.parallel_scale = 0.5 * extent[1]
        plotter.reset_camera_clipping_range()
    pixels = plotter.screenshot(picture, transparent_background=True, return_img=True)
    plotter.close()
    if pixels is None or not pixels[..., 3].any():
        raise RuntimeError("the picture is empty")


def view_axes(towards_viewer: Sequence[float]) -> FloatArray:
    """(3, 3) orthonormal rows: to the right, up, towards the viewer; z points up."""
    towards = np.asarray(towards_viewer) / np.linalg.norm(towards_viewer)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _add_body(plotter: Any, scene: Mapping[str, NDArray[Any]], column: int, towards: FloatArray) -> None:
    """Add one body, the edges of its faces and its outline at rest.

    Args:
        plotter: The pyvista plotter.
        scene: See `main`.
        column: Which body.
        towards: (3,) the way to the viewer, as long as what is seen [m].
    """
    import pyvista

    positions, triangles = scene["positions"][column], scene["triangles"]
    surface = pyvista.PolyData.from_regular_faces(positions, triangles)
    surface["values"] = scene["values"][column]
    plotter.add_mesh(
        surface,
        scalars="values",
        cmap=COLOUR_MAP,
        clim=(0.0, 1.0),
        show_scalar_bar=False,
        ambient=1.0 - SHADE,
        diffuse=SHADE,
    )
    pairs = np.insert(scene["edges"], 0, 2, axis=1)  # VTK wants the number of points before each line.
    edges = pyvista.PolyData(positions + 0.2 * NUDGE * towards, lines=pairs.ravel())
    plotter.add_mesh(edges, color="black", opacity=0.35, lighting=False, line_width=LINE_WIDTHS["edges"] * LONGER_SIDE)
    rest = pyvista.PolyData.from_regular_faces(scene["rest"] - NUDGE * towards, triangles)
    outline = rest.extract_feature_edges(FEATURE_ANGLE)
    plotter.add_mesh(outline, color=OUTLINE, lighting=False, line_width=LINE_WIDTHS["outline"] * LONGER_SIDE)


if __name__ == "__main__":
    main(*sys.argv[1:])
