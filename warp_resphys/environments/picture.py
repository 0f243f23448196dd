"""Pictures of robots with their tasks."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from ..io.arrays import FloatArray, IntArray
from ..report.bodies import BODIES, BODY_LIGHT, obstacle_layers, sharp_edges
from ..report.obstacles import ObstacleSurface
from ..report.render import INK, Layer, Pixels, Renderer, RenderScene, View, chain, frame_of, view_axes

_SIZE: Final = (480, 480)  # px
_TURN, _TILT = np.radians(-35.0), np.radians(20.0)  # azimuth and elevation of the camera
_MARGIN: Final = 0.12  # around the scene, relative to its longer side
_GOAL: Final = "#d1495b"
_RADII: Final = {"marker": 0.015, "goal": 0.022}  # relative to half the height of the picture
_BEFORE: Final = {"edges": 0.01, "goals": 4.0, "markers": 5.0}  # shift towards the camera, in the same units


class Camera:
    """A distant camera whose frame fits a set of points.

    Args:
        up: (3,) upward direction of the pictures.
        points: (P, 3) that fill the frame [m].
        obstacles: that the robots touch.

    Raises:
        DrawingError: this machine cannot render.
    """

    def __init__(self, up: FloatArray, points: FloatArray, obstacles: ObstacleSurface) -> None:
        up = up / np.linalg.norm(up)
        side = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
        side /= np.linalg.norm(side)
        level = np.cos(_TURN) * np.cross(side, up) + np.sin(_TURN) * side
        self._axes = view_axes(np.cos(_TILT) * level + np.sin(_TILT) * up, up)
        self._focus, half = frame_of(np.concatenate([points, obstacles.near(points)]), self._axes, _MARGIN)
        self._half = float(half.max())
        self._around = obstacle_layers(obstacles)
        self._renderer = Renderer()

    def pictures(
        self,
        triangles: IntArray,
        vertices: FloatArray,
        markers: FloatArray,
        goals: Sequence[FloatArray],
        texts: Sequence[str],
    ) -> list[Pixels]:
        """Returns pictures (H, W, 3) of B robots.

        Args:
            triangles: (S, 3) of their surface; empty if only markers are known.
            vertices: (B, N, 3) [m].
            markers: (B, M, 3) [m].
            goals: B paths or places (K, 3) of their tasks [m].
            texts: B captions.

        Raises:
            DrawingError: this machine cannot render.
        """
        most = max(map(len, goals))
        paths = np.stack([np.pad(path, ((0, most - len(path)), (0, 0)), mode="edge") for path in goals])
        before = {name: self._half * share for name, share in _BEFORE.items()}
        radii = {name: self._half * share for name, share in _RADII.items()}
        layers = [
            *self._around,
            Layer("balls", paths[:, :1], None, _GOAL, size=radii["goal"], shift=before["goals"]),
            Layer("balls", markers, None, INK, size=radii["marker"], shift=before["markers"]),
        ]
        if most > 1:
            layers.append(Layer("lines", paths, chain(most), _GOAL, size=2.0, shift=before["goals"]))
        if len(triangles):
            edges = sharp_edges(vertices[0], triangles)
            layers.append(Layer("surface", vertices, triangles, BODIES[1], light=BODY_LIGHT))
            layers.append(Layer("lines", vertices, edges, INK, size=1.5, shift=before["edges"]))
        view = View(layers, self._axes, self._focus, self._half)
        return list(self._renderer.frames(RenderScene([view], _SIZE, background="white", texts=texts)))

    def close(self) -> None:
        """Ends the rendering process."""
        self._renderer.close()
