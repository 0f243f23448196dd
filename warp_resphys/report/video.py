"""A moving body with measured and simulated markers: pictures of a few instants, and a film."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..io.files import atomic_path
from ..io.progress import Progress
from ..mesh.mesh import Mesh, boundary_triangles
from ..mesh.surface import closest_points
from .render import INK, MEASURED, OUTLINE, Layer, Pixels, View, draw, face_edges, film, sharp_edges

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LARGEST_RATE: Final = 25.0  # Frames a second, of the film.
BODIES: Final = ("#6b7580", "#8db4e8")  # Of the bodies behind, and of the last one.
RINGS: Final = ("#6b7580", "#1a5fb4")  # Of their markers.
_MARGIN: Final = 0.06  # Around what is seen, over its longer side.
_HEADROOM: Final = 0.12  # For the text above a film's first view, over half its height.
_MOST_NEAR: Final = 1.6  # How far the other models' markers may widen the view from nearby.
_TILT: Final = (0.30, 0.30)  # From the right and from above.
_FILM_VIEW: Final = (560, 480)  # [px] of each of two.
_PICTURE_VIEW: Final = (480, 408)
_RADII: Final = {_FILM_VIEW: 0.013, _PICTURE_VIEW: 0.02}  # Of a dot, over the height of a view; pictures are small.
_DIVERGED: Final = 10.0  # Distance from rest, over the body's size, beyond which nothing is drawn.
_RING: Final = 1.9  # Radius of a simulated marker's ring, over that of a dot.
_WIDER: Final = 0.35  # That of each other model's ring.
_BEHIND: Final = 0.3  # Opacity of the bodies that the last one is compared with.
_NUDGE: Final = 0.01  # Lines are drawn this far before a surface, over half the height of a view.
_BACK: Final = 4.0  # Surfaces of the other bodies are drawn this far behind it, so that they show beside it only.
_BEFORE: Final = 5.0  # Dots are drawn this far before all bodies.


@dataclass(frozen=True, eq=False)
class Motion:
    """A measured motion and simulations of it, at the same T times.

    Attributes:
        mesh: The body at rest.
        times: (T,) since the release [s].
        measured: (T, M, 3) markers [m], NaN where they were not seen.
        positions: (T, N, 3) [m] of the vertices, by the model's name; the last is drawn solid.
        markers: (T, M, 3) [m] of the same models.
        bound: (M, 3) [m] markers on the body at rest.
        gravity: (3,) which way is down.
        from_below: Whether the second view is from below, where a hanging body moves, and not from nearby.
    """

    mesh: Mesh
    times: FloatArray
    measured: FloatArray
    positions: Mapping[str, FloatArray]
    markers: Mapping[str, FloatArray]
    bound: FloatArray
    gravity: FloatArray
    from_below: bool = False

    def at(self, frames: Sequence[int] | IntArray) -> "Motion":
        """Some of the frames."""
        chosen = np.asarray(frames, dtype=np.int64)
        return Motion(
            self.mesh,
            self.times[chosen],
            self.measured[chosen],
            {name: q[chosen] for name, q in self.positions.items()},
            {name: m[chosen] for name, m in self.markers.items()},
            self.bound,
            self.gravity,
            self.from_below,
        )


def draw_instants(motion: Motion) -> Pixels:
    """Draw a motion's frames: the whole body, and beside it the markers from nearby.

    Args:
        motion: Few frames.

    Returns:
        (T, 2, H, W, 4) red, green, blue and opacity, 0 to 255, of both views.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
    """
    frames = draw(_views(motion, _PICTURE_VIEW), _PICTURE_VIEW)
    return np.stack(np.split(frames, 2, axis=2), axis=1)


def write_video(path: Path, motion: Motion, names: Mapping[str, str], slower: float, longest: float) -> None:
    """Write a film (MP4, H.264) of the first seconds of a motion, slowed down, and show how far it is.

    Args:
        path: The file to write.
        motion: All frames.
        names: What the legend says, by model; last, under no name, what it says of the dots.
        slower: Than the motion was, by this factor.
        longest: What is shown of the motion [s].

    Raises:
        DrawingError: There is no pyvista, no OpenGL driver that works off screen, or no encoder.
        DataFileError: The file cannot be written.
    """
    step = float(np.median(np.diff(motion.times)))
    every = max(1, round(1.0 / (slower * step * LARGEST_RATE)))
    shown = motion.at(np.flatnonzero(motion.times <= longest + 1e-9)[::every])
    colours = [RINGS[0]] * (len(shown.positions) - 1) + [RINGS[1], MEASURED]
    legend = list(zip([*(names[model] for model in shown.positions), names.get("", "measured")], colours, strict=True))
    with Progress("video", len(shown.times), "frames") as progress:
        content = film(
            _views(shown, _FILM_VIEW, _HEADROOM),
            _FILM_VIEW,
            progress,
            fps=1.0 / (slower * step * every),
            texts=[f"{time:.2f} s" for time in shown.times],
            legend=legend,
        )
    with atomic_path(path) as partial:
        partial.write_bytes(content)


def _views(motion: Motion, size: tuple[int, int], headroom: float = 0.0) -> list[View]:
    """The whole body, with room for text above it over half its height, and its markers from nearby or from below."""
    models = list(motion.positions)
    body = float(np.ptp(motion.mesh.vertices, axis=0).max())
    positions = np.stack([_whole(q, motion.mesh.vertices, _DIVERGED * body) for q in motion.positions.values()])
    simulated = np.stack([_whole(motion.markers[model], motion.bound, _DIVERGED * body) for model in models])
    seen = np.concatenate([motion.mesh.vertices[None], *positions])
    axes = view_axes(motion.gravity, seen)
    everything = np.concatenate([seen.reshape(-1, 3), simulated.reshape(-1, 3), motion.measured.reshape(-1, 3)])
    middle, half = _frame(everything, axes, size)
    if motion.from_below:
        second = axes_from_below(axes, motion.gravity)
        near, near_half = _frame(everything, second, size)
    else:
        second = axes
        near, near_half = _follow(motion.measured, simulated, axes, size)
        near = np.where(np.isfinite(near), near, middle)
    room = headroom * half
    feet = _feet(motion.mesh, motion.bound, positions[-1])
    layers = _bodies(motion.mesh, positions, half) + [_stems(feet, simulated[-1])]
    return [
        View([*layers, *_dots(motion.measured, simulated, height, _RADII[size])], turned, focus, height)
        for turned, focus, height in ((axes, middle + room * axes[1], half + room), (second, near, near_half))
    ]


def _bodies(mesh: Mesh, positions: FloatArray, half: float) -> list[Layer]:
    """The last of some bodies (B, T, N, 3) solid with the lines around its faces, the others seen through behind it."""
    triangles, edges = boundary_triangles(mesh), face_edges(mesh)
    sharp = sharp_edges(mesh.vertices, triangles)
    sharp = sharp if len(sharp) else edges
    layers, light, nudge = [], (0.72, 0.3), _NUDGE * half
    *others, solid = positions
    for q in others:
        layers.append(Layer("surface", q, triangles, BODIES[0], opacity=_BEHIND, light=light, shift=-_BACK * half))
        layers.append(Layer("lines", q, sharp, BODIES[0], size=2.0, shift=nudge))
    layers.append(Layer("surface", solid, triangles, BODIES[1], light=light))
    layers.append(Layer("lines", solid, edges, INK, size=1.0, opacity=0.3, shift=nudge))
    layers.append(Layer("lines", solid, sharp, INK, size=2.0, shift=nudge))
    return layers


def _stems(feet: FloatArray, simulated: FloatArray) -> Layer:
    """Lines from (T, M, 3) feet to the last body's markers."""
    frames, count = feet.shape[:2]
    ends = np.stack([feet, simulated], axis=2).reshape(frames, 2 * count, 3)
    return Layer("lines", ends, np.arange(2 * count).reshape(count, 2), OUTLINE, size=2.0)


def _dots(measured: FloatArray, simulated: FloatArray, half: float, radius: float) -> list[Layer]:
    """Dots of the measured markers (T, M, 3) and rings of the simulated ones (B, T, M, 3), in front of all else."""
    size, last = 2.0 * half * radius, len(simulated) - 1
    rings = [
        Layer(
            "rings",
            places,
            None,
            RINGS[1 if body == last else 0],
            size=(_RING + _WIDER * (last - body)) * size,
            shift=0.5 * _BEFORE * half,
        )
        for body, places in enumerate(simulated)
    ]
    return [*rings, Layer("balls", measured, None, MEASURED, size=size, shift=_BEFORE * half)]


def _whole(points: FloatArray, rest: FloatArray, largest: float) -> FloatArray:
    """(T, P, 3) points, NaN in the frames in which one of them is not finite or farther than this from rest."""
    with np.errstate(invalid="ignore", over="ignore"):
        kept = (np.abs(points - rest) < largest).all(axis=(1, 2), keepdims=True)
    return np.where(kept, points, np.nan)


def view_axes(gravity: FloatArray, positions: FloatArray) -> FloatArray:
    """(3, 3) to the right, up, towards the viewer: what extends or moves most across gravity goes to the right.

    Args:
        gravity: (3,) which way is down; along -z where it is zero.
        positions: (T, N, 3) [m], the first frame at rest; NaN is left out.
    """
    length = float(np.linalg.norm(gravity))
    up = -gravity / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    points = positions[np.isfinite(positions).all(axis=2)]
    flat = points - np.outer(points @ up, up)
    _, _, directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    right = directions[0] - (directions[0] @ up) * up
    right /= np.linalg.norm(right)
    moved = np.nanmax(np.linalg.norm(positions - positions[0], axis=2), axis=0)  # (N,)
    towards_end = (positions[0] * moved[:, None]).sum(axis=0) - positions[0].mean(axis=0) * moved.sum()
    if towards_end @ right < 0.0:
        right = -right
    towards = np.cross(right, up) + _TILT[0] * right + _TILT[1] * up
    towards /= np.linalg.norm(towards)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def axes_from_below(axes: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return (3, 3) as `view_axes`, of a view from below with the same direction to the right.

    Args:
        axes: (3, 3) of a view that has gravity along its second row, or behind it.
        gravity: (3,) which way is down; along -z where it is zero.
    """
    length = float(np.linalg.norm(gravity))
    towards = gravity / length if length > 0.0 else np.array([0.0, 0.0, -1.0])
    return np.stack([axes[0], np.cross(towards, axes[0]), towards])


def _frame(points: FloatArray, axes: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, float]:
    """The middle (3,) of what is seen of points (P, 3), and half the height of a view that holds it all [m]."""
    turned = points[np.isfinite(points).all(axis=1)] @ axes.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = (high - low)[:2] + 2.0 * _MARGIN * (high - low)[:2].max()
    return 0.5 * (low + high) @ axes, 0.5 * max(extent[1], extent[0] * size[1] / size[0])


def _follow(
    measured: FloatArray, simulated: FloatArray, axes: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, float]:
    """(T, 3) middle of the markers in each frame, and half the height of a view that holds them [m].

    Where not all markers were seen, those of the last model say where the middle is. The other models' markers are in
    the view unless they are far off.
    """
    places = np.where(np.isfinite(measured).all(axis=(1, 2), keepdims=True), measured, simulated[-1])
    middle = places.mean(axis=1)

    def half(points: FloatArray) -> float:
        reach = np.nanmax(np.abs((points - middle[:, None]) @ axes[:2].T), axis=(0, 1))
        return float(max(reach[1], reach[0] * size[1] / size[0], 1e-4))

    least = half(measured)
    return middle, 1.25 * min(half(np.concatenate([measured, *simulated], axis=1)), _MOST_NEAR * least)


def _feet(mesh: Mesh, bound: FloatArray, positions: FloatArray) -> FloatArray:
    """(T, M, 3) [m] the points of a moving body that are closest to its markers at rest."""
    found = closest_points(mesh, bound)
    corners = mesh.vertices[found.triangles]  # (M, 3, 3)
    matrix = np.concatenate([corners.transpose(0, 2, 1), np.full((len(bound), 1, 3), corners.max() or 1.0)], axis=1)
    right = np.concatenate([found.points, np.full((len(bound), 1), corners.max() or 1.0)], axis=1)
    weights = (np.linalg.pinv(matrix) @ right[..., None])[..., 0]  # (M, 3), their sum one
    feet: FloatArray = np.einsum("tmki,mk->tmi", positions[:, found.triangles], weights)
    return feet
