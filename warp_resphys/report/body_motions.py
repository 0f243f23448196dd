"""Motions that are drawn: measured and simulated ones in a trial,
and those of bodies that controllers drive.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.mesh.surface import closest_points
from ..core.mesh.volume_mesh import Mesh, boundary_triangles
from ..data.camera import axes_from_below, frame_of, height_of, motion_axes, path_axes
from ..io.arrays import FloatArray, IntArray
from ..learning.metrics import mean_distance
from .layers import (
    BEHIND,
    MEASURED,
    OUTLINE,
    Layer,
    RenderScene,
    View,
    body_layers,
    chain,
    face_edges,
    ghost_layers,
    obstacle_layers,
    pace,
    sharp_edges,
    stems,
)
from .wording import MODELS, TONES, controller_name

MEASURED_MARKERS: Final = "measured markers"
LABORATORY_MARKERS: Final = "markers of the simulated laboratory"
TARGET_VERTICES: Final = "vertices of the simulated target"
_DIVERGED: Final = 10.0  # Distance from rest beyond which nothing is drawn, over the body's size.
_FAST: Final = 2.5  # Longest duration of a motion that is shown in slow motion [s],
_FINE: Final = 0.025  # if its frames are no farther apart than this [s].
_SOLID: Final = "#1a5fb4"  # Colour of the last model's markers.
_HEADROOM: Final = 0.12  # Space for the text above a film's view, over half its height.
_LEAST_NEAR: Final = 0.03  # Least half height of the close-up, over the body's size.
_MOST_NEAR: Final = 1.6  # Largest factor by which the other models' markers widen the close-up.
_FILM_VIEW: Final = (560, 480)  # Size of each view [px].
_PICTURE_VIEW: Final = (480, 408)
# Radius of a dot, over the height of a view.
_RADII: Final = {_FILM_VIEW: 0.013, _PICTURE_VIEW: 0.02}
_RING: Final = 1.9  # Radius of a simulated marker's ring, over that of a dot.
_WIDER: Final = 0.35  # Increase of the radius for the ring of each further model.
_HANGING: Final = 0.7  # Least cosine between gravity and the axis of a hanging body.
_DRAWING: Final = 0.6  # Longer side of the enlarged drawing of a path, over that of the body.
_GAP: Final = 0.15  # Distance of the drawing from the body, over the same.
_POINT: Final = 0.02  # Radius of the controlled point, over half a view's height.
# Widths [px] of the path and of the trail, on the body and in the drawing.
_WIDTHS: Final = ((4.0, 2.0), (6.0, 3.0))
# Least length of line segments, over half a view's height; shorter ones have ragged edges.
_APART: Final = 0.012
# Shifts to the viewer, over half a view's height.
_BEFORE: Final = {"rings": 2.5, "path": 4.0, "trail": 4.5, "dots": 5.0}
# Largest shifts, which are still in front of the camera.
_NEAREST: Final = {"rings": 9.0, "dots": 14.0}


@dataclass(frozen=True, eq=False)
class ComparedMotion:
    """A measured motion and its simulations, at the same T times."""

    mesh: Mesh  # The body at rest.
    times: FloatArray  # (T,) since the release [s].
    measured: FloatArray  # (T, M, 3) markers [m], NaN where they were not seen.
    positions: Mapping[str, FloatArray]  # (T, N, 3) [m] of vertices, by model; the last is solid.
    markers: Mapping[str, FloatArray]  # (T, M, 3) [m] of the same models.
    bound: FloatArray  # (M, 3) [m] markers on the body at rest.
    gravity: FloatArray  # (3,) direction of gravity.
    from_below: bool = False  # Whether the second view is from below, as for hanging bodies.
    target: FloatArray | None = None  # (T, N, 3) [m] of the vertices, where every one is observed.
    obstacles: ObstacleSurface = field(default_factory=ObstacleSurface)  # Of the last, over time.
    observed: str = (
        MEASURED_MARKERS  # What `measured` shows: of a real body, or of a simulation in its place.
    )

    @property
    def is_fast(self) -> bool:
        """Whether the motion is shown in slow motion."""
        return bool(self.times[-1] <= _FAST and np.diff(self.times).max(initial=0.0) <= _FINE)

    @property
    def instants(self) -> list[int]:
        """The frames of pictures, by `instants` for the first model."""
        return instants(self.measured, self.bound, next(iter(self.markers.values())))

    def at(self, frames: Sequence[int] | IntArray) -> "ComparedMotion":
        """Returns the motion at some of its frames."""
        chosen = np.asarray(frames, dtype=np.int64)
        positions, markers = (
            {m: q[chosen] for m, q in by_model.items()}
            for by_model in (self.positions, self.markers)
        )
        target = None if self.target is None else self.target[chosen]
        shown = replace(
            self, times=self.times[chosen], measured=self.measured[chosen], target=target
        )
        return replace(
            shown, positions=positions, markers=markers, obstacles=self.obstacles.at(chosen)
        )

    def scene(self) -> RenderScene:
        """Returns the scene of the body at some instants,
        with a close-up of the markers or a view from below.
        """
        return RenderScene(self.at(self.instants)._views(_PICTURE_VIEW), _PICTURE_VIEW)

    def film(self, seconds: float | None = None, slower: float | None = None) -> RenderScene:
        """Returns the scene of a film of the first seconds.

        Args:
            seconds: Duration [s]; by default 10, or 1.5 of a fast motion.
            slower: Factor of slow motion; by default 1, or 4 of a fast motion.
        """
        usual, longest = (4.0, 1.5) if self.is_fast else (1.0, 10.0)
        frames, fps = pace(self.times, usual if slower is None else slower)
        shown = self.at(
            frames[self.times[frames] <= (longest if seconds is None else seconds) + 1e-9]
        )
        *others, last = (MODELS[model].name for model in shown.positions)
        first, second = shown._views(_FILM_VIEW, _HEADROOM)
        first = replace(first, legend=[*((name, BEHIND) for name in others), (last, _SOLID)])
        second = replace(second, legend=[(self.observed, MEASURED)])
        return RenderScene(
            [first, second], _FILM_VIEW, background="white", fps=fps, texts=_clock(shown.times)
        )

    def _views(self, size: tuple[int, int], headroom: float = 0.0) -> list[View]:
        """Returns a view of the whole body, with space for text above it
        over half its height, and a second view.
        """
        rest = self.mesh.vertices
        far = _DIVERGED * float(np.ptp(rest, axis=0).max())
        # (B, T, N, 3)
        positions = without_diverged(np.stack([*self.positions.values()]), rest, far)
        # (B, T, M, 3)
        simulated = without_diverged(np.stack([*self.markers.values()]), self.bound, far)
        seen = np.concatenate([rest[None], *positions])
        axes = second = motion_axes(self.gravity, seen)
        everything = np.concatenate(
            [points.reshape(-1, 3) for points in (seen, simulated, self.measured)]
        )
        everything = np.concatenate([everything, self.obstacles.near(everything)])
        middle, half = frame_of(everything, axes)
        height = height_of(half, size)
        if self.from_below:
            second = axes_from_below(axes, self.gravity)
            near, half = frame_of(everything, second)
            near_height = height_of(half, size)
        else:
            near, near_height = self._follow(simulated, axes, size)
            near = np.where(np.isfinite(near), near, middle)
        triangles, edges = boundary_triangles(self.mesh), face_edges(self.mesh)
        sharp = sharp_edges(rest, triangles)
        sharp = sharp if len(sharp) else edges
        layers = obstacle_layers(self.obstacles.points, self.obstacles.triangles)
        for q in positions[:-1]:
            layers += ghost_layers(q, triangles, height, sharp)
        layers += body_layers(positions[-1], triangles, height, edges, sharp)
        layers.append(stems(self._feet(positions[-1]), simulated[-1], OUTLINE, 2.0))
        room = headroom * height
        places = ((axes, middle + room * axes[1], height + room), (second, near, near_height))
        return [
            View([*layers, *self._dots(simulated, at[2], height, _RADII[size])], *at)
            for at in places
        ]

    def _feet(self, positions: FloatArray) -> FloatArray:
        """The points (T, M, 3) of a body (T, N, 3) that are closest to the markers at rest."""
        closest = closest_points(self.mesh, self.bound)
        corners = self.mesh.vertices[closest.triangles]  # (M, 3, 3)
        unit = np.full((len(self.bound), 1, 3), corners.max() or 1.0)
        matrix = np.concatenate([corners.transpose(0, 2, 1), unit], axis=1)
        right = np.concatenate([closest.points, unit[:, :, 0]], axis=1)
        weights = (np.linalg.pinv(matrix) @ right[..., None])[..., 0]  # (M, 3), their sum one
        return np.asarray(np.einsum("tmki,mk->tmi", positions[:, closest.triangles], weights))

    def _dots(
        self, simulated: FloatArray, half: float, height: float, radius: float
    ) -> list[Layer]:
        """Returns dots of the measured markers and rings
        of the simulated ones (B, T, M, 3), in the foreground.

        Args:
            simulated: Of the models [m].
            half: Half the height of the view [m].
            height: That of the view of the whole body, behind which no marker is to be hidden [m].
            radius: Of a dot, over the height of the view.
        """
        size, layers = 2.0 * half * radius, list[Layer]()
        rings, dots = (
            min(_BEFORE[name] * height, _NEAREST[name] * half) for name in ("rings", "dots")
        )
        for behind, places in zip(reversed(range(len(simulated))), simulated, strict=True):
            colour, wide = BEHIND if behind else _SOLID, (_RING + _WIDER * behind) * size
            layers.append(Layer("rings", places, None, colour, size=wide, shift=rings))
        return [*layers, Layer("balls", self.measured, None, MEASURED, size=size, shift=dots)]

    def _follow(
        self, simulated: FloatArray, axes: FloatArray, size: tuple[int, int]
    ) -> tuple[FloatArray, float]:
        """Returns the middle (T, 3) of the markers in each frame,
        and half the height of a view that contains them [m].

        Where markers were not seen, the middle is that of the last model's markers (B, T, M, 3).
        The view contains the markers of the other models unless they are far away.
        """
        measured = self.measured
        least = _LEAST_NEAR * float(np.ptp(self.mesh.vertices, axis=0).max())
        places = np.where(
            np.isfinite(measured).all(axis=(1, 2), keepdims=True), measured, simulated[-1]
        )
        middle = places.mean(axis=1)

        def half(points: FloatArray) -> float:
            reach = np.nanmax(np.abs((points - middle[:, None]) @ axes[:2].T), axis=(0, 1))
            return max(height_of(reach, size), least)

        everything = half(np.concatenate([measured, *simulated], axis=1))
        return middle, 1.25 * min(everything, _MOST_NEAR * half(measured))


def instants(target: FloatArray, bound: FloatArray, simulated: FloatArray) -> list[int]:
    """Returns three separate frames, or fewer of a short motion.

    These are the frames of the largest error, of the largest motion of the markers, and the last
    one; where two of them are close to each other, a frame in between is chosen.

    Args:
        target: (T, M, 3) [m], NaN where a marker was not seen.
        bound: (M, 3) [m] on the undeformed body.
        simulated: (T, M, 3) [m].
    """
    count = len(target)
    moved = np.nan_to_num(np.linalg.norm(target - bound, axis=2)).mean(axis=1)
    off = mean_distance(simulated[None], target[None])[0]
    worst = int(np.argmax(np.where(np.isfinite(off), off, -1.0)))
    chosen: list[int] = []
    for frame in (worst, int(np.argmax(moved)), count - 1, count // 2, count // 4):
        if len(chosen) < 3 and all(abs(frame - other) > count // 10 for other in chosen):
            chosen.append(frame)
    return sorted(chosen)


def without_diverged(points: FloatArray, rest: FloatArray, far: float) -> FloatArray:
    """Returns points (..., P, 3), NaN in frames with a point
    that is not finite or farther than `far` from rest [m].
    """
    with np.errstate(invalid="ignore", over="ignore"):
        kept = (np.abs(points - rest) < far).all(axis=(-2, -1), keepdims=True)
    return np.where(kept, points, np.nan)


def hangs(mesh: Mesh, fixed: IntArray, gravity: FloatArray) -> tuple[bool, FloatArray]:
    """Returns whether a body hangs from its clamp, and the distances (N,)
    of its vertices from the clamp [m].
    """
    start = mesh.vertices[fixed].mean(axis=0) if len(fixed) else mesh.vertices[0]
    away = mesh.vertices - start
    axis = away.mean(axis=0)
    size = float(np.linalg.norm(axis) * np.linalg.norm(gravity))
    return bool(size > 0.0 and axis @ gravity > _HANGING * size), np.linalg.norm(away, axis=1)


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
        """Returns the scene of a film: a view of each body with the path
        and the trail of the point, also enlarged.

        Args:
            slower: Factor of slow motion.
        """
        frames, fps = pace(self.times, slower)
        axes, placed = path_axes(self.plane, self.gravity), self._placed()
        seen = [*(q.reshape(-1, 3) for q in self.positions.values()), placed(self.path)]
        middle, half = frame_of(np.concatenate([*seen, *map(placed, self.points.values())]), axes)
        height = height_of(half, _FILM_VIEW)
        room = _HEADROOM * height
        legends = [[(controller_name(name), _colour(name))] for name in self.positions]
        legends[0].append(("path", TONES["muted"].light))
        views = [
            View(
                self._layers(name, frames, height, placed),
                axes,
                middle + room * axes[1],
                height + room,
                legend,
            )
            for name, legend in zip(self.positions, legends, strict=True)
        ]
        return RenderScene(
            views, _FILM_VIEW, background="white", fps=fps, texts=_clock(self.times[frames])
        )

    def _placed(self) -> Callable[[FloatArray], FloatArray]:
        """The map from points (..., 3) of the plane into the enlarged drawing beside the body."""
        axes = path_axes(self.plane, self.gravity)
        body = np.concatenate([q.reshape(-1, 3) for q in self.positions.values()]) @ axes[:2].T
        low, high = body.min(axis=0), body.max(axis=0)
        longer, across = float((high - low).max()), plane_axes(self.plane)
        drawn = np.concatenate([self.path, *self.points.values()]) @ across.T
        first, last = drawn.min(axis=0), drawn.max(axis=0)
        larger = _DRAWING * longer / float((last - first).max())
        size, tall = larger * (last - first), high[1] - low[1] > high[0] - low[0]
        beside = (high[0] + _GAP * longer, 0.5 * (low[1] + high[1] - size[1]))
        above = (0.5 * (low[0] + high[0] - size[0]), high[1] + _GAP * longer)
        corner = np.array(beside if tall else above) - larger * first
        return lambda points: (larger * (points @ across.T) + corner) @ axes[:2]

    def _layers(
        self,
        controller: str,
        frames: IntArray,
        half: float,
        placed: Callable[[FloatArray], FloatArray],
    ) -> list[Layer]:
        colour = _colour(controller)
        layers = body_layers(self.positions[controller][frames], self.triangles, half, width=1.5)
        for place, (wide, thin) in ((np.asarray, _WIDTHS[0]), (placed, _WIDTHS[1])):
            path, points = place(self.path), place(self.points[controller])
            corners = _corners(path, _APART * half)
            # The part that follows is
            trail = points[np.minimum(_corners(points, _APART * half), frames[:, None])]
            trail = np.concatenate([trail, points[frames, None]], axis=1)  # at the point.
            before = {name: half * shift for name, shift in _BEFORE.items()}
            grey, lines = TONES["target"].light, chain(len(corners))
            layers += [
                Layer("lines", path[corners], lines, grey, size=wide, shift=before["path"]),
                Layer(
                    "lines", trail, chain(trail.shape[1]), colour, size=thin, shift=before["trail"]
                ),
                Layer(
                    "balls",
                    points[frames, None],
                    None,
                    colour,
                    size=_POINT * half,
                    shift=before["dots"],
                ),
            ]
        return layers


def plane_axes(plane: FloatArray) -> FloatArray:
    """Returns unit vectors (2, 3): the first of two directions (2, 3),
    and the part of the second across it.
    """
    right = plane[0] / np.linalg.norm(plane[0])
    up = plane[1] - (plane[1] @ right) * right
    return np.stack([right, up / np.linalg.norm(up)])


def _corners(points: FloatArray, apart: float) -> IntArray:
    """Indices of the first and last of points (T, 3),
    and of points in between at a least distance along the line.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    _, first = np.unique(np.floor(along / apart), return_index=True)
    return np.unique(np.append(first, len(points) - 1))


def _clock(times: FloatArray) -> list[str]:
    return [f"{time:.2f} s" for time in times]


def _colour(controller: str) -> str:
    """Colour of the controller's model, as in the figures."""
    model = controller.partition("_")[2]
    return TONES[model if model in TONES else "ink"].light
