"""Obstacles from a configuration: contact of the body and of its target, and robots that keep them."""

from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from support.configured import check, composed, settings
from warp_resphys.energies.contact import Contact
from warp_resphys.energies.obstacles import HalfSpace
from warp_resphys.experiment.actuators import build_contact
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.experiment.report import true_contact
from warp_resphys.experiment.simulate import target_settings
from warp_resphys.io.errors import InputError
from warp_resphys.learning.parameters import constants_of, identifiable_parameters
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.robot.description import Description
from warp_resphys.robot.robot import Robot
from warp_resphys.settings.body import SimulatorSettings
from warp_resphys.stepping.inputs import Inputs
from warp_resphys.studies.live import LiveRobot
from warp_resphys.studies.view import Page

BEAM = "mesh.divisions=[4,1,1]"
FLOOR = "{floor: {shape: half_space, position: [0, 0, -0.005]}}"
TWO = (
    "{floor: {shape: half_space, position: [0, 0, -0.05]}, ball: {shape: sphere, position: [0, 0, 0.1], radius: 0.01}}"
)


def test_regions_of_the_body_have_factors_of_friction():
    run = settings(
        "mesh.divisions=[10,3,3]",
        f"obstacles={FLOOR}",
        "+regions={foot: {x: [0.09, 0.1]}}",
        "contact={friction: 0.2, friction_factors: {foot: 3.0}}",
    )
    body = build_body(run)
    (contact,), x = body.energies, body.vertices[:, 0]
    (points,) = contact.points(body.mesh)
    vertices = points.nodes[:, 0]
    assert points.factors == pytest.approx(np.where(x > 0.095, 3.0, np.where(x > 0.085, 2.0, 1.0))[vertices])
    with pytest.raises(InputError, match="no region 'hand'"):
        build_simulator(run.changed(contact=run.contact.changed(friction_factors={"hand": 1.0})), run.simulation)


def test_without_obstacles_there_is_no_contact():
    assert build_body(settings(BEAM)).energies == ()


def test_the_real_body_touches_the_same_obstacles_unless_it_has_its_own():
    run = settings(BEAM, f"obstacles={FLOOR}", "contact={friction: 0.3}", "target.contact={friction: 0.6}")
    (played,) = build_body(target_settings(run, run.target)).energies
    assert isinstance(played, Contact)
    assert played.obstacles == {"floor": HalfSpace(position=(0.0, 0.0, -0.005))}
    assert (played.friction, build_contact(run).friction) == (0.6, 0.3)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["contact={friction: 0.5}"], r"contact is set, but obstacles has none: name an obstacle"),
        (
            [f"obstacles={FLOOR}", "contact={friction: {wall: 0.5}}"],
            r"values for 'wall', but the obstacles are 'floor'",
        ),
        ([f"obstacles={TWO}", "contact={stiffness: {ball: 1e5}}"], r"contact\.stiffness has values for 'ball'"),
        (["obstacles={floor: {shape: half_space, axis: [0, 0, 0]}}"], r"obstacles\.floor\.axis"),
        (["obstacles={floor: {shape: half_space, position: [0, 0, 0.01]}}"], r"within the obstacle 'floor' at rest"),
    ],
)
def test_obstacles_that_do_not_fit_are_refused(given, said):
    with pytest.raises(InputError, match=said):
        check(composed(BEAM, *given))


def test_a_run_with_control_is_refused():
    floor = "{floor: {shape: half_space, position: [0, 0, -0.5]}}"
    with pytest.raises(InputError, match="reduced model, which has no contact"):
        check(composed("experiment=tendon_rod_control", f"obstacles={floor}"))


def test_parameters_have_a_name_for_each_obstacle():
    run = settings(BEAM, f"obstacles={TWO}", "contact={friction: {floor: 0.1, ball: 0.2}}")
    simulator = build_simulator(run, run.simulation)
    assert {"contact_friction", "contact_friction_floor", "obstacle_x_ball", "obstacle_turn_y_floor"} <= {
        *identifiable_parameters(simulator)
    }
    constants = constants_of(simulator, {"contact_friction_ball": torch.tensor([0.7, 0.8], dtype=torch.float64)})
    assert constants["contact_friction"].tolist() == [[0.1, 0.7], [0.1, 0.8]]


def test_the_truth_of_a_laboratory_is_by_parameter():
    truth = true_contact(settings("experiment=beam_obstacle"))
    assert truth["contact_friction"] == 0.5
    assert truth["obstacle_z"] == pytest.approx(-1.5e-3)


@pytest.fixture(scope="module")
def robot():
    run = settings(BEAM, f"obstacles={FLOOR}", "contact={friction: 0.4}", "integrator=bdf2")
    described = Description(
        "beam",
        "sysid",
        SimulatorSettings.of(run),
        run.simulation,
        box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1)),
        {"obstacle_z": 1e-3, "contact_friction": 0.2},
    )
    return Robot(described)


def test_a_robot_rests_and_falls_on_its_obstacle(robot):
    """A floor 4 mm below the beam, which bends 8 mm under its weight."""
    lowest = float(robot.settle().q[0, :, 2].min())
    assert -4e-3 < lowest < -3e-3
    assert float(robot.with_parameters(obstacle_z=-0.1).settle().q[0, :, 2].min()) < -6e-3
    state = robot.begin()
    for _ in range(30):
        state = robot.step(state)
        assert float(state.q[0, :, 2].min()) > -4e-3


def test_a_saved_robot_keeps_its_obstacles(robot, tmp_path):
    path = tmp_path / "robot.safetensors"
    robot.description.write(path)
    loaded = Robot(Description.read(path))
    (contact,) = loaded.simulator.body.energies
    assert contact == build_contact(robot.description.settings)
    state, again = robot.begin(), loaded.begin()
    for _ in range(12):
        state, again = robot.step(state), loaded.step(again)
    np.testing.assert_array_equal(again.q, state.q)


def test_the_live_view_shows_obstacles_where_its_parameters_put_them(robot):
    server, live, meshes = MagicMock(), LiveRobot(robot), {}
    server.scene.add_mesh_simple.side_effect = lambda name, points, *_, **__: meshes.setdefault(
        name, MagicMock(vertices=points)
    )
    page = Page(server, live)
    before = meshes["/obstacles"].vertices
    live.set_parameter("obstacle_z", 0.0)
    page.run(0.05)
    moved = meshes["/obstacles"].vertices - before
    np.testing.assert_allclose(moved, np.tile([0.0, 0.0, -1e-3 / live.size], (8, 1)), atol=1e-6)


@pytest.mark.slow
def test_the_tentacle_curls_around_its_post_and_not_onto_itself():
    """It goes through the place of the post where that is elsewhere, and lies on it otherwise, far from itself."""
    run = settings("experiment=tentacle_wrap", "mesh.layers=8")
    simulator, post = build_simulator(run, run.simulation), run.obstacles["post"]
    vertices = simulator.body.mesh.vertices
    ends = {}
    for name, shift in {"around": 0.0, "alone": 1.0}.items():
        constants = simulator.prepare({"obstacle_x": simulator.tensor([[shift]])})
        state = simulator.rest_state()
        for number in range(100):
            tension = simulator.tensor([[run.data.input_limit * min(number / 80, 1.0), 0.0]])
            before, inputs = state, Inputs(tendon_tension=tension)
            state, _ = simulator.step(state, inputs, constants)
        ends[name] = state.q[0].numpy()
        if name == "around":
            forces = simulator.contacts(before, state, inputs, constants)[""]
    away = {name: np.linalg.norm((q - post.position)[:, [0, 2]], axis=1) - post.radius for name, q in ends.items()}
    assert away["alone"].min() < -5e-3
    assert 0.0 < away["around"].min() < run.contact.distance
    assert float(forces.normal.sum((1, 2))[0, 0]) < -0.1  # N: it pulls itself against the post.
    layers = np.unique(vertices[:, 2].round(6))
    line = np.stack([ends["around"][np.isclose(vertices[:, 2], z, atol=1e-5)].mean(axis=0) for z in layers])
    tip = line[0] - line[1]
    assert tip[2] > 0.7 * np.linalg.norm(tip)  # The tip points up, where it hangs down at rest.
    far = np.abs(layers[:, None] - layers) > 0.08
    assert np.linalg.norm(line[:, None] - line, axis=2)[far].min() > 0.03
