"""Meshes, bodies and their states drawn by pyvista off screen."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from support.refusals import refuses
from warp_resphys import (
    Body,
    InputError,
    MeshError,
    Scene,
    Simulator,
    box_hexahedra,
    quadratic,
    select_vertices,
)
from warp_resphys.core.mesh.plotting import BODY, REGIONS

BOX = box_hexahedra((0.1, 0.02, 0.02), (5, 1, 1))
pytestmark = pytest.mark.usefixtures("can_draw")


def colours(path):
    """Share of the pixels that are not of the background, and their mean colour."""
    pixels = imread(path)[..., :3]
    drawn = np.abs(pixels - pixels[0, 0]).max(-1) > 0.02
    return drawn.mean(), pixels[drawn].mean(0)


def actors(plotter):
    """Bounds and colours of the meshes."""
    return {
        actor.prop.color.hex_rgb: actor.bounds
        for actor in plotter.actors.values()
        if hasattr(actor, "prop")
    }


@pytest.mark.parametrize("mesh", [BOX, quadratic(BOX)])
def test_a_mesh_with_its_regions(tmp_path, mesh):
    plotter = replace(mesh, regions={"tip": np.array([3, 4])}).plot(
        screenshot=tmp_path / "mesh.png"
    )
    share, mean = colours(tmp_path / "mesh.png")
    assert 0.05 < share < 0.9
    assert mean.max() - mean.min() > 0.05  # The tip is blue.
    drawn = actors(plotter)
    assert drawn[BODY][:2] == pytest.approx((0.0, 0.06))
    assert drawn[REGIONS[0]][:2] == pytest.approx((0.06, 0.1))


def test_a_body_in_a_state_and_a_scene_and_what_cannot_be_drawn(tmp_path):
    body = Body(BOX, fixed=select_vertices(BOX, x=0.0))
    state = Simulator(body).static_equilibrium(batch=2)
    drawn = actors(body.plot(state, 1, screenshot=tmp_path / "body.png", show_edges=False))
    assert drawn[BODY][4] == pytest.approx(float(state.q[1, :, 2].min()))
    assert drawn[BODY][4] < -1e-3
    assert colours(tmp_path / "body.png")[0] > 0.05
    beside = Body(replace(BOX, vertices=BOX.vertices + [0.0, 0.05, 0.0]))
    plotter = Scene({"one": body, "two": beside}).plot(screenshot=tmp_path / "scene.png")
    assert BOX.plot(plotter=plotter) is plotter
    assert len([actor for actor in plotter.actors.values() if hasattr(actor, "prop")]) == 4
    refuses(
        MeshError,
        r"positions to draw have shape \(2, 3\): give \(24, 3\)",
        BOX.plot,
        np.zeros((2, 3)),
    )
    refuses(
        InputError,
        r"shape \(2, 24, 3\), and environment is 2",
        Body(BOX).plot,
        np.zeros((2, 24, 3)),
        2,
    )
