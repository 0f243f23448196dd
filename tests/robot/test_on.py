"""The material of a robot on another body."""

import pytest
import torch

from support.configured import settings
from warp_resphys import Body, Simulator, box_hexahedra, select_vertices
from warp_resphys.energies.materials import ConvexMaterial
from warp_resphys.io.errors import InputError, MeshError
from warp_resphys.robot.description import Description
from warp_resphys.robot.robot import Robot
from warp_resphys.settings.body import MaterialSettings, SimulatorSettings

LAW = {"c10": 30e3, "ogden_3": 20e3, "bulk_1": 4e6, "prony_modulus_1": 1e4, "prony_time_1": 0.05, "density": 1000.0}
OF_THE_ROBOT = {"mass_damping": 9.0}
LONG = box_hexahedra((0.15, 0.02, 0.02), (6, 1, 1))


@pytest.fixture(scope="module")
def robot():
    run = settings("mesh={kind:box_hexahedra,size:[0.1,0.03,0.03],divisions:[4,1,1]}")
    material = MaterialSettings.model_validate({"model": "law", **LAW, **OF_THE_ROBOT})
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
    described = Description("beam", "law", SimulatorSettings.of(run), material, mesh, {"c10": 44e3, **OF_THE_ROBOT})
    return Robot(described)


def test_its_law_moves_the_other_body_as_a_simulator_of_it_does(robot):
    other = robot.on(LONG, fixed={"x": 0.0})
    material = ConvexMaterial(44e3, bulk_1=4e6, density=1000.0, ogden={3: 20e3}, prony=[(1e4, 0.05)])
    alone = Simulator(Body(LONG, fixed=select_vertices(LONG, x=0.0)), material)
    state, expected = other.state(LONG.vertices), alone.rest_state()
    for _ in range(3):
        state, expected = other.step(state), alone.step(expected)[0]
    torch.testing.assert_close(state.q, expected.q, rtol=0.0, atol=1e-9)
    assert (state.q - alone.rest_positions).abs().max() > 1e-3


def test_it_has_no_force_and_no_markers(robot):
    other = robot.on(LONG, fixed={"x": 0.0}).description
    assert (other.learned, other.markers, other.intervals) == (None, None, None)


def test_what_does_not_fit_is_refused(robot):
    with pytest.raises(InputError, match="no_such_key"):
        robot.on(LONG, no_such_key=1)
    with pytest.raises(MeshError, match="no vertex"):
        robot.on(LONG, fixed={"x": 5.0})
