"""A picture of registered markers on a body, for checking the registration."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from scipy.optimize import isotonic_regression

from ..io.atomic import atomic_path
from ..mesh.mesh import Mesh, boundary_triangles
from .bodies import face_edges, sharp_edges, stems
from .data import Recordings
from .render import (
    BODY,
    CLAMPED,
    INK,
    MEASURED,
    FloatArray,
    IntArray,
    Layer,
    Pixels,
    Renderer,
    RenderScene,
    View,
    draw,
    frame_of,
    picture_size,
    view_axes,
)

NOMINAL: Final = "#0072b2"  # Blue of Okabe and Ito (2008).
_GREY: Final = "#5b6570"
_VIEWS: Final = {"From above": (0.62, -1.0, 0.52), "From the side": (0.0, -1.0, 0.0)}  # Towards the viewer.
_DPI: Final = 160
_FINER: Final = 2  # Oversampling, as sorted translucent surfaces have no smooth edges.
_LONGER_SIDE: Final = 6.6  # Of a panel [inch].
_MARGIN: Final = 0.03  # Around the points, over their longer side.
_LETTER: Final = 0.088  # Largest mean width of the letters of a name [inch].
_TITLE, _HEAD, _STRIP, _PAD = 0.7, 0.42, 0.9, 0.12  # Heights of title, above and below a view, and outer margin [inch].
_LABEL_HEIGHT: Final = 0.36  # [inch]
_RADIUS: Final = 0.016  # Of a marker, over the longest side of the body.
_RING: Final = 1.55  # Radius of a nominal position's ring, in radii of a marker.
_FOOT: Final = 0.42  # Radius of the ball at the foot of a stem, in radii of a marker.
_NUDGE: Final = 0.1  # Shift of lines towards the viewer, over the radius of a marker.


@dataclass(frozen=True)
class Panel:
    """A view of the body from one side."""

    title: str
    axes: FloatArray  # (3, 3) rows: to the right, up, towards the viewer.
    focus: FloatArray  # (3,) [m] point in the middle.
    half: FloatArray  # (2,) half the width and height of the view [m].

    @property
    def inch(self) -> float:
        """Length on the body that corresponds to an inch of the picture [m]."""
        return float(2.0 * self.half.max() / _LONGER_SIDE)

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates (2,) of the view [m], to the right and up."""
        middle = self.project(self.focus)
        return middle - self.half, middle + self.half

    def project(self, points: FloatArray) -> FloatArray:
        """Return coordinates (..., 2) of points (..., 3) [m] in the picture, to the right and up."""
        return points @ self.axes[:2].T

    def scene(self, layers: Sequence[Layer]) -> RenderScene:
        """Return the scene that is drawn below names and rings."""
        size = picture_size(self.half, _FINER * _DPI * _LONGER_SIDE)
        return RenderScene([View(layers, self.axes, self.focus, self.half[1])], size, background="white", sorts=True)


def draw_registration(path: Path, recordings: Recordings, fixed: IntArray, renderer: Renderer | None = None) -> None:
    """Draw the body, the measured markers and their feet from two sides, with names and residuals.

    Args:
        path: The PNG file to write.
        recordings: With the markers; those that were not seen are not drawn.
        fixed: Vertices of the clamped region.
        renderer: Process that draws, in place of a new one.

    Raises:
        DrawingError: There is no pyvista, or no OpenGL driver that works off screen.
        DataFileError: The file cannot be written.
    """
    seen = np.isfinite(recordings.positions).all(axis=1)
    panels = panels_of(np.concatenate([recordings.mesh.vertices, recordings.positions[seen], recordings.nominal]))
    radius = _RADIUS * float(np.ptp(recordings.mesh.vertices, axis=0).max())
    layers = registration_layers(recordings.mesh, fixed, recordings.positions[seen], recordings.feet[seen], radius)
    pictures = [frames[0] for frames in draw(*(panel.scene(layers) for panel in panels), renderer=renderer)]
    with mpl.rc_context({"font.size": 9, "text.color": INK}):
        figure = _compose(panels, pictures, recordings, radius, bool(len(fixed)))
        with atomic_path(path) as partial:
            figure.savefig(partial, dpi=_DPI, format="png", facecolor="white", bbox_inches="tight", pad_inches=_PAD)


def panels_of(points: FloatArray) -> list[Panel]:
    """Return the panels, which contain all points (P, 3) [m] with a margin."""
    panels = []
    for title, towards in _VIEWS.items():
        axes = view_axes(towards)
        panels.append(Panel(title, axes, *frame_of(points, axes, _MARGIN)))
    return panels


def registration_layers(
    mesh: Mesh, fixed: IntArray, markers: FloatArray, feet: FloatArray, radius: float
) -> list[Layer]:
    """Return the translucent body with its clamped region, and markers (M, 3) on stems from their feet (M, 3) [m]."""
    q, triangles, lift = mesh.vertices, boundary_triangles(mesh), _NUDGE * radius
    clamped = triangles[np.isin(triangles, fixed).all(axis=1)]
    line = 2.0 * _FINER  # Width of a thin line [px].
    layers = [Layer("surface", q, triangles, BODY, opacity=0.42, light=(0.78, 0.28))]
    if len(clamped):
        rim = sharp_edges(q, clamped)  # All that is visible of a region that is seen edge-on.
        layers.append(Layer("surface", q, clamped, CLAMPED, opacity=0.75, light=(0.7, 0.22), shift=lift))
        layers.append(Layer("lines", q, rim, CLAMPED, size=5.0 * line))
    sharp = sharp_edges(q, triangles)
    layers.append(Layer("lines", q, face_edges(mesh), INK, opacity=0.22, size=line, shift=lift))
    if len(sharp):
        layers.append(Layer("lines", q, sharp, CLAMPED, opacity=0.75, size=1.8 * line))
    if len(markers):
        layers += [
            stems(feet, markers, INK, 3.0 * line),
            Layer("balls", feet, None, INK, size=_FOOT * radius, light=(0.8, 0.16)),
            Layer("balls", markers, None, MEASURED, size=radius, light=(0.72, 0.41)),
        ]
    return layers


def _compose(
    panels: Sequence[Panel], pictures: Sequence[Pixels], recordings: Recordings, radius: float, is_clamped: bool
) -> Figure:
    """Composes the views, stacked or side by side, with names, rings, axes and a scale.

    The figure is one inch wide and high, so that all positions are in inches; it is cropped to its content when saved.
    """
    (wide, tall), (other_wide, other_tall) = sizes = [2.0 * panel.half / panel.inch for panel in panels]
    longest = max(len(text) for marker in range(len(recordings.labels)) for text in _label(recordings, marker))
    margin = _LETTER * max(longest, 9) + 0.15
    corners = [(0.0, 0.0), (wide + 2.0 * margin, tall - other_tall)]
    if wide + other_wide > 1.6 * max(tall, other_tall):
        corners[1] = (0.5 * (wide - other_wide), -_HEAD - _STRIP - other_tall)
    figure = Figure(figsize=(1.0, 1.0))
    middle, lowest = 0.5 * max(wide, corners[1][0] + other_wide), min(0.0, corners[1][1])
    figure.text(middle, tall + _TITLE, recordings.drawn, ha="center", va="center", fontsize=12, fontweight="bold")
    for panel, picture, corner, size in zip(panels, pictures, corners, sizes, strict=True):
        axes = figure.add_axes((*corner, *size))
        low, high = panel.corners
        axes.imshow(picture, extent=(low[0], high[0], low[1], high[1]), aspect="auto")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set_axis_off()
        axes.set_title(panel.title, fontsize=10, color=_GREY, pad=14)
        _directions(axes, panel, margin)
        _rings(axes, panel, recordings, radius)
        _names(axes, panel, recordings, radius)
    _scale(axes, panel, margin)
    handles = _legend(is_clamped)
    place, columns = (middle, lowest - _STRIP), len(handles)
    figure.legend(handles=handles, loc="upper center", bbox_to_anchor=place, ncols=columns, frameon=False, fontsize=9)
    return figure


def _directions(axes: Axes, panel: Panel, margin: float) -> None:
    """Draws arrows along x, y and z in the margin [inch] at the lower left."""
    origin = panel.corners[0] - panel.inch * np.array([margin - 0.3, _STRIP - 0.2])
    for direction, name in zip(panel.axes[:2].T, "xyz", strict=True):
        length = float(np.linalg.norm(direction))
        if length > 0.1:
            end = origin + 0.36 * panel.inch * direction
            arrow = {"arrowstyle": "-|>", "color": _GREY, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", tuple(end), tuple(origin), arrowprops=arrow, annotation_clip=False)
            x, y = end + 0.11 * panel.inch * direction / length
            axes.text(x, y, name, ha="center", va="center", color=_GREY, fontsize=9, clip_on=False)


def _scale(axes: Axes, panel: Panel, margin: float) -> None:
    """Draws a bar of a round length in the margin [inch] at the lower right."""
    low, high = panel.corners
    length = round_length(0.3 * (high - low)[0])
    right, height = high[0] + panel.inch * (margin - 0.25), low[1] - panel.inch * (_STRIP - 0.2)
    line: dict[str, Any] = {"linewidth": 2.0, "clip_on": False, "solid_capstyle": "butt"}
    axes.plot([right - length, right], [height, height], color=_GREY, **line)
    middle, above = right - 0.5 * length, height + 0.06 * panel.inch
    axes.text(middle, above, f"{1e3 * length:g} mm", ha="center", va="bottom", color=_GREY)


def round_length(longest: float) -> float:
    """Return the largest of the lengths 1, 2, 5, 10, ... mm that does not exceed a given one [m]."""
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(max(factor * decade for factor in (1.0, 2.0, 5.0) if factor * decade <= longest * (1.0 + 1e-9)))


def _rings(axes: Axes, panel: Panel, recordings: Recordings, radius: float) -> None:
    """Draws rings at the nominal positions, with lines to the markers outside of them."""
    for ring, marker in zip(panel.project(recordings.nominal), panel.project(recordings.positions), strict=True):
        axes.add_patch(Circle((ring[0], ring[1]), _RING * radius, fill=False, edgecolor=NOMINAL, linewidth=1.5))
        if np.linalg.norm(marker - ring) > _RING * radius:
            axes.plot(*np.stack([ring, marker]).T, color=NOMINAL, linewidth=1.0, linestyle=(0, (3, 2)))


def _names(axes: Axes, panel: Panel, recordings: Recordings, radius: float) -> None:
    """Writes names and residuals of the visible markers in columns on both sides, with lines to the markers."""
    at = panel.project(recordings.positions)  # (M, 2) [m]
    seen = np.flatnonzero(np.isfinite(at).all(axis=1))
    on_the_left = at[:, 0] < np.median(at[seen, 0])
    for side, edge in ((-1.0, panel.corners[0][0]), (1.0, panel.corners[1][0])):
        group = seen[on_the_left[seen] == (side < 0.0)]
        group = group[np.argsort(at[group, 1], kind="stable")]
        align: Any = "right" if side < 0.0 else "left"
        for marker, height in zip(group, spread(at[group, 1], _LABEL_HEIGHT * panel.inch), strict=True):
            end, x = np.array([edge + side * 0.05 * panel.inch, height]), edge + side * 0.1 * panel.inch
            away = 1.2 * radius / float(np.linalg.norm(end - at[marker]))
            start = at[marker] + min(away, 1.0) * (end - at[marker])
            axes.plot(*np.stack([start, end]).T, color=_GREY, linewidth=0.7, clip_on=False)
            name, note = _label(recordings, marker)
            colour = MEASURED if name in recordings.outliers else _GREY
            axes.text(x, height, name, ha=align, va="bottom", fontweight="bold", clip_on=False)
            axes.text(x, height, note, ha=align, va="top", fontsize=8, color=colour, clip_on=False)


def _label(recordings: Recordings, marker: int) -> tuple[str, str]:
    """Name and residual of a marker."""
    name = recordings.labels[marker]
    return name, f"{recordings.residual_mm[marker]:.2f} mm" + ", left out" * (name in recordings.outliers)


def spread(heights: FloatArray, least: float) -> FloatArray:
    """Return sorted heights moved apart to a least distance, with the least mean square displacement."""
    apart = least * np.arange(len(heights))  # Less these, the heights need to be in order only.
    return isotonic_regression(heights - apart).x + apart if len(heights) else heights


def _legend(is_clamped: bool) -> list[Any]:
    """Handles of the legend."""
    none: dict[str, Any] = {"linestyle": "none", "marker": "o"}
    hollow: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 1.5}
    return [
        Line2D([], [], **none, markersize=7, color=MEASURED, label="measured, with residual"),
        Line2D([], [], marker="o", markersize=3.5, markevery=[0], linewidth=1.4, color=INK, label="stem and its foot"),
        Line2D([], [], **none, **hollow, markersize=9, color=NOMINAL, label="nominal"),
        *([Patch(facecolor=CLAMPED, alpha=0.8, label="clamped")] if is_clamped else []),
        Patch(facecolor=BODY, alpha=0.6, label="body at rest"),
    ]
