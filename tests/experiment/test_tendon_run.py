"""A small experiment with tendons through its command line: from its laboratory to its report, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest

from support.configured import check, composed
from support.main_job import IN_RUN, run
from support.played_run import check_robots
from warp_resphys.experiment.sensitivity import sensitivities
from warp_resphys.io.errors import InputError
from warp_resphys.learning.replay import exact
from warp_resphys.robot.description import finished_experiment

QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN]
TINY = [
    "experiment=tendon_rod",
    *("mesh.layers=3", "mesh.nodes=20", "laboratory.mesh.layers=4", "laboratory.mesh.nodes=20"),
    *("data.steps=12", "data.sequences=5", "data.train=2", "data.validation=1", "data.test=1"),
    *("data.horizons=[0.06,0.12]", "data.rest_seconds=0.01", "data.cutoff=20.0", "parallel={processes:1,batch:2}"),
    *("laboratory.sequences.rest=0.01", "laboratory.sequences.correlation_time=0.03"),
    *("identify.trials=1", "identify.seconds=0.1", "identify.max_evaluations=3"),
    *("network={position_modes:2,velocity_modes:0,force_modes:2,width:8}", "trainer={epochs:4,rollout_every:2}"),
    *("trainer.batch_size=16", *QUIET),
]


MUSCLES = (
    "muscles={commanded:stress,stiffness:0,bundles:{front:{within:{x:[0,0.02]},direction:[0,0,1]},"
    "back:{within:{x:[-0.02,0]},direction:[0,0,1]}}}"
)


@pytest.mark.slow
def test_a_body_whose_muscles_contract_goes_through_every_stage(tmp_path, monkeypatch):
    """The same rod and laboratory with muscles in place of the tendons, by options alone."""
    monkeypatch.chdir(tmp_path)
    push = ["laboratory.sequences.mean=1e4", "laboratory.sequences.deviation=8e3", "data.input_limit=3e4"]
    code, err = run(*TINY, "tendons=null", MUSCLES, *push)
    assert (code, err[-500:] if code else "") == (0, "")
    errors = json.loads(Path("run/metrics.json").read_text())["errors_mm"]
    assert all(np.isfinite(errors[model]["mean"]) for model in ("simulation", "sysid", "simfree", "resphys"))
    page = Path("run/report.html").read_text()
    check_robots("run")
    for said in ("2 muscles under stress", "The body and its stresses", "the limit of 30"):
        assert said in page


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("tendons.routes.left.guides=[[0,0,0]]", "tendons.routes.left.guides is .*two or more"),
        ("tendons.routes.left.guides=[[0.02,0,0],[0,0,-0.2]]", "guide 1 of tendon 2.* lies .* mm outside of the body"),
        ("tendons.commanded=contraction", "tendons.stiffness"),
        ("+tendons.routes.left.offsets=[[[1,0,0],[0,1,0],[0,0,1]]]", "left.offsets"),
        ("+tendons.routes.left.offsets=[[1,0,0]]", "3 tendons|the tendons have"),
        ("+identify.parameters.tendon_offset_1_left={lower:-1,upper:1}", "'tendon_offset_1_left': choose from"),
        (MUSCLES, "tendons and muscles are two inputs of the body, but recordings have one: take one out"),
        ("chambers={count:1,axis:[0,0,1]}", "chambers and tendons are two inputs"),
        (
            "muscles={commanded:null,stiffness:1e4,bundles:{a:{direction:[0,0,1],within:{x:[1,2]}}}}",
            "no cell has its centre within x from 1 to 2",
        ),
        ("+tendons.routes.left.entry_angle=1.0", "an entry angle of tendons acts by friction"),
        ("+tendons.routes.left.fixed_guides=[0,1]", "all guides of tendon 2 are fixed in the world"),
        ("+tendons.routes.left.fixed_guides=[2]", "the route has guides 0 to 1"),
    ],
)
def test_wrong_tendons_are_refused_before_anything_runs(override, said):
    with pytest.raises(InputError, match=said):
        check(composed("experiment=tendon_rod", override))


@pytest.mark.slow
def test_inputs_with_a_zero_that_differs_from_trial_to_trial(tmp_path, monkeypatch):
    """Recordings begin under tensions that are logged with an error, which first frames show also of a test trial."""
    monkeypatch.chdir(tmp_path)
    deviation = 0.15  # N
    zero = f"{{lower: -0.6, upper: 0.6, per: trial, prior: {{mean: 0.0, deviation: {deviation}}}}}"
    parameters = f"{{youngs_modulus: {{lower: 1e5, upper: 5e5, logarithmic: true}}, tendon_tension_zero: {zero}}}"
    code, err = run(
        *TINY,
        *("data.begins=driven", f"laboratory.zero_noise={deviation}", "identify.trials=null"),
        *("laboratory.noise=1e-5", "laboratory.placement_noise=0.0", "laboratory.tilt=0.0"),
        *(f"laboratory.material.{key}" for key in ("model=corotated", "poissons_ratio=0.45", "density=1070")),
        *(f"laboratory.material.{key}" for key in ("mass_damping=0", "stiffness_damping=5e-3", "prony_ratio_1=0")),
        *("laboratory.mesh.layers=3", "laboratory.mesh.nodes=20"),
        *(f"++identify.parameters={parameters}", "identify.elastic=null", "identify.max_evaluations=12"),
    )
    assert (code, err[-500:] if code else "") == (0, "")
    found, truth = (json.loads(Path(f"run/{name}.json").read_text()) for name in ("identification", "truth"))
    zeros = {name.split("@")[1]: value for name, value in found["sysid"]["own"].items()}
    assert zeros.keys() == truth["zeros"].keys()
    errors = {name: abs(zeros[name] - value) for name, value in truth["zeros"].items()}
    assert max(errors.values()) < 0.4 * deviation
    later = [name for name in errors if name not in ("t000", "t001")]  # of which the first frames show it
    assert max(errors[name] for name in later) < 0.1 * deviation
    deviations = found["sysid"]["own_deviation"]
    ratios = [error / deviations[f"tendon_tension_zero@{name}"] for name, error in errors.items()]
    assert np.sqrt(np.mean(np.square(ratios))) < 3.0  # the largest of four depends on where the search stops
    page = Path("run/report.html").read_text()
    assert "Zero of the tensions [N]" in page
    assert "What could explain the remaining error" in page
    check_sensitivities(finished_experiment(Path("run")), later)


def check_sensitivities(experiment, names):
    """Derivatives of the markers are differences of roll-outs, by the zero of the trial where it has its own."""
    found = sensitivities(experiment, "sysid", names)
    parameters, step = experiment.parameters("sysid"), 1e-4
    for name in names:
        replay = experiment.replay(exact(experiment.model_simulator("sysid")), [name], "sysid")
        start = experiment.start(replay, "sysid")
        for key, moved in (
            ("tendon_tension_zero", f"tendon_tension_zero@{name}"),
            ("youngs_modulus", "youngs_modulus"),
        ):
            size = step * (float(parameters[moved]) if key == "youngs_modulus" else 1.0)
            ends = [replay(start, {**parameters, moved: parameters[moved] + sign * size})[0, 0] for sign in (1, -1)]
            slopes = ((ends[0] - ends[1]) / (2.0 * size)).numpy()
            np.testing.assert_allclose(found[name].by_parameter[key], slopes, atol=2e-2 * np.abs(slopes).max())
        moved = replay(start, parameters)[0, 0].numpy()
        np.testing.assert_allclose(found[name].points, moved, atol=1e-9)
