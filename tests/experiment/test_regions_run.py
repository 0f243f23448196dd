"""A beam of two silicones with a rigid cap, from YAML:
identified by region, corrected, and taken along as a robot.

Motion capture sees the pose of the cap alone, on which its rigid body is mounted in any way.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warp_resphys
from support.main_job import run_without_report
from warp_resphys.data.rigid_bodies import angles, arms
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.files import DATASET, REGISTRATION, TRUTH
from warp_resphys.io.safe_files import read_array, read_hdf5, read_json
from warp_resphys.robot.description import Description, describe
from warp_resphys.twin.stream import recorded_packets

TINY = [
    "experiment=beam_regions",
    "budget=quick",
    "mesh.divisions=[10,1,1]",
    "laboratory.mesh.divisions=[10,1,1]",
    "laboratory.time_step=0.005",
    "laboratory.integrator=bdf2",
    "laboratory.material.model=corotated",
    *("laboratory.material.poissons_ratio=0.499", "laboratory.material.mass_damping=0"),
    "laboratory.material.regions.root.youngs_modulus=350e3",
    "laboratory.seconds=0.4",
    "laboratory.noise=1e-6",
    *("laboratory.placement_noise=1e-6", "laboratory.tilt=0", "laboratory.train=[m0,m80]"),
    *("laboratory.validation=[m20]", "laboratory.test=[m50]", "laboratory.orientation_noise=0.05"),
    *("data.seconds=0.3", "data.limit=null", "identify.substeps=2", "identify.max_evaluations=10"),
    *("~markers.tracked", "markers.rigid_bodies={plate: {part: cap}}", "correct_uncorrected=false"),
    *("simfree.trainer.epochs=10", "simfree.trainer.rollout_every=10", "in_the_loop.epochs=1"),
]
pytestmark = pytest.mark.slow
TRUE = {"root_youngs_modulus": 350e3, "tip_youngs_modulus": 90e3}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return run_without_report(tmp_path_factory.mktemp("regions"), *TINY)


def test_each_silicone_is_identified(folder):
    results = read_json(folder / "identification.json")["sysid"]
    assert {name: results["parameters"][name] for name in TRUE} == pytest.approx(TRUE, rel=0.08)
    assert results["first_guess"]["tip_youngs_modulus"] == 150e3
    errors = read_json(folder / "metrics.json")["errors_mm"]
    assert errors["sysid"]["mean"] < 0.2 * errors["simulation"]["mean"]


def test_the_rest_frames_show_how_a_rigid_body_is_mounted(folder):
    dataset, truth = Trials.read(folder / DATASET), read_json(folder / TRUTH)["bound"]
    assert dataset.labels == ("plate +++", "plate +--", "plate -+-", "plate --+")
    true = np.array([truth[label] for label in dataset.labels])
    np.testing.assert_allclose(dataset.bound.mean(axis=0), true.mean(axis=0), atol=2e-5)
    assert np.degrees(angles(true, dataset.bound)) < 0.05
    centre = [0.095, 0.015, 0.015]
    assert np.linalg.norm(true.mean(axis=0) - centre) > 5e-3
    assert np.degrees(angles(arms(1.0), true)) > 10.0
    mountings = [own["mounting"]["plate"] for own in read_json(folder / REGISTRATION).values()]
    assert max(own["distance_mm"] for own in mountings) < 0.02
    assert max(own["angle_deg"] for own in mountings) < 0.1


def test_positions_and_orientations_have_their_own_errors_as_robots_count_them(folder):
    metrics = read_json(folder / "metrics.json")
    seen = Trials.read(folder / DATASET)
    with read_hdf5(folder / "rollouts.h5", "rollouts") as file:
        simulated = read_array(file, "sysid_observed")[0]
    observed = seen.observed[seen.names.index("m50")]
    away = np.linalg.norm((simulated - observed).mean(axis=1), axis=-1)
    turned = [
        Rotation.align_vectors(a - a.mean(axis=0), b - b.mean(axis=0))[0].magnitude()
        for a, b in zip(simulated, observed, strict=True)
        if np.isfinite(b).all()
    ]
    assert metrics["errors_mm"]["sysid"]["mean"] == pytest.approx(1e3 * np.nanmean(away))
    assert metrics["per_marker"]["sysid"] == {"plate": pytest.approx(1e3 * np.nanmean(away))}
    assert metrics["orientations_deg"]["sysid"]["plate"] == pytest.approx(
        np.degrees(np.mean(turned))
    )
    assert (
        metrics["orientations_deg"]["sysid"]["plate"]
        < 0.3 * metrics["orientations_deg"]["simulation"]["plate"]
    )
    robot = warp_resphys.load(folder, "sysid")
    assert "vertices, 1 rigid body, steps" in repr(robot)
    trial = warp_resphys.recorded_trial(robot, "m50")
    errors = trial.errors_mm(trial.play(robot))
    assert errors.shape == (len(trial.times), 1)
    assert np.nanmean(errors) == pytest.approx(metrics["errors_mm"]["sysid"]["mean"], rel=1e-3)


def test_a_robot_takes_its_regions_along(folder):
    described = describe(folder, "sysid")
    described.write(folder / "robot.safetensors")
    results = Description.read(folder / "robot.safetensors")
    assert {name: len(cells) for name, cells in results.mesh.regions.items()} == {
        "root": 5,
        "tip": 4,
        "cap": 1,
    }
    robot = warp_resphys.load(folder / "robot.safetensors")
    packet = next(recorded_packets(robot, folder / "recordings" / "m50.h5"))
    assert {*robot.labels} < {*packet.markers}
    points = np.array([packet.markers[label] for label in robot.labels])
    np.testing.assert_allclose(points.mean(axis=0), packet.markers["plate"], atol=1e-12)
