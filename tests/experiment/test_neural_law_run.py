"""A convex network as the law of a material, through the command line."""

import json

import numpy as np
import pytest
import torch

import warp_resphys
from support.main_job import IN_RUN, run_without_report
from warp_resphys import box_hexahedra
from warp_resphys.energies.catalogue import make_material
from warp_resphys.energies.neural import NeuralMaterial, initial_weights, weight_constants
from warp_resphys.io.errors import InputError
from warp_resphys.learning import neural_law

RUN = [
    *("experiment=law_beam", "law.kind=network", "law.max_evaluations=14", "law.trials=2", "law.seconds=0.2"),
    *("mesh.divisions=[4,1,1]", "data.steps=24", "data.weights_g.train=[60,140,200]", "data.others={}"),
    *("data.weights_g.validation=[100]", "data.weights_g.test=[160]", "trainer.epochs=2", "trainer.rollout_every=2"),
    *("network.width=8", "timing=false", "hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return run_without_report(tmp_path_factory.mktemp("neural"), *RUN)


def read(folder, name):
    return json.loads((folder / name).read_text())


def test_a_network_is_much_closer_than_the_uncorrected_simulator(run):
    law = read(run, "law.json")
    assert law["model"] == "neural_law"
    assert law["accepted"]
    assert law["validation"]["law"] < 0.1 * law["validation"]["below"]
    assert law["validation"]["law"] == pytest.approx(min(own["validation"] for own in law["history"]), rel=1e-3)
    assert law["history"][-1]["loss"] < 0.05 * law["history"][0]["loss"]
    errors = {model: own["mean"] for model, own in read(run, "metrics.json")["errors_mm"].items()}
    assert errors["law"] < 0.1 * errors["simulation"]
    assert errors["resphys"] != errors["law"]


def test_its_material_is_put_on_another_body(run):
    robot = warp_resphys.load(run, model="law")
    assert isinstance(robot.simulator.materials[""], NeuralMaterial)
    other = robot.on(box_hexahedra((0.2, 0.03, 0.03), (4, 1, 1)), fixed={"x": 0.0})
    weights = [torch.as_tensor(own.simulator.materials[""].weights) for own in (robot, other)]
    torch.testing.assert_close(*weights)
    assert len(weights[0]) == 163


def test_another_run_takes_it(run, tmp_path):
    own = [word for word in RUN if not word.startswith("law.")]
    folder = run_without_report(tmp_path, *own, f"law={run / 'law.json'}")
    law, given = read(folder, "law.json"), read(run, "law.json")
    assert (law["model"], law["constants"]) == (given["model"], given["constants"])
    assert law["validation"]["law"] == pytest.approx(given["validation"]["law"], rel=1e-3)


def test_an_interrupted_training_goes_on(run, monkeypatch):
    (run / "stages" / "identify_law.json").unlink()
    reached, train = [], neural_law.train_weights

    def stopped(*arguments):
        *others, start, keep = arguments
        reached.append(start)

        def kept(at):
            keep(at)
            if start is None and len(reached) < 4:
                reached.append(at)
                if len(reached) == 4:
                    raise KeyboardInterrupt

        return train(*others, start, kept)

    monkeypatch.setattr("warp_resphys.experiment.neural_law.train_weights", stopped)
    with pytest.raises((KeyboardInterrupt, SystemExit, AssertionError)):
        run_without_report(run.parent, *RUN)
    assert len(reached) == 4
    run_without_report(run.parent, *RUN)
    assert reached[4] == pytest.approx(reached[3])
    law = read(run, "law.json")
    assert law["validation"]["law"] < 0.1 * law["validation"]["below"]
    assert not list(run.glob("identify_law.safetensors"))


def test_weights_are_constants_of_a_configuration():
    weights = initial_weights(50e3, 1e6, seed=3)
    own = make_material("neural_law", bulk_1=2e6, prony_ratio_1=0.2, prony_time_1=0.1, **weight_constants(weights))
    torch.testing.assert_close(torch.as_tensor(own.weights), weights)
    assert np.allclose([own.bulk_1, own.prony[0][0]], [2e6, 0.2])
    assert isinstance(make_material("neural_law"), NeuralMaterial)
    with pytest.raises(InputError, match="neural_law has 2 weights: give weight_1 to weight_163, or none"):
        make_material("neural_law", weight_1=0.1, weight_2=0.1)
    with pytest.raises(InputError, match=r"neural_law has no constant 'c10': it has .*weights"):
        make_material("neural_law", c10=1.0)
