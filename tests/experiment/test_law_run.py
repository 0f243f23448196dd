"""The law of a material through the command line: identified,
used where it helps, and tested under other loads.
"""

import json
import shutil

import numpy as np
import pytest
import torch

import warp_resphys
from support.configured import check, composed, settings
from support.main_job import means, run_without_report
from warp_resphys import DataFileError, Inputs, State, select_vertices
from warp_resphys.experiment.experiment import LAW
from warp_resphys.experiment.simulate import build_target, initial_state
from warp_resphys.experiment.splits import all_trials
from warp_resphys.io.safe_files import read_json
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.learning.identification import law_search
from warp_resphys.pipeline import acquisition_stages
from warp_resphys.robot.description import finished_experiment

TINY = [
    *("mesh.divisions=[4,1,1]", "data.steps=24"),
    *("data.weights_g.train=[60,140,200]", "data.weights_g.test=[160]"),
    *("data.weights_g.validation=[100]", "network.width=32"),
    *("trainer.epochs=40", "trainer.rollout_every=20"),
    *("timing=false", "law.branches=7", "law.trials=2", "law.seconds=0.2", "law.max_evaluations=6"),
    # Powers of Ogden's law have kernels of their own; test_law selects them.
    "law.terms=[c20,c01,dilation]",
    *("identify.seconds=0.2", "trainer.gate=false"),  # a tiny force is no gain
]
RUBBER = ["experiment=law_rubber", *TINY, "identify.trials=2", "identify.max_evaluations=6"]
RANGES = (
    "{youngs_modulus:{lower:50e3,upper:1e6,logarithmic:true},"
    "poissons_ratio:{lower:0.3,upper:0.4995}}"
)
KNOWN = [  # E and nu alone describe its target.
    *("experiment=beam_oscillation", "target.poissons_ratio=0.4", *TINY, "law.families=0"),
    f"identify={{parameters:{RANGES},max_evaluations:12,tolerance:1e-10}}",
]
OTHERS = [
    "400 g",
    "120 g up",
    "120 g sideways",
    "200 g mid-span",
    "120 g, and 200 g sideways mid-span",
    "twist 90°",
]
OTHERS += ["120 g at 45°"]


@pytest.fixture(scope="module")
def short_stride():
    """Balances forces every other step, as the trials have few steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(law_search, "_STRIDE", 2)
        yield


@pytest.fixture(scope="module")
def rubber(tmp_path_factory, short_stride):
    return run_without_report(tmp_path_factory.mktemp("rubber"), *RUBBER)


def by_trial(folder):
    return {
        trial["name"]: trial["errors_mm"]
        for trial in read_json(folder / "metrics.json")["per_trajectory"]
    }


@pytest.mark.slow
class TestALawThatHelps:
    def test_it_has_the_terms_of_the_rubber(self, rubber):
        law = read_json(rubber / "law.json")
        assert law["accepted"]
        assert {"branches", "fibres"} <= {*law["groups"]}
        parameters = law["parameters"]
        along = np.cos(parameters["fibre_azimuth_1"]) * np.cos(parameters["fibre_elevation_1"])
        assert abs(along) > np.cos(np.radians(5.0))
        assert parameters["fibre_tension_1"] == pytest.approx(80e3, rel=0.3)
        moduli = sum(
            value for name, value in parameters.items() if name.startswith("prony_modulus")
        )
        assert moduli == pytest.approx(0.3 * 2.0 * 44e3, rel=0.3)
        assert all(
            value >= 0.0
            for name, value in parameters.items()
            if "azimuth" not in name and "elev" not in name
        )
        sizes = [len(own["groups"]) for own in law["classes"]]
        assert sizes == sorted(sizes)
        assert law["classes"][0]["groups"] == []
        assert law["validation"]["law"] < 0.1 * law["validation"]["below"]

    def test_it_is_better_than_identification_under_every_load(self, rubber):
        errors, trials = means(rubber), by_trial(rubber)
        assert list(errors) == [*BASELINES, "simulation", "sysid", "law", "simfree", "resphys"]
        assert errors["sysid"] < errors["simulation"]
        assert errors["law"] < 0.05 * errors["sysid"]
        assert list(trials) == ["160 g", *OTHERS]
        for name, own in trials.items():
            assert own["law"] < 0.2 * own["sysid"], name
        # Far from the training of the force.
        assert trials["twist 90°"]["resphys"] == trials["twist 90°"]["law"]
        assert trials["160 g"]["resphys"] != trials["160 g"]["law"]
        assert finished_experiment(rubber).sources("resphys") == (LAW, LAW)

    def test_another_run_takes_it(self, rubber, tmp_path):
        others = [word for word in RUBBER if not word.startswith("law.")]
        given = read_json(rubber / "law.json")
        of_another_body = given["parameters"] | {"mass_damping": 7.0, "density": 400.0}
        (tmp_path / "other.json").write_text(json.dumps(given | {"parameters": of_another_body}))
        shutil.copytree(rubber, tmp_path / "run")  # whose data and first parameters are kept
        folder = run_without_report(tmp_path, *others, f"law={tmp_path / 'other.json'}")
        law = read_json(folder / "law.json")
        assert law["parameters"] == given["parameters"]
        assert law["accepted"]
        assert by_trial(folder)["twist 90°"]["law"] == pytest.approx(
            by_trial(rubber)["twist 90°"]["law"], rel=0.01
        )
        with pytest.raises(DataFileError, match=r"errors\.json is not a law of this version"):
            check(composed("experiment=beam_oscillation", f"law={rubber / 'errors.json'}"))


@pytest.mark.slow
def test_a_law_that_does_not_help_is_not_used(tmp_path, short_stride):
    """The force corrects the identified simulator, and does not fade out."""
    folder = run_without_report(tmp_path, *KNOWN)
    law, errors = read_json(folder / "law.json"), means(folder)
    assert not law["accepted"]
    assert law["validation"]["law"] > law["validation"]["below"]
    assert list(errors) == [*BASELINES, "simulation", "sysid", "simfree", "resphys"]
    assert errors["sysid"] < 1e-4 * errors["simulation"]
    experiment = finished_experiment(folder)
    assert experiment.sources("resphys") == ("identified", "sysid")
    assert not experiment.has_law
    robot = warp_resphys.load(folder, model="resphys")
    assert robot.description.material.model == "corotated"
    assert robot.description.learned.range_.missed is None


@pytest.mark.slow
def test_the_demo_corrects_within_and_beyond_its_training_loads(tmp_path):
    """Law, force and what has no simulator, under a weight
    between those of the training and in a twist [mm].
    """
    errors = by_trial(run_without_report(tmp_path, "budget=quick"))
    within, beyond = errors["70 g"], errors["twist 90°"]
    for own, law, force in ((within, 2.4e-4, 2.2e-5), (beyond, 4.3e-4, 3.5e-4)):
        assert own["simulation"] == pytest.approx(1.0, rel=0.05)
        assert own["law"] == pytest.approx(law, rel=0.3)
        assert own["resphys"] == pytest.approx(force, rel=0.5)
        assert own["resphys"] < own["law"]
    assert within["regression"] < 1e-4
    assert within["simfree"] < 0.02
    assert beyond["regression"] == pytest.approx(0.154, rel=0.01)
    assert beyond["simfree"] > 0.5


def test_a_silicone_is_named_in_place_of_a_file():
    check(composed("experiment=beam_oscillation", "law=dragon_skin_10"))


def test_weights_in_their_directions_at_their_places_hold_the_beam():
    """Initial states of test trials that are held in other ways."""
    run = settings("experiment=law_rubber", "mesh.divisions=[8,2,2]", "data.weights_g.test=[120]")
    held = {"120 g up": {0.1: (0.0, 0.0, 0.12)}, "200 g mid-span": {0.05: (0.0, 0.0, -0.2)}}
    held["120 g at 45°"] = {0.1: (0.0, 0.12 / np.sqrt(2.0), -0.12 / np.sqrt(2.0))}
    held["120 g"] = {0.1: (0.0, 0.0, -0.12)}
    held["120 g, and 200 g sideways mid-span"] = {0.1: (0.0, 0.0, -0.12), 0.05: (0.0, 0.2, 0.0)}
    (stage,) = acquisition_stages(run)
    simulator = build_target(stage.settings, stage.settings.target).simulator
    force = torch.zeros(len(held), *simulator.rest_positions.shape, dtype=torch.float64)
    for row, places in enumerate(held.values()):
        for x, weight in places.items():
            face = select_vertices(simulator.body.mesh, x=x)
            force[row, face] += (
                force.new_tensor(weight) * float(np.linalg.norm(simulator.gravity)) / len(face)
            )
    with torch.no_grad():
        state = initial_state(simulator, run.data, [all_trials(run)[name] for name in held])
        assert not state.v.any()
        still = State(state.q, torch.zeros_like(state.q))
        balanced, released = (
            simulator.step(still, inputs).q for inputs in (Inputs(force), Inputs())
        )
    moved = (released - state.q).abs().amax((1, 2))
    assert float(moved.min()) > 1e-4
    assert ((balanced - state.q).abs().amax((1, 2)) < 1e-4 * moved).all()
