"""Scenes for tests of the renderer."""

from typing import Final

import numpy as np

from warp_resphys.core.mesh.plotting import BODY
from warp_resphys.core.mesh.volume_mesh import Mesh, boundary_triangles
from warp_resphys.data.camera import frame_of, view_axes
from warp_resphys.report.layers import OUTLINE, Layer, RenderScene, View, sharp_edges

TOWARDS_VIEWER: Final = (0.40, -1.0, 0.40)
MARGIN: Final = 0.02  # around the body, over its longer side
SHADE: Final = 0.25  # share of the colour that depends on the light


def body_scene(
    mesh: Mesh,
    views: int = 1,
    moved: tuple[float, float, float] = (0.0, 0.0, 0.0),
    longest: int = 1100,
) -> RenderScene:
    """Views of a body that has moved, with the outline of where it was.

    `longest` is the longer side [px].
    """
    axes = view_axes(TOWARDS_VIEWER)
    triangles, placed = boundary_triangles(mesh), mesh.vertices + moved
    focus, half = frame_of(np.concatenate([mesh.vertices, placed]), axes, MARGIN)
    layers = [
        Layer("surface", placed, triangles, BODY, light=(1.0 - SHADE, SHADE)),
        Layer(
            "lines",
            mesh.vertices,
            sharp_edges(mesh.vertices, triangles),
            OUTLINE,
            size=4.0,
            shift=-1e-3,
        ),
    ]
    return RenderScene(
        [View(layers, axes, focus, half[1])] * views,
        [int(side) for side in np.ceil(longest * half / half.max())],
    )
