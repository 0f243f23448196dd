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


@pytest.mark.slow
def test_a_trial_commands_its_inputs(robot):
    live = LiveRobot(robot)
    live.play_trial(warp_resphys.trial_names(robot)[-1])
    motion = live.trial.play(robot)
    (name,) = [name for name in live.trial.inputs if name in robot.inputs]
    given = np.asarray(live.trial.inputs[name]).reshape(-1, len(robot.inputs[name].parts))
    assert np.ptp(given, axis=0).max() > 0.0
    shown = live.trial.shown(motion)
    for number in range(live.trial.steps):
        assert live.step()
        np.testing.assert_allclose(live.inputs[name], given[number])
        np.testing.assert_allclose(live.positions, motion.q[number + 1, 0], rtol=0.0, atol=1e-9)
        for frame in np.flatnonzero(np.isclose(live.trial.times, live.time, atol=1e-9)):
            np.testing.assert_allclose(live.markers, shown[frame], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(live.measured, live.trial.markers[frame], rtol=0.0, atol=1e-9)


@pytest.mark.slow
def test_measured_markers_are_interpolated_linearly_between_frames(robot):
    live = LiveRobot(robot)
    live.play_trial(warp_resphys.trial_names(robot)[0])
    times, seen = live.trial.times, live.trial.markers
    live.time = 0.75 * times[3] + 0.25 * times[4]
    np.testing.assert_allclose(live.measured, 0.75 * seen[3] + 0.25 * seen[4], rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_markers_observed_in_their_own_frame_are_shown_on_the_body(robot):
    description = robot.description
    own = Robot(replace(description, markers=description.markers.changed(frame="own")))
    plain, turned = LiveRobot(Robot(description)), LiveRobot(own)
    name, driven = next(iter(robot.inputs.items()))
    for live in (plain, turned):
        live.play_trial(None)
        live.set_input(name, 0, 0.5 * driven.high[0])
        for _ in range(10):
            live.step()
    observed = own.observe(turned.state)[0].numpy()
    np.testing.assert_allclose(turned.positions, plain.positions, rtol=0.0, atol=1e-9)
    assert np.abs(observed - plain.markers).max() > 1e-4
    np.testing.assert_allclose(turned.markers, plain.markers, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(kabsch(observed, plain.markers).apply(observed), plain.markers, atol=1e-8)
