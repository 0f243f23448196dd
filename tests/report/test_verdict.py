"""The verdict on a run: properties of its sentences for random errors, and what they say where it is known."""

import re
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from support.configured import settings
from warp_resphys.io.settings import parse
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.report.data import trial_errors, untrained
from warp_resphys.report.page import NO_BREAK_SPACE
from warp_resphys.report.verdict import (
    CORRECTED,
    LEAST_TRIALS,
    comparisons,
    known_errors,
    model_name,
    recommended,
    standings,
    verdict,
)
from warp_resphys.settings.learning import IdentifySettings

MODELS = (*BASELINES, "simulation", "sysid", "law", "simfree", "resphys")
IDENTIFY = parse(
    IdentifySettings,
    {
        "parameters": {
            "youngs_modulus": {"lower": 5e4, "upper": 2e6, "logarithmic": True},
            "mass_damping": {"lower": 0.0, "upper": 10.0},
        },
        "elastic": {"poissons_ratio": {"lower": 0.48, "upper": 0.4995}},
    },
)
SETTINGS = SimpleNamespace(name="my_robot", data=None, identify=IDENTIFY)


def metrics_of(errors, **more):
    """Content of metrics.json with errors [mm] of each model on the same trials."""
    count = len(next(iter(errors.values())))
    rows = [{"name": f"t{k}", "errors_mm": {model: own[k] for model, own in errors.items()}} for k in range(count)]
    return {"per_trajectory": rows, **more}


def sentences(errors, **more):
    return [text.replace(NO_BREAK_SPACE, " ") for text in verdict(metrics_of(errors, **more), SETTINGS)]


@pytest.mark.parametrize("seed", range(40))
def test_what_holds_for_any_errors(seed):
    random = np.random.default_rng(seed)
    models = [model for model in MODELS if random.random() < 0.8] or ["sysid"]
    count = int(random.integers(1, 9))
    level = {model: 10.0 ** random.uniform(-4, 1) for model in models}
    errors = {m: [float(level[m] * 10.0 ** random.normal(0, 0.3)) for _ in range(count)] for m in models}
    said = sentences(errors)
    assert 1 <= len(said) <= 4
    assert all(text.endswith(".") for text in said)
    best = min(models, key=lambda model: np.mean(errors[model]))
    assert model_name(best).lower() in said[0].lower()
    intervals = [interval for interval, _ in standings(known_errors(errors)).values()]
    if count < LEAST_TRIALS:
        assert "90 %" not in " ".join(said)
        assert "too few for an interval; use at least five" in said[-1] or "unlike those of the training" in said[-1]
        assert intervals == [None] * len(models)
    else:
        assert all(low <= np.mean(errors[m]) <= high for m, (low, high) in zip(errors, intervals, strict=True))
    for step in comparisons(errors):
        if step.outcome == "helps":
            assert step.gain.lower > 0.0
            assert any(f"{model_name(step.model)} {step.text}".lower() in text.lower() for text in said[1:])
        assert (step.outcome == "few") == (count < LEAST_TRIALS)
        assert step.improves == (step.gain.share > 0.0 if count < LEAST_TRIALS else step.gain.lower > 0.0)


class TestSentences:
    ERRORS: ClassVar = {
        "simulation": [3.0] * 5,
        "sysid": [0.6, 0.5, 0.7, 0.6, 0.5],
        "simfree": [1.0, 1.1, 0.9, 1.0, 1.2],
        "resphys": [0.4, 0.3, 0.5, 0.4, 0.3],
        "reconstruction": [0.01] * 5,  # Fitted to these trials.
    }

    def test_a_corrected_simulator_that_is_best(self):
        first, helps, fails, do = sentences(self.ERRORS)
        assert re.fullmatch(
            r"ResPhys is best, with a mean error of 0\.380 mm on 5 trials: it has 63 % less error than SimFree "
            r"\(90 % interval \d\d to \d\d %\)\.",
            first,
        )
        assert helps.startswith("SysID has 81 % less error than the uncorrected simulation (90 % interval ")
        assert "; ResPhys has 34 % less error than SysID (90 % interval " in helps
        assert fails.startswith("SimFree has 79 % more error than SysID (90 % interval ")
        assert do == "Use ResPhys."

    def test_where_the_trials_lie_between_those_of_the_training_the_split_cannot_judge_a_simulator(self):
        errors = {**self.ERRORS, "regression": [1e-3, 1.2e-3, 1.1e-3, 1e-3, 1.3e-3]}
        first, *_, do = sentences(errors)
        assert first.startswith("ResPhys is the best simulator, with a mean error of 0.380 mm on 5 trials, but kernel ")
        assert "kernel regression without physics is 340 times more accurate than ResPhys (90 % interval " in first
        assert first.endswith("so this split cannot judge a simulator.")
        assert do.startswith("To judge the simulator, test it on trials unlike those of the training")
        assert recommended(known_errors(errors)) == ""

    def test_a_difference_that_other_draws_of_the_trials_do_not_show(self):
        said = sentences({**self.ERRORS, "resphys": [0.5, 0.6, 0.6, 0.5, 0.6]})
        assert "ResPhys shows no significant difference from SysID on 5 trials" in said[2]
        assert said[3] == "Use SysID, which is simpler than ResPhys and not significantly worse."

    def test_few_trials_give_their_counts_and_no_claim(self):
        first, helps, fails, do = sentences({model: own[:3] for model, own in self.ERRORS.items()})
        assert first == "ResPhys is best, with a mean error of 0.400 mm on 3 trials; SimFree has 1.000 mm."
        assert "ResPhys has a lower error than SysID on 3 of 3 trials (0.600 to 0.400 mm)" in helps
        assert fails == "SimFree has a higher error than SysID on 3 of 3 trials (0.600 to 1.000 mm)."
        assert do == "Three trials are too few for an interval; use at least five."

    def test_what_diverged_was_not_trained_or_is_not_used(self):
        errors = {**self.ERRORS, "sysid": [None, 0.5, 0.7, 0.6, 0.5]}
        networks = {"resphys": {"epoch": 0}, "simfree": {"epoch": 3}}
        said = sentences(errors, networks=networks, law={"accepted": False})
        assert "SysID diverged in 1 of 5 trials" in said[1]
        assert "ResPhys adds nothing to SysID, as no epoch of its training improved the validation trials" in said[1]
        assert "SimFree cannot be compared with SysID, which diverged or has no error" in said[1]
        assert "the identified law is not used, as it did not help on the validation trials" in said[1]
        assert untrained({"folds": {"a": {"networks": networks}, "b": {"networks": {"simfree": {"epoch": 1}}}}}) == {
            "resphys"
        }
        assert sentences({"resphys": [None]}) == []

    def test_bounds_and_first_guesses_are_counted_over_folds(self):
        identified = {"sysid": {"youngs_modulus": 2e6, "mass_damping": 0.0}, "sysid_elastic": {"poissons_ratio": 0.49}}
        guesses = {"sysid_elastic": {"poissons_ratio": 0.49}}
        metrics = metrics_of(self.ERRORS, parameters=identified, first_guesses=guesses)
        do = verdict(metrics, SETTINGS)[-1]
        assert "youngs_modulus is at its upper bound, 2e+06: widen identify.parameters.youngs_modulus.upper" in do
        assert "mass_damping is at its lower bound, 0: remove it from the fit (~identify.parameters.mass_damping)" in do
        assert "poissons_ratio stayed at its first guess, 0.49: raise identify.starts" in do
        other = metrics_of(self.ERRORS, parameters={"sysid": {"youngs_modulus": 1e6}})
        assert (
            "in 1 of 2 folds, youngs_modulus is at its" in verdict({"folds": {"a": metrics, "b": other}}, SETTINGS)[-1]
        )

    def test_trials_with_other_loads_are_compared_by_themselves(self):
        data = settings().data
        names = [f"t{k}" for k in range(5)]
        loads = data.changed(others={name: {"weight_g": 50.0} for name in names})
        errors = {m: [2.0 * x for x in self.ERRORS[m]] + self.ERRORS[m] for m in ("simulation", "sysid")}
        errors["resphys"] = [5.0] * 5 + [0.01] * 5
        run = SimpleNamespace(name="beam", data=loads, identify=None)
        first, helps, fails, _ = verdict(metrics_of(errors), run)
        assert "SysID is best" in first
        assert "on 5 trials with other loads" in first
        assert "ResPhys is 58 times more accurate than SysID" in helps
        assert "with loads as in training" in helps
        assert re.search(
            r"ResPhys has 33[14] % more error than SysID .* with other loads", fails.replace(NO_BREAK_SPACE, " ")
        )


def test_models_that_are_equal_count_as_the_simplest():
    errors = {"simulation": [1.0] * 6, "sysid": [1.0] * 6}
    assert recommended(known_errors(errors)) == "simulation"
    assert set(CORRECTED) <= {*MODELS, "sysid_elastic", "resphys_uncorrected"}
    assert trial_errors({"folds": {"a": metrics_of(errors), "b": metrics_of({"sysid": [2.0]})}}) == {
        "sysid": [1.0] * 6 + [2.0]
    }
