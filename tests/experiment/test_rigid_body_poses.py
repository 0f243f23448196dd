"""A rigid body on a hanging cap: its mounting follows from the pose of its part,
and is refused where none shows it.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.configured import settings
from warp_resphys.data.recordings.recording_files import read_recording, write_recording
from warp_resphys.data.rigid_bodies import angles, motion_between
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.files import DATASET, TRUTH
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.resuming import run_stages
from warp_resphys.io.safe_files import read_json
from warp_resphys.pipeline import acquisition_stages

# The laboratory is the simulator, so that the cap hangs where the import expects it.
HANGS = [
    *("experiment=beam_regions", "~markers.tracked", "markers.rigid_bodies={plate: {part: cap}}"),
    "mesh.divisions=[10,1,1]",
    "laboratory.mesh.divisions=[10,1,1]",
    "simulation.youngs_modulus=100e3",
    "laboratory.material={model: corotated, youngs_modulus: 100e3, poissons_ratio: 0.499, "
    "density: 1070.0}",
    "laboratory.material.regions={root: {}, tip: {youngs_modulus: 100e3}}",
    "simulation.regions={root: {}, tip: {youngs_modulus: 100e3}}",
    "laboratory.noise=1e-7",
    "laboratory.placement_noise=0",
    "laboratory.tilt=0",
    "laboratory.validation=[]",
    "laboratory.trials={p0: {begins: static}, p30: {begins: static, payload: 0.03}}",
]
SPLIT = ("laboratory.train=[p0]", "laboratory.test=[p30]")
BASES = {
    "Base - 1": [0.006, -0.01, -0.001],
    "Base - 2": [0.006, 0.04, 0.0275],
    "Base - 3": [0.006, 0.04, 0.0],
}


def imported(folder, *overrides):
    """The dataset of a run of the first stages."""
    run_stages(acquisition_stages(settings(*HANGS, *overrides)), folder)
    return Trials.read(folder / DATASET)


def recorded(folder, train, test):
    return f"data.folder={folder}", "~data.folds", f"data.train=[{train}]", f"data.test=[{test}]"


def test_a_hanging_part_shows_the_mounting(tmp_path):
    dataset = imported(tmp_path, *SPLIT)
    true = np.array([read_json(tmp_path / TRUTH)["bound"][label] for label in dataset.labels])
    moved = motion_between(true, dataset.observed[0, 0])
    assert np.degrees(Rotation.from_matrix(moved.rotation).magnitude()) > 10.0  # It hangs far down.
    np.testing.assert_allclose(dataset.bound, true, atol=2e-5)
    assert np.degrees(angles(true, dataset.bound)) < 0.01


def test_a_mounting_that_no_trial_shows_is_refused(tmp_path):
    loaded = (
        "laboratory.trials={p20: {begins: static, payload: 0.02}, "
        "p30: {begins: static, payload: 0.03}}"
    )
    with pytest.raises(
        InputError, match=r"rigid_bodies\.plate: its mounting on the body is unknown, as no trial"
    ):
        imported(tmp_path, loaded, "laboratory.train=[p20]", "laboratory.test=[p30]")


@pytest.mark.parametrize(
    ("angle", "train", "test"), [(120.0, "p0", "other"), (5.0, "p0, other", "p30")]
)
def test_a_rigid_body_that_was_remounted_is_refused(tmp_path, angle, train, test):
    """By 120 degrees in a test trial.

    By 5 degrees, 5 mm at its points, between two trials of the training.
    """
    imported(tmp_path / "played", *SPLIT)
    recording = read_recording(tmp_path / "played" / "recordings" / "p0.h5")
    positions = recording.positions.copy()
    arms = [recording.labels.index(f"plate +{axis}") for axis in "xyz"]
    place = positions[:, [recording.labels.index("plate")]]
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(angle)]).as_matrix()
    positions[:, arms] = place + (positions[:, arms] - place) @ turn.T
    write_recording(tmp_path / "p0.h5", recording)
    write_recording(tmp_path / "other.h5", replace(recording, positions=positions))
    write_recording(
        tmp_path / "p30.h5", read_recording(tmp_path / "played" / "recordings" / "p30.h5")
    )
    trials = "p0: {file: p0.h5, begins: static}, other: {file: other.h5, begins: static}"
    given = f"data.trials={{{trials}, p30: {{file: p30.h5, begins: static, payload: 0.03}}}}"
    message = (
        rf"other\.h5: 'plate' is 0\.0 mm and {angle} degrees from its mounting in p0\.h5: "
        "where it was remounted"
    )
    with pytest.raises(InputError, match=message):
        imported(tmp_path, given, *recorded(tmp_path, train, test))


def test_a_rest_without_an_orientation_is_refused(tmp_path):
    """Markers that stand still, of which 'plate' is a rigid body."""
    places = {"plate": [0.095, 0.015, 0.015], **BASES}
    turns = np.where(np.array([*places])[:, None] == "plate", [1.0, 0.0, 0.0, 0.0], np.nan)
    x, turned = (np.repeat(np.array(own)[None], 20, 0) for own in ([*places.values()], turns))
    for name in "ab":
        own = {"positions": x, "quaternions": turned, "rest": x[0]}
        np.savez(tmp_path / f"{name}.npz", labels=[*places], rate_hz=100.0, **own)
    trials = "data.trials={a: {file: a.npz, begins: released}, b: {file: b.npz, begins: released}}"
    options = (trials, "data.rest=file", "data.seconds=0.1", "release.sideways=0")
    with pytest.raises(
        DataFileError, match=r"a\.npz: 'rest' has no orientation of 'plate': set data\.rest to held"
    ):
        imported(tmp_path, *options, *recorded(tmp_path, "a", "b"))
