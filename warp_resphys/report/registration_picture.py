"""A picture of registered markers on a body, by which a user sees whether the registration is right."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from ..data.registration import Registration
from ..io.files import atomic_path
from ..mesh.mesh import Mesh, boundary_triangles
from . import render
from .render import BODY, CLAMPED, INK, MEASURED, Layer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NOMINAL: Final = "#0072b2"  # Blue of Okabe and Ito (2008).
_GREY: Final = "#5b6570"
_VIEWS: Final = (("In perspective", (0.62, -1.0, 0.52), True), ("From the side", (0.0, -1.0, 0.0), False))
_DISTANCE: Final = 3.2  # Of the eye from the middle, in diagonals of what is seen.
_DPI: Final = 160
_FINER: Final = 2  # Drawn so many times finer and averaged, as smooth rims and translucency do not go together.
_LONGER_SIDE: Final = 6.6  # Of a view [inch].
_LETTER: Final = 0.088  # Widest that the letters of a name are on average [inch].
_HEAD, _STRIP, _LEGEND, _PAD = 0.42, 0.9, 0.42, 0.12  # [inch] above and below a view, and for the legend and rims.
_LABEL_HEIGHT: Final = 0.36  # [inch]
_RADIUS: Final = 0.016  # Of a marker, over the longest side of the body.
_RING: Final = 1.55  # Radius of a nominal position's ring, in radii of a marker.
_FOOT: Final = 0.42  # That of the small ball at the foot of a stem.
_NUDGE: Final = 0.1  # Lines are drawn this far before the surface, over the radius of a marker.
_OPACITY: Final = {"body": 0.42, "clamped": 0.75, "edges": 0.22, "outline": 0.75}
_LIGHT: Final = 0.55  # Its intensity.


@dataclass(frozen=True)
class _View:
    """A camera and the part of its picture that is kept.

    Attributes:
        title: Of the view.
        axes: (3, 3) rows: to the right, up, towards the viewer.
        focus: (3,) [m] what the middle of the whole picture shows.
        distance: Of the eye from it [m]; infinite without perspective.
        low: (2,) lowest coordinates that are kept, to the right and up: [m], or tangents with perspective.
        high: (2,) the highest.
    """

    title: str
    axes: FloatArray
    focus: FloatArray
    distance: float
    low: FloatArray
    high: FloatArray

    @property
    def extent(self) -> FloatArray:
        """(2,) of what is kept."""
        return self.high - self.low

    def project(self, points: FloatArray) -> FloatArray:
        """(..., 2) coordinates of points (..., 3) [m] in the picture, to the right and up."""
        return _project(points, self.axes, self.focus, self.distance)

    def shown(self, length: float, point: FloatArray) -> float:
        """How long a length [m] across the view at a point (3,) [m] is in the picture."""
        return (
            length if np.isinf(self.distance) else length / (self.distance - float((point - self.focus) @ self.axes[2]))
        )


def draw_registration(
    path: Path,
    mesh: Mesh,
    registration: Registration,
    nominal: FloatArray | None = None,
    feet: FloatArray | None = None,
    fixed: Sequence[int] | IntArray = (),
    title: str = "",
) -> None:
    """Draws the body, the measured markers and what they are bound to, from two sides, with names and residuals.

    Args:
        path: The PNG file to write.
        mesh: The body at rest.
        registration: The measured markers in its frame; those that were not seen are not drawn.
        nominal: (M, 3) [m] where the markers should be.
        feet: (M, 3) [m] where their stems stand; not drawn if left out.
        fixed: Vertices of the clamped region.
        title: What is drawn.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
        DataFileError: The file cannot be written.
    """
    seen = np.isfinite(registration.positions).all(axis=1)
    markers = registration.positions[seen]
    everything = [mesh.vertices, markers, *([] if nominal is None else [nominal])]
    radius = _RADIUS * float(np.ptp(mesh.vertices, axis=0).max())
    views = [_view(*each, np.concatenate(everything), 2.0 * radius) for each in _VIEWS]
    clamped = _within(boundary_triangles(mesh), np.asarray(fixed, dtype=np.int64))
    layers = _layers(mesh, clamped, markers, markers if feet is None else feet[seen], radius)
    figure = _compose(views, _pictures(views, layers), registration, nominal, radius, bool(len(clamped)), title)
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=_DPI, format="png", facecolor="white")


def _layers(mesh: Mesh, clamped: IntArray, markers: FloatArray, feet: FloatArray, radius: float) -> list[Layer]:
    """The translucent body with what is clamped (C, 3) of its triangles, and markers (M, 3) [m] on stems."""
    q, triangles, lift = mesh.vertices, boundary_triangles(mesh), _NUDGE * radius
    line = 2.0 * _FINER  # [px] of a thin one.
    layers = [Layer("surface", q, triangles, BODY, opacity=_OPACITY["body"], light=(0.78, 0.5))]
    if len(clamped):
        rim = render.sharp_edges(q, clamped)  # Seen edge-on, this is all of it.
        layers.append(Layer("surface", q, clamped, CLAMPED, opacity=_OPACITY["clamped"], light=(0.7, 0.4), shift=lift))
        layers.append(Layer("lines", q, rim, CLAMPED, size=5.0 * line))
    sharp = render.sharp_edges(q, triangles)
    layers.append(Layer("lines", q, render.face_edges(mesh), INK, opacity=_OPACITY["edges"], size=line, shift=lift))
    if len(sharp):
        layers.append(Layer("lines", q, sharp, CLAMPED, opacity=_OPACITY["outline"], size=1.8 * line))
    if len(markers):
        stems = np.stack([feet, markers], axis=1).reshape(-1, 3)
        pairs = np.arange(len(stems)).reshape(-1, 2)
        layers += [
            Layer("lines", stems, pairs, INK, size=3.0 * line),
            Layer("balls", feet, None, INK, size=_FOOT * radius, light=(0.8, 0.3)),
            Layer("balls", markers, None, MEASURED, size=radius, light=(0.72, 0.75)),
        ]
    return layers


def _within(triangles: IntArray, vertices: IntArray) -> IntArray:
    return triangles[np.isin(triangles, vertices).all(axis=1)]


def _view(title: str, towards: Sequence[float], perspective: bool, points: FloatArray, margin: float) -> _View:
    """The camera that sees all points (P, 3), with a margin [m] around them."""
    axes = render.view_axes(towards)
    turned = points @ axes.T
    middle = 0.5 * (turned.min(axis=0) + turned.max(axis=0))
    diagonal = float(np.linalg.norm(np.ptp(turned, axis=0)))
    focus = middle @ axes
    distance = _DISTANCE * diagonal if perspective else np.inf
    at = _project(points, axes, focus, distance)
    around = margin / distance if perspective else margin
    return _View(title, axes, focus, distance, at.min(axis=0) - around, at.max(axis=0) + around)


def _project(points: FloatArray, axes: FloatArray, focus: FloatArray, distance: float) -> FloatArray:
    seen = (np.asarray(points) - focus) @ axes.T
    flat: FloatArray = seen[..., :2]
    return flat if np.isinf(distance) else flat / (distance - seen[..., 2:])


def _sizes(views: Sequence[_View]) -> list[FloatArray]:
    """(2,) [inch] of each view."""
    return [_LONGER_SIDE * view.extent / view.extent.max() for view in views]


def _pictures(views: Sequence[_View], layers: Sequence[Layer]) -> list[NDArray[np.float32]]:
    """(H, W, 3) of each view, drawn by another process in windows of one size and cut out of these."""
    scales = [_FINER * _DPI * size[0] / view.extent[0] for view, size in zip(views, _sizes(views), strict=True)]
    halves = [np.maximum(np.abs(view.low), np.abs(view.high)) for view in views]
    window = np.max([np.ceil(half * scale) for half, scale in zip(halves, scales, strict=True)], axis=0).astype(int)
    window += -window % _FINER  # [px] half of it
    cameras = [
        render.View(
            layers, each.axes, each.focus, window[1] / scale, None if np.isinf(each.distance) else each.distance
        )
        for each, scale in zip(views, scales, strict=True)
    ]
    (frame,) = render.draw(cameras, 2 * window, background="white", samples=0, intensity=_LIGHT)
    drawn = frame.astype(np.float32) / np.float32(255.0)
    out = []
    for column, (view, scale) in enumerate(zip(views, scales, strict=True)):
        pixels = drawn[:, 2 * window[0] * column : 2 * window[0] * (column + 1), :3]
        left, right = (window[0] + scale * np.array([view.low[0], view.high[0]])).round().astype(int)
        top, bottom = (window[1] - scale * np.array([view.high[1], view.low[1]])).round().astype(int)
        cut = pixels[max(top, 0) : bottom, max(left, 0) : right]
        cut = cut[: len(cut) - len(cut) % _FINER, : cut.shape[1] - cut.shape[1] % _FINER]
        blocks = cut.reshape(len(cut) // _FINER, _FINER, cut.shape[1] // _FINER, _FINER, 3)
        out.append(blocks.mean(axis=(1, 3)))
    return out


def _compose(
    views: Sequence[_View],
    pictures: Sequence[NDArray[np.float32]],
    registration: Registration,
    nominal: FloatArray | None,
    radius: float,
    clamped: bool,
    title: str,
) -> "Figure":
    """The views, one above the other or side by side, with names, rings, axes, a scale and a legend."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    sizes = _sizes(views)
    stacked = sizes[0][0] + sizes[1][0] > 1.6 * max(size[1] for size in sizes)
    longest = max(len(text) for each in range(len(registration.names)) for text in _label(registration, each))
    margin = _LETTER * max(longest, 9) + 0.15  # [inch]
    cells = [size + [2.0 * margin, _HEAD + _STRIP] for size in sizes]
    width, height = (max(cell[0] for cell in cells), sum(cell[1] for cell in cells))
    if not stacked:
        width, height = sum(cell[0] for cell in cells), max(cell[1] for cell in cells)
    top = 0.5 if title else _PAD
    total = np.array([width, height + top + _LEGEND])
    with mpl.rc_context({"font.size": 9, "text.color": INK}):
        figure = Figure(figsize=tuple(total))
        if title:
            figure.text(0.5, 1.0 - 0.28 / total[1], title, ha="center", va="center", fontsize=12, fontweight="bold")
        corner = np.array([0.0, total[1] - top])  # Upper left one of the next cell [inch].
        for view, picture, size, cell in zip(views, pictures, sizes, cells, strict=True):
            left = corner[0] + (0.5 * (width - size[0]) if stacked else margin)
            box = [left / total[0], (corner[1] - _HEAD - size[1]) / total[1], *(size / total)]
            axes = figure.add_axes((box[0], box[1], box[2], box[3]))
            _show(axes, view, picture, size, margin)
            _mark(axes, view, size, registration, nominal, radius)
            corner += [0.0, -cell[1]] if stacked else [cell[0], 0.0]
        _legend(figure, nominal is not None, clamped, 0.06 / total[1])
    return figure


def _show(axes: "Axes", view: _View, picture: NDArray[np.float32], size: FloatArray, margin: float) -> None:
    """The picture, its title, the directions of the axes and, without perspective, a scale.

    Args:
        axes: Where to draw.
        view: What to draw.
        picture: (H, W, 3) of it.
        size: (2,) of it [inch].
        margin: On its left and right [inch].
    """
    axes.imshow(picture, extent=(view.low[0], view.high[0], view.low[1], view.high[1]), aspect="auto")
    axes.set(xlim=(view.low[0], view.high[0]), ylim=(view.low[1], view.high[1]))
    axes.set_axis_off()
    axes.set_title(view.title, fontsize=10, color=_GREY, pad=14)
    inch = view.extent[0] / size[0]
    origin = view.low + [-(margin - 0.3) * inch, -(_STRIP - 0.2) * inch]
    for direction, name in zip(view.axes[:2].T, "xyz", strict=True):
        if np.linalg.norm(direction) > 0.1:
            end = origin + 0.36 * inch * direction
            arrow = {"arrowstyle": "-|>", "color": _GREY, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", end, origin, arrowprops=arrow, annotation_clip=False)
            at = origin + 0.36 * inch * direction + 0.11 * inch * direction / np.linalg.norm(direction)
            axes.text(at[0], at[1], name, ha="center", va="center", color=_GREY, fontsize=9, clip_on=False)
    if np.isinf(view.distance):
        length = _round_length(0.3 * view.extent[0])
        right, low = view.high[0] + (margin - 0.25) * inch, view.low[1] - (_STRIP - 0.2) * inch
        axes.plot([right - length, right], [low, low], color=_GREY, linewidth=2.0, clip_on=False, solid_capstyle="butt")
        axes.text(
            right - 0.5 * length, low + 0.06 * inch, f"{1e3 * length:g} mm", ha="center", va="bottom", color=_GREY
        )


def _round_length(longest: float) -> float:
    """The longest of 1, 2, 5, 10, ... [mm] that is not longer than what is given [m]."""
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(max(factor * decade for factor in (1.0, 2.0, 5.0) if factor * decade <= longest * (1.0 + 1e-9)))


def _mark(
    axes: "Axes",
    view: _View,
    size: FloatArray,
    registration: Registration,
    nominal: FloatArray | None,
    radius: float,
) -> None:
    """Names and residuals in columns on both sides, leaders to the markers, and rings at the nominal positions."""
    from matplotlib.patches import Circle

    inch = view.extent[0] / size[0]
    seen = np.flatnonzero(np.isfinite(registration.positions).all(axis=1))
    at = {int(each): view.project(registration.positions[each]) for each in seen}
    if nominal is not None:
        for marker, point in enumerate(nominal):
            ring = view.project(point)
            around = view.shown(_RING * radius, point)
            axes.add_patch(Circle((ring[0], ring[1]), around, fill=False, edgecolor=NOMINAL, linewidth=1.5))
            if marker in at and np.linalg.norm(at[marker] - ring) > around:
                axes.plot(*np.stack([ring, at[marker]]).T, color=NOMINAL, linewidth=1.0, linestyle=(0, (3, 2)))
    middle = float(np.median([each[0] for each in at.values()]))
    for side in (-1.0, 1.0):
        group = sorted(
            (each for each in at if (at[each][0] < middle) == (side < 0.0)), key=lambda each: float(at[each][1])
        )
        heights = _spread(np.array([at[each][1] for each in group]), _LABEL_HEIGHT * inch)
        edge = view.low[0] if side < 0.0 else view.high[0]
        for each, height in zip(group, heights, strict=True):
            text = edge + side * 0.1 * inch
            end = np.array([edge + side * 0.05 * inch, height])
            away = view.shown(1.2 * radius, registration.positions[each]) / float(np.linalg.norm(end - at[each]))
            start = at[each] + min(away, 1.0) * (end - at[each])
            axes.plot(*np.stack([start, end]).T, color=_GREY, linewidth=0.7, clip_on=False)
            align = "right" if side < 0.0 else "left"
            name, note = _label(registration, each)
            colour = MEASURED if name in registration.outliers else _GREY
            axes.text(text, height, name, ha=align, va="bottom", fontweight="bold", clip_on=False)
            axes.text(text, height, note, ha=align, va="top", fontsize=8, color=colour, clip_on=False)


def _label(registration: Registration, marker: int) -> tuple[str, str]:
    """Name of a marker, and how well it fits."""
    name = registration.names[marker]
    return name, f"{1e3 * registration.residual[marker]:.2f} mm" + (", left out" * (name in registration.outliers))


def _spread(heights: FloatArray, least: float) -> FloatArray:
    """Sorted heights moved apart to a least distance, as little as that takes in the mean square.

    With the least distances taken off they need only be in order: isotonic regression, by pooling neighbours that
    are not (Ayer et al. 1955).
    """
    pools: list[tuple[float, int]] = []
    for value in heights - least * np.arange(len(heights)):
        mean, count = float(value), 1
        while pools and pools[-1][0] > mean:
            before, size = pools.pop()
            mean, count = (before * size + mean * count) / (size + count), size + count
        pools.append((mean, count))
    return np.repeat([mean for mean, _ in pools], [count for _, count in pools]) + least * np.arange(len(heights))


def _legend(figure: "Figure", nominal: bool, clamped: bool, bottom: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    none: dict[str, Any] = {"linestyle": "none"}
    handles: list[Any] = [
        Line2D([], [], **none, marker="o", markersize=7, color=MEASURED, label="measured, with residual"),
        Line2D([], [], marker="o", markersize=3.5, markevery=[0], linewidth=1.4, color=INK, label="stem and its foot"),
    ]
    if nominal:
        ring = Line2D([], [], **none, marker="o", markersize=9, markerfacecolor="none", color=NOMINAL)
        ring.set_label("nominal")
        ring.set_markeredgewidth(1.5)
        handles.append(ring)
    if clamped:
        handles.append(Patch(facecolor=CLAMPED, alpha=0.8, label="clamped"))
    handles.append(Patch(facecolor=BODY, alpha=0.6, label="body at rest"))
    figure.legend(
        handles=handles, loc="lower center", bbox_to_anchor=(0.5, bottom), ncols=len(handles), frameon=False, fontsize=9
    )
