"""The end of a run: its table, and what verdict, advice
and conditions say for random and for known errors.
"""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from support.configured import settings
from warp_resphys.io.settings import parse
from warp_resphys.learning.baselines import BASELINES
from warp_resphys.report.conditions import conditions
from warp_resphys.report.data import trial_errors
from warp_resphys.report.page import write_page
from warp_resphys.report.ranking import (
    LEAST_EVIDENCE,
    LEAST_TRIALS,
    recommended,
    shown_metrics,
    unused,
)
from warp_resphys.report.verdict import results_table, verdict
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
WORDS = {
    "heading": "My robot",
    "test_titles": ("weights of the paper", "other loads"),
    "targets": {},
}
SETTINGS = SimpleNamespace(name="my_robot", data=None, identify=IDENTIFY, markers=0, **WORDS)


def metrics_of(errors, **more):
    """Content of metrics.json with errors [mm] of each model on the same trials."""
    count = len(next(iter(errors.values())))
    rows = [
        {"name": f"t{k}", "errors_mm": {model: own[k] for model, own in errors.items()}}
        for k in range(count)
    ]
    return {"per_trajectory": rows, **more}


def sentences(errors, run=SETTINGS, **more):
    return [text.replace(NO_BREAK_SPACE, " ") for text in verdict(metrics_of(errors, **more), run)]


def holding(errors, run=SETTINGS, **more):
    return [
        text.replace(NO_BREAK_SPACE, " ") for text in conditions(metrics_of(errors, **more), run)
    ]


def table_of(errors, run=SETTINGS, **more):
    table = results_table(metrics_of(errors, **more), run)
    return {row.head: ([cell.text for cell in row.cells], row.mark) for row in table.rows}


@pytest.mark.parametrize("seed", range(40))
def test_what_holds_for_any_errors(seed):
    random = np.random.default_rng(seed)
    models = [model for model in MODELS if random.random() < 0.8] or ["sysid"]
    count = int(random.integers(1, 9))
    level = {model: 10.0 ** random.uniform(-4, 1) for model in models}
    errors = {
        m: [float(level[m] * 10.0 ** random.normal(0, 0.3)) for _ in range(count)] for m in models
    }
    first, use = sentences(errors)
    lines = holding(errors)
    assert all(text.endswith(".") for text in (first, use, *lines))
    best = min(models, key=lambda model: np.mean(errors[model]))
    assert (
        first.startswith("No evidence either way") == (count < LEAST_EVIDENCE) or "alone" in first
    )
    assert model_words(best).lower() in first.lower()
    assert f"{count} trial" in first
    assert [line.startswith("Trials: ") for line in lines] == [True] * (count < LEAST_TRIALS)
    enough = best in BASELINES and count >= LEAST_EVIDENCE
    assert ("is enough for trials like these" in use) == enough
    assert ("conditions" in use) == (count < LEAST_TRIALS and not enough)
    (marked,) = (head for head, (_, mark) in table_of(errors).items() if mark == "best")
    assert (model_words(best) in marked) or best not in BASELINES
    assert not {"helps", "harm", "rest", "simfree", "resphys_uncorrected"} & {
        *" ".join([first, use, *lines]).split()
    }
    if "less error than" in first:
        ours, lower = errors[best], first.partition("(on ")[2].partition(" of ")
        assert count >= LEAST_EVIDENCE
        assert int(lower[0]) > 0.5 * count
        assert any(
            sum(a < b for a, b in zip(ours, errors[m], strict=True)) == int(lower[0])
            for m in models
        )


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
        assert holding(self.ERRORS) == []
        without = {model: own for model, own in self.ERRORS.items() if model != "simfree"}
        assert (
            "has 87 % less error than anything without physics (on 5 of 5" in sentences(without)[0]
        )
        assert (
            sentences({"sysid": [1.0] * 3})[0] == "SysID has the lowest error, 1.00 mm on 3 trials."
        )
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
        assert (
            do == "Regression is enough for trials like these; to judge the simulator, test it on "
            "others."
        )
        assert recommended(metrics_of(errors), SETTINGS) == "resphys"  # Of the simulators.
        close = {**self.ERRORS, "resphys": [0.5, 0.6, 0.6, 0.5, 0.6]}
        assert (
            sentences(close)[1]
            == "Use SysID, which is simpler than ResPhys and not significantly worse."
        )
        assert recommended(metrics_of(close), SETTINGS) == "sysid"
        wide = {"sysid": [2.0, 0.1, 0.1, 0.1, 0.1], "resphys": [0.2, 0.2, 0.2, 0.2, 0.2]}
        # It has 58 % less error, though not in 90 % of the draws.
        assert sentences(wide)[1] == "Use ResPhys."
        assert sentences({"simulation": [1.0] * 6, "sysid": [1.0] * 6}) == [
            "The uncorrected simulator and SysID show no difference on 6 trials, 1.00 mm.",
            "Use the uncorrected simulator.",
        ]

    def test_less_error_is_claimed_with_three_trials_or_more_and_on_most_of_them(self):
        assert sentences({model: own[:3] for model, own in self.ERRORS.items()}) == [
            "ResPhys has 60 % less error than SimFree (on 3 of 3 trials).",
            "Recommended, under the conditions below: ResPhys.",
        ]
        assert sentences({model: own[:2] for model, own in self.ERRORS.items()}) == [
            "No evidence either way: 2 trials (ResPhys 0.350 mm, SimFree 1.05 mm).",
            "Recommended, under the conditions below: ResPhys.",
        ]
        assert sentences({"sysid": [1.0]})[0] == "No evidence either way: 1 trial (SysID 1.00 mm)."
        uneven = {"linear": [1.0, 1.0, 9.0], "sysid": [1.1, 1.2, 2.0]}
        assert sentences(uneven)[0] == (
            "No evidence either way: SysID has less error on 1 of 3 trials alone (1.43 mm, a "
            "linear model 3.67 mm)."
        )
        assert "less error than" in sentences({**uneven, "sysid": [0.9, 1.2, 2.0]})[0]
        half = {"linear": [1.0, 1.0, 9.0, 9.0], "sysid": [1.1, 1.2, 2.0, 2.0]}
        assert sentences(half)[0].startswith(
            "No evidence either way: SysID has less error on 2 of 4 trials alone"
        )

    def test_a_simulated_target_is_named_first_and_a_body_at_rest_where_the_simulator_is_no_better(
        self,
    ):
        played = SimpleNamespace(
            **{**vars(SETTINGS), "targets": {"target": None, "laboratory": None}}
        )
        errors = {"rest": [0.386] * 6, "simulation": [1.07] * 6, "sysid": [0.01] * 6}
        assert sentences(errors, played)[0] == (
            "On a simulated target and laboratory, SysID has 97 % less error than anything "
            "without physics (on 6 of 6 trials); a body that does not move has 0.386 mm, the "
            "uncorrected simulator 1.07 mm."
        )
        assert "does not move" not in sentences({**errors, "rest": [1.08] * 6}, played)[0]

    def test_what_diverged_or_was_not_trained(self):
        errors = {**self.ERRORS, "sysid": [None, 0.5, 0.7, 0.6, 0.5]}
        tests = [
            {"trials": ["a"], "split": "validation", "error_mm": 46.0, "below_mm": 11.0, "used": x}
            for x in (False, True)
        ]
        networks = {"resphys": {"test": tests[0]}, "simfree": {"test": tests[1]}}
        lines = holding(errors, networks=networks)
        why = (
            "Not used: ResPhys, as on the validation trials (a) it has 46 mm, "
            "and the simulator without"
        )
        assert lines[0].startswith(why)
        assert (
            lines[1] == "Not used: SysID diverged in 1 of 5 trials; use the uncorrected simulator."
        )
        assert recommended(metrics_of(errors, networks=networks), SETTINGS) == "simulation"
        assert table_of(errors)["+ identified parameters (SysID)"] == (["1 of 5 diverged"], "")
        folds = {"a": {"networks": networks}, "b": {"networks": {"resphys": {"test": tests[0]}}}}
        assert unused({"folds": folds}) == {
            "resphys": "it is clearly closer in none of the 2 folds"
        }
        assert sentences({"resphys": [None]})[0] == "All models diverged."
        assert sentences({"reconstruction": [0.1]}) == []
        assert recommended(metrics_of({"reconstruction": [0.1]}), SETTINGS) == ""

    def test_a_force_that_was_never_learned_is_no_row_and_no_refusal(self):
        equal = {**self.ERRORS, "actuator": self.ERRORS["resphys"]}
        metrics = metrics_of(
            equal, without_forces=True, intervals={"models": {"resphys": {}, "actuator": {}}}
        )
        shown = shown_metrics(metrics)
        heads = [row.head for row in results_table(shown, SETTINGS).rows]
        assert heads[-1] == "+ learned actuator"
        assert shown["intervals"]["models"].keys() == {"actuator"}
        assert verdict(shown, SETTINGS)[1] == "Use the learned actuator."
        assert conditions(shown, SETTINGS) == []
        assert shown_metrics(metrics_of(equal)) == metrics_of(equal)

    def test_trials_with_other_loads_decide(self):
        names = [f"t{k}" for k in range(5)]
        loads = settings().data.changed(others={name: {"weight_g": 50.0} for name in names})
        errors = {
            m: [2.0 * x for x in self.ERRORS[m]] + self.ERRORS[m] for m in ("simulation", "sysid")
        }
        more = {"resphys": (0.1, 0.5), "regression": (1.0, 0.01), "rest": (0.5, 3.0)}
        errors |= {model: [far] * 5 + [near] * 5 for model, (far, near) in more.items()}
        run = SimpleNamespace(data=loads, identify=None, markers=None, **WORDS)
        far = {"range": {"resphys": {"first_s": dict.fromkeys(names, 0.0)}}}
        assert sentences(errors, run, **far) == [
            "Beyond the training loads, ResPhys has 80 % less error than anything without "
            "physics (on 5 of 5 trials); a body that does not move has 3.00 and 0.500 mm, the "
            "uncorrected simulator 3.00 and 6.00 mm.",
            "Within them, regression is enough.",
            "Recommended, under the conditions below: ResPhys.",
        ]
        assert holding(errors, run, **far) == [
            "Beyond the training: 5 of 10 tests; ResPhys leaves the range of its training in "
            "these; train on trials that reach as far."
        ]
        table = results_table(
            metrics_of(errors, scales={"1": {}, "1.5": {"resphys": {"mean": 2.0}}}), run
        )
        assert table.head == "My robot: mean error of the vertices [mm]"
        assert table.columns == [
            "weights of the paper",
            "other loads",
            "inputs \N{MULTIPLICATION SIGN} 1.5",
        ]
        heads = {row.head: [cell.text for cell in row.cells] for row in table.rows}
        assert heads["without physics (regression, a body that does not move)"] == [
            "0.0100",
            "0.500",
            "",
        ]
        assert heads["+ learned force (ResPhys)"] == ["0.500", "0.100", "2.00"]
        assert [row.mark for row in table.rows if row.mark] == ["best beyond the training"]


REFUSED = {
    "trials": ["a"],
    "split": "validation",
    "error_mm": 46.0,
    "below_mm": 11.0,
    "used": False,
}
EACH = {  # Conditions by name: what the metrics have, and the line.
    "coverage": (
        {
            "intervals": {
                "models": {"sysid": {"coverage": 0.44, "by_trial": {"t0": 0.61, "t1": 0.27}}}
            }
        },
        "Coverage: the 90 % band holds 44 % of the measurements (27 % in t1); validate on trials "
        "like those of the test.",
    ),
    "bounds": (
        {
            "at_bounds": {
                "sysid": {"poissons_ratio": 0.3, "fibre_stiffness": 10.0, "pressure_rise": 0.0}
            }
        },
        "At a bound: Poisson's ratio 0.3, fibre stiffness 10 N/m and pressure rise 0 ms; widen "
        "such a range in identify.parameters, or add the physics that the simulator lacks.",
    ),
    "beyond": (
        {"beyond": {"t0": {"inputs": 0.2}, "t1": {"inputs": 0.4, "displacements": 0.38}}},
        "Beyond the training: 2 of 3 tests (t0, t1), by up to 40 % in inputs and 38 % in "
        "displacements; train on trials that reach as far.",
    ),
    "mesh": (
        {"mesh_check": {"model": "sysid", "moved_mm": 3.0}},
        "Mesh: a finer one moves the markers by 3.00 mm, and SysID gains 2.40 mm over the "
        "uncorrected simulator; refine the mesh first.",
    ),
    "registration": (
        {
            "placement": {
                "turned_deg": 0.0,
                "rms_mm": 0.3,
                "left_out_mm": {"Base - 1": 35.0, "Base - 2": 40.0},
            }
        },
        "Registration: Base - 1 (35.0 mm) and Base - 2 (40.0 mm) left out, as far from the "
        "nominal position; check names (exchanged ones too), nominal positions, and the unit.",
    ),
    "trials": ({}, "Trials: three trials are too few for an interval; test on five or more."),
    "refused": (
        {"networks": {"resphys": {"test": REFUSED}}},
        "Not used: ResPhys, as on the validation trials (a) it has 46 mm, and the simulator "
        "without it has 11 mm, which it does not clearly beat.",
    ),
}


class TestConditions:
    FIVE: ClassVar = {"linear": [3.0] * 5, "simulation": [3.0] * 5, "sysid": [0.6] * 5}
    THREE: ClassVar = {model: errors[:3] for model, errors in FIVE.items()}

    @pytest.mark.parametrize("name", EACH)
    def test_each_of_them_is_said_alone(self, name):
        more, line = EACH[name]
        errors = {**self.FIVE, "resphys": [0.1] * 5} if name == "refused" else self.FIVE
        errors = self.THREE if name == "trials" else errors
        assert holding(errors, **more) == [line.replace("of 3 tests", "of 5 tests")]
        assert sentences(errors, **more)[-1] == "Recommended, under the conditions below: SysID."

    def test_all_of_them_are_said_in_their_order(self):
        errors = {**self.THREE, "resphys": [0.1] * 3}
        more = {key: value for content, _ in EACH.values() for key, value in content.items()}
        assert holding(errors, **more) == [line for _, line in EACH.values()]

    @pytest.mark.parametrize("first", EACH)
    def test_any_two_of_them_keep_their_order(self, first):
        for second in [*EACH][[*EACH].index(first) + 1 :]:
            pair = {first, second}
            errors = self.THREE if "trials" in pair else self.FIVE
            errors = (
                {**errors, "resphys": [0.1] * len(errors["sysid"])} if "refused" in pair else errors
            )
            more = {
                key: x
                for name, (content, _) in EACH.items()
                if name in pair
                for key, x in content.items()
            }
            count = len(errors["sysid"])
            wanted = [
                EACH[name][1].replace("of 3 tests", f"of {count} tests") for name in (first, second)
            ]
            assert holding(errors, **more) == wanted

    def test_none_is_said_where_none_holds(self):
        fine = {"mesh_check": {"model": "sysid", "moved_mm": 0.1}, "at_bounds": {}, "beyond": {}}
        fine |= {
            "placement": {"turned_deg": 1.0, "rms_mm": 0.3},
            "range": {"sysid": {"first_s": {}}},
        }
        fine |= {
            "intervals": {
                "models": {"sysid": {"coverage": 0.88, "by_trial": {"t0": 0.76, "t1": 1.0}}}
            }
        }
        assert holding(self.FIVE, **fine) == []
        assert sentences(self.FIVE, **fine)[1:] == ["Use SysID."]

    def test_coverage_names_a_trial_that_is_much_worse_although_the_mean_is_not(self):
        by_trial = {"t0": 1.0, "t1": 1.0, "t2": 0.5, "t3": 0.74}
        lines = holding(
            self.FIVE, intervals={"models": {"sysid": {"coverage": 0.81, "by_trial": by_trial}}}
        )
        assert lines[0].startswith(
            "Coverage: the 90 % band holds 81 % of the measurements (50 % in t2)"
        )
        assert holding(self.FIVE, intervals={"models": {"sysid": {"coverage": 0.5}}})[0].startswith(
            "Coverage: the 90 % band holds 50 % of the measurements; "
        )

    def test_bounds_and_first_guesses_are_counted_over_folds(self):
        errors = TestSentences.ERRORS
        identified = {
            "sysid": {"youngs_modulus": 2e6, "mass_damping": 0.0},
            "sysid_elastic": {"poissons_ratio": 0.49},
        }
        guesses = {"sysid_elastic": {"poissons_ratio": 0.49}}
        metrics = metrics_of(
            errors, parameters=identified, first_guesses=guesses, at_bounds=identified["sysid"]
        )
        metrics["at_bounds"] = {"sysid": identified["sysid"]}
        bounds, guess = (
            text.replace(NO_BREAK_SPACE, " ") for text in conditions(metrics, SETTINGS)
        )
        assert bounds.startswith(
            "At a bound: Young's modulus 2000 kPa and mass damping 0 1/s; widen such a range"
        )
        assert guess == "At the first guess: Poisson's ratio 0.49; raise identify.starts."
        both = {"folds": {"a": metrics, "b": metrics_of(errors)}}
        assert "mass damping 0 1/s in 1 of 2 folds; widen" in conditions(both, SETTINGS)[0].replace(
            NO_BREAK_SPACE, " "
        )
        assert len(trial_errors(both)["sysid"]) == 10

    def test_bounds_of_a_law_count_if_it_is_used(self):
        law = {
            "parameters": {"c20": 0.0},
            "units": {"c20": "Pa"},
            "at_bounds": ["c20"],
            "against": "sysid",
        }
        (line,) = holding(self.FIVE, law={**law, "accepted": True})
        assert line.startswith("At a bound: c20 of the law 0 Pa; ")
        (line,) = holding(self.FIVE, law={**law, "accepted": False})
        assert (
            line == "Not used: the law of the material, as it is not clearly closer to the trials "
            "than SysID."
        )

    def test_a_network_that_leaves_its_range_is_beyond_the_training(self):
        left = {"range": {"resphys": {"first_s": {"t0": 0.1, "t4": 0.2}}}}
        errors = {**self.FIVE, "resphys": [0.1] * 5}
        assert holding(errors, **left) == [
            "Beyond the training: ResPhys leaves the range of its training in 2 of 5 tests (t0, "
            "t4); train on trials that reach as far."
        ]
        assert holding(self.FIVE, **left) == []  # It is not the model that is recommended.

    def test_the_error_of_the_mesh_is_set_against_what_a_model_gains_over_that_which_it_improves(
        self,
    ):
        errors = {"simulation": [1.0] * 5, "sysid": [0.3] * 5, "resphys": [0.1] * 5}
        check = {"model": "sysid", "moved_mm": 0.15}
        assert holding(errors, mesh_check=check) == []
        (line,) = holding(errors, mesh_check={**check, "moved_mm": 0.25})
        assert "moves the markers by 0.250 mm, and ResPhys gains 0.200 mm over SysID" in line
        (line,) = holding(errors, mesh_check={"model": "sysid", "failed": "Too fine."})
        assert line == "Mesh: its error is not known, as too fine."

    @pytest.mark.parametrize(
        ("placed", "fact"),
        [
            (
                {"turned_deg": 5.0, "rms_mm": 0.1},
                "the markers are rotated by 5.0° from it; check the positions of",
            ),
            (
                {"turned_deg": 1.0, "rms_mm": 2.1},
                "fit their nominal positions to 2.10 mm only; check names (exchanged",
            ),
        ],
    )
    def test_a_poor_registration_names_its_causes(self, placed, fact):
        (line,) = holding(self.FIVE, placement=placed)
        assert line.startswith("Registration: ")
        assert fact in line


def test_a_quick_look_says_so_in_the_table_and_at_the_top_of_the_page(tmp_path):
    run = settings("budget=quick")
    assert results_table(metrics_of({"sysid": [1.0]}), run).head.startswith(
        "Oscillating beam, quick look: mean error"
    )
    metrics = {"seconds": {}, "peak_memory_gib": 1.0, "versions": {}, "device": "cpu"}
    write_page(tmp_path / "report.html", lambda _: [], run, [], metrics)
    assert "<h1>Oscillating beam, quick look</h1>" in (tmp_path / "report.html").read_text(
        encoding="utf-8"
    )
