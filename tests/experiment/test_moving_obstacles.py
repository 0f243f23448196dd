"""Obstacles that move in experiments: configured, recorded, drawn and refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.configured import check, composed, settings
from support.main_job import IN_RUN, run
from support.played_run import check_robots
from warp_resphys import Body
from warp_resphys.data.base_motion import prescribed, rigid
from warp_resphys.data.obstacle_motion import contact_inputs, recorded
from warp_resphys.data.recordings.recording import ARM, Recording
from warp_resphys.energies.contact import Contact
from warp_resphys.energies.obstacles import Box, Sphere
from warp_resphys.experiment.files import read_dataset
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.settings import parse
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.report.obstacles import ObstacleSurface
from warp_resphys.settings.trials import MotionSettings

QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN]
PUSHED = [
    "experiment=beam_pushed",
    "mesh.divisions=[6,1,1]",
    "laboratory.mesh.divisions=[6,1,1]",
    "laboratory.time_step=0.01",
    "data.steps=40",
    "identify.max_evaluations=4",
    "identify.substeps=1",
    "in_the_loop.epochs=1",
    "network.width=4",
    "simfree.network={position_modes:3,velocity_modes:3,layers:1,width:8}",
    "simfree.trainer={epochs:4,rollout_every:2}",
    "laboratory.train=[lift1,slide]",
    "laboratory.validation=[mixed]",
    "laboratory.test=[lift2]",
]
MOVES = "swings:{a:{frequency:1.0,translation:[0,0,0.01]}}"
BALL = "{shape: sphere, position: [0.08, 0.015, -0.02], radius: 0.01, moves: true}"


@pytest.fixture(autouse=True)
def _here(folder, no_report):
    """Runs are in a folder of the test, without a report."""


def done(*arguments):
    """metrics.json of a run."""
    code, err = run(*arguments, *QUIET)
    assert (code, err[-600:] if code else "") == (0, "")
    return json.loads(Path("run/metrics.json").read_text())


def swing(**more):
    swings = {"a": {"frequency": 1.0, "translation": (0.01, 0.0, -0.02), "rotation": (0.2, 0.3, -0.1)}}
    return parse(MotionSettings, {"swings": swings, **more})


def test_inputs_of_contact_move_obstacles_rigidly():
    """A turn about a point outside of the obstacle moves its corners as it moves points of space."""
    obstacles = {
        "still": Sphere(radius=0.01, position=(0.0, 0.0, 1.0)),
        "box": Box(edges=(0.02, 0.03, 0.04), moves=True),
    }
    obstacles["box"] = replace(obstacles["box"], position=(0.05, 0.01, -0.1), axis=(0.3, 0.2, 1.0))
    body = Body(box_hexahedra((0.1, 0.02, 0.02), (2, 1, 1)), energies=[Contact(obstacles)])
    poses = prescribed(swing(about=(0.02, 0.0, 0.03)), np.linspace(0.0, 1.0, 7))
    inputs = contact_inputs(body, {"box": poses})
    rest = ObstacleSurface.of(body)
    moved = rest.moved(inputs)
    still, corners = (np.flatnonzero(rest.owners == number) for number in (0, 1))
    np.testing.assert_array_equal(moved.points[:, still], np.broadcast_to(rest.points[still], (7, len(still), 3)))
    expected = rigid(poses).apply(np.broadcast_to(rest.points[corners], (7, len(corners), 3)))
    np.testing.assert_allclose(moved.points[:, corners], expected, atol=1e-15)
    assert np.ptp(expected, axis=0).max() > 0.02
    np.testing.assert_array_equal(moved.at(3).points, moved.points[3])


def shown(poses, places, rate=100.0, labels=("ball",)):
    """A recording of points fixed to an obstacle."""
    points = rigid(poses).apply(np.broadcast_to(places, (len(poses), *np.shape(places))))
    return Recording((*labels, "tip"), np.concatenate([points, points[:, :1]], axis=1), rate, Path("motion.h5"))


def test_a_marker_shows_a_translation_and_a_rigid_body_a_turn():
    times = np.arange(100) / 100.0
    poses = prescribed(swing(start=0.1, ramp=0.1), times)
    places = np.array([0.3, 0.1, -0.2]) + ARM * np.eye(4, 3, -1)
    whole = recorded(shown(poses, places, labels=("ball", "ball +x", "ball +y", "ball +z")), "ball", 0.05)
    np.testing.assert_allclose(whole, poses, atol=2e-6)
    alone = recorded(shown(poses, places[:1]), "ball", 0.05)
    np.testing.assert_allclose(alone[:, :3] + places[0], shown(poses, places[:1]).positions[:, 0], atol=2e-6)
    assert not alone[:, 3:].any()


def test_a_marker_that_does_not_show_its_obstacle_is_refused():
    recording = shown(np.zeros((50, 6)), np.zeros((1, 3)))
    with pytest.raises(DataFileError, match=r"no marker or rigid body 'bar', which shows the motion of this obstacle"):
        recorded(recording, "bar", 0.05)
    recording.positions[:10, 0] = np.nan
    assert not recorded(recording, "ball", 0.2).any()
    with pytest.raises(DataFileError, match=r"'ball' is not seen in the first 0\.05 s"):
        recorded(recording, "ball", 0.05)
    recording.positions[:40:2, 0] = recording.positions[10:, 0] = np.nan
    recording.positions[3, 0] = 0.0
    with pytest.raises(DataFileError, match=r"the obstacle 'ball' moves, and its marker is seen in 2 % of the frames"):
        recorded(recording, "ball", 0.05)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            [f"data.obstacle_motion={{bar:{{{MOVES}}}}}"],
            r"data\.obstacle_motion\.bar is of 'bar', but obstacles has 'ball'",
        ),
        (
            [f"data.obstacle_motion={{ball:{{{MOVES}}}}}", "obstacles.ball.moves=false"],
            r"data\.obstacle_motion\.ball moves 'ball': set obstacles\.ball\.moves to true",
        ),
        (
            [
                f"data.obstacle_motion={{ball:{{{MOVES}}}}}",
                "target.obstacles={wall: {shape: half_space, position: [0,0,-1]}}",
            ],
            r"is of 'ball', but target\.obstacles has 'wall'",
        ),
        (["data.obstacle_motion={ball: recorded}"], r"data\.obstacle_motion\.ball"),
        (["data.obstacle_motion={ball: {swings: {a: {frequency: 80}}}}"], r"steps of 0\.01 s resolve less than 50 Hz"),
    ],
)
def test_a_motion_without_its_obstacle_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        check(composed("mesh.divisions=[4,1,1]", f"+obstacles={{ball: {BALL}}}", *given))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["markers.labels=assigned"], r"recorded by a marker of its name, but markers\.labels is assigned"),
        (["markers.frame=own"], r"markers\.frame is own, but base_motion and obstacle_motion"),
        (["laboratory.trials.mixed.begins=static"], r"'mixed' is a static pose: obstacles cannot move in it"),
        (
            ["+laboratory.trials.mixed.obstacle_motion.wall={file: wall.csv}"],
            r"laboratory\.trials\.mixed\.obstacle_motion\.wall is of 'wall', but obstacles has 'bar'",
        ),
    ],
)
def test_recorded_motions_that_do_not_fit_are_refused(given, said):
    with pytest.raises(InputError, match=said):
        check(composed("experiment=beam_pushed", *given))


@pytest.mark.slow
def test_a_recorded_bar_pushes_the_beam_of_the_laboratory_and_of_the_models():
    results = done(*PUSHED)
    dataset, configured = read_dataset(Path("run/dataset.h5")), settings(*PUSHED)
    poses = dataset.obstacles["bar"]
    for row, name in enumerate(dataset.names):
        trial = configured.laboratory.trials[name].obstacle_motion["bar"]
        np.testing.assert_allclose(poses[row], prescribed(trial, 0.01 * np.arange(41)), atol=3e-4)
    assert np.abs(poses[..., :3]).max() > 0.014
    assert not poses[..., 3:].any()
    errors = results["errors_mm"]
    assert errors["sysid"]["mean"] < 0.2 * errors["rest"]["mean"]
    check_robots("run", tolerance=1e-7)
