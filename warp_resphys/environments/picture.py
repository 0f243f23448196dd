"""Pictures of a robot with its task, without a graphics card: triangles from back to front, by Matplotlib."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_SIZE: Final = (480, 480)  # px
_DPI: Final = 100
_TURN, _TILT = np.radians(35.0), np.radians(20.0)  # of the eye, about the vertical and over the horizon
_LIGHT: Final = np.array([0.35, 0.55, 0.76])  # towards it, in the axes of the picture: right, up, to the eye
_SHADE: Final = 0.55  # of the body's colour, where no light falls
_MARGIN: Final = 0.12  # around what is shown, as a share of it
_BODY: Final = np.array([0.42, 0.62, 0.80])
_MARKER, _GOAL, _PAPER = "#1d2833", "#d1495b", "#ffffff"


@dataclass(frozen=True)
class Look:
    """What is to be seen of one robot.

    Attributes:
        triangles: (S, 3) of its surface, counter-clockwise from outside; none where only markers are known.
        vertices: (N, 3) [m].
        markers: (M, 3) [m].
        goals: (K, 3) a path, or one place, that its task asks for [m].
        text: below.
    """

    triangles: NDArray[np.int64]
    vertices: FloatArray
    markers: FloatArray
    goals: FloatArray
    text: str


class Camera:
    """Looks from afar, so that what it showed first fills the picture.

    Args:
        up: (3,) direction that is up in pictures.
        points: (P, 3) that are to be in it [m].
    """

    def __init__(self, up: FloatArray, points: FloatArray) -> None:
        up = up / np.linalg.norm(up)
        side = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
        side /= np.linalg.norm(side)
        level = np.cos(_TURN) * np.cross(side, up) + np.sin(_TURN) * side
        eye = np.cos(_TILT) * level + np.sin(_TILT) * up
        right = np.cross(up, eye)
        right /= np.linalg.norm(right)
        self._axes = np.stack([right, np.cross(eye, right), eye])
        flat = points @ self._axes[:2].T
        self._middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
        self._half = (0.5 + _MARGIN) * float(np.ptp(flat, axis=0).max())

    def picture(self, look: Look) -> Pixels:
        """(H, W, 3) of a robot."""
        figure = Figure(figsize=(_SIZE[0] / _DPI, _SIZE[1] / _DPI), dpi=_DPI, facecolor=_PAPER)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set_xlim(self._middle[0] - self._half, self._middle[0] + self._half)
        axes.set_ylim(self._middle[1] - self._half, self._middle[1] + self._half)
        if len(look.triangles):
            axes.add_collection(self._surface(look))
        goals = look.goals @ self._axes.T
        axes.plot(goals[:, 0], goals[:, 1], color=_GOAL, linewidth=1.5, zorder=3)
        axes.plot(goals[:1, 0], goals[:1, 1], "o", color=_GOAL, markersize=8, fillstyle="none", mew=2.0, zorder=4)
        markers = look.markers @ self._axes.T
        axes.plot(markers[:, 0], markers[:, 1], "o", color=_MARKER, markersize=5, mec=_PAPER, mew=0.8, zorder=5)
        axes.text(0.03, 0.03, look.text, transform=axes.transAxes, color=_MARKER, fontsize=11)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _surface(self, look: Look) -> PolyCollection:
        corners = (look.vertices @ self._axes.T)[look.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        seen = np.flatnonzero(normal[:, 2] > 0.0)
        seen = seen[np.argsort(corners[seen, :, 2].mean(axis=1), kind="stable")]
        lit = _SHADE + (1.0 - _SHADE) * np.clip(normal[seen] @ _LIGHT, 0.0, 1.0)
        colours = np.clip(lit[:, None] * _BODY, 0.0, 1.0)
        return PolyCollection(corners[seen][:, :, :2], facecolors=colours, edgecolors=colours, linewidths=0.4, zorder=2)
