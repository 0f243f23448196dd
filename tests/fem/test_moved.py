"""A body in another place, with its actuators, moves as the first one does there."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.chambered import hollow_box
from support.clamped import clamped
from warp_resphys import Corotated, Fibres, Inputs, Muscles, Pressure, Simulator, SymmetryPlane, Tendons, box_hexahedra
from warp_resphys.energies import Muscle
from warp_resphys.io.errors import InputError
from warp_resphys.mesh import find_chambers
from warp_resphys.settings.body import Route

ROTATION = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
SHIFT = np.array([0.1, -0.2, 0.05])  # m
BOX = box_hexahedra((0.1, 0.02, 0.02), (5, 1, 1))
HOLLOW = hollow_box("hexahedron")
CHAMBER = [max(find_chambers(HOLLOW), key=lambda own: len(own.faces))]  # longer than it is wide
ROUTE = [[0.0, 0.015, 0.01], [0.05, 0.015, 0.012], [0.1, 0.015, 0.01]]
BODIES = {
    "tendon": (
        clamped(BOX, energies=[Tendons([Route(guides=ROUTE, offsets=[[0.0, 0.0, 1.0]])])]),
        {"tendon_tension": 0.4},
        {"tendon_offset_1": 2e-3},
    ),
    "muscle": (clamped(BOX, energies=[Muscles([Muscle([2, 3], (1.0, 0.5, 0.0))])]), {"muscle_stress": 2e4}, {}),
    "chamber": (
        clamped(HOLLOW, energies=[Pressure(CHAMBER), Fibres(CHAMBER, [20.0], axis=(1.0, 0.2, 0.1), stiffness=1e3)]),
        {"pressure": 3e4},
        {},
    ),
}


@pytest.mark.parametrize("name", BODIES)
def test_the_motion_moves_with_the_body(name):
    body, given, parameters = BODIES[name]
    gravity = np.array([0.0, 3.0, -9.0])
    material, ends = Corotated(2e5, 0.4), []
    for own, pull in ((body, gravity), (body.moved(ROTATION, SHIFT), ROTATION @ gravity)):
        simulator = Simulator(own, material, 0.01, tuple(pull), relative_tolerance=1e-11)
        ends.append(simulator.rollout(simulator.rest_state(), 5, Inputs(**given), parameters).q[-1, 0].numpy())
    without = Simulator(body, material, 0.01, tuple(gravity))
    free = without.rollout(without.rest_state(), 5).q[-1, 0].numpy()
    assert np.abs(ends[0] - free).max() > 1e-4  # The actuator does something.
    np.testing.assert_allclose(ends[1], ends[0] @ ROTATION.T + SHIFT, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("rotation", [np.diag([1.0, 1.0, -1.0]), [0.0, 0.0, 1.0]])
def test_a_matrix_that_is_no_rotation_is_refused(rotation):
    with pytest.raises(InputError, match="the rotation is"):
        BODIES["tendon"][0].moved(rotation, SHIFT)


def test_a_symmetric_body_stays():
    with pytest.raises(InputError, match="symmetry plane"):
        clamped(BOX, symmetry=[SymmetryPlane((0.0, 1.0, 0.0))]).moved(ROTATION, SHIFT)
