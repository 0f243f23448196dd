"""The announced duration of a run: counts of steps, and the sentence."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from support.configured import settings
from warp_resphys import Simulator
from warp_resphys.experiment import duration
from warp_resphys.experiment.duration import announcement, work_of
from warp_resphys.experiment.experiment import Experiment
from warp_resphys.experiment.splits import split_of
from warp_resphys.io.fan_out import Workers
from warp_resphys.io.resuming import run_stages
from warp_resphys.learning.residuals.reconstruction import LeastSquares
from warp_resphys.pipeline import _announce, acquire, learning_stages

TINY = ("mesh.divisions=[4,1,1]", "budget=quick", "data.steps=6", "trainer.epochs=40", "trainer.rollout_every=20")
TINY += ("~law", "~data.others", "timing=true")
ALWAYS = {
    "_SHORT": 0.0,
    "_LEAST_SECONDS": 0.0,
    "pace_of": lambda experiment, reconstructed: 2.0 if reconstructed else 1.0,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder with the dataset of a short run of 5 training, 1 validation and 2 test trials."""
    folder = tmp_path_factory.mktemp("data")
    return folder, acquire(settings(*TINY), folder)[1]


def stages_of(data, *more):
    run = settings(*TINY, *more)
    return learning_stages(run, split_of(run), ".", data[1])


def works_of(data, *more):
    stages = {one.name: one.settings for one in stages_of(data, *more)}
    del stages["report"]
    return {name: work_of(name, Experiment(own, data[0], "count")) for name, own in stages.items()}


def test_the_work_is_trials_by_steps_by_epochs(data):
    works = works_of(data)
    assert works["reconstruct_resphys"] == (0.0, (5 + 1 + 2) * 6, 0.0)
    assert works["evaluate"] == (2 * 2 * 6, 0.0, 0.0)  # the simulator, without and with a learned force
    assert works["time"] == (6.0 * 2 * 6, 0.0, 0.0)
    assert works["train_resphys"][0] == 40 / 20 * 6  # roll-outs of the validation trial
    batches = works["train_simfree"][2]
    assert works["train_resphys"][2] > 0.0
    twice = works_of(data, "simfree.trainer.epochs=80", "simfree.trainer.batch_size=1")
    assert twice["train_simfree"][2] == pytest.approx(2.0 * 30 * 1e-3 * 80 / 2.0)
    assert works_of(data, "simfree.trainer.epochs=80")["train_simfree"][2] == pytest.approx(2.0 * batches)


def test_derivatives_of_each_part_count(monkeypatch, tmp_path):
    """A parameter of three tendons takes three derivatives, in the identification and for intervals."""
    monkeypatch.setattr(duration, "steps_of", lambda experiment, model, names, longest=None: float(len(names)))
    monkeypatch.setattr(Experiment, "trials", SimpleNamespace(inputs={"tendon_tension": np.zeros((1, 2, 3))}))
    factor, works = "+identify.parameters.tendon_tension_factor={lower: 0.5, upper: 2.0", dict[str, list[float]]()
    for more in ((), (f"{factor}}}",), (f"{factor}, per: part}}",)):
        run = settings("experiment=tendon_rod", *more)
        split = split_of(run)
        for stage in learning_stages(run, split, ".", ""):
            if stage.name in ("identify", "evaluate"):
                amount, *_ = work_of(stage.name, Experiment(stage.settings, tmp_path, "count"))
                works.setdefault(stage.name, []).append(amount)
    for without, one, three in works.values():
        assert one > without
        assert three - without == pytest.approx(3.0 * (one - without))
    assert works["evaluate"][1] - works["evaluate"][0] == pytest.approx(0.2 * len(split.validation + split.test))


def test_a_sentence_says_how_long_and_what_helps(data, monkeypatch):
    """Folds multiply the duration, workers share the reconstruction."""
    folder, _ = data
    stages = [one for one in stages_of(data, "parallel.batch=2") if one.name in ("reconstruct_resphys", "evaluate")]
    assert announcement(stages, folder, quick=True) == ""
    for name, value in ALWAYS.items():
        monkeypatch.setattr(duration, name, value)
    text = announcement(stages, folder, quick=True)
    assert text == (
        "about 2 min 00 s more for 20 vertices (longest: reconstruct_resphys 1 min 36 s, evaluate 24.0 s); "
        "shorter with a coarser mesh, fewer or shorter trials."
    )
    assert announcement(stages, folder, quick=False).endswith("trials, or at first budget=quick.")
    assert "reconstruct_resphys 3 min 12 s" in announcement(stages, folder, quick=True, times=2.0)
    assert "reconstruct_resphys 24.0 s" in announcement(stages, folder, quick=True, workers=Workers(4))


def test_only_unfinished_stages_are_announced_and_an_estimate_that_fails_ends_no_run(tmp_path, monkeypatch, caplog):
    for name, value in ALWAYS.items():
        monkeypatch.setattr(duration, name, value)
    run = settings(*TINY)
    _, acquired = acquire(run, tmp_path)
    stages = learning_stages(run, split_of(run), ".", acquired)[:1]
    with caplog.at_level(logging.INFO, logger="warp_resphys"):
        _announce(run, stages, tmp_path, Workers())
        assert caplog.messages[-1].startswith("about 1 min 36 s more")
        before = len(caplog.messages)
        with monkeypatch.context() as patch:
            patch.setattr(duration, "pace_of", lambda *_: [][0])
            _announce(run, stages, tmp_path, Workers())
        assert len(caplog.messages) == before
        run_stages(stages, tmp_path)
        before = len(caplog.messages)
        _announce(run, stages, tmp_path, Workers())
    assert len(caplog.messages) == before


def test_steps_and_reconstructed_ones_are_timed_by_the_clock(data, monkeypatch):
    """By a clock on which the first step of each kind, which may compile kernels, takes 1.5 s and others less."""
    clock, passed = [0.0], {False: [1.5, *[0.1] * 9], True: [1.5, *[0.4] * 9]}
    monkeypatch.setattr(duration.time, "perf_counter", lambda: clock[0])

    def timed(step, seconds):
        def stepped(self, *arguments):
            result = step(self, *arguments)
            clock[0] += seconds.pop(0)
            return result

        return stepped

    (first, *_) = stages_of(data)
    experiment = Experiment(first.settings, data[0], "count")
    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "step", timed(Simulator.step, passed[False]))
        assert duration.pace_of(experiment, False) == pytest.approx(0.1 / 5)  # of five trials at once
    monkeypatch.setattr(LeastSquares, "step", timed(LeastSquares.step, passed[True]))
    assert duration.pace_of(experiment, True) == pytest.approx(0.4 / 5)
