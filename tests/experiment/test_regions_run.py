"""A beam of two silicones with a rigid cap, from YAML: identified by region, corrected, and taken along as a robot."""

import contextlib
import json

import numpy as np
import pytest

import warp_resphys
from support.main_job import IN_RUN, run, run_without_report
from warp_resphys.robot.description import Description, describe

TINY = [
    "experiment=beam_regions",
    "budget=quick",
    "mesh.divisions=[10,1,1]",
    "laboratory.mesh.divisions=[10,1,1]",
    "laboratory.time_step=0.005",
    "laboratory.integrator=bdf2",
    "laboratory.material.model=corotated",
    "laboratory.material.poissons_ratio=0.499",
    "laboratory.material.mass_damping=0",
    "laboratory.material.regions.root.youngs_modulus=350e3",
    "laboratory.seconds=0.4",
    "laboratory.noise=1e-6",
    "laboratory.placement_noise=1e-6",
    "laboratory.tilt=0",
    "laboratory.train=[m0,m80]",
    "laboratory.validation=[m20]",
    "laboratory.test=[m50]",
    "data.seconds=0.3",
    "data.limit=null",
    "identify.substeps=2",
    "identify.max_evaluations=10",
    "correct_uncorrected=false",
    "simfree.trainer.epochs=10",
    "simfree.trainer.rollout_every=10",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
    IN_RUN,
]
TRUE = {"root_youngs_modulus": 350e3, "tip_youngs_modulus": 90e3}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return run_without_report(tmp_path_factory.mktemp("regions"), *TINY)


def test_each_silicone_is_identified(folder):
    results = json.loads((folder / "identification.json").read_text())["sysid"]
    assert {name: results["parameters"][name] for name in TRUE} == pytest.approx(TRUE, rel=0.08)
    assert results["first_guess"]["tip_youngs_modulus"] == 150e3
    errors = json.loads((folder / "metrics.json").read_text())["errors_mm"]
    assert errors["sysid"]["mean"] < 0.2 * errors["simulation"]["mean"]


def test_a_robot_takes_its_regions_along(folder):
    described = describe(folder, "sysid")
    described.write(folder / "robot.safetensors")
    results = Description.read(folder / "robot.safetensors")
    assert {name: len(cells) for name, cells in results.mesh.regions.items()} == {"root": 5, "tip": 4, "cap": 1}
    robot = warp_resphys.load(folder / "robot.safetensors")
    body = robot.simulator.body
    cap = np.unique(body.mesh.cells[body.mesh.region("cap")])
    state = robot.begin()
    for _ in range(5):
        state = robot.step(state)
    q = state.body.q[0, cap].cpu().numpy()
    rest = body.vertices[cap]
    apart = [np.linalg.norm(x[:, None] - x, axis=-1) for x in (q, rest)]
    assert np.abs(apart[0] - apart[1]).max() < 1e-4 * apart[1].max()
    assert np.abs(q - rest).max() > 1e-4


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("regions.cap.x=[0.2,0.3]", "regions.cap: no cell has its centre"),
        ("rigid.lid.density=1000", "no region 'lid'"),
        (
            "simulation.regions.tip.youngs_module=1e5",
            "simulation.regions.tip: corotated has no constant",
        ),
        ("simulation.regions.cap.density=1000", "cap"),
        ("identify.parameters.youngs_modulus={lower: 1.0, upper: 2.0}", "identify.parameters names 'youngs_modulus'"),
        ("identify.integrator=midpoint", "midpoint"),
    ],
)
def test_regions_that_do_not_fit_cost_one_sentence(tmp_path, override, key):
    with contextlib.chdir(tmp_path):
        code, err = run(*TINY, override)
    assert (code, err if key not in err else "") == (2, "")
    assert len(err.splitlines()) == 1
