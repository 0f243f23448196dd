"""What experiments are made of combines: payloads, releases, poses, folds, windows and searches of any bodies."""

import json
from pathlib import Path

import numpy as np
import pytest

from support.main_job import IN_RUN, run
from support.played_run import check_robots
from support.segment_run import TRACKED, place_segment
from warp_resphys.data.base_motion import prescribed
from warp_resphys.io.files import read_array, read_checkpoint, read_hdf5
from warp_resphys.io.settings import parse
from warp_resphys.settings.trials import MotionSettings

SEGMENT = [
    "experiment=tiny",
    TRACKED,
    "data.sequences=4",
    "data.horizons=[]",
    "identify.trials=null",
    "identify.seconds=0.1",
    "identify.max_evaluations=4",
]
# A beam of two elements' length whose releases and poses a laboratory records.
BEAM = [
    "experiment=beam_synthetic",
    "mesh.divisions=[4,1,1]",
    "laboratory.mesh.divisions=[5,1,1]",
    "laboratory.time_step=0.01",
    "laboratory.seconds=0.2",
    "data.seconds=0.15",
    "identify.starts=1",
    "identify.candidates=0",
    "identify.max_evaluations=4",
    "identify.substeps=1",
    "identify.elastic=null",
    "in_the_loop.epochs=2",
    "network.width=4",
    "simfree.network={position_modes:3,velocity_modes:3,layers:1,width:8}",
    "simfree.trainer={epochs:4,rollout_every:2}",
    "release.sideways=0",
    "correct_uncorrected=false",
    "laboratory.train=[m0,m40,m90]",
    "laboratory.validation=[m60]",
    "laboratory.test=[m30]",
]
QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN]


pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _place(folder, no_report):
    place_segment(folder)


def done(*arguments):
    """metrics.json of a run."""
    code, err = run(*arguments, *QUIET)
    assert (code, err[-600:] if code else "") == (0, "")
    return json.loads(Path("run/metrics.json").read_text())


def segment(*overrides):
    return done(*SEGMENT, *overrides)


def finite(results):
    assert all(
        summary["mean"] is not None and np.isfinite(summary["mean"]) for summary in results["errors_mm"].values()
    )


def dataset(*names):
    with read_hdf5("run/dataset.h5", "dataset") as file:
        words = {key: [str(value) for value in file.attrs[key]] for key in ("names", "begins")}
        return words, [read_array(file, name) for name in names]


def test_every_trial_is_the_test_of_a_fold():
    few = ["data.sequences=3", "identify.max_evaluations=2", "trainer.epochs=2", "trainer.rollout_every=2"]
    results = segment(*few, "data.folds=leave_one_out", "timing=false")
    assert set(results["folds"]) == {"t000", "t001", "t002"}
    for trial, fold in results["folds"].items():
        assert [row["name"] for row in fold["per_trajectory"]] == [trial]
    mean = np.mean([fold["errors_mm"]["simulation"]["mean"] for fold in results["folds"].values()])
    assert results["errors_mm"]["simulation"]["mean"] == pytest.approx(mean)


def test_an_arm_under_pressure_carries_payloads_that_the_networks_see():
    own = "+laboratory.trials={t000:{payload:0.0},t001:{payload:0.03},t002:{payload:0.01},t003:{payload:0.02}}"
    factor = "+identify.parameters.attached_mass_factor={lower:0.5,upper:1.5}"
    results = segment("data.payload_at={z:-0.1}", "actuation.sees_payload=true", own, factor)
    finite(results)
    assert results["parameters"]["sysid"].keys() == {"youngs_modulus", "poissons_ratio", "attached_mass_factor"}
    _, (payload, observed) = dataset("payload", "observed")
    np.testing.assert_allclose(payload, [0.0, 0.03, 0.01, 0.02])
    heights = observed[:, 0, :, 2].mean(-1)  # m, at rest: the heavier, the lower
    assert np.argsort(-heights).tolist() == np.argsort(payload).tolist()
    tensors, _ = read_checkpoint(Path("run/resphys.safetensors"), "residual force")
    assert len(tensors["actuation.scale"]) == 1 + 2 * 2  # the payload, two pressures and their means
    check_robots("run")
    code, err = run(*SEGMENT, own, *QUIET)
    assert (code, "data.payload_at is not set" in err) == (2, True)


def test_an_arm_that_is_pulled_aside_is_initial_motion():
    pulls = "+laboratory.trials={a:{pull:[0.9,0,0]},b:{pull:[0,0.9,0]},c:{pull:[0.6,0.6,0]},d:{pull:[-0.6,0.4,0]}}"
    own = ["+laboratory.held_seconds=0.3", "+laboratory.seconds=0.15", pulls, "data.sequences=0", "data.cutoff=null"]
    results = segment("data.begins=held", "data.rest=file", "data.seconds=0.1", *own, "data.alignment=own")
    finite(results)
    words, (held, bound) = dataset("held", "bound")
    assert words["begins"] == ["released"] * 4
    moved = (held - bound).mean(1)  # (4, 3) [m]
    for row, direction in zip(moved, ([1, 0], [0, 1], [1, 1], [-0.6, 0.4]), strict=True):
        towards = np.array(direction) / np.linalg.norm(direction)
        assert row[:2] @ towards > 0.95 * np.linalg.norm(row[:2]) > 2e-3
    code, err = run(*SEGMENT, "data.begins=held", "data.seconds=0.1", *own, *QUIET)
    assert (code, "set data.rest to file" in err) == (2, True)


def test_poses_and_motions_under_pressure_are_identified_and_corrected_together():
    poses = ["+laboratory.trials={t000:{begins:static},t003:{begins:static}}", "data.sequences=5"]
    split = ["data.train=[t000,t001]", "data.validation=[t002]", "data.test=[t003,t004]"]
    results = segment(*poses, *split)
    finite(results)
    words, (observed, pressure) = dataset("observed", "pressure")
    assert words["begins"] == ["static", "rest", "rest", "static", "rest"]
    assert np.isfinite(observed[0, 0]).all()
    assert np.isnan(observed[0, 1:]).all()  # a pose has one frame
    assert (pressure[0] == pressure[0, :1]).all()
    assert [row["name"] for row in results["per_trajectory"]] == ["t003", "t004"]
    with read_hdf5("run/reconstruction_resphys.h5", "reconstruction") as file:
        order = [str(name) for name in file.attrs["names"]]
        error = read_array(file, "error")[order.index("t000")]
    before = results["errors_mm"]["sysid"]["mean"]
    assert error[1] < 0.2 * before  # [mm]: a force brings the pose to its markers
    check_robots("run")


SWINGS = (
    "+laboratory.trials={"
    + ",".join(
        f"{name}:{{base_motion:{{start:0.05,ramp:0.05,swings:{{a:{{frequency:{hertz},{motion}}}}}}}}}"
        for name, hertz, motion in (
            ("s0", 4.0, "translation:[0,0.01,0]"),
            ("s1", 3.0, "rotation:[0.2,0.2,0]"),
            ("s2", 5.0, "translation:[0,0,0.006]"),
            ("s3", 4.0, "rotation:[0,0.1,0.2]"),
        )
    )
    + "}"
)
MOVING = [
    *(
        option
        for option in BEAM
        if not option.startswith(("laboratory.t", "laboratory.v", "data.seconds", "experiment"))
    ),
    "experiment=beam_moving_base",
    "data.steps=30",
    "laboratory.train=[s0,s1]",
    "laboratory.validation=[s2]",
    "laboratory.test=[s3]",
    SWINGS,
]


def test_a_base_that_moves_is_told_by_markers():
    results = done(*MOVING, "data.base_motion=reference")
    errors = {name: summary["mean"] for name, summary in results["errors_mm"].items()}
    assert errors["simulation"] > 3.0  # mm
    assert errors["sysid"] < 0.7 * errors["simulation"]
    assert errors["resphys"] < 1.05 * errors["sysid"]
    _, (base, times) = dataset("base", "times")
    swing = {"frequency": 3.0, "rotation": [0.2, 0.2, 0.0]}
    motion = parse(MotionSettings, {"start": 0.05, "ramp": 0.05, "swings": {"a": swing}})
    truth = prescribed(motion, times[1])
    # Markers that are placed to 0.3 mm over 40 mm turn the frame by some 10 mrad, and its rotations by 0.3 of that.
    assert np.abs(base[1, : len(truth), 3:] - truth[:, 3:]).max() < 0.01
    assert np.abs(truth[:, 3:]).max() > 0.19
    check_robots("run", ("simulation", "sysid", "resphys"))
