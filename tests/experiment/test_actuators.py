"""Actuators from the configuration: routes and muscles on the body, and the input that drives them."""

import numpy as np

from warp_resphys.experiment.actuators import build_muscles, build_tendons
from warp_resphys.io.settings import parse
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.settings.body import MuscleSettings, TendonSettings


def test_tendons_run_straight_between_their_guides():
    routes = {
        "left": {"guides": [[0, 0, 0], [0.3, 0, 0], [0.3, 0.4, 0]], "pieces": 5},
        "right": {"guides": [[0, 0, 1], [0, 1, 1]]},
    }
    tendons = build_tendons(parse(TendonSettings, {"routes": routes, "commanded": "tension", "stiffness": 0.0}))
    assert tendons.names == ("left", "right")
    left, right = (np.asarray(route) for route in tendons.routes)
    assert (len(left), len(right)) == (11, 2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(left, axis=0), axis=1), [0.06] * 5 + [0.08] * 5)
    np.testing.assert_allclose(left[[0, 5, 10]], routes["left"]["guides"])


def test_muscles_are_in_the_cells_whose_centres_are_in_their_boxes():
    bundles = {"root": {"direction": [1, 0, 0], "within": {"x": [0.0, 0.02]}}, "all": {"direction": [0, 1, 0]}}
    settings = parse(MuscleSettings, {"bundles": bundles, "commanded": "stress", "stiffness": 0.0})
    root, everywhere = build_muscles(settings, box_hexahedra((0.04, 0.01, 0.01), (4, 1, 1))).muscles
    assert (list(root.cells), root.name) == ([0, 1], "root")
    assert list(everywhere.cells) == [0, 1, 2, 3]
