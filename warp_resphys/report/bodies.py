"""Scenes of bodies in motion, with measured and simulated markers, and their edges, obstacles and stems."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from ..io.arrays import FloatArray, IntArray
from ..learning.metrics import mean_distance
from ..mesh.mesh import Mesh, boundary_faces, boundary_triangles
from ..mesh.surface import closest_points
from .data import MODELS
from .obstacles import OBSTACLE, OBSTACLE_LIGHT, ObstacleSurface
from .render import (
    INK,
    MEASURED,
    OUTLINE,
    Layer,
    RenderScene,
    View,
    axes_from_below,
    frame_of,
    height_of,
    motion_axes,
    pace,
)

_SHARP: Final = 30.0  # Least angle between the normals of faces at an edge of the outline [degrees].
_DIVERGED: Final = 10.0  # Distance from rest beyond which nothing is drawn, over the body's size.

_FAST: Final = 2.5  # Longest duration of a motion that is shown in slow motion [s],
_FINE: Final = 0.025  # if its frames are no farther apart than this [s].
BODIES: Final = ("#6b7580", "#8db4e8")  # Colours of the bodies behind, and of the last one.
_RINGS: Final = ("#6b7580", "#1a5fb4")  # Colours of their markers.
BODY_LIGHT: Final = (0.72, 0.3)
HEADROOM: Final = 0.12  # Space for the text above a film's view, over half its height.
_LEAST_NEAR: Final = 0.03  # Least half height of the close-up, over the body's size.
_MOST_NEAR: Final = 1.6  # Largest factor by which the other models' markers widen the close-up.
MEASURED_MARKERS: Final = "measured markers"
LABORATORY_MARKERS: Final = "markers of the simulated laboratory"
TARGET_VERTICES: Final = "vertices of the simulated target"
FILM_VIEW: Final = (560, 480)  # Size of each view [px].
_PICTURE_VIEW: Final = (480, 408)
_RADII: Final = {FILM_VIEW: 0.013, _PICTURE_VIEW: 0.02}  # Radius of a dot, over the height of a view.
_RING: Final = 1.9  # Radius of a simulated marker's ring, over that of a dot.
_WIDER: Final = 0.35  # Increase of the radius for the ring of each further model.
_BEHIND: Final = 0.3  # Opacity of the bodies with which the last one is compared.
_BEFORE: Final = {
    "lines": 0.01,
    "others": -4.0,
    "rings": 2.5,
    "dots": 5.0,
}  # Shift to the viewer, over half a view's height.


def face_edges(mesh: Mesh) -> IntArray:
    """Return the unique lines (E, 2) around the faces of the boundary."""
    sides, corners = boundary_faces(mesh), mesh.element.face.corners
    rims = sides[:, :corners]
    if sides.shape[1] > corners:  # Edge midpoints follow the corners.
        rims = np.stack([rims, sides[:, corners : 2 * corners]], axis=2).reshape(len(sides), -1)
    edges = np.sort(np.stack([rims, np.roll(rims, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    return np.asarray(np.unique(edges, axis=0))


def sharp_edges(points: FloatArray, triangles: IntArray) -> IntArray:
    """Return edges (E, 2) at which triangles (S, 3) of points (P, 3) meet at a sharp angle, or a surface ends."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, which, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    together = np.zeros((len(edges), 3))
    np.add.at(together, which.ravel(), np.repeat(normals, 3, axis=0))
    # Two unit vectors at an angle a have a sum of length 2 cos(a / 2).
    smooth = (count == 2) & (np.linalg.norm(together, axis=1) >= 2.0 * np.cos(0.5 * np.radians(_SHARP)))
    return np.asarray(edges[~smooth])


def obstacle_layers(obstacles: ObstacleSurface, width: float = 1.5) -> list[Layer]:
    """Return layers of obstacles, with lines [px wide] along their sharp edges."""
    if not len(obstacles.local):
        return []
    points, triangles = obstacles.points, obstacles.triangles
    edges = sharp_edges(points[0] if obstacles.moves else points, triangles)
    return [
        Layer("surface", points, triangles, OBSTACLE, light=OBSTACLE_LIGHT),
        *([Layer("lines", points, edges, OUTLINE, size=width)] if len(edges) else []),
    ]


@dataclass(frozen=True, eq=False)
class ComparedMotion:
    """A measured motion and its simulations, at the same T times."""

    mesh: Mesh  # The body at rest.
    times: FloatArray  # (T,) since the release [s].
    measured: FloatArray  # (T, M, 3) markers [m], NaN where they were not seen.
    positions: Mapping[str, FloatArray]  # (T, N, 3) [m] of the vertices, by model; the last is drawn solid.
    markers: Mapping[str, FloatArray]  # (T, M, 3) [m] of the same models.
    bound: FloatArray  # (M, 3) [m] markers on the body at rest.
    gravity: FloatArray  # (3,) direction of gravity.
    from_below: bool = False  # Whether the second view is from below, as for hanging bodies, rather than a close-up.
    target: FloatArray | None = None  # (T, N, 3) [m] of the vertices, where every one is observed.
    obstacles: ObstacleSurface = field(default_factory=ObstacleSurface)  # Of the last model, at these times.
    observed: str = MEASURED_MARKERS  # What `measured` shows: of a real body, or of a simulation in its place.

    @property
    def is_fast(self) -> bool:
        """Whether the motion is shown in slow motion."""
        return bool(self.times[-1] <= _FAST and np.diff(self.times).max(initial=0.0) <= _FINE)

    @property
    def instants(self) -> list[int]:
        """The frames of pictures, by `instants` for the first model."""
        return instants(self.measured, self.bound, next(iter(self.markers.values())))

    def at(self, frames: Sequence[int] | IntArray) -> "ComparedMotion":
        """Return the motion at some of its frames."""
        chosen = np.asarray(frames, dtype=np.int64)
        positions, markers = (
            {m: q[chosen] for m, q in by_model.items()} for by_model in (self.positions, self.markers)
        )
        times, measured = self.times[chosen], self.measured[chosen]
        target = None if self.target is None else self.target[chosen]
        shown = replace(self, times=times, measured=measured, positions=positions, markers=markers, target=target)
        return replace(shown, obstacles=self.obstacles.at(chosen))

    def scene(self) -> RenderScene:
        """Return the scene of the body at some instants, with a close-up of the markers or a view from below."""
        return RenderScene(_views(self.at(self.instants), _PICTURE_VIEW), _PICTURE_VIEW)

    def film(self, seconds: float | None = None, slower: float | None = None) -> RenderScene:
        """Return the scene of a film of the first seconds.

        Args:
            seconds: Duration [s]; by default 10, or 1.5 of a fast motion.
            slower: Factor of slow motion; by default 1, or 4 of a fast motion.
        """
        usual, longest = (4.0, 1.5) if self.is_fast else (1.0, 10.0)
        frames, fps = pace(self.times, usual if slower is None else slower)
        shown = self.at(frames[self.times[frames] <= (longest if seconds is None else seconds) + 1e-9])
        *others, last = (MODELS[model][0] for model in shown.positions)
        first, second = _views(shown, FILM_VIEW, HEADROOM)
        first = replace(first, legend=[*((name, _RINGS[0]) for name in others), (last, _RINGS[1])])
        second = replace(second, legend=[(self.observed, MEASURED)])
        texts = [f"{time:.2f} s" for time in shown.times]
        return RenderScene([first, second], FILM_VIEW, background="white", fps=fps, texts=texts)


def instants(target: FloatArray, bound: FloatArray, simulated: FloatArray) -> list[int]:
    """Return three separate frames, or fewer of a short motion.

    These are the frames of the largest error, of the largest motion of the markers, and the last one; where two of them
    are close to each other, a frame in between is chosen.

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
    """Return points (..., P, 3), NaN in frames with a point that is not finite or farther than `far` from rest [m]."""
    with np.errstate(invalid="ignore", over="ignore"):
        kept = (np.abs(points - rest) < far).all(axis=(-2, -1), keepdims=True)
    return np.where(kept, points, np.nan)


def _views(motion: ComparedMotion, size: tuple[int, int], headroom: float = 0.0) -> list[View]:
    """A view of the whole body, with space for text above it over half its height, and a second view."""
    rest = motion.mesh.vertices
    far = _DIVERGED * float(np.ptp(rest, axis=0).max())
    positions = without_diverged(np.stack([*motion.positions.values()]), rest, far)  # (B, T, N, 3)
    simulated = without_diverged(np.stack([*motion.markers.values()]), motion.bound, far)  # (B, T, M, 3)
    seen = np.concatenate([rest[None], *positions])
    axes = motion_axes(motion.gravity, seen)
    everything = np.concatenate([points.reshape(-1, 3) for points in (seen, simulated, motion.measured)])
    everything = np.concatenate([everything, motion.obstacles.near(everything)])
    middle, half = frame_of(everything, axes)
    height = height_of(half, size)
    if motion.from_below:
        second = axes_from_below(axes, motion.gravity)
        near, half = frame_of(everything, second)
        near_height = height_of(half, size)
    else:
        second = axes
        near, near_height = _follow(motion, simulated, axes, size)
        near = np.where(np.isfinite(near), near, middle)
    layers = [*obstacle_layers(motion.obstacles), *_bodies(motion.mesh, positions, height)]
    layers.append(_stems(motion, positions[-1], simulated[-1]))
    room = headroom * height
    return [
        View([*layers, *_dots(motion.measured, simulated, half_height, _RADII[size])], turned, focus, half_height)
        for turned, focus, half_height in ((axes, middle + room * axes[1], height + room), (second, near, near_height))
    ]


def _bodies(mesh: Mesh, positions: FloatArray, half: float) -> list[Layer]:
    """Layers of bodies (B, T, N, 3): the last one solid with the lines around its faces, the others translucent.

    The surfaces of the others are shifted far behind, so that they show beside the solid body only.
    """
    triangles, edges = boundary_triangles(mesh), face_edges(mesh)
    sharp = sharp_edges(mesh.vertices, triangles)
    sharp = sharp if len(sharp) else edges
    layers, before = [], {name: half * shift for name, shift in _BEFORE.items()}
    *others, solid = positions
    for q in others:
        others_shift = before["others"]
        layers.append(Layer("surface", q, triangles, BODIES[0], opacity=_BEHIND, light=BODY_LIGHT, shift=others_shift))
        layers.append(Layer("lines", q, sharp, BODIES[0], size=2.0, shift=before["lines"]))
    layers.append(Layer("surface", solid, triangles, BODIES[1], light=BODY_LIGHT))
    layers.append(Layer("lines", solid, edges, INK, size=1.0, opacity=0.3, shift=before["lines"]))
    layers.append(Layer("lines", solid, sharp, INK, size=2.0, shift=before["lines"]))
    return layers


def _stems(motion: ComparedMotion, positions: FloatArray, markers: FloatArray) -> Layer:
    """Lines to the markers (T, M, 3) of a body from the points of it that are closest to them at rest."""
    closest = closest_points(motion.mesh, motion.bound)
    corners = motion.mesh.vertices[closest.triangles]  # (M, 3, 3)
    unit = np.full((len(markers[0]), 1, 3), corners.max() or 1.0)
    matrix = np.concatenate([corners.transpose(0, 2, 1), unit], axis=1)
    right = np.concatenate([closest.points, unit[:, :, 0]], axis=1)
    weights = (np.linalg.pinv(matrix) @ right[..., None])[..., 0]  # (M, 3), their sum one
    feet = np.einsum("tmki,mk->tmi", positions[:, closest.triangles], weights)
    return stems(feet, markers, OUTLINE, 2.0)


def stems(feet: FloatArray, markers: FloatArray, colour: str, width: float) -> Layer:
    """Return lines [px wide] from feet (..., M, 3) to markers (..., M, 3) [m]."""
    ends = np.stack([feet, markers], axis=-2).reshape(*markers.shape[:-2], -1, 3)
    return Layer("lines", ends, np.arange(ends.shape[-2]).reshape(-1, 2), colour, size=width)


def _dots(measured: FloatArray, simulated: FloatArray, half: float, radius: float) -> list[Layer]:
    """Dots of the measured markers (T, M, 3) and rings of the simulated ones (B, T, M, 3), in the foreground."""
    size, layers = 2.0 * half * radius, []
    for behind, places in zip(reversed(range(len(simulated))), simulated, strict=True):
        colour, wide = _RINGS[0 if behind else 1], (_RING + _WIDER * behind) * size
        layers.append(Layer("rings", places, None, colour, size=wide, shift=_BEFORE["rings"] * half))
    return [*layers, Layer("balls", measured, None, MEASURED, size=size, shift=_BEFORE["dots"] * half)]


def _follow(
    motion: ComparedMotion, simulated: FloatArray, axes: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, float]:
    """Middle (T, 3) of the markers in each frame, and half the height of a view that contains them [m].

    Where markers were not seen, the middle is that of the last model's markers (B, T, M, 3). The view contains the
    markers of the other models unless they are far away.
    """
    measured, least = motion.measured, _LEAST_NEAR * float(np.ptp(motion.mesh.vertices, axis=0).max())
    places = np.where(np.isfinite(measured).all(axis=(1, 2), keepdims=True), measured, simulated[-1])
    middle = places.mean(axis=1)

    def half(points: FloatArray) -> float:
        reach = np.nanmax(np.abs((points - middle[:, None]) @ axes[:2].T), axis=(0, 1))
        return max(height_of(reach, size), least)

    everything = half(np.concatenate([measured, *simulated], axis=1))
    return middle, 1.25 * min(everything, _MOST_NEAR * half(measured))
