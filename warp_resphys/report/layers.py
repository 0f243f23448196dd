"""Scenes: layers of bodies, obstacles, markers and strings, seen by cameras without perspective.

Every picture of a body is a scene: those of the report, films, pictures of environments (`render`
draws them with pyvista), and the live view of a robot in the browser. Points are (P, 3), or
(F, P, 3) where they move over F frames [m].
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..core.mesh.volume_mesh import Mesh, boundary_faces
from ..io.arrays import FloatArray, IntArray

INK: Final = "#1c2127"
OUTLINE: Final = (
    "#808891"  # Of the undeformed body: a grey that is visible on light and dark pages.
)
BODY: Final = "#8db4e8"
BEHIND: Final = "#6b7580"  # Of bodies and markers with which the last one is compared.
MEASURED: Final = "#d55e00"  # Vermilion of Okabe and Ito (2008).
OBSTACLE: Final = "#b9b2a6"  # A warm grey beside the blue of bodies.
LARGEST_RATE: Final = 25.0  # Frames a second of a film, at most.
_BODY_LIGHT: Final = (0.72, 0.3)
_OBSTACLE_LIGHT: Final = (0.62, 0.42)
_SHARP: Final = 30.0  # Least angle between the normals of faces at a sharp edge [degrees].
_BEFORE: Final = 0.01  # Shift of edges to the viewer, over half the height of a view.


@dataclass(frozen=True, eq=False)
class Layer:
    """An object of a scene. Moving points have a first axis of F frames.

    It is not drawn where they are not finite.
    """

    kind: str  # surface, lines, balls, rings (towards the viewer), slice or slice_edges (of cells).
    points: FloatArray  # (P, 3) or (F, P, 3) [m] corners, or centres, hidden one by one.
    cells: IntArray | None = None  # (S, 3) triangles, (E, 2) lines or (C, 4 | 8) solid cells.
    colour: str = INK
    size: float = 1.0  # Radius of balls and rings [m], or width of lines [px].
    opacity: float = 1.0
    light: tuple[float, float] | None = (
        None  # Shares of ambient and scene light; None draws the plain colour.
    )
    shift: float = 0.0  # Towards the viewer [m].
    plane: FloatArray | None = (
        None  # (2, 3) normal and point of a plane; of a surface, the part behind it is drawn.
    )


@dataclass(frozen=True, eq=False)
class View:
    """A view of layers, by parallel projection."""

    layers: Sequence[Layer]  # In the order in which they are drawn.
    axes: FloatArray  # (3, 3) rows: to the right, up, towards the viewer (`data.camera.view_axes`).
    focus: FloatArray  # (3,) or (F, 3) [m] point in the middle.
    half_height: float  # Of the view [m].
    legend: Sequence[tuple[str, str]] = ()  # Texts and colours, at the top.


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Views side by side, and their drawing options."""

    views: Sequence[View]
    size: Sequence[int]  # (2,) width and height of each view [px]; even for a film.
    background: str | None = None  # A colour; None for a transparent one.
    sorts: bool = (
        False  # Whether translucent surfaces are sorted by depth, which excludes smooth edges.
    )
    texts: Sequence[str] = ()  # One for each frame, in the first view, before its legend.
    fps: float = LARGEST_RATE  # Of a film.


def body_layers(
    points: FloatArray,
    triangles: IntArray,
    half: float,
    edges: IntArray | None = None,
    sharp: IntArray | None = None,
    width: float = 2.0,
) -> list[Layer]:
    """Returns layers of a solid body in a view of half a height [m].

    Args:
        points: Of its surface.
        triangles: (S, 3).
        half: Half the height of the view [m].
        edges: (E, 2) lines around its faces, drawn thin; None for none.
        sharp: (E, 2) edges; by default those of the first frame.
        width: Of its sharp edges [px].
    """
    sharp = (
        sharp_edges(points if points.ndim == 2 else points[0], triangles)
        if sharp is None
        else sharp
    )
    before = _BEFORE * half
    thin = [] if edges is None else [Layer("lines", points, edges, opacity=0.3, shift=before)]
    solid = Layer("surface", points, triangles, BODY, light=_BODY_LIGHT)
    return [solid, *thin, Layer("lines", points, sharp, size=width, shift=before)]


def ghost_layers(
    points: FloatArray, triangles: IntArray, half: float, sharp: IntArray
) -> list[Layer]:
    """Returns layers of a translucent body with which a solid one is compared,
    as those of `body_layers`.

    Its surface is shifted far behind, so that it shows beside the solid body only.
    """
    surface = Layer(
        "surface", points, triangles, BEHIND, opacity=0.3, light=_BODY_LIGHT, shift=-4.0 * half
    )
    return [surface, Layer("lines", points, sharp, BEHIND, size=2.0, shift=_BEFORE * half)]


def obstacle_layers(
    points: FloatArray, triangles: IntArray, width: float = 1.5, colour: str = OBSTACLE
) -> list[Layer]:
    """Returns layers of obstacles, with lines [px wide] along their sharp edges.

    None without triangles.
    """
    if not len(triangles):
        return []
    edges = sharp_edges(points if points.ndim == 2 else points[0], triangles)
    surface = Layer("surface", points, triangles, colour, light=_OBSTACLE_LIGHT)
    return [surface, *([Layer("lines", points, edges, OUTLINE, size=width)] if len(edges) else [])]


def stems(feet: FloatArray, markers: FloatArray, colour: str, width: float) -> Layer:
    """Returns lines [px wide] from feet (..., M, 3) to markers (..., M, 3) [m]."""
    ends = np.stack([feet, markers], axis=-2).reshape(*markers.shape[:-2], -1, 3)
    return Layer("lines", ends, np.arange(ends.shape[-2]).reshape(-1, 2), colour, size=width)


def chain(count: int) -> IntArray:
    """Returns lines (count - 1, 2) from points to the next ones."""
    return np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)


def face_edges(mesh: Mesh) -> IntArray:
    """Returns the unique lines (E, 2) around the faces of the boundary."""
    sides, corners = boundary_faces(mesh), mesh.element.face.corners
    rims = sides[:, :corners]
    if sides.shape[1] > corners:  # Edge midpoints follow the corners.
        rims = np.stack([rims, sides[:, corners : 2 * corners]], axis=2).reshape(len(sides), -1)
    edges = np.sort(np.stack([rims, np.roll(rims, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    return np.asarray(np.unique(edges, axis=0))


def sharp_edges(points: FloatArray, triangles: IntArray) -> IntArray:
    """Returns edges (E, 2) at which triangles (S, 3) of points (P, 3) meet
    at a sharp angle, or a surface ends.
    """
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, which, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    together = np.zeros((len(edges), 3))
    np.add.at(together, which.ravel(), np.repeat(normals, 3, axis=0))
    # Two unit vectors at an angle a have a sum of length 2 cos(a / 2).
    smooth = (count == 2) & (
        np.linalg.norm(together, axis=1) >= 2.0 * np.cos(0.5 * np.radians(_SHARP))
    )
    return np.asarray(edges[~smooth])


def pace(times: FloatArray, slower: float) -> tuple[IntArray, float]:
    """Returns the frames of a film of a motion at times (T,) [s], and its frame rate [Hz]."""
    step = float(np.median(np.diff(times)))
    every = max(1, round(1.0 / (slower * step * LARGEST_RATE)))
    return np.arange(0, len(times), every), 1.0 / (slower * step * every)
