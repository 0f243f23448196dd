"""A driven robot with markers that is stepped as time goes on."""

from dataclasses import replace

import numpy as np
import pytest

import warp_resphys
from warp_resphys.data.rigid import kabsch
from warp_resphys.robot.robot import Robot
from warp_resphys.studies.live import LiveRobot


@pytest.fixture(scope="module")
def robot(folder):
    return warp_resphys.load(folder)


def test_a_trial_commands_its_inputs(robot):
    live = LiveRobot(robot)
    live.play_trial(warp_resphys.trial_names(robot)[-1])
    motion = live.trial.play(robot)
    (name,) = (each for each in live.trial.inputs if each in robot.inputs)
    given = np.asarray(live.trial.inputs[name]).reshape(-1, len(robot.inputs[name].parts))
    assert np.ptp(given, axis=0).max() > 0.0
    shown = live.trial.shown(motion)
    for number in range(live.trial.steps):
        assert live.step()
        np.testing.assert_allclose(live.inputs[name], given[number])
        np.testing.assert_allclose(live.positions, motion.q[number + 1, 0], rtol=0.0, atol=1e-9)
        frame = np.flatnonzero(np.isclose(live.trial.times, live.time, atol=1e-9))
        for known in frame:
            np.testing.assert_allclose(live.markers, shown[known], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(live.measured, live.trial.markers[known], rtol=0.0, atol=1e-9)


def test_between_frames_what_was_measured_is_linear_in_time(robot):
    live = LiveRobot(robot)
    live.play_trial(warp_resphys.trial_names(robot)[0])
    times, seen = live.trial.times, live.trial.markers
    live.time = 0.75 * times[3] + 0.25 * times[4]
    np.testing.assert_allclose(live.measured, 0.75 * seen[3] + 0.25 * seen[4], rtol=0.0, atol=1e-12)


def test_markers_that_are_seen_in_a_frame_of_their_own_are_shown_on_the_body(robot):
    known = robot.description
    own = Robot(replace(known, markers=known.markers.changed(frame="own")))
    plain, turned = LiveRobot(Robot(known)), LiveRobot(own)
    for live in (plain, turned):
        live.play_trial(None)
        live.set_input(next(iter(robot.inputs)), 0, 0.5 * robot.inputs[next(iter(robot.inputs))].high[0])
        for _ in range(10):
            live.step()
    told = own.observe(turned.state)[0].numpy()
    np.testing.assert_allclose(turned.positions, plain.positions, rtol=0.0, atol=1e-9)
    assert np.abs(told - plain.markers).max() > 1e-4
    np.testing.assert_allclose(turned.markers, plain.markers, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(kabsch(told, plain.markers).apply(told), plain.markers, atol=1e-8)
