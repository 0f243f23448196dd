"""Draws a translucent body with markers on stems, from several sides: a program for a process of its own.

`python -m warp_resphys.report.render_markers scene.npz picture.png`; see `warp_resphys.report.render` for why.
"""

import sys
from typing import Any, Final

import numpy as np

BODY: Final = "#a9bccf"
CLAMPED: Final = "#33485e"
MEASURED: Final = "#d55e00"  # Vermilion of Okabe and Ito (2008).
INK: Final = "#1c2127"
_OPACITY: Final = {"body": 0.42, "clamped": 0.75, "edges": 0.22, "outline": 0.75}
_TOWARDS_LIGHT: Final = (0.15, -0.75, 1.0)
_FEATURE_ANGLE: Final = 30.0  # [degrees]
_NUDGE: Final = 0.1  # Lines are drawn this far above the surface, over the radius of a marker.
_PEELS: Final = 12  # Layers of translucent surface that are told apart.


def main(source: str, picture: str) -> None:
    """Draw a scene, its views side by side on white.

    Args:
        source: An .npz file with vertices (N, 3) [m], triangles (F, 3) and edges (E, 2) of the surface, clamped
            (C, 3) triangles of it, markers and feet (M, 3) [m], radius [m] of a marker, size (2,) [px] of a view, and
            for V views eye, focus and up (V, 3) and half_height (V,): half of what is seen, [m] for a view without
            perspective and as a tangent for one with it, as perspective (V,) says.
        picture: The .png file to write.
    """
    import pyvista

    with np.load(source, allow_pickle=False) as arrays:
        scene: dict[str, Any] = dict(arrays)
    width, height = scene["size"].tolist()
    views = len(scene["eye"])
    plotter: Any = pyvista.Plotter(
        shape=(1, views), off_screen=True, border=False, lighting="none", window_size=[views * width, height]
    )
    plotter.render_window.SetMultiSamples(0)  # Depth peeling needs whole pixels.
    plotter.set_background("white", all_renderers=True)
    plotter.add_light(
        pyvista.Light(position=_TOWARDS_LIGHT, focal_point=(0.0, 0.0, 0.0), light_type="scene light", intensity=0.55)
    )
    for column in range(views):
        plotter.subplot(0, column)
        _add_body(plotter, scene, line_width=height / 500.0)
        _add_markers(plotter, scene)
        camera = plotter.camera
        camera.position, camera.focal_point = scene["eye"][column], scene["focus"][column]
        camera.up = scene["up"][column]
        half = float(scene["half_height"][column])
        if scene["perspective"][column]:
            camera.view_angle = float(np.degrees(2.0 * np.arctan(half)))
        else:
            plotter.enable_parallel_projection()
            camera.parallel_scale = half
        plotter.enable_depth_peeling(_PEELS)
        plotter.reset_camera_clipping_range()
    plotter.screenshot(picture)
    plotter.close()


def _add_body(plotter: Any, scene: dict[str, Any], line_width: float) -> None:
    """The surface, the lines around its faces, its sharp edges, and what is clamped."""
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(scene["vertices"], scene["triangles"])
    plotter.add_mesh(surface, color=BODY, opacity=_OPACITY["body"], ambient=0.78, diffuse=0.5)
    if len(scene["clamped"]):
        clamped = pyvista.PolyData.from_regular_faces(scene["vertices"], scene["clamped"])
        plotter.add_mesh(clamped, color=CLAMPED, opacity=_OPACITY["clamped"], ambient=0.7, diffuse=0.4)
        rim = clamped.extract_feature_edges(_FEATURE_ANGLE, manifold_edges=False)  # Seen edge-on, this is all of it.
        plotter.add_mesh(rim, color=CLAMPED, lighting=False, line_width=5.0 * line_width)
    lines = np.insert(scene["edges"], 0, 2, axis=1)  # VTK wants the number of points before each line.
    normals = surface.compute_normals(cell_normals=False, split_vertices=False, auto_orient_normals=False)
    above = scene["vertices"] + _NUDGE * scene["radius"] * normals.point_data["Normals"]
    edges = pyvista.PolyData(above, lines=lines.ravel())
    plotter.add_mesh(edges, color=INK, opacity=_OPACITY["edges"], lighting=False, line_width=line_width)
    outline = surface.extract_feature_edges(_FEATURE_ANGLE)
    if outline.n_cells:
        plotter.add_mesh(
            outline, color=CLAMPED, opacity=_OPACITY["outline"], lighting=False, line_width=1.8 * line_width
        )


def _add_markers(plotter: Any, scene: dict[str, Any]) -> None:
    """Balls, the stems that they stand on, and a small ball at the foot of each."""
    import pyvista

    radius = float(scene["radius"])
    for marker, foot in zip(scene["markers"], scene["feet"], strict=True):
        plotter.add_mesh(
            pyvista.Sphere(radius, marker, theta_resolution=48, phi_resolution=48),
            color=MEASURED,
            smooth_shading=True,
            ambient=0.72,
            diffuse=0.75,
            specular=0.3,
        )
        if np.linalg.norm(marker - foot) > 1e-9:
            stem = pyvista.Line(foot, marker).tube(radius=0.22 * radius, n_sides=24)
            plotter.add_mesh(stem, color=INK, ambient=0.8, diffuse=0.3)
        plotter.add_mesh(pyvista.Sphere(0.42 * radius, foot), color=INK, ambient=0.8, diffuse=0.3)


if __name__ == "__main__":
    main(*sys.argv[1:])
