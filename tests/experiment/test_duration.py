"""Estimates of the duration of a run."""

import logging

import pytest

from support.configured import settings
from warp_resphys.experiment import duration
from warp_resphys.experiment.duration import ExpectedDuration, estimate, may_be_long, remedies
from warp_resphys.experiment.trials import split_of
from warp_resphys.io.stages import Stage, run_stages, unfinished
from warp_resphys.pipeline import acquire, learning_stages, run_experiment

TINY = ("mesh.divisions=[4,1,1]", "budget=quick", "data.steps=6", "timing=false", "trainer.epochs=2")


def test_an_estimate_is_the_time_of_a_step_by_their_number(tmp_path, monkeypatch):
    """Calls of 0.1 s give that for a step of reconstruction, and for a step of the roll-outs of two models."""
    monkeypatch.setattr(duration, "_timed", lambda call: (call(), 0.1)[1])
    parts = {}
    for steps, epochs in ((6, 20), (12, 20), (6, 40)):
        folder = tmp_path / f"{steps}_{epochs}"
        run = settings(*TINY, f"data.steps={steps}", f"trainer.epochs={epochs}", f"trainer.rollout_every={epochs}")
        _, acquired = acquire(run, folder)
        parts[steps, epochs] = estimate(learning_stages(run, split_of(run), ".", acquired), folder)
    own = parts[6, 20].seconds
    assert own.keys() == {"reconstruct_resphys", "train_resphys", "train_simfree", "evaluate"}
    assert not parts[6, 20].without
    assert own["reconstruct_resphys"] == pytest.approx(0.6)
    assert own["evaluate"] == pytest.approx(2 * 0.6)
    longer, trained = parts[12, 20].seconds, parts[6, 40].seconds
    assert longer["reconstruct_resphys"] == pytest.approx(1.2)
    assert longer["evaluate"] == pytest.approx(2 * 1.2)
    assert trained["train_simfree"] == pytest.approx(2.0 * own["train_simfree"])
    assert trained["train_resphys"] - own["train_resphys"] == pytest.approx(own["train_simfree"])


def test_a_sentence_says_how_long_and_what_helps():
    """Folds multiply the duration; a short run says nothing."""
    own = ExpectedDuration({"identify": 50.0, "evaluate": 5.0}, ["plan_resphys"], 1234)
    assert own.sentence(["a coarser mesh"]) == ""
    text = own.sentence(["a coarser mesh", "fewer trials"], times=2.0)
    assert text.startswith("about 1 min 50 s more for 1,234 vertices, without plan_resphys")
    assert "identify 1 min 40 s" in text
    assert text.endswith("shorter with a coarser mesh, fewer trials.")


def test_a_training_in_a_second_process_counts_where_the_others_wait_for_it():
    """The second training begins with the reconstruction, and takes less or more time than the stages before it."""
    before = [Stage("reconstruct", print, (), {}), Stage("train_a", print, (), {}, ("reconstruct",), bool)]
    stages = [*before, Stage("train_b", print, (), {}, (), bool), Stage("evaluate", print, (), {}, ("train_b",))]
    seconds = {"reconstruct": 5.0, "train_a": 3.0, "evaluate": 1.0}
    for own, expected in ((2.0, 9.0), (20.0, 21.0)):
        assert duration._elapsed(stages, {**seconds, "train_b": own}) == expected
    part = ExpectedDuration({"train": 50.0, "train_simfree": 45.0}, at_once=45.0)
    assert part.sentence([]) == ""


def test_remedies_name_the_parameters_and_the_quick_budget():
    """The number of identified parameters is said where there are several."""
    run = settings("experiment=beam_real")
    stages = [own for own in learning_stages(run, split_of(run), ".", "") if own.name == "identify"]
    assert "fewer of the 3 parameters of identify.parameters" in remedies(stages, quick=True)
    assert remedies([], quick=False)[-1] == "or at first budget=quick"


def test_a_run_announces_its_duration_before_the_first_stage(tmp_path, monkeypatch, caplog):
    """The line comes after the data are there and before any force is reconstructed; a repetition has none."""
    monkeypatch.setattr(duration, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr(duration, "_SHORT", 0.0)
    run = settings(*TINY)
    with caplog.at_level(logging.INFO, logger="warp_resphys"):
        run_experiment(run, tmp_path)
    lines = [record.getMessage() for record in caplog.records]
    announced = next(number for number, line in enumerate(lines) if line.startswith("about "))
    assert any(line.startswith("simulate: done") for line in lines[:announced])
    assert any(line.startswith("reconstruct_resphys: started") for line in lines[announced:])
    caplog.clear()
    with caplog.at_level(logging.INFO, logger="warp_resphys"):
        run_experiment(run, tmp_path)
    assert not any(record.getMessage().startswith("about ") for record in caplog.records)


def test_a_short_run_is_not_measured(tmp_path, monkeypatch):
    """Few steps of a coarse beam take no time that is worth an estimate, many steps and identification do."""
    run = settings(*TINY)
    _, acquired = acquire(run, tmp_path)
    stages = learning_stages(run, split_of(run), ".", acquired)
    assert not may_be_long(stages, tmp_path)
    monkeypatch.setattr(duration, "_SHORT", 10.0)
    assert may_be_long(stages, tmp_path)
    identified = settings("experiment=beam_real")
    assert may_be_long(learning_stages(identified, split_of(identified), ".", acquired), tmp_path)


def test_an_estimate_that_fails_ends_no_run(tmp_path, monkeypatch):
    """A stage whose steps cannot be measured has no estimate."""

    def failing(call):
        raise MemoryError

    monkeypatch.setattr(duration, "_timed", failing)
    run = settings(*TINY)
    _, acquired = acquire(run, tmp_path)
    expected = estimate(learning_stages(run, split_of(run), ".", acquired), tmp_path)
    assert not expected.seconds
    assert "reconstruct_resphys" in expected.without


def test_finished_stages_are_not_estimated(tmp_path):
    """A stage with the record of its settings is left out."""
    run = settings(*TINY)
    _, acquired = acquire(run, tmp_path)
    stages = learning_stages(run, split_of(run), ".", acquired)
    assert [own.name for own in unfinished(stages, tmp_path)] == [own.name for own in stages]
    run_stages(stages[:1], tmp_path)
    assert [own.name for own in unfinished(stages, tmp_path)] == [own.name for own in stages[1:]]
