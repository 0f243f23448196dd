"""A film of bodies side by side, on which controllers drive a point along a path."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..io.arrays import FloatArray, IntArray
from .bodies import BODIES, BODY_LIGHT, FILM_VIEW, HEADROOM, sharp_edges
from .control_section import controller_name
from .figures import TONES
from .render import INK, Layer, RenderScene, View, chain, frame_of, height_of, pace, path_axes

_DRAWING: Final = 0.6  # Longer side of the enlarged drawing, over that of the body.
_GAP: Final = 0.15  # Distance of the drawing from the body, over the same.
_BEFORE: Final = {"edges": 0.01, "path": 4.0, "trail": 4.5, "point": 5.0}  # Shifts to the viewer, over half height.
_POINT: Final = 0.02  # Radius of the point, over half a view's height.
_LINES: Final = ((4.0, 2.0), (6.0, 3.0))  # Widths [px] of the path and of the trail, on the body and in the drawing.
_APART: Final = 0.012  # Least length of line segments, over half a view's height; shorter ones have ragged edges.

Placement = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class DrivenBodies:
    """Motions of the simulated laboratory under several controllers, at the same T times."""

    times: FloatArray  # (T,) since the first command [s].
    triangles: IntArray  # (S, 3) of the surface.
    positions: Mapping[str, FloatArray]  # (T, N, 3) [m] of the vertices, by controller.
    points: Mapping[str, FloatArray]  # (T, 3) [m] controlled point, by controller.
    path: FloatArray  # (P, 3) [m] path that it follows.
    plane: FloatArray  # (2, 3) directions to the right and upwards in the plane of the path.
    gravity: FloatArray  # (3,) direction of gravity.

    def film(self, slower: float = 1.0) -> RenderScene:
        """Return the scene of a film: a view of each body with the path and the trail of the point, also enlarged.

        Args:
            slower: Factor of slow motion.
        """
        frames, fps = pace(self.times, slower)
        axes, placed = path_axes(self.plane, self.gravity), self._placed()
        seen = [*(q.reshape(-1, 3) for q in self.positions.values()), placed(self.path)]
        middle, half = frame_of(np.concatenate([*seen, *map(placed, self.points.values())]), axes)
        height = height_of(half, FILM_VIEW)
        room = HEADROOM * height
        legends = [[(controller_name(name), _colour(name))] for name in self.positions]
        legends[0].append(("path", TONES["muted"].light))
        views = [
            View(self._layers(name, frames, height, placed), axes, middle + room * axes[1], height + room, legend)
            for name, legend in zip(self.positions, legends, strict=True)
        ]
        texts = [f"{time:.2f} s" for time in self.times[frames]]
        return RenderScene(views, FILM_VIEW, background="white", fps=fps, texts=texts)

    def _placed(self) -> Placement:
        """Returns the map from points (..., 3) of the plane into the enlarged drawing beside the body."""
        axes = path_axes(self.plane, self.gravity)
        body = np.concatenate([q.reshape(-1, 3) for q in self.positions.values()]) @ axes[:2].T
        low, high = body.min(axis=0), body.max(axis=0)
        longer = float((high - low).max())
        right = self.plane[0] / np.linalg.norm(self.plane[0])
        up = self.plane[1] - (self.plane[1] @ right) * right
        across = np.stack([right, up / np.linalg.norm(up)])
        drawn = np.concatenate([self.path, *self.points.values()]) @ across.T
        first, last = drawn.min(axis=0), drawn.max(axis=0)
        larger = _DRAWING * longer / float((last - first).max())
        size, tall = larger * (last - first), high[1] - low[1] > high[0] - low[0]
        beside = (high[0] + _GAP * longer, 0.5 * (low[1] + high[1] - size[1]))
        above = (0.5 * (low[0] + high[0] - size[0]), high[1] + _GAP * longer)
        corner = np.array(beside if tall else above) - larger * first
        return lambda points: (larger * (points @ across.T) + corner) @ axes[:2]

    def _layers(self, controller: str, frames: IntArray, half: float, placed: Placement) -> list[Layer]:
        before, colour = {name: half * shift for name, shift in _BEFORE.items()}, _colour(controller)
        body, grey = self.positions[controller][frames], TONES["target"].light
        layers = [
            Layer("surface", body, self.triangles, BODIES[1], light=BODY_LIGHT),
            Layer("lines", body, sharp_edges(body[0], self.triangles), INK, size=1.5, shift=before["edges"]),
        ]
        for place, (wide, thin) in ((np.asarray, _LINES[0]), (placed, _LINES[1])):
            path, points = place(self.path), place(self.points[controller])
            corners = _corners(path, _APART * half)
            trail = points[np.minimum(_corners(points, _APART * half), frames[:, None])]  # The part that follows is
            trail = np.concatenate([trail, points[frames, None]], axis=1)  # at the point.
            layers += [
                Layer("lines", path[corners], chain(len(corners)), grey, size=wide, shift=before["path"]),
                Layer("lines", trail, chain(trail.shape[1]), colour, size=thin, shift=before["trail"]),
                Layer("balls", points[frames, None], None, colour, size=_POINT * half, shift=before["point"]),
            ]
        return layers


def _corners(points: FloatArray, apart: float) -> IntArray:
    """Indices of the first and last of points (T, 3), and of points in between at a least distance along the line."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    _, first = np.unique(np.floor(along / apart), return_index=True)
    return np.unique(np.append(first, len(points) - 1))


def _colour(controller: str) -> str:
    """Colour of the controller's model, as in the figures."""
    model = controller.partition("_")[2]
    return TONES[model if model in TONES else "ink"].light
