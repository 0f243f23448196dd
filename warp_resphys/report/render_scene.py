"""Draws layers in views, frame by frame: a program for a process of its own; see `warp_resphys.report.render` for why.

`python -m warp_resphys.report.render_scene scene.npz frames.npy` (or `film.mp4`); it writes a line to stdout for every
frame that is done.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .render import COLOUR_MAP, INK, OUTLINE, UNWRITTEN

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Pixels = NDArray[np.uint8]

_FAR: Final = 20.0  # Of the eye without perspective, in half heights of the view.
_PEELS: Final = 12  # Layers of translucent surface that are told apart.
_CORNERS: Final = 48  # Of a ring.


def main(source: str, target: str) -> None:
    """Draw a scene.

    Args:
        source: The .npz file that `_run` wrote.
        target: Where to write: frames (F, H, V * W, 3 | 4) as .npy, or a film as .mp4.
    """
    with np.load(source, allow_pickle=False) as arrays:
        held = dict(arrays)
    spec: dict[str, Any] = json.loads(str(held.pop("spec")))
    frames = _frames(spec, held)
    if not target.endswith(".mp4"):
        write_frames(target, np.stack(list(frames)))
        return
    import imageio_ffmpeg

    width, height = spec["size"]
    encoder = imageio_ffmpeg.write_frames(
        target,
        (width * len(spec["views"]), height),
        fps=spec["fps"],
        codec="libx264",
        quality=None,
        ffmpeg_log_level="error",
        output_params=["-crf", "23", "-preset", "fast", "-threads", "1", "-movflags", "+faststart", "-bitexact"],
    )
    encoder.send(None)
    for frame in frames:
        encoder.send(np.ascontiguousarray(frame))
    encoder.close()


def write_frames(target: str, frames: Pixels) -> None:
    """Write frames, or end the process with `UNWRITTEN` where there is no room for them."""
    try:
        np.save(target, frames)
    except OSError as error:
        print(error.strerror or error, file=sys.stderr)
        sys.exit(UNWRITTEN)


def _frames(spec: Mapping[str, Any], held: Mapping[str, NDArray[Any]]) -> Iterator[Pixels]:
    """(H, V * W, 3 | 4) of each frame."""
    import pyvista

    views, (width, height), white = spec["views"], spec["size"], spec["background"]
    plotter: Any = pyvista.Plotter(
        shape=(1, len(views)), off_screen=True, border=False, lighting="none", window_size=[len(views) * width, height]
    )
    if spec["samples"]:
        plotter.enable_anti_aliasing("msaa", multi_samples=spec["samples"], all_renderers=True)
    else:
        plotter.render_window.SetMultiSamples(0)  # Depth peeling needs whole pixels.
    plotter.set_background(white or OUTLINE, all_renderers=True)  # Transparent, but for a share of it in smooth rims.
    light = {"position": spec["towards_light"], "focal_point": (0.0, 0.0, 0.0), "intensity": spec["intensity"]}
    plotter.add_light(pyvista.Light(light_type="scene light", **light))
    things, count = [], len(spec["texts"])
    for column, view in enumerate(views):
        plotter.subplot(0, column)
        for layer in view["layers"]:
            things.append(_Thing({key: held.get(str(each), each) for key, each in layer.items()}, held[view["axes"]]))
            things[-1].add(plotter)
            count = max(count, len(things[-1].points))
        if not spec["samples"]:
            plotter.enable_depth_peeling(_PEELS)
    text = _add_texts(plotter, spec) if spec["texts"] else None
    for frame in range(count):
        for thing in things:
            thing.move(min(frame, len(thing.points) - 1))
        if text is not None:
            text.input = spec["texts"][frame]
        for column, view in enumerate(views):
            plotter.subplot(0, column)
            _aim(plotter, view, held[view["axes"]], np.atleast_2d(held[view["focus"]]), frame)
        plotter.render()
        picture = plotter.screenshot(None, transparent_background=not white, return_img=True)
        if not white and not picture[..., 3].any():
            raise RuntimeError("the picture is empty")
        yield picture
        print("frame", frame, flush=True)
    plotter.close()


def _aim(plotter: Any, view: Mapping[str, Any], axes: FloatArray, focus: FloatArray, frame: int) -> None:
    """The camera of a view; focus (1 | F, 3)."""
    middle, half, camera = focus[min(frame, len(focus) - 1)], view["half_height"], plotter.camera
    distance = view["distance"] or _FAR * half
    camera.focal_point = middle
    camera.position = middle + distance * axes[2]
    camera.up = axes[1]
    if view["distance"]:
        camera.view_angle = float(np.degrees(2.0 * np.arctan(half)))
    else:
        plotter.enable_parallel_projection()
        camera.parallel_scale = half
    camera.clipping_range = (0.05 * distance, 2.0 * distance)


class _Thing:
    """A layer in a view."""

    def __init__(self, layer: Mapping[str, Any], axes: FloatArray) -> None:
        self.layer, self.kind = layer, layer["kind"]
        points = np.asarray(layer["points"], dtype=np.float64)
        points = points if points.ndim == 3 else points[None]
        self.points = points + layer["shift"] * axes[2]  # (1 | F, P, 3)
        self.around, cells = np.zeros((1, 3)), layer["cells"]  # (Q, 3) of a ball or ring around its centre.
        if self.kind == "balls":
            import pyvista

            ball = pyvista.Sphere(radius=layer["size"], theta_resolution=20, phi_resolution=20)
            self.around, cells = np.asarray(ball.points), np.asarray(ball.faces).reshape(-1, 4)[:, 1:]
        elif self.kind == "rings":
            angle = 2.0 * np.pi * np.arange(_CORNERS)[:, None] / _CORNERS
            self.around = layer["size"] * (np.cos(angle) * axes[0] + np.sin(angle) * axes[1])
            cells = np.stack([np.arange(_CORNERS), (np.arange(_CORNERS) + 1) % _CORNERS], axis=1)
        if self.kind in ("balls", "rings"):
            cells = np.concatenate([cells + len(self.around) * each for each in range(self.points.shape[1])])
        self.mesh = self._made(self._at(0), cells)

    def _made(self, points: FloatArray, cells: Any) -> Any:
        """The pyvista object."""
        import pyvista

        if self.kind.startswith("slice"):
            solid = pyvista.CellType.HEXAHEDRON if cells.shape[1] == 8 else pyvista.CellType.TETRA
            normal, origin = self.layer["plane"]
            return pyvista.UnstructuredGrid({solid: cells}, points).slice(normal=normal, origin=origin)
        if cells.shape[1] == 2:  # VTK wants the number of points before each line.
            return pyvista.PolyData(points, lines=np.insert(cells, 0, 2, axis=1).ravel())
        surface = pyvista.PolyData.from_regular_faces(points, cells)
        paint = self.layer["paint"]
        if paint is not None:
            data = surface.cell_data if paint.ndim == 2 else surface.point_data
            data["paint"] = paint.astype(np.uint8) if paint.ndim == 2 else paint
        if self.layer["plane"] is not None:
            normal, origin = self.layer["plane"]
            return surface.clip(normal=normal, origin=origin)
        return surface

    def add(self, plotter: Any) -> None:
        """Shows it in the current view."""
        layer = self.layer
        style: dict[str, Any] = {"opacity": layer["opacity"], "lighting": layer["light"] is not None}
        if layer["light"] is not None:
            style |= {"ambient": layer["light"][0], "diffuse": layer["light"][1]}
        if layer["paint"] is None:
            style |= {"color": layer["colour"], "scalars": None}
        elif layer["paint"].ndim == 2:
            style |= {"scalars": "paint", "rgb": True}
        else:
            style |= {"scalars": "paint", "cmap": COLOUR_MAP, "clim": (0.0, 1.0), "show_scalar_bar": False}
        if self.kind in ("lines", "rings", "slice_edges"):
            style["line_width"] = layer["width"] if self.kind == "rings" else layer["size"]
        if self.kind == "slice_edges":
            style["style"] = "wireframe"
        if self.kind == "balls":
            style["smooth_shading"] = True
        if self.mesh.n_cells:
            plotter.add_mesh(self.mesh, **style)

    def _at(self, frame: int) -> FloatArray:
        """(P Q, 3) where its points are in a frame; what is not finite shrinks to nothing."""
        points = self.points[frame]
        whole = np.isfinite(points).all(axis=1, keepdims=True)
        if self.kind not in ("balls", "rings"):
            return points if whole.all() else np.zeros_like(points)
        places = np.where(whole, points, 0.0)[:, None] + np.where(whole[:, None], self.around, 0.0)
        return places.reshape(-1, 3)

    def move(self, frame: int) -> None:
        """Takes the places of a frame."""
        if len(self.points) > 1:
            self.mesh.points = self._at(frame)


def _add_texts(plotter: Any, spec: Mapping[str, Any]) -> Any:
    """The time, which is returned, and the legend beside it, where no player's controls hide them."""
    plotter.subplot(0, 0)
    top, left = spec["size"][1] - 32, 90
    for name, colour in spec["legend"]:
        plotter.add_text(name, position=(left, top), font_size=9, color=colour)
        left += 24 + 9 * len(name)
    return plotter.add_text(spec["texts"][0], position=(14, top), font_size=10, color=INK)


if __name__ == "__main__":
    main(*sys.argv[1:])
