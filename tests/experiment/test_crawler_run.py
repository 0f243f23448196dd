"""A body that is fixed nowhere and crawls by friction: its trials, its identification, its models and its refusals."""

import json
from pathlib import Path

import numpy as np
import pytest

from support.configured import check, composed, settings
from support.main_job import IN_RUN, run
from support.played_run import check_robots
from warp_resphys.data.actuation import InputWaves
from warp_resphys.experiment.files import read_dataset
from warp_resphys.experiment.report import read_recordings
from warp_resphys.io.errors import ResphysError
from warp_resphys.robot.loading import load

OTHER = "{youngs_modulus: 7.5e4, poissons_ratio: 0.45, density: 1070, model: corotated, stiffness_damping: 8.0e-3}"
CRAWLS = [
    "experiment=crawler",
    "mesh.divisions=[6,1,2]",
    "laboratory.mesh.divisions=[6,1,2]",
    "laboratory.time_step=0.01",
    "~laboratory.material",
    f"+laboratory.material={OTHER}",
    "laboratory.placement_noise=0.0",
    "data.steps=100",
    "data.horizons=[1.0]",
    "network.width=4",
    "trainer.epochs=4",
    "trainer.rollout_every=2",
    "simfree.network={position_modes:3,velocity_modes:3,layers:1,width:8}",
    "simfree.trainer={epochs:4,rollout_every:2}",
    "laboratory.train=[fast,back]",
    "laboratory.validation=[between]",
    "laboratory.test=[faster]",
]


@pytest.fixture(autouse=True)
def _here(folder, no_report):
    """Runs are in a folder of the test, without a report."""


@pytest.mark.slow
def test_a_crawler_shows_friction_and_stiffness_of_a_laboratory_that_lacks_nothing():
    code, err = run(*CRAWLS, "hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN)
    assert (code, err[-600:] if code else "") == (0, "")
    results = json.loads(Path("run/metrics.json").read_text())
    dataset, configured = read_dataset(Path("run/dataset.h5")), settings(*CRAWLS)
    moved = 1e3 * (dataset.observed[:, -1] - dataset.observed[:, 0])[..., 0].mean(-1)
    ways = dict(zip(dataset.names, moved, strict=True))
    assert ways["faster"] > 4.0  # mm
    assert ways["back"] < -2.0
    for row, name in enumerate(dataset.names):
        waves = InputWaves(limit=1e4, **dict(configured.laboratory.trials[name].waves)).series(100, 0.01)
        np.testing.assert_allclose(dataset.inputs["muscle_stress"][row], waves[1:], rtol=1e-9)
    identified = results["parameters"]["sysid"]
    assert identified["youngs_modulus"] == pytest.approx(7.5e4, rel=0.01)
    assert identified["contact_friction"] == pytest.approx(0.4, rel=0.05)
    errors = results["errors_mm"]
    assert errors["sysid"]["mean"] < 1.2 * results["noise_mm"] < 0.2 * errors["simulation"]["mean"]
    check_robots("run", tolerance=1e-7)
    robot = load("run", "sysid")
    begun = robot.begin(muscle_stress=[0.0, 0.0, 0.0]).body.q[0]
    assert 0.0 < float((begun - robot.simulator.rest_positions).abs().max()) < 1e-4  # It lies where it lay.
    recordings = read_recordings(Path("run"), configured, robot.simulator.body.mesh, {})
    stands = [label.startswith("Floor") for label in recordings.labels]
    assert (np.isclose(recordings.feet, recordings.positions, atol=0).all(1) == stands).all()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            ["laboratory.trials.fast.waves.phases=[0,1]"],
            r"laboratory\.trials\.fast\.waves\.phases has 2 values, but the body has 3 muscles: give as many phases",
        ),
        (
            ["laboratory.trials.fast.waves.frequency=60"],
            r"waves\.frequency is 60: steps of 0\.01 s resolve less than 50 Hz",
        ),
        (
            ["+laboratory.trials.fast.begins=static"],
            r"laboratory\.trials\.fast\.waves is set, but the trial begins static",
        ),
        (["laboratory.trials.fast.waves=null"], r"laboratory\.trials\.fast\.waves is missing, which other trials have"),
        (["muscles=null", "laboratory.muscles=null"], r"waves is set, but the body has no inputs"),
        (["fixed={x: 1.0}"], r"no vertex lies within"),
        (["data.base_motion=reference"], r"data\.base_motion moves the fixed vertices, but fixed is null"),
    ],
)
def test_trials_and_places_that_do_not_fit_are_refused(given, said):
    with pytest.raises(ResphysError, match=said):
        check(composed("experiment=crawler", *given))
