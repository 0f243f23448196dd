"""Bodies in pictures: coloured by their distance from a target, at instants with markers, and in a film."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from ..io.files import atomic_path
from ..io.progress import Progress
from ..mesh.mesh import Mesh, boundary_faces, boundary_triangles
from ..mesh.surface import closest_points
from .data import MODELS, mean_distance
from .render import INK, MEASURED, OUTLINE, FloatArray, IntArray, Layer, Scene, View, film, view_axes

LONGER_SIDE: Final = 1100  # Of a picture of a body coloured by its distance [px].
MARGIN: Final = 0.02  # Around the bodies there, as the lengths below relative to the longer side of what is seen.
_WIDTHS: Final = (0.0034, 0.0018)  # Of the outline, and of the lines around faces.
NUDGE: Final = 0.005  # The outline is drawn this far behind the body where they coincide.
TOWARDS_VIEWER: Final = (0.40, -1.0, 0.40)  # A body along x is seen from the side, the end of high x nearer.
SHADE: Final = 0.25  # Share of the colour that depends on the light; the rest stays readable as a value.
_SHARP: Final = 30.0  # Between the normals of faces that share an edge of the outline [degrees].
_HANGING: Final = 0.7  # Cosine between gravity and a body that hangs.
_DIVERGED: Final = 10.0  # Distance from the target, or from rest, over the body's, beyond which nothing is drawn.

_FAST: Final = 2.5  # [s] that a motion lasts which is shown slowed down, and from its start only,
_FINE: Final = 0.025  # where its frames are no farther apart [s].
LARGEST_RATE: Final = 25.0  # Frames a second, of the film.
BODIES: Final = ("#6b7580", "#8db4e8")  # Of the bodies behind, and of the last one.
RINGS: Final = ("#6b7580", "#1a5fb4")  # Of their markers.
_FRAME: Final = 0.06  # Around what is seen of a motion, over its longer side.
_HEADROOM: Final = 0.12  # For the text above a film's first view, over half its height.
_LEAST_NEAR: Final = 0.03  # Of the body's size, half the height of the view from nearby, as of one marker alone.
_MOST_NEAR: Final = 1.6  # How far the other models' markers may widen the view from nearby.
_TILT: Final = (0.30, 0.30)  # From the right and from above.
_FILM_VIEW: Final = (560, 480)  # [px] of each of two.
_PICTURE_VIEW: Final = (480, 408)
_RADII: Final = {_FILM_VIEW: 0.013, _PICTURE_VIEW: 0.02}  # Of a dot, over the height of a view; pictures are small.
_RING: Final = 1.9  # Radius of a simulated marker's ring, over that of a dot.
_WIDER: Final = 0.35  # That of each other model's ring.
_BEHIND: Final = 0.3  # Opacity of the bodies that the last one is compared with.
_BEFORE: Final = {"lines": 0.01, "others": -4.0, "rings": 2.5, "dots": 5.0}  # The last body, over half a view's height.


def largest_distances(mesh: Mesh, positions: Mapping[str, FloatArray], target: FloatArray) -> dict[str, float | None]:
    """Return how far each body (N, 3) is from the target's vertices (N, 3) at most [m]; None where it has diverged."""
    far = _DIVERGED * np.ptp(mesh.vertices, axis=0).max()
    return {
        name: float(np.linalg.norm(q - target, axis=1).max()) if np.all(np.abs(q - target) < far) else None
        for name, q in positions.items()
    }


def distance_scene(mesh: Mesh, positions: Mapping[str, FloatArray], target: FloatArray) -> Scene | None:
    """Return deformed bodies, coloured by the distance from the target's vertices: from zero to the largest of each.

    Args:
        mesh: The undeformed body, drawn as an outline.
        positions: (N, 3) deformed positions [m] by name; what has diverged is left out.
        target: (N, 3) the target's [m].

    Returns:
        A view of each body; None where all of them have diverged.
    """
    found = largest_distances(mesh, positions, target)
    largest = {name: max(most, 1e-15) for name, most in found.items() if most is not None}
    if not largest:
        return None
    axes = view_axes(TOWARDS_VIEWER)
    seen = np.concatenate([mesh.vertices, *(positions[name] for name in largest)]) @ axes.T  # (P, 3) [m]
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    length = (upper - lower)[:2].max()  # [m]
    extent = (upper - lower)[:2] + 2.0 * MARGIN * length
    triangles, edges = boundary_triangles(mesh), face_edges(mesh)
    outline, line = (width * LONGER_SIDE for width in _WIDTHS)
    sharp = sharp_edges(mesh.vertices, triangles)
    rest = Layer("lines", mesh.vertices, sharp, OUTLINE, size=outline, shift=-NUDGE * length)
    views = []
    for name, most in largest.items():
        q, paint = positions[name], np.linalg.norm(positions[name] - target, axis=1) / most
        surface = Layer("surface", q, triangles, paint=paint, light=(1.0 - SHADE, SHADE))
        rims = Layer("lines", q, edges, "black", size=line, opacity=0.35, shift=0.2 * NUDGE * length)
        views.append(View([surface, rims, rest], axes, 0.5 * (lower + upper) @ axes, 0.5 * extent[1]))
    return Scene(views, np.ceil(extent * LONGER_SIDE / extent.max()).astype(int).tolist(), samples=8)


def face_edges(mesh: Mesh) -> IntArray:
    """(E, 2) vertices of the lines around the faces of the boundary, each line once."""
    sides, corners = boundary_faces(mesh), mesh.element.face.corners
    rims = sides[:, :corners]
    if sides.shape[1] > corners:  # Middles of the edges come after the corners.
        rims = np.stack([rims, sides[:, corners : 2 * corners]], axis=2).reshape(len(sides), -1)
    edges = np.sort(np.stack([rims, np.roll(rims, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    return np.asarray(np.unique(edges, axis=0))


def sharp_edges(points: FloatArray, triangles: IntArray) -> IntArray:
    """(E, 2) edges at which triangles (S, 3) of points (P, 3) meet at a sharp angle, or at which a surface ends."""
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


@dataclass(frozen=True, eq=False)
class Motion:
    """A measured motion and simulations of it, at the same T times."""

    mesh: Mesh  # The body at rest.
    times: FloatArray  # (T,) since the release [s].
    measured: FloatArray  # (T, M, 3) markers [m], NaN where they were not seen.
    positions: Mapping[str, FloatArray]  # (T, N, 3) [m] of the vertices, by model; the last is drawn solid.
    markers: Mapping[str, FloatArray]  # (T, M, 3) [m] of the same models.
    bound: FloatArray  # (M, 3) [m] markers on the body at rest.
    gravity: FloatArray  # (3,) which way is down.
    from_below: bool = False  # Whether the second view is from below, where a hanging body moves, not from nearby.
    target: FloatArray | None = None  # (T, N, 3) [m] of the vertices, where every one is observed.

    @property
    def is_fast(self) -> bool:
        """Whether it is shown slowed down."""
        return bool(self.times[-1] <= _FAST and np.diff(self.times).max(initial=0.0) <= _FINE)

    @property
    def instants(self) -> list[int]:
        """The frames that are shown, as `instants` chooses them for the first model."""
        return instants(self.measured, self.bound, next(iter(self.markers.values())))

    def at(self, frames: Sequence[int] | IntArray) -> "Motion":
        """Some of the frames."""
        chosen = np.asarray(frames, dtype=np.int64)
        positions, markers = ({m: q[chosen] for m, q in each.items()} for each in (self.positions, self.markers))
        times, measured = self.times[chosen], self.measured[chosen]
        target = None if self.target is None else self.target[chosen]
        return replace(self, times=times, measured=measured, positions=positions, markers=markers, target=target)

    def scene(self) -> Scene:
        """The whole body at some instants, and beside it the markers from nearby, or the body from below."""
        return Scene(_views(self.at(self.instants), _PICTURE_VIEW), _PICTURE_VIEW)


def instants(target: FloatArray, bound: FloatArray, simulated: FloatArray) -> list[int]:
    """Return three frames that lie apart, or fewer of a short motion.

    They are where the simulation is farthest off, where the markers have moved most, and the last one; where two of
    these are close to each other, one from between is taken.

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


def write_film(path: Path, motion: Motion, seconds: float | None = None, slower: float | None = None) -> None:
    """Write a film (MP4, H.264) of the first seconds of a motion, slowed down if it is fast, and show how far it is.

    Args:
        path: Of the file.
        motion: What is shown.
        seconds: Of it; 10, or 1.5 of a fast one, if left out.
        slower: How many times slower it is shown; 4 for a fast one, if left out.

    Raises:
        DrawingError: There is no pyvista, no OpenGL driver that works off screen, or no encoder.
        DataFileError: The file cannot be written.
    """
    usual, usually = (4.0, 1.5) if motion.is_fast else (1.0, 10.0)  # [s] that are shown.
    slower, longest = usual if slower is None else slower, usually if seconds is None else seconds
    step = float(np.median(np.diff(motion.times)))
    every = max(1, round(1.0 / (slower * step * LARGEST_RATE)))
    shown = motion.at(np.flatnonzero(motion.times <= longest + 1e-9)[::every])
    *others, last = (MODELS[model][0] for model in shown.positions)
    first, second = _views(shown, _FILM_VIEW, _HEADROOM)
    legend = [*((name, RINGS[0]) for name in others), (last, RINGS[1]), ("measured", MEASURED)]
    write_scene(
        path,
        Scene(
            [replace(first, legend=legend), second],
            _FILM_VIEW,
            background="white",
            fps=1.0 / (slower * step * every),
            texts=[f"{time:.2f} s" for time in shown.times],
        ),
    )


def write_scene(path: Path, scene: Scene) -> None:
    """Write a film (MP4, H.264) of a scene with a text for every frame, and show how far it is.

    Raises:
        DrawingError, DataFileError: See `write_film`.
    """
    with Progress("video", len(scene.texts), "frames") as progress:
        content = film(scene, progress)
    with atomic_path(path) as partial:
        partial.write_bytes(content)


def _views(motion: Motion, size: tuple[int, int], headroom: float = 0.0) -> list[View]:
    """The whole body, with room for text above it over half its height, and its markers from nearby or from below."""
    body = float(np.ptp(motion.mesh.vertices, axis=0).max())
    positions, simulated = (
        np.stack([whole(each, rest, _DIVERGED * body) for each in shown.values()])  # (B, T, N | M, 3)
        for shown, rest in ((motion.positions, motion.mesh.vertices), (motion.markers, motion.bound))
    )
    seen = np.concatenate([motion.mesh.vertices[None], *positions])
    axes = motion_axes(motion.gravity, seen)
    everything = np.concatenate([each.reshape(-1, 3) for each in (seen, simulated, motion.measured)])
    middle, half = _frame(everything, axes, size)
    if motion.from_below:
        second = axes_from_below(axes, motion.gravity)
        near, near_half = _frame(everything, second, size)
    else:
        second = axes
        near, near_half = _follow(motion.measured, simulated, axes, size, _LEAST_NEAR * body)
        near = np.where(np.isfinite(near), near, middle)
    room = headroom * half
    layers = [*_bodies(motion.mesh, positions, half), _stems(motion, positions[-1], simulated[-1])]
    return [
        View([*layers, *_dots(motion.measured, simulated, height, _RADII[size])], turned, focus, height)
        for turned, focus, height in ((axes, middle + room * axes[1], half + room), (second, near, near_half))
    ]


def _bodies(mesh: Mesh, positions: FloatArray, half: float) -> list[Layer]:
    """The last of some bodies (B, T, N, 3) solid with the lines around its faces, the others seen through behind it.

    The others' surfaces are so far behind that they show beside it only.
    """
    triangles, edges = boundary_triangles(mesh), face_edges(mesh)
    sharp = sharp_edges(mesh.vertices, triangles)
    sharp = sharp if len(sharp) else edges
    layers, light, before = [], (0.72, 0.3), {name: half * each for name, each in _BEFORE.items()}
    *others, solid = positions
    for q in others:
        layers.append(Layer("surface", q, triangles, BODIES[0], opacity=_BEHIND, light=light, shift=before["others"]))
        layers.append(Layer("lines", q, sharp, BODIES[0], size=2.0, shift=before["lines"]))
    layers.append(Layer("surface", solid, triangles, BODIES[1], light=light))
    layers.append(Layer("lines", solid, edges, INK, size=1.0, opacity=0.3, shift=before["lines"]))
    layers.append(Layer("lines", solid, sharp, INK, size=2.0, shift=before["lines"]))
    return layers


def _stems(motion: Motion, positions: FloatArray, markers: FloatArray) -> Layer:
    """Lines to (T, M, 3) a body's markers from the points of it that are closest to them at rest."""
    found = closest_points(motion.mesh, motion.bound)
    corners = motion.mesh.vertices[found.triangles]  # (M, 3, 3)
    unit = np.full((len(markers[0]), 1, 3), corners.max() or 1.0)
    matrix = np.concatenate([corners.transpose(0, 2, 1), unit], axis=1)
    right = np.concatenate([found.points, unit[:, :, 0]], axis=1)
    weights = (np.linalg.pinv(matrix) @ right[..., None])[..., 0]  # (M, 3), their sum one
    feet = np.einsum("tmki,mk->tmi", positions[:, found.triangles], weights)
    ends = np.stack([feet, markers], axis=2).reshape(len(markers), -1, 3)
    return Layer("lines", ends, np.arange(ends.shape[1]).reshape(-1, 2), OUTLINE, size=2.0)


def _dots(measured: FloatArray, simulated: FloatArray, half: float, radius: float) -> list[Layer]:
    """Dots of the measured markers (T, M, 3) and rings of the simulated ones (B, T, M, 3), in front of all else."""
    size, layers = 2.0 * half * radius, []
    for behind, places in zip(reversed(range(len(simulated))), simulated, strict=True):
        colour, wide = RINGS[0 if behind else 1], (_RING + _WIDER * behind) * size
        layers.append(Layer("rings", places, None, colour, size=wide, shift=_BEFORE["rings"] * half))
    return [*layers, Layer("balls", measured, None, MEASURED, size=size, shift=_BEFORE["dots"] * half)]


def whole(points: FloatArray, rest: FloatArray, largest: float) -> FloatArray:
    """Return (T, P, 3) points, NaN in the frames in which one is not finite or farther than this from rest [m]."""
    with np.errstate(invalid="ignore", over="ignore"):
        kept = (np.abs(points - rest) < largest).all(axis=(1, 2), keepdims=True)
    return np.where(kept, points, np.nan)


def upwards(gravity: FloatArray) -> FloatArray:
    """Return (3,) against gravity; along z where there is none."""
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def hangs(mesh: Mesh, fixed: IntArray, gravity: FloatArray) -> tuple[bool, FloatArray]:
    """Whether a body hangs, so that its motion is seen from below, and (N,) how far vertices are from the clamp [m]."""
    start = mesh.vertices[fixed].mean(axis=0) if len(fixed) else mesh.vertices[0]
    away = mesh.vertices - start
    axis = away.mean(axis=0)
    size = float(np.linalg.norm(axis) * np.linalg.norm(gravity))
    return bool(size > 0.0 and axis @ gravity > _HANGING * size), np.linalg.norm(away, axis=1)


def motion_axes(gravity: FloatArray, positions: FloatArray) -> FloatArray:
    """(3, 3) as `view_axes`: what extends or moves most across gravity goes to the right.

    Args:
        gravity: (3,) which way is down; along -z where it is zero.
        positions: (T, N, 3) [m], the first frame at rest; NaN is left out.
    """
    up = upwards(gravity)
    points = positions[np.isfinite(positions).all(axis=2)]
    flat = points - np.outer(points @ up, up)
    _, _, directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    right = directions[0] - (directions[0] @ up) * up
    right /= np.linalg.norm(right)
    moved = np.nanmax(np.linalg.norm(positions - positions[0], axis=2), axis=0)  # (N,)
    towards_end = moved @ (positions[0] - positions[0].mean(axis=0))
    right = -right if towards_end @ right < 0.0 else right
    return view_axes(np.cross(right, up) + _TILT[0] * right + _TILT[1] * up, up)


def axes_from_below(axes: FloatArray, gravity: FloatArray) -> FloatArray:
    """Return (3, 3) as `view_axes`, of a view from below with the same direction to the right.

    Args:
        axes: (3, 3) of a view that has gravity along its second row, or behind it.
        gravity: (3,) which way is down; along -z where it is zero.
    """
    towards = -upwards(gravity)
    return np.stack([axes[0], np.cross(towards, axes[0]), towards])


def frame_of(points: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middle (3,) of what is seen of points (P, 3), and half the width and height that hold it all [m]."""
    turned = points[np.isfinite(points).all(axis=1)] @ axes.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = (high - low)[:2] + 2.0 * _FRAME * (high - low)[:2].max()
    return 0.5 * (low + high) @ axes, 0.5 * extent


def _frame(points: FloatArray, axes: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, float]:
    """The middle (3,) of what is seen of points (P, 3), and half the height of a view that holds it all [m]."""
    middle, half = frame_of(points, axes)
    return middle, max(half[1], half[0] * size[1] / size[0])


def _follow(
    measured: FloatArray, simulated: FloatArray, axes: FloatArray, size: tuple[int, int], least: float
) -> tuple[FloatArray, float]:
    """(T, 3) middle of the markers in each frame, and half the height of a view that holds them, or the least one [m].

    Where not all markers were seen, those of the last model say where the middle is. The other models' markers are in
    the view unless they are far off.
    """
    places = np.where(np.isfinite(measured).all(axis=(1, 2), keepdims=True), measured, simulated[-1])
    middle = places.mean(axis=1)

    def half(points: FloatArray) -> float:
        reach = np.nanmax(np.abs((points - middle[:, None]) @ axes[:2].T), axis=(0, 1))
        return float(max(reach[1], reach[0] * size[1] / size[0], least))

    everything = half(np.concatenate([measured, *simulated], axis=1))
    return middle, 1.25 * min(everything, _MOST_NEAR * half(measured))
