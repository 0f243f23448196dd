"""Draws a moving body with its markers, frame by frame: a program for a process of its own.

`python -m warp_resphys.report.render_motion scene.npz frames.npy` (or `motion.mp4`); see `warp_resphys.report.render`
for why. It writes a line to stdout for every frame that is done.
"""

import sys
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .render import OUTLINE
from .render_markers import INK, MEASURED

FloatArray = NDArray[np.float64]

_RING: Final = 1.9  # Radius of a simulated marker's ring, over that of a dot.
_TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
_FEATURE_ANGLE: Final = 30.0  # [degrees]
_BEHIND: Final = 0.3  # Opacity of the bodies that the last one is compared with.
_CORNERS: Final = 48  # Of a ring.
_NUDGE: Final = 0.01  # Lines are drawn this far before a surface, over half the height of a view.
_BACK: Final = 4.0  # Surfaces of the other bodies are drawn this far behind it, so that they show beside it only.
_FAR: Final = 20.0  # Of the eye, in heights of the view.


def main(source: str, target: str) -> None:
    """Draw a scene.

    Args:
        source: An .npz file with, for F frames and B bodies, positions (B, F, N, 3) [m] (a body that is not finite in a
            frame is not drawn in it), rest (N, 3), triangles (S, 3) and edges (E, 2) of the surface, colours of bodies
            and rings (B,), simulated (B, F, M, 3) and measured (F, M, 3) markers, feet (F, M, 3) of the last body's
            markers, for V views axes (V, 3, 3) (to the right, up, towards the viewer), focus (V, F, 3) and
            half_height (V,) [m], size (2,) of a view [px], radius of a measured marker's dot over the height of a
            view, texts (F,) and legend (B + 1,), both perhaps empty, and fps.
        target: Where to write: frames (F, H, W, 4) as .npy on nothing, or a film on white as .mp4.
    """
    with np.load(source, allow_pickle=False) as arrays:
        scene: dict[str, Any] = dict(arrays)
    film = target.endswith(".mp4")
    frames = _frames(scene, transparent=not film)
    if film:
        _write_film(target, scene, frames)
    else:
        np.save(target, np.stack(list(frames)))


def _write_film(target: str, scene: dict[str, Any], frames: Iterator[NDArray[np.uint8]]) -> None:
    import imageio_ffmpeg

    width, height = scene["size"].tolist()
    encoder = imageio_ffmpeg.write_frames(
        target,
        (width * len(scene["focus"]), height),
        fps=float(scene["fps"]),
        codec="libx264",
        quality=None,
        ffmpeg_log_level="error",
        output_params=["-crf", "23", "-preset", "fast", "-threads", "1", "-movflags", "+faststart", "-bitexact"],
    )
    encoder.send(None)
    for frame in frames:
        encoder.send(np.ascontiguousarray(frame))
    encoder.close()


def _frames(scene: dict[str, Any], transparent: bool) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 3 | 4) of each frame, the views side by side."""
    import pyvista

    width, height = scene["size"].tolist()
    views = len(scene["focus"])
    plotter: Any = pyvista.Plotter(
        shape=(1, views), off_screen=True, border=False, lighting="none", window_size=[views * width, height]
    )
    plotter.enable_anti_aliasing("msaa", multi_samples=4, all_renderers=True)
    plotter.set_background("white", all_renderers=True)
    plotter.add_light(pyvista.Light(position=_TOWARDS_LIGHT, focal_point=(0.0, 0.0, 0.0), light_type="scene light"))
    bodies: list[_Body] = []
    markers: list[_Markers] = []
    for view in range(views):
        plotter.subplot(0, view)
        markers.append(_Markers(scene, view))
        bodies += [_Body(scene, each, view) for each in range(len(scene["positions"]))]
        for body in bodies[-len(scene["positions"]) :]:
            body.add(plotter)
        markers[-1].add(plotter)
        plotter.enable_parallel_projection()
        plotter.camera.parallel_scale = float(scene["half_height"][view])
    text = _add_texts(plotter, scene) if len(scene["texts"]) else None
    for frame in range(scene["positions"].shape[1]):
        for body in bodies:
            body.move(frame)
        for each in markers:
            each.move(frame)
        if text is not None:
            text.input = str(scene["texts"][frame])
        for view in range(views):
            plotter.subplot(0, view)
            _aim(plotter.camera, scene, view, frame)
        plotter.render()
        yield plotter.screenshot(None, transparent_background=transparent, return_img=True)
        print("frame", frame, flush=True)
    plotter.close()


def _aim(camera: Any, scene: dict[str, Any], view: int, frame: int) -> None:
    towards, focus, half = scene["axes"][view, 2], scene["focus"][view, frame], float(scene["half_height"][view])
    camera.focal_point = focus
    camera.position = focus + _FAR * half * towards
    camera.up = scene["axes"][view, 1]
    camera.clipping_range = (0.05 * _FAR * half, 2.0 * _FAR * half)


class _Body:
    """One body's surface: the last one solid with the lines around its faces, the others seen through."""

    def __init__(self, scene: dict[str, Any], index: int, view: int) -> None:
        import pyvista

        self.positions, self.colour = scene["positions"][index], str(scene["colours"][index])
        self.solid = index == len(scene["positions"]) - 1
        self.nudge = _NUDGE * float(scene["half_height"][0]) * scene["axes"][view, 2]
        surface = pyvista.PolyData.from_regular_faces(scene["rest"], scene["triangles"])
        surface["vertex"] = np.arange(len(scene["rest"]))
        self.surface = surface
        outline = surface.extract_feature_edges(_FEATURE_ANGLE)
        pairs = outline["vertex"][outline.lines.reshape(-1, 3)[:, 1:]] if outline.n_cells else scene["edges"]
        self.outline = pyvista.PolyData(scene["rest"].copy(), lines=np.insert(pairs, 0, 2, axis=1).ravel())
        self.edges = pyvista.PolyData(scene["rest"].copy(), lines=np.insert(scene["edges"], 0, 2, axis=1).ravel())

    def add(self, plotter: Any) -> None:
        """Shows it in the current view."""
        opacity = 1.0 if self.solid else _BEHIND
        plotter.add_mesh(self.surface, color=self.colour, opacity=opacity, ambient=0.72, diffuse=0.3, scalars=None)
        if self.solid:
            plotter.add_mesh(self.edges, color=INK, opacity=0.3, lighting=False, line_width=1.0)
        plotter.add_mesh(self.outline, color=self.colour if not self.solid else INK, lighting=False, line_width=2.0)

    def move(self, frame: int) -> None:
        """Takes the positions of a frame; a body that has diverged shrinks to nothing."""
        q = self.positions[frame]
        points = q if np.isfinite(q).all() else np.zeros_like(q)
        self.surface.points = points if self.solid else points - _BACK / _NUDGE * self.nudge
        self.outline.points = self.edges.points = points + self.nudge


class _Markers:
    """Dots of the measured markers, rings of the simulated ones, stems; sized for a view and in front of all else."""

    def __init__(self, scene: dict[str, Any], view: int) -> None:
        import pyvista

        half = float(scene["half_height"][view])
        self.measured, self.simulated, self.feet = scene["measured"], scene["simulated"], scene["feet"]
        self.colours = [str(colour) for colour in scene["rings"]]
        self.nearer = 5.0 * half * scene["axes"][view, 2]
        radius = 2.0 * half * float(scene["radius"])
        ball = pyvista.Sphere(radius, theta_resolution=20, phi_resolution=20)
        count = self.measured.shape[1]
        self.ball = np.asarray(ball.points, dtype=np.float64)
        faces = np.asarray(ball.faces, dtype=np.int64).reshape(-1, 4)[:, 1:]
        self.balls = pyvista.PolyData.from_regular_faces(
            np.tile(self.ball, (count, 1)), np.concatenate([faces + len(self.ball) * m for m in range(count)])
        )
        angle = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ scene["axes"][view, :2]
        self.circles = [
            (_RING + 0.35 * (len(self.colours) - 1 - b)) * radius * circle for b in range(len(self.colours))
        ]
        ring = np.append(np.arange(_CORNERS), 0)
        lines = np.concatenate([[_CORNERS + 1, *(ring + _CORNERS * m)] for m in range(count)])
        self.rings = [pyvista.PolyData(np.tile(circle, (count, 1)), lines=lines) for circle in self.circles]
        pairs = np.arange(2 * count).reshape(count, 2)
        self.stems = pyvista.PolyData(np.zeros((2 * count, 3)), lines=np.insert(pairs, 0, 2, axis=1).ravel())

    def add(self, plotter: Any) -> None:
        """Shows them in the current view."""
        plotter.add_mesh(self.stems, color=OUTLINE, lighting=False, line_width=2.0)
        for colour, ring in zip(self.colours, self.rings, strict=True):
            plotter.add_mesh(ring, color=colour, lighting=False, line_width=2.5)
        plotter.add_mesh(self.balls, color=MEASURED, lighting=False)

    def move(self, frame: int) -> None:
        """Takes the places of a frame; a marker that was not seen, or has diverged, shrinks to nothing."""
        self.balls.points = self._around(self.measured[frame], self.ball, 2.0)
        for ring, circle, places in zip(self.rings, self.circles, self.simulated[:, frame], strict=True):
            ring.points = self._around(places, circle, 1.0)
        ends = np.stack([self.feet[frame], self.simulated[-1, frame]], axis=1)
        self.stems.points = np.where(np.isfinite(ends).all(axis=(1, 2), keepdims=True), ends, 0.0).reshape(-1, 3)

    def _around(self, places: FloatArray, shape: FloatArray, steps: float) -> FloatArray:
        """(M P, 3) a shape (P, 3) around each of (M, 3) places."""
        whole = np.asarray(np.isfinite(places).all(axis=1))[:, None, None]
        points = np.where(whole, places[:, None] + shape + 0.5 * steps * self.nearer, 0.0)
        return points.reshape(-1, 3)


def _add_texts(plotter: Any, scene: dict[str, Any]) -> Any:
    """The time, which is returned, and the legend beside it, where no player's controls hide them."""
    plotter.subplot(0, 0)
    top = int(scene["size"][1]) - 32
    left = 90
    for name, colour in zip(scene["legend"], (*scene["rings"], MEASURED), strict=True):
        plotter.add_text(str(name), position=(left, top), font_size=9, color=str(colour))
        left += 24 + 9 * len(str(name))
    return plotter.add_text(str(scene["texts"][0]), position=(14, top), font_size=10, color=INK)


if __name__ == "__main__":
    main(*sys.argv[1:])
