"""Pictures of a body at rest: with its chambers or tendons, and with its registered markers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.mesh.chambers import Chamber
from ..core.mesh.elements import ELEMENTS
from ..core.mesh.plotting import BODY, FIXED
from ..core.mesh.surface import closest_points
from ..core.mesh.volume_mesh import Mesh, boundary_triangles, face_triangles
from ..data.camera import frame_of, view_axes
from ..io.arrays import FloatArray, IntArray
from ..io.atomic import atomic_path
from .data import Recordings
from .figures import CHAMBER_COLOURS, WIDE, in_style
from .layers import (
    INK,
    MEASURED,
    Layer,
    RenderScene,
    View,
    chain,
    face_edges,
    obstacle_layers,
    sharp_edges,
    stems,
)
from .render import Pixels, Renderer, draw

TOWARDS_VIEWER: Final = (0.32, -1.0, 0.28)
# Towards the viewer.
_SIDES: Final = {"From above": TOWARDS_VIEWER, "From the side": (0.0, -1.0, 0.0)}
_CUT: Final = "#d3dde7"
NOMINAL: Final = "#0072b2"  # Blue of Okabe and Ito (2008).
_LIFT: Final = 2e-3  # Height of lines above their surface, over the body's longest side.
_DOT: Final = 0.011  # Radius of a marker, over the body's longest side.
_RING: Final = 1.6  # Radius of a nominal position's ring, in radii of a marker.
_ROPE: Final = 4.0  # Width of a tendon over that of a thin line.
_MARGIN: Final = 0.02  # Around the body, over its longer side.
_LONGER_SIDE: Final = 1400  # of a view [px]
_NARROWEST: Final = 0.3  # width of a view over its height
_ENTRY: Final = 1.9  # Width of an entry of the legend [inch]
_LINE: Final = 0.24  # Height of a line of text [inch]
_CUBIC_CENTI: Final = 1e6


@dataclass(frozen=True, eq=False)
class MeshSummary:
    """A mesh with its clamped vertices, and its chambers or tendons."""

    mesh: Mesh
    fixed: IntArray  # (P,) clamped vertices.
    chambers: tuple[Chamber, ...]  # Closed chambers, and open faces under pressure.
    tendons: Mapping[str, FloatArray] = field(default_factory=dict)  # (G, 3) guides [m], by name.
    inside: str = "Chambers"  # Title of the coloured parts.
    obstacles: ObstacleSurface = field(default_factory=ObstacleSurface)  # That the body touches.

    def chamber_volume(self, chamber: Chamber) -> float:
        """Returns the volume of a chamber [m^3], by the divergence theorem."""
        corners = self.mesh.vertices[face_triangles(chamber.faces)]
        return float(-np.linalg.det(corners - corners.mean(axis=(0, 1))).sum() / 6.0)


@dataclass(frozen=True, eq=False)
class BodyPicture:
    """Views of a body side by side, of the width of all figures,
    with titles above and a legend below.
    """

    scene: RenderScene
    titles: Sequence[str]  # One a view.
    handles: Sequence[Any]  # Of the legend.
    # Texts beside points of the picture (2,) [px], and whether they are to the left of them.
    notes: Sequence[tuple[str, tuple[float, float], bool]] = ()

    def draw(self, renderer: Renderer | None = None) -> Pixels:
        """Returns the pixels of the views, see `render.draw`."""
        return np.asarray(draw(self.scene, renderer)[0])

    @in_style()
    def save(self, path: Path, pixels: Pixels) -> Path:
        """Writes a PNG file of drawn views."""
        dpi, columns = pixels.shape[1] / WIDE, max(1, int(WIDE / _ENTRY))
        legend = _LINE * -(-len(self.handles) // columns) + _LINE if self.handles else 0.0
        height = pixels.shape[0] / dpi
        total = height + legend + _LINE
        figure = Figure(figsize=(WIDE, total), dpi=dpi)
        panel = figure.add_axes((0.0, legend / total, 1.0, height / total))
        panel.imshow(pixels, aspect="auto", interpolation="antialiased")
        panel.set_axis_off()
        for at, title in enumerate(self.titles):
            figure.text((at + 0.5) / len(self.titles), 1.0, title, ha="center", va="top")
        if self.handles:
            figure.legend(handles=self.handles, loc="lower center", ncols=columns, frameon=False)
        for text, place, left in self.notes:
            beside: dict[str, Any] = {
                "textcoords": "offset points",
                "ha": "right" if left else "left",
                "va": "center",
            }
            outline = [withStroke(linewidth=2.5, foreground="white")]
            panel.annotate(text, place, (-9 if left else 9, 0), path_effects=outline, **beside)
        with atomic_path(path) as target:
            figure.savefig(target, format="png")
        return path


def mesh_picture(summary: MeshSummary, markers: FloatArray | None = None) -> BodyPicture:
    """Returns a body from outside and cut open.

    And translucent, with chambers and tendons in colours, if it has any.

    Markers (M, 3) [m] are dots in the uncut views.
    """
    vertices, dots = summary.mesh.vertices, np.empty((0, 3)) if markers is None else markers
    shown = dots[np.isfinite(dots).all(axis=1)]
    radius = _DOT * float(np.ptp(vertices, axis=0).max())
    around = summary.obstacles.near(vertices)
    points = np.concatenate([vertices, shown - radius, shown + radius, around])
    ((axes, focus),), half, size = _framed(points, [TOWARDS_VIEWER])
    views = [View(layers, axes, focus, half[1]) for layers in _layers(summary, dots, _line(size))]
    labels = [
        chamber.name.replace("_", " ")
        + (
            ""
            if len(chamber.edges)
            else f": {_CUBIC_CENTI * summary.chamber_volume(chamber):.1f} cm³"
        )
        for chamber in summary.chambers
    ]
    labels += [name.replace("_", " ") for name in summary.tendons]
    handles = [
        Patch(color=tone, label=label)
        for label, tone in zip(labels, cycle(CHAMBER_COLOURS), strict=False)
    ]
    titles = ["Outside", "Cut open", summary.inside][: len(views)]
    return BodyPicture(RenderScene(views, size, background="white", sorts=True), titles, handles)


def _layers(summary: MeshSummary, markers: FloatArray, line: float) -> list[list[Layer]]:
    """Layers of the body from outside, of its half behind a plane along it,
    and of what is in the translucent body.

    Markers are (M, 3) [m]; a thin line has a width of `line` [px].
    """
    mesh, triangles = summary.mesh, boundary_triangles(summary.mesh)
    vertices, size = mesh.vertices, float(np.ptp(mesh.vertices, axis=0).max())
    chambers = list(
        zip((face_triangles(chamber.faces) for chamber in summary.chambers), cycle(CHAMBER_COLOURS))
    )
    inner = np.concatenate([np.empty(0, dtype=np.int64), *(faces.ravel() for faces, _ in chambers)])
    outer = triangles[~np.isin(triangles[:, 0], inner)]
    normal = np.array(TOWARDS_VIEWER)
    normal[np.ptp(vertices, axis=0).argmax()] = 0.0  # The body is cut along its longest side.
    plane = np.stack([normal, vertices.mean(axis=0)])
    solid = mesh.cells[:, : ELEMENTS[mesh.element.linear].nodes]
    lift = _LIFT * size
    bright = (0.6, 0.6)
    cut_light = (0.55, 0.6)
    balls = Layer("balls", markers, None, MEASURED, size=_DOT * size, light=(0.6, 0.5))
    clamped = Layer(
        "balls", vertices[summary.fixed], None, FIXED, size=0.5 * _DOT * size, light=(0.7, 0.3)
    )
    dots = [balls] if len(markers) else []
    outside = [
        Layer("surface", vertices, triangles, BODY, light=bright),
        Layer("lines", vertices, face_edges(mesh), size=line, opacity=0.6, shift=lift),
        *([clamped] if len(summary.fixed) else []),
        *dots,
        *obstacle_layers(summary.obstacles.points, summary.obstacles.triangles, line),
    ]
    cut = [
        Layer("surface", vertices, outer, BODY, light=cut_light, plane=plane),
        Layer("slice", vertices, solid, _CUT, light=(0.93, 0.12), plane=plane),
        Layer("slice_edges", vertices, solid, size=line, opacity=0.55, shift=lift, plane=plane),
        *(
            Layer("surface", vertices, faces, colour, light=cut_light, plane=plane)
            for faces, colour in chambers
        ),
    ]
    inside = [
        *(Layer("surface", vertices, faces, colour, light=bright) for faces, colour in chambers),
        *(
            Layer("lines", guides, chain(len(guides)), colour, size=_ROPE * line)
            for guides, colour in zip(
                summary.tendons.values(), cycle(CHAMBER_COLOURS[len(chambers) :])
            )
        ),
        *dots,
    ]
    translucent = [
        Layer("surface", vertices, outer, BODY, opacity=0.22, light=(0.82, 0.45)),
        Layer("lines", vertices, sharp_edges(vertices, outer), FIXED, size=line, opacity=0.5),
    ]
    return [outside, cut, *([[*translucent, *inside]] if inside else [])]


def registration_picture(recordings: Recordings, fixed: IntArray) -> BodyPicture:
    """Returns a translucent body, its measured markers on stems, and rings at their nominal
    positions, from two sides.

    Lines connect rings with the markers outside of them. Names and residuals of these markers, and
    of those that were left out of the fit, are written beside them. The trial that fits worst is
    drawn, without markers that were not seen, and with the clamped region of fixed vertices.
    """
    mesh, fit = recordings.mesh, recordings.registered[recordings.worst]
    labels = [label for label in fit["positions"] if label in recordings.nominal]
    # Markers that were not seen are null in JSON.
    markers = np.array(
        [fit["positions"][label] or (None,) * 3 for label in labels], dtype=np.float64
    )
    nominal = np.stack([recordings.nominal[label] for label in labels])
    radius = _DOT * float(np.ptp(mesh.vertices, axis=0).max())
    ends = np.concatenate([markers, nominal])
    shown = np.concatenate([mesh.vertices, ends - _RING * radius, ends + _RING * radius])
    placed, half, size = _framed(shown, [*_SIDES.values()])
    seen, line = np.isfinite(markers).all(axis=1), _line(size)
    away = seen & (np.linalg.norm(markers - nominal, axis=1) > _RING * radius)
    standing = np.isin(labels, [*recordings.beside])[seen, None]
    feet = (
        np.where(standing, markers[seen], closest_points(mesh, markers[seen]).points)
        if seen.any()
        else nominal[:0]
    )
    layers = [
        *_translucent(mesh, fixed, line, radius),
        Layer("rings", nominal, None, NOMINAL, size=_RING * radius, shift=4.0 * radius),
        *([stems(feet, markers[seen], INK, 3.0 * line)] if seen.any() else []),
        *(
            [Layer("balls", markers[seen], None, MEASURED, size=radius, light=(0.72, 0.41))]
            if seen.any()
            else []
        ),
        *([stems(nominal[away], markers[away], NOMINAL, 2.0 * line)] if away.any() else []),
    ]
    none: dict[str, Any] = {"linestyle": "none", "marker": "o"}
    handles = [
        Line2D([], [], **none, color=MEASURED, label="measured"),
        Line2D(
            [], [], **none, color=NOMINAL, markerfacecolor="none", markersize=9, label="nominal"
        ),
        *([Patch(color=FIXED, label="clamped")] if len(fixed) else []),
    ]
    outlying, notes = np.isin(labels, fit["outliers"]), []
    for at, (axes, focus) in enumerate(placed):
        # [px] from the middle.
        across, up = ((markers - focus) @ axes[:2].T).T / half[1] * (0.5 * size[1])
        for marker in np.flatnonzero(away | (seen & outlying)):
            name = f"{labels[marker]}: {fit['residual_mm'][labels[marker]]:.2f} mm"
            name += ", left out" if outlying[marker] else ""
            place = (size[0] * (at + 0.5) + across[marker], 0.5 * size[1] - up[marker])
            notes.append((name, place, bool(across[marker] > 0.0)))
    views = [View(layers, axes, focus, half[1]) for axes, focus in placed]
    return BodyPicture(
        RenderScene(views, size, background="white", sorts=True), [*_SIDES], handles, notes
    )


def _translucent(mesh: Mesh, fixed: IntArray, line: float, radius: float) -> list[Layer]:
    """Layers of a translucent body with its clamped region,
    and lines of a width [px] around its faces.
    """
    q, triangles = mesh.vertices, boundary_triangles(mesh)
    layers = [
        Layer("surface", q, triangles, BODY, opacity=0.42, light=(0.78, 0.28)),
        Layer("lines", q, face_edges(mesh), opacity=0.22, size=line, shift=0.1 * radius),
    ]
    sharp = sharp_edges(q, triangles)
    if len(sharp):
        layers.append(Layer("lines", q, sharp, FIXED, opacity=0.75, size=1.8 * line))
    clamped = triangles[np.isin(triangles, fixed).all(axis=1)]
    if len(clamped):
        layers.append(
            Layer("surface", q, clamped, FIXED, opacity=0.75, light=(0.7, 0.22), shift=0.1 * radius)
        )
    return layers


def _framed(
    points: FloatArray, towards_viewer: Sequence[Sequence[float]]
) -> tuple[list[tuple[FloatArray, FloatArray]], FloatArray, list[int]]:
    """Axes and middle of each view of points (P, 3),
    half the width and height (2,) of all [m], and their size [px].
    """
    turned = [view_axes(towards) for towards in towards_viewer]
    frames = [frame_of(points, axes, _MARGIN) for axes in turned]
    half = np.max([size for _, size in frames], axis=0)
    half = np.maximum(half, _NARROWEST * half.max())
    placed = [(axes, focus) for axes, (focus, _) in zip(turned, frames, strict=True)]
    return placed, half, [int(side) for side in np.ceil(_LONGER_SIDE * half / half.max())]


def _line(size: Sequence[int]) -> float:
    """Width of a thin line [px] in views of a size."""
    return max(1.0, size[1] / 900.0)
