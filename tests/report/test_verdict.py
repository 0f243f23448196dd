"""The end of a run: its table, and what the verdict and the advice say for random and for known errors."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from support.configured import settings
from warp_resphys.io.settings import parse
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.report.data import trial_errors, unused
from warp_resphys.report.page import write_page
from warp_resphys.report.verdict import LEAST_TRIALS, results_table, verdict
from warp_resphys.report.wording import NO_BREAK_SPACE, model_words
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
WORDS = {"heading": "My robot", "test_titles": ("weights of the paper", "other loads")}
SETTINGS = SimpleNamespace(name="my_robot", data=None, identify=IDENTIFY, markers=0, **WORDS)


def metrics_of(errors, **more):
    """Content of metrics.json with errors [mm] of each model on the same trials."""
    count = len(next(iter(errors.values())))
    rows = [{"name": f"t{k}", "errors_mm": {model: own[k] for model, own in errors.items()}} for k in range(count)]
    return {"per_trajectory": rows, **more}


def sentences(errors, run=SETTINGS, **more):
    return [text.replace(NO_BREAK_SPACE, " ") for text in verdict(metrics_of(errors, **more), run)]


def table_of(errors, run=SETTINGS, **more):
    table = results_table(metrics_of(errors, **more), run)
    return {row.head: ([cell.text for cell in row.cells], row.mark) for row in table.rows}


@pytest.mark.parametrize("seed", range(40))
def test_what_holds_for_any_errors(seed):
    random = np.random.default_rng(seed)
    models = [model for model in MODELS if random.random() < 0.8] or ["sysid"]
    count = int(random.integers(1, 9))
    level = {model: 10.0 ** random.uniform(-4, 1) for model in models}
    errors = {m: [float(level[m] * 10.0 ** random.normal(0, 0.3)) for _ in range(count)] for m in models}
    first, *advice = sentences(errors)
    assert 1 <= len(advice) <= 2
    assert all(text.endswith(".") for text in (first, *advice))
    best = min(models, key=lambda model: np.mean(errors[model]))
    assert first.lower().startswith(model_words(best).lower())
    assert f"{count} trial" in first
    assert ("too few for an interval" in advice[0]) == (count < LEAST_TRIALS)
    (marked,) = (head for head, (_, mark) in table_of(errors).items() if mark == "best")
    assert (model_words(best) in marked) or best not in BASELINES
    assert not {"helps", "harm", "rest", "simfree", "resphys_uncorrected"} & {*" ".join([first, *advice]).split()}


class TestSentences:
    ERRORS: ClassVar = {
        "rest": [9.0] * 5,
        "linear": [3.0] * 5,
        "simulation": [3.0] * 5,
        "sysid": [0.6, 0.5, 0.7, 0.6, 0.5],
        "simfree": [1.0, 1.1, 0.9, 1.0, 1.2],
        "resphys": [0.4, 0.3, 0.5, 0.4, 0.3],
        "reconstruction": [0.01] * 5,  # Fitted to these trials.
    }

    def test_a_corrected_simulator_that_is_best(self):
        assert sentences(self.ERRORS) == [
            "ResPhys has 63 % less error than SimFree (on 5 of 5 trials).",
            "Use ResPhys.",
        ]
        without = {model: own for model, own in self.ERRORS.items() if model != "simfree"}
        assert "has 87 % less error than anything without physics (on 5 of 5" in sentences(without)[0]
        assert sentences({"sysid": [1.0]})[0] == "SysID has the lowest error, 1.00 mm on 1 trial."
        assert table_of(self.ERRORS) == {
            "without physics (a linear model)": (["3.00"], ""),
            "network in place of the simulator (SimFree)": (["1.04"], ""),
            "uncorrected simulator": (["3.00"], ""),
            "+ identified parameters (SysID)": (["0.580"], ""),
            "+ learned force (ResPhys)": (["0.380"], "best"),
        }

    def test_what_a_regression_or_a_simpler_model_can_do_needs_no_better_one(self):
        errors = {**self.ERRORS, "regression": [1e-3, 1.2e-3, 1.1e-3, 1e-3, 1.3e-3]}
        first, do = sentences(errors)
        said = "Regression, without physics, has 99.7 % less error than any corrected simulator"
        assert first.startswith(said)
        assert do == "Regression is enough for trials like these; to judge the simulator, test it on others."
        said = sentences({**self.ERRORS, "resphys": [0.5, 0.6, 0.6, 0.5, 0.6]})
        assert said[1] == "Use SysID, which is simpler than ResPhys and not significantly worse."
        wide = {"sysid": [2.0, 0.1, 0.1, 0.1, 0.1], "resphys": [0.2, 0.2, 0.2, 0.2, 0.2]}
        assert sentences(wide)[1] == "Use ResPhys."  # It has 58 % less error, though not in 90 % of the draws.
        assert sentences({"simulation": [1.0] * 6, "sysid": [1.0] * 6}) == [
            "The uncorrected simulator and SysID show no difference on 6 trials, 1.00 mm.",
            "Use the uncorrected simulator.",
        ]

    def test_few_trials_give_their_counts_and_no_advice_to_use_a_model(self):
        assert sentences({model: own[:3] for model, own in self.ERRORS.items()}) == [
            "ResPhys has 60 % less error than SimFree (on 3 of 3 trials).",
            "Check before use: three trials are too few for an interval.",
            "Test on five trials or more.",
        ]

    def test_what_diverged_or_was_not_trained(self):
        errors = {**self.ERRORS, "sysid": [None, 0.5, 0.7, 0.6, 0.5]}
        tests = [
            {"trials": ["a"], "split": "validation", "error_mm": 46.0, "below_mm": 11.0, "used": x}
            for x in (False, True)
        ]
        networks = {"resphys": {"test": tests[0]}, "simfree": {"test": tests[1]}}
        _, why, check, use = sentences(errors, networks=networks)
        assert why.startswith(
            "ResPhys is not used: on the validation trials (a) it has 46 mm, and the simulator without"
        )
        assert check.startswith("Check before use: SysID diverged in 1 of 5 trials")
        assert use == "Use the uncorrected simulator."
        assert table_of(errors)["+ identified parameters (SysID)"] == (["1 of 5 diverged"], "")
        folds = {"a": {"networks": networks}, "b": {"networks": {"resphys": {"test": tests[0]}}}}
        assert unused({"folds": folds}) == {"resphys": "it is clearly closer in none of the 2 folds"}
        assert sentences({"resphys": [None]})[0] == "All models diverged."
        assert sentences({"reconstruction": [0.1]}) == []

    @pytest.mark.parametrize(
        ("more", "fact", "remedy"),
        [
            ({"placement": {"turned_deg": 5.0, "rms_mm": 0.1}}, "rotated by 5.0°", "Check the positions and axes"),
            ({"placement": {"turned_deg": 1.0, "rms_mm": 2.1}}, "fit their positions to 2.10 mm only", "Measure"),
            ({"mesh_check": {"model": "sysid", "moved_mm": 2.9}}, "by 2.90 mm, but ResPhys gains 0.200 mm", "Refine"),
            ({"intervals": {"models": {"resphys": {"coverage": 0.3}}}}, "within the 90 % intervals, 30 % do", "Valid"),
            ({"range": {"resphys": {"first_s": dict.fromkeys("abc", 0)}}}, "3 of 5 trials leave the training", "Train"),
        ],
    )
    def test_a_recommendation_has_conditions(self, more, fact, remedy):
        _, check, do = sentences(self.ERRORS, **more)
        assert check.startswith("Check before use: ")
        assert fact in check
        assert do.startswith(remedy)
        fine = {"mesh_check": {"model": "sysid", "moved_mm": 0.1}, "range": {"resphys": {"first_s": {"a": 0.0}}}}
        fine |= {"placement": {"turned_deg": 1.0, "rms_mm": 0.3}}
        fine |= {"intervals": {"models": {"resphys": {"coverage": 0.88}}}}
        assert sentences(self.ERRORS, **fine)[1:] == ["Use ResPhys."]

    def test_the_error_of_the_mesh_is_set_against_what_a_model_gains_over_that_which_it_improves(self):
        errors = {"simulation": [1.0] * 5, "sysid": [0.22] * 5, "sysid_elastic": [0.2] * 5}
        check = {"model": "sysid", "moved_mm": 0.4}
        assert sentences(errors, mesh_check=check)[1:] == ["Use identification of E and \N{GREEK SMALL LETTER NU}."]
        said = sentences(errors, mesh_check={**check, "moved_mm": 0.9})
        assert "by 0.900 mm, but identification of E and \N{GREEK SMALL LETTER NU} gains 0.800 mm" in said[1]

    def test_bounds_and_first_guesses_are_counted_over_folds(self):
        identified = {"sysid": {"youngs_modulus": 2e6, "mass_damping": 0.0}, "sysid_elastic": {"poissons_ratio": 0.49}}
        guesses = {"sysid_elastic": {"poissons_ratio": 0.49}}
        metrics = metrics_of(self.ERRORS, parameters=identified, first_guesses=guesses)
        _, check, do = verdict(metrics, SETTINGS)
        assert (
            "Young's modulus is at its upper bound, 2000\N{NO-BREAK SPACE}kPa; mass damping is at its lower bound, 0 "
            in check
        )
        assert "Poisson's ratio stayed at its first guess, 0.49." in check
        assert do == "Widen identify.parameters.youngs_modulus.upper."
        del metrics["parameters"]["sysid"]["youngs_modulus"]
        assert verdict(metrics, SETTINGS)[2] == "Remove it from the fit (~identify.parameters.mass_damping)."
        both = {"folds": {"a": metrics, "b": metrics_of(self.ERRORS)}}
        assert "in 1 of 2 folds, mass damping is at its" in verdict(both, SETTINGS)[1]
        assert len(trial_errors(both)["sysid"]) == 10

    def test_trials_with_other_loads_decide(self):
        names = [f"t{k}" for k in range(5)]
        loads = settings().data.changed(others={name: {"weight_g": 50.0} for name in names})
        errors = {m: [2.0 * x for x in self.ERRORS[m]] + self.ERRORS[m] for m in ("simulation", "sysid")}
        more = {"resphys": (0.1, 0.5), "regression": (1.0, 0.01), "rest": (0.5, 3.0)}
        errors |= {model: [far] * 5 + [near] * 5 for model, (far, near) in more.items()}
        run = SimpleNamespace(data=loads, identify=None, markers=None, **WORDS)
        far = {"range": {"resphys": {"first_s": dict.fromkeys(names, 0.0)}}}
        assert sentences(errors, run, **far) == [
            "Beyond the training loads, ResPhys has 80 % less error than anything without physics (on 5 of 5 trials).",
            "Within them, regression is enough.",
        ]
        table = results_table(metrics_of(errors, scales={"1": {}, "1.5": {"resphys": {"mean": 2.0}}}), run)
        assert table.head == "My robot: mean error of the vertices [mm]"
        assert table.columns == ["weights of the paper", "other loads", "inputs \N{MULTIPLICATION SIGN} 1.5"]
        heads = {row.head: [cell.text for cell in row.cells] for row in table.rows}
        assert heads["without physics (regression, a body that does not move)"] == ["0.010", "0.500", ""]
        assert heads["+ learned force (ResPhys)"] == ["0.500", "0.100", "2.00"]
        assert [row.mark for row in table.rows if row.mark] == ["best beyond the training"]


def test_a_quick_look_says_so_in_the_table_and_at_the_top_of_the_page(tmp_path):
    run = settings("budget=quick")
    assert results_table(metrics_of({"sysid": [1.0]}), run).head.startswith("Oscillating beam, quick look: mean error")
    metrics = {"seconds": {}, "peak_memory_gib": 1.0, "versions": {}, "device": "cpu"}
    write_page(tmp_path / "report.html", lambda _: [], run, [], metrics)
    assert "<h1>Oscillating beam, quick look</h1>" in (tmp_path / "report.html").read_text(encoding="utf-8")
