"""Contact from a configuration: obstacles, which may move, and surfaces of the body.

Robots that keep it.
"""

from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from support.configured import settings
from support.main_job import run_without_report
from support.played_run import check_robots
from warp_resphys import (
    Body,
    Contact,
    DataFileError,
    HalfSpace,
    InputError,
    Robot,
    SurfaceContact,
    Twin,
    box_hexahedra,
)
from warp_resphys.core.energies.contact.obstacle_surface import ObstacleSurface
from warp_resphys.data.base_motion import contact_inputs, prescribed, rigid
from warp_resphys.data.recordings.processing import obstacle_motion
from warp_resphys.data.recordings.recording import ARM, Recording
from warp_resphys.data.trials import Trials
from warp_resphys.energies import Box, FrictionPair, Sphere
from warp_resphys.experiment.build import build_body, build_simulator
from warp_resphys.experiment.report import true_contact
from warp_resphys.experiment.simulate import target_settings
from warp_resphys.io.safe_files import read_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.parameters import constants_of, identifiable_parameters
from warp_resphys.robot.description import Description
from warp_resphys.settings.body import SimulatorSettings
from warp_resphys.settings.performed import MotionSettings
from warp_resphys.studies.live import LiveRobot
from warp_resphys.studies.view import Page

BEAM = "mesh.divisions=[4,1,1]"
FLOOR = "{floor: {shape: half_space, position: [0, 0, -0.005]}}"
TWO = (
    "{floor: {shape: half_space, position: [0, 0, -0.05]}, ball: {shape: sphere, position: [0, "
    "0, 0.1], radius: 0.01}}"
)
LOWER = (
    "{mesh: {kind: box_hexahedra, size: [0.1, 0.03, 0.06], divisions: [4, 1, 1]}, shift: [0.0, "
    "0.0, -0.062]}"
)
ABOVE = (
    BEAM,
    f"parts={{lower: {LOWER}}}",
    "self_contact={friction: 0.3, distance: 5e-4, stiffness: 2e4}",
)


def simulator_of(*overrides):
    run = settings(*overrides)
    return build_simulator(run, run.simulation)


def test_regions_have_factors_of_friction_and_parameters_a_name_for_each_obstacle():
    run = settings(
        *("mesh.divisions=[10,3,3]", f"obstacles={FLOOR}", "+regions={foot: {x: [0.09, 0.1]}}"),
        "contact={friction: 0.2, friction_factors: {foot: 3.0}}",
    )
    body = build_body(run)
    (contact,), x = body.energies, body.vertices[:, 0]
    (points,) = contact.points(body.mesh)
    vertices = points.nodes[:, 0]
    assert points.factors == pytest.approx(
        np.where(x > 0.095, 3.0, np.where(x > 0.085, 2.0, 1.0))[vertices]
    )
    with pytest.raises(InputError, match="no region 'hand'"):
        build_simulator(
            run.changed(contact=run.contact.changed(friction_factors={"hand": 1.0})), run.simulation
        )
    simulator = simulator_of(
        BEAM, f"obstacles={TWO}", "contact={friction: {floor: 0.1, ball: 0.2}}"
    )
    assert {
        "contact_friction",
        "contact_friction_floor",
        "obstacle_x_ball",
        "obstacle_turn_y_floor",
    } <= {*identifiable_parameters(simulator)}
    constants = constants_of(
        simulator, {"contact_friction_ball": torch.tensor([0.7, 0.8], dtype=torch.float64)}
    )
    assert constants["contact_friction"].tolist() == [[0.1, 0.7], [0.1, 0.8]]


def test_the_real_body_touches_the_same_obstacles_unless_it_has_its_own():
    run = settings(
        BEAM, f"obstacles={FLOOR}", "contact={friction: 0.3}", "target.contact={friction: 0.6}"
    )
    (played,) = build_body(target_settings(run, run.target)).energies
    assert isinstance(played, Contact)
    assert played.obstacles == {"floor": HalfSpace(position=(0.0, 0.0, -0.005))}
    (touching,) = build_body(run).energies
    assert (played.friction, touching.friction) == (0.6, 0.3)
    truth = true_contact(settings("experiment=beam_obstacle"))
    assert truth["contact_friction"] == 0.5
    assert truth["obstacle_z"] == pytest.approx(-1.5e-3)


def robot_of(run, parameters):
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
    return Robot(
        Description("beam", "sysid", SimulatorSettings.of(run), run.simulation, mesh, parameters)
    )


@pytest.fixture(scope="module")
def robot():
    run = settings(BEAM, f"obstacles={FLOOR}", "contact={friction: 0.4}", "integrator=bdf2")
    return robot_of(run, {"obstacle_z": 1e-3, "contact_friction": 0.2})


def test_a_robot_rests_and_falls_on_its_obstacle_and_keeps_it_in_its_file(robot, tmp_path):
    """A floor 4 mm below the beam, which bends 8 mm under its weight."""
    path = tmp_path / "robot.safetensors"
    robot.description.write(path)
    loaded = Robot(Description.read(path))
    (contact,) = loaded.simulator.body.energies
    configured = robot.description.settings
    assert contact == Contact(configured.obstacles, **dict(configured.contact))
    assert -4e-3 < float(robot.settle().q[0, :, 2].min()) < -3e-3
    assert float(robot.with_parameters(obstacle_z=-0.1).settle().q[0, :, 2].min()) < -6e-3
    state, again = robot.begin(), loaded.begin()
    for _ in range(30):
        state, again = robot.step(state), loaded.step(again)
        assert float(state.q[0, :, 2].min()) > -4e-3
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


class TestSurfaces:
    def test_contact_and_friction_of_pairs_of_regions_are_configured_and_identified(self):
        assert build_body(settings(*ABOVE)).energies == (SurfaceContact(2e4, 0.3, 5e-4, 1e-3),)
        assert build_body(settings(BEAM)).energies == ()
        simulator = simulator_of(*ABOVE)
        assert {"surface_friction", "surface_stiffness"} <= {*identifiable_parameters(simulator)}
        given = {"surface_friction": torch.tensor([0.1, 0.7], dtype=torch.float64)}
        assert constants_of(simulator, given)["surface_friction"].tolist() == [[0.1], [0.7]]
        pairs = "self_contact.pairs={pad: {first: lower, second: body, friction: 0.8}}"
        simulator = simulator_of(*ABOVE, pairs)
        (contact,) = simulator.body.energies
        assert contact.pairs == {"pad": FrictionPair(first="lower", second="body", friction=0.8)}
        given = {"surface_friction_pad": torch.tensor([0.5, 0.6], dtype=torch.float64)}
        assert given.keys() <= {*identifiable_parameters(simulator)}
        assert constants_of(simulator, given)["surface_friction"].tolist() == [
            [0.3, 0.5],
            [0.3, 0.6],
        ]
        with pytest.raises(
            InputError, match=r"the pair 'pad' of a contact between surfaces: .*shell"
        ):
            build_body(settings(*ABOVE, pairs.replace("body", "shell")))

    def test_a_beam_lies_on_another_one_which_a_twin_refuses(self):
        """The upper beam bends more than the thicker one below:
        in equilibrium its end lies on it.
        """
        upper, gaps = torch.arange(20 + 20) < 20, []
        for given in (ABOVE, ABOVE[:2]):
            simulator = simulator_of(*given, "integrator=bdf2")
            q, end = simulator.static_equilibrium().q[0], simulator.rest_positions[:, 0] > 0.09
            gaps.append(float(q[upper & end, 2].min() - q[~upper & end, 2].max()))
        touching, free = gaps
        assert free < -1e-3 < 0.0 < touching < 1e-3
        with pytest.raises(InputError, match="contact between surfaces"):
            Twin(robot_of(settings(BEAM, "self_contact={friction: 0.3}", "integrator=bdf2"), {}))


def swing(**more):
    swings = {
        "a": {"frequency": 1.0, "translation": (0.01, 0.0, -0.02), "rotation": (0.2, 0.3, -0.1)}
    }
    return parse(MotionSettings, {"swings": swings, **more})


def shown(poses, places, rate=100.0, labels=("ball",)):
    """A recording of points fixed to an obstacle."""
    points = rigid(poses).apply(np.broadcast_to(places, (len(poses), *np.shape(places))))
    return Recording(
        (*labels, "tip"), np.concatenate([points, points[:, :1]], axis=1), rate, Path("motion.h5")
    )


class TestMotions:
    def test_inputs_of_contact_move_obstacles_rigidly(self):
        """A turn about a point outside of the obstacle moves its corners
        as it moves points of space.
        """
        box = Box(
            edges=(0.02, 0.03, 0.04), position=(0.05, 0.01, -0.1), axis=(0.3, 0.2, 1.0), moves=True
        )
        obstacles = {"still": Sphere(radius=0.01, position=(0.0, 0.0, 1.0)), "box": box}
        body = Body(box_hexahedra((0.1, 0.02, 0.02), (2, 1, 1)), energies=[Contact(obstacles)])
        poses = prescribed(swing(about=(0.02, 0.0, 0.03)), np.linspace(0.0, 1.0, 7))
        rest = ObstacleSurface.of(body)
        moved = rest.moved(contact_inputs(body, {"box": poses}))
        still, corners = (np.flatnonzero(rest.owners == number) for number in (0, 1))
        np.testing.assert_array_equal(
            moved.points[:, still], np.broadcast_to(rest.points[still], (7, len(still), 3))
        )
        expected = rigid(poses).apply(np.broadcast_to(rest.points[corners], (7, len(corners), 3)))
        np.testing.assert_allclose(moved.points[:, corners], expected, atol=1e-15)
        assert np.ptp(expected, axis=0).max() > 0.02
        np.testing.assert_array_equal(moved.at(3).points, moved.points[3])

    def test_a_marker_shows_a_translation_and_a_rigid_body_a_turn_or_they_are_refused(self):
        poses = prescribed(swing(start=0.1, ramp=0.1), np.arange(100) / 100.0)
        places = np.array([0.3, 0.1, -0.2]) + ARM * np.eye(4, 3, -1)
        whole = obstacle_motion(
            shown(poses, places, labels=("ball", "ball +x", "ball +y", "ball +z")), "ball", 0.05
        )
        np.testing.assert_allclose(whole, poses, atol=2e-6)
        alone = obstacle_motion(shown(poses, places[:1]), "ball", 0.05)
        np.testing.assert_allclose(
            alone[:, :3] + places[0], shown(poses, places[:1]).positions[:, 0], atol=2e-6
        )
        assert not alone[:, 3:].any()
        recording = shown(np.zeros((50, 6)), np.zeros((1, 3)))
        with pytest.raises(
            DataFileError, match="no marker or rigid body 'bar', which shows the motion of this"
        ):
            obstacle_motion(recording, "bar", 0.05)
        recording.positions[:10, 0] = np.nan
        assert not obstacle_motion(recording, "ball", 0.2).any()
        with pytest.raises(DataFileError, match=r"'ball' is not seen in the first 0\.05 s"):
            obstacle_motion(recording, "ball", 0.05)
        recording.positions[:40:2, 0] = recording.positions[10:, 0] = np.nan
        recording.positions[3, 0] = 0.0
        with pytest.raises(
            DataFileError, match="'ball' moves, and its marker is seen in 2 % of the frames"
        ):
            obstacle_motion(recording, "ball", 0.05)

    @pytest.mark.slow
    def test_a_recorded_bar_pushes_the_beam_of_the_laboratory_and_of_the_models(self, tmp_path):
        pushed = [
            "experiment=beam_pushed",
            "mesh.divisions=[6,1,1]",
            "laboratory.mesh.divisions=[6,1,1]",
            "laboratory.time_step=0.01",
            "data.steps=40",
            "identify.max_evaluations=4",
            "identify.substeps=1",
            "in_the_loop.epochs=1",
            "network.width=4",
            "simfree.trainer={epochs:4,rollout_every:2}",
            "simfree.network={position_modes:3,velocity_modes:3,layers:1,width:8}",
            "laboratory.train=[lift1,slide]",
            "laboratory.validation=[mixed]",
            "laboratory.test=[lift2]",
        ]
        folder = run_without_report(tmp_path, *pushed)
        dataset, configured = Trials.read(folder / "dataset.h5"), settings(*pushed)
        poses = dataset.obstacles["bar"]
        for row, name in enumerate(dataset.names):
            trial = configured.laboratory.trials[name].obstacle_motion["bar"]
            np.testing.assert_allclose(
                poses[row], prescribed(trial, 0.01 * np.arange(41)), atol=3e-4
            )
        assert np.abs(poses[..., :3]).max() > 0.014
        assert not poses[..., 3:].any()
        errors = read_json(folder / "metrics.json")["errors_mm"]
        assert errors["sysid"]["mean"] < 0.2 * errors["rest"]["mean"]
        check_robots(folder, tolerance=1e-7)
