"""Draws a body from outside, cut open and translucent, side by side: a program for a process of its own.

`python -m warp_resphys.report.render_cut scene.npz picture.png`; see `warp_resphys.report.render` for why.
"""

import sys
from typing import Any, Final

import numpy as np

from .render_markers import BODY, CLAMPED, INK, MEASURED

CUT: Final = "#d3dde7"
_TOWARDS_LIGHT: Final = (0.35, -0.9, 0.8)
_LIFT: Final = 2e-3  # Of lines above the surface that they lie on, over the body's longest side.
_DOT: Final = 0.011  # Radius of a marker, over the body's longest side.
_PEELS: Final = 12  # Layers of translucent surface that are told apart.


def main(source: str, picture: str) -> None:
    """Draw a scene, its three views side by side on white.

    Args:
        source: An .npz file with vertices (N, 3) [m], cells (M, 4 | 8) of them, triangles (F, 3) and edges (E, 2) of
            the surface; outer (O, 3) and inner (I, 3): the triangles outside of and in chambers, colours (I, 3) of the
            latter in [0, 255]; markers (M, 3) [m]; clamped (P,) vertices; axes (3, 3): to the right, up and towards the
            viewer; cut_normal and cut_origin (3,) of the plane of the cut; and size (2,) [px] of a view.
        picture: The .png file to write.
    """
    import pyvista

    with np.load(source, allow_pickle=False) as arrays:
        scene: dict[str, Any] = dict(arrays)
    width, height = scene["size"].tolist()
    seen = scene["vertices"] @ scene["axes"].T
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    plotter: Any = pyvista.Plotter(
        shape=(1, 3), off_screen=True, border=False, lighting="none", window_size=[3 * width, height]
    )
    plotter.render_window.SetMultiSamples(0)  # Depth peeling needs whole pixels.
    plotter.set_background("white", all_renderers=True)
    plotter.add_light(pyvista.Light(position=_TOWARDS_LIGHT, focal_point=(0.0, 0.0, 0.0), light_type="scene light"))
    centre = 0.5 * (lower + upper) @ scene["axes"]
    for column, draw in enumerate((_outside, _cut, _translucent)):
        plotter.subplot(0, column)
        draw(plotter, scene, max(1.0, height / 900.0))
        if draw is not _cut:
            _markers(plotter, scene)
        plotter.enable_depth_peeling(_PEELS)
        plotter.camera.focal_point = centre
        plotter.camera.position = centre + scene["axes"][2] * 10.0 * (upper - lower).max()
        plotter.camera.up = scene["axes"][1]
        plotter.enable_parallel_projection()
        plotter.camera.parallel_scale = 0.5 * 1.04 * max(upper[1] - lower[1], (upper[0] - lower[0]) * height / width)
        plotter.reset_camera_clipping_range()
    plotter.screenshot(picture)
    plotter.close()


def _outside(plotter: Any, scene: dict[str, Any], line_width: float) -> None:
    """The surface with the edges of its faces, and the clamped vertices."""
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(scene["vertices"], scene["triangles"])
    plotter.add_mesh(surface, color=BODY, ambient=0.55, diffuse=0.5)
    lines = np.insert(scene["edges"], 0, 2, axis=1)  # VTK wants the number of points before each line.
    shift = _lift(scene)
    edges = pyvista.PolyData(scene["vertices"] + shift, lines=lines.ravel())
    plotter.add_mesh(edges, color=INK, opacity=0.6, lighting=False, line_width=line_width)
    if len(scene["clamped"]):
        points = scene["vertices"][scene["clamped"]] + shift
        plotter.add_mesh(
            pyvista.PolyData(points), color=CLAMPED, point_size=7.0 * line_width, render_points_as_spheres=True
        )


def _cut(plotter: Any, scene: dict[str, Any], line_width: float) -> None:
    """The half behind a plane along the body, with the cut cells and the chambers behind the cut."""
    import pyvista

    cells = scene["cells"]
    kind = pyvista.CellType.HEXAHEDRON if cells.shape[1] == 8 else pyvista.CellType.TETRA
    grid = pyvista.UnstructuredGrid({kind: cells}, scene["vertices"])
    plane = {"normal": scene["cut_normal"], "origin": scene["cut_origin"]}
    shell = pyvista.PolyData.from_regular_faces(scene["vertices"], scene["outer"])
    plotter.add_mesh(shell.clip(**plane), color=BODY, ambient=0.5, diffuse=0.55)
    section = grid.slice(**plane)
    plotter.add_mesh(section, color=CUT, ambient=0.9, diffuse=0.1)
    lines = section.translate(_lift(scene))
    plotter.add_mesh(lines, style="wireframe", color=INK, opacity=0.55, lighting=False, line_width=line_width)
    if len(scene["inner"]):
        plotter.add_mesh(_chambers(scene).clip(**plane), scalars="colours", rgb=True, ambient=0.5, diffuse=0.55)


def _translucent(plotter: Any, scene: dict[str, Any], line_width: float) -> None:
    """The chambers within the translucent body."""
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(scene["vertices"], scene["outer"])
    plotter.add_mesh(surface, color=BODY, opacity=0.22, ambient=0.8, diffuse=0.4)
    outline = surface.extract_feature_edges(30.0)
    if outline.n_cells:
        plotter.add_mesh(outline, color=CLAMPED, opacity=0.5, lighting=False, line_width=line_width)
    if len(scene["inner"]):
        plotter.add_mesh(_chambers(scene), scalars="colours", rgb=True, ambient=0.55, diffuse=0.5)


def _lift(scene: dict[str, Any]) -> Any:
    """(3,) [m] towards the viewer, by which lines are drawn above a surface."""
    return _LIFT * np.ptp(scene["vertices"], axis=0).max() * scene["axes"][2]


def _markers(plotter: Any, scene: dict[str, Any]) -> None:
    """Balls at the markers."""
    import pyvista

    radius = _DOT * np.ptp(scene["vertices"], axis=0).max()
    for marker in scene["markers"]:
        plotter.add_mesh(pyvista.Sphere(radius, marker), color=MEASURED, ambient=0.6, diffuse=0.5)


def _chambers(scene: dict[str, Any]) -> Any:
    """The surfaces of the chambers in their colours."""
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(scene["vertices"], scene["inner"])
    surface.cell_data["colours"] = scene["colours"].astype(np.uint8)
    return surface


if __name__ == "__main__":
    main(*sys.argv[1:])
