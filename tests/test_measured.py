"""Recordings of a body, real or simulated, become markers in its frame; what cannot is refused by file and marker."""

import json

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from warp_resphys.configured import build_body
from warp_resphys.files import read_hdf5
from warp_resphys.stages import run_stages
from warp_resphys.tasks.checks import check_configuration
from warp_resphys.tasks.measured.files import MARKERS, QUALITY, REGISTRATION, TRUTH, read_motions
from warp_resphys.tasks.measured.stages import import_stages
from warp_resphys.tasks.measured.synthesise import make_scene, reality, simulate
from warp_resphys.tasks.measured.trials import trials_of

TIPS, BASES = [f"Tip - {i}" for i in (1, 2, 3)], [f"Base - {i}" for i in (1, 2, 3)]
RATE = 100.0
SMALL = [
    "synthetic.mesh.divisions=[6,2,2]",
    "synthetic.time_step=0.005",
    "synthetic.seconds=0.6",
    "data.seconds=0.5",
    "synthetic.train=[m0,m50]",
    "synthetic.validation=[]",
    "synthetic.test=[m90]",
]


def configuration(*overrides):
    with initialize_config_module("warp_resphys.conf", version_base="1.3"):
        composed = compose("config", ["experiment=beam_real", *overrides])
    return OmegaConf.to_container(composed, resolve=True)


def read_json(path):
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A run of the first stages without recordings."""
    folder = tmp_path_factory.mktemp("laboratory")
    config = configuration(*SMALL)
    check_configuration(config)
    run_stages(import_stages(config), folder)
    return folder, config


def simulated_again(folder, config, times):
    """(R, T, M, 3) the true markers in the frame in which the body is exactly as drawn [m]."""
    scene = make_scene(config)
    return scene, simulate(config, reality(config, scene.gravity), scene, trials_of(config), times)


def test_simulated_markers_come_back_within_noise(laboratory):
    folder, config = laboratory
    motions, bound, labels, _ = read_motions(folder / MARKERS, build_body(config), config["data"]["hung_on"])
    assert motions.names == ("m0", "m50", "m90")
    assert labels == tuple(TIPS)
    np.testing.assert_allclose(motions.attached_mass.sum(1), [0.0, 0.05, 0.09], atol=1e-12)
    scene, true = simulated_again(folder, config, motions.times.numpy())
    # Registration to nominal places turns and moves the body a little; the shape of the motion is what comes back.
    turn, _ = Rotation.align_vectors(bound - bound.mean(0), scene.followed - scene.followed.mean(0))
    assert np.degrees(turn.magnitude()) < 1.0
    moved = turn.apply((true - scene.followed).reshape(-1, 3)).reshape(true.shape)
    off = (motions.markers.numpy() - bound - moved)[motions.seen.numpy()]
    noise, amplitude = config["synthetic"]["noise"], float(motions.amplitude.max())
    assert amplitude > 0.01
    assert np.sqrt(np.mean(off**2)) < 1.0 * noise + 0.1 * noise + 0.01 * amplitude
    torch.testing.assert_close(motions.held, torch.as_tensor(bound).expand(3, -1, -1), rtol=0.0, atol=1e-12)
    registration = read_json(folder / REGISTRATION)
    assert registration["m50"]["rms_mm"] < 0.6
    assert max(abs(x) for shift in registration["m50"]["shift_mm"].values() for x in shift) < 0.1


def test_gravity_and_release_are_recovered(laboratory):
    folder, config = laboratory
    truth, quality = read_json(folder / TRUTH), read_json(folder / QUALITY)
    with read_hdf5(folder / MARKERS, "markers") as file:
        gravity = np.asarray(file.attrs["gravity"])
    true = np.array(truth["gravity"])
    lean = np.degrees(np.arccos(gravity @ true / np.linalg.norm(gravity) / np.linalg.norm(true)))
    assert lean < 0.5
    assert np.linalg.norm(gravity) == pytest.approx(9.80709)
    tilt = np.degrees(np.arccos(-true[2] / np.linalg.norm(true)))
    assert tilt == pytest.approx(config["synthetic"]["tilt"])
    for name, at in truth["released_s"].items():
        assert quality[name]["release_frame"] == pytest.approx(RATE * at, abs=0.3)
        assert 40.0 < RATE * at < 41.0
