"""Bodies of several meshes, halves of bodies and their actuators from YAML.

Tests/dynamics has how they move.
"""

import numpy as np
import pytest

from support.configured import check, composed, settings
from warp_resphys.core.energies.route import Route
from warp_resphys.core.energies.tendons import Tendons
from warp_resphys.core.mesh.boxes import box_hexahedra
from warp_resphys.experiment.actuators import build_muscles
from warp_resphys.experiment.build import build_simulator
from warp_resphys.io.settings import parse
from warp_resphys.settings.body import MuscleSettings

HALVES = [
    "mesh={kind: box_hexahedra, size: [0.05, 0.03, 0.03], divisions: [5, 2, 2]}",
    "parts={tip: {mesh: {kind: box_hexahedra, size: [0.05, 0.03, 0.03], divisions: [5, 3, 3]}, "
    "shift: [0.05, 0, 0]}}",
    "simulation.poissons_ratio=0.45",
]
GLUED = "glued=[{region: tip, at: {x: 0.05}, to: body}]"
BEAM = "mesh={{kind: box_hexahedra, size: [0.1, {}, 0.03], divisions: [10, {}, 2]}}"


def sag(*overrides):
    """The simulator of a configuration, and its equilibrium, (N, 3) [m]."""
    run = settings(*overrides)
    built = build_simulator(run, run.simulation)
    return built, (built.static_equilibrium().q[0] - built.rest_positions).numpy()


def test_halves_that_are_glued_bend_like_one_beam_and_half_of_one_behind_a_plane_like_it():
    nu = "simulation.poissons_ratio=0.45"
    built, glued = sag(*HALVES, GLUED)
    _, half = sag(BEAM.format(0.015, 1), nu, "symmetry={y: 0.015}")
    _, whole = sag(BEAM.format(0.03, 2), nu)
    assert len(built.body.coordinates.dependent) == 16  # the finer side of the interface
    assert whole[:, 2].min() < -1e-3
    assert glued[:, 2].min() == pytest.approx(whole[:, 2].min(), rel=0.03)
    assert half[:, 2].min() == pytest.approx(whole[:, 2].min(), rel=1e-6)
    check(composed(*HALVES, GLUED, "tip={x: 0.1}"))


def test_a_region_of_another_mesh_has_its_own_material_and_may_be_rigid():
    soft, _ = sag(
        *HALVES, GLUED, "simulation.regions={body: {}, tip: {youngs_modulus: 50e3}}", "law=null"
    )
    assert {"body_youngs_modulus", "tip_youngs_modulus"} <= set(soft.parameters)
    # A rigid part is followed; it cannot follow.
    rigid = [
        "glued=[{region: body, at: {x: 0.05}, to: tip}]",
        "rigid={tip: {density: 1240}}",
        "integrator=bdf2",
    ]
    built, moved = sag(*HALVES, *rigid)
    tip = np.unique(built.body.mesh.cells[built.body.mesh.region("tip")])
    rest = built.body.vertices
    spread = [np.linalg.norm(x[tip][:, None] - x[tip], axis=-1) for x in (rest + moved, rest)]
    assert np.abs(spread[0] - spread[1]).max() < 1e-4 * spread[1].max()
    assert np.abs(moved[tip]).max() > 1e-3


def test_tendons_run_straight_between_their_guides_and_muscles_are_in_the_cells_of_their_boxes():
    routes = {
        "left": {"guides": [[0, 0, 0], [0.3, 0, 0], [0.3, 0.4, 0]], "pieces": 5},
        "right": {"guides": [[0, 0, 1], [0, 1, 1]]},
    }
    tendons = Tendons({name: Route(**route) for name, route in routes.items()})
    assert tendons.names == ("left", "right")
    left, right = tendons.guides
    assert (len(left), len(right)) == (11, 2)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(left, axis=0), axis=1), [0.06] * 5 + [0.08] * 5
    )
    np.testing.assert_allclose(left[[0, 5, 10]], routes["left"]["guides"])
    bundles = {
        "root": {"direction": [1, 0, 0], "within": {"x": [0.0, 0.02]}},
        "all": {"direction": [0, 1, 0]},
    }
    settings = parse(MuscleSettings, {"bundles": bundles, "commanded": "stress", "stiffness": 0.0})
    root, everywhere = build_muscles(settings, box_hexahedra((0.04, 0.01, 0.01), (4, 1, 1))).muscles
    assert (list(root.cells), root.name) == ([0, 1], "root")
    assert list(everywhere.cells) == [0, 1, 2, 3]
