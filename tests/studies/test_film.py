"""The film of a trial of the small main job."""

import h5py
import imageio_ffmpeg
import numpy as np
import pytest

from support.command_line import outcome, sentence
from warp_resphys.studies.film import motion_of


def test_the_motion_is_that_of_the_evaluation(finished):
    run = finished[0]
    motion = motion_of(run, "150 g", ["simulation", "resphys"])
    with h5py.File(run / "rollouts.h5") as file:
        # Tests are 70 and 150 g.
        known = {name: file[f"{name}_observed"][1] for name in ("simulation", "resphys")}
    assert list(motion.positions) == ["simulation", "resphys"]
    for name, expected in known.items():
        np.testing.assert_allclose(motion.positions[name], expected, rtol=0.0, atol=2e-8)
    assert motion.measured.shape == motion.markers["resphys"].shape == (13, 6, 3)
    assert np.abs(motion.measured - motion.markers["simulation"]).max() > 1e-4
    np.testing.assert_allclose(motion.bound[:, 0], 0.1)
    assert len(motion_of(run, "150 g", ["resphys"], 0.05).times) == 6
    # It was simulated, and the film does not call it measured.
    assert [text for view in motion.film().views for text, _ in view.legend][
        -1
    ] == "vertices of the simulated target"


@pytest.mark.slow
def test_a_command_makes_it(finished, folder, can_draw):
    done = outcome("view", "film", f"run={finished[0]}", "file=motion.mp4", "slower=2")
    assert done.code == 0, done.err
    frames = imageio_ffmpeg.read_frames("motion.mp4")
    told = next(frames)
    assert told["duration"] == pytest.approx(13 * 0.01 * 2.0, rel=0.1)
    first, *_, last = frames
    assert (
        np.abs(np.frombuffer(first, np.uint8).astype(int) - np.frombuffer(last, np.uint8)).max()
        > 100
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["trial=80 g"], "the trial is '80 g': "),
        (["models=[teapot]"], "models names teapot: choose some of "),
        (["slower=0"], "slower is 0: "),
        (["motion=eight_4s"], "no motion was driven in "),
    ],
)
def test_what_cannot_be_filmed_is_said(finished, folder, change, said):
    assert said in sentence("view", "film", f"run={finished[0]}", *change)
