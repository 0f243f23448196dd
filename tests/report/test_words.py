"""What a run shows, in words: the verdict, the conclusions, notes, and numbers as they are written."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from support.configured import settings
from warp_resphys.io.settings import parse
from warp_resphys.learning.metrics import (
    PUBLISHED_MM,
    PUBLISHED_WINDOWS_MM,
    PublishedError,
    published_errors,
    summarise,
)
from warp_resphys.report.conclusions import (
    Identified,
    advice,
    conclusions,
    epochs_kept,
    gains,
    headline,
    intervals_text,
    untrained,
)
from warp_resphys.report.notes import error_notes, kept_note, network_note
from warp_resphys.report.page import MINUS, NO_BREAK_SPACE, duration_text, error_parts, number_text
from warp_resphys.report.recommendation import recommendation, recommended
from warp_resphys.report.run_page import largest_filtered, range_texts
from warp_resphys.report.verdict import (
    growth_text,
    learned_in_part,
    left_text,
    marker_verdict,
    published_growth,
    scale_text,
    vertex_verdict,
)
from warp_resphys.settings.learning import IdentifySettings


def summary(mean, diverged=0):
    return {"mean": mean, "std": None if mean is None else 0.1, "trajectories": 3, "diverged": diverged}


def said_of(model, sentences):
    name = {"sysid": "Identification (SysID)", "resphys": "The learned force (ResPhys)"}[model]
    (only,) = [sentence for sentence in sentences if sentence.startswith(name)]
    return only


class TestGains:
    def test_a_gain_that_other_draws_of_the_trials_show_helps(self):
        """Shares of 30, 20, 40, 30 and 30 % of the error of SysID: draws of five lie between."""
        errors = {"simulation": [2.0] * 5, "sysid": [1.0, 1.0, 2.0, 1.0, 2.2], "resphys": [0.7, 0.8, 1.2, 0.7, 1.54]}
        said = said_of("resphys", gains(errors, {"resphys": [3]}))
        assert "has 31 % (90 %: 2" in said
        assert said.endswith("less error than SysID on 5 trials (mean 1.44 to 0.988 mm): it helps.")
        said = said_of("sysid", gains({**errors, "simulation": [2.0, 0.8, 2.0, 2.0, 2.0]}, {}))
        assert "on 5 trials (mean 1.76 to 1.44 mm)" in said
        assert said.endswith("other trials may show the opposite.")

    def test_fewer_than_five_trials_give_their_errors_and_no_interval(self):
        errors = {"sysid": [1.0, 1.0, 2.0], "resphys": [0.7, 0.8, 1.2]}
        said, few = gains(errors, {"resphys": [3]})
        assert said == (
            "The learned force (ResPhys) has 32 % less error than SysID on 3 trials (1, 1 and 2 to 0.7, 0.8 and 1.2 "
            "mm)."
        )
        assert few.startswith("These gains rest on 3 held-out trials, and others may differ")

    def test_what_was_published_of_it_stands_beside_it(self):
        errors = {"sysid": [2.0, 2.0], "resphys": [2.1, 2.1]}
        assert "; published: 21.1 % less)" in said_of("resphys", gains(errors, {}, PUBLISHED_MM["sopra"]))
        worse = {"sysid": PublishedError(1.0, 0.1), "resphys": PublishedError(1.5, 0.1)}
        assert "; published: 50.0 % more)" in said_of("resphys", gains(errors, {}, worse))
        assert "published" not in said_of("resphys", gains(errors, {}, published_errors("my_robot")))
        identified = gains({"simulation": [3.0, 3.0], **errors}, {}, PUBLISHED_MM["sopra"])
        assert "published" not in said_of("sysid", identified)  # They identify other parameters.

    @pytest.mark.parametrize(
        ("after", "said"),
        [
            ([0.9, 1.2, 0.8, 0.9, 1.0], f"has 4 % (90 %: {MINUS}11 to 16) less error than SysID on 5 trials"),
            ([1.1, 1.3, 0.8, 1.1, 1.1], f"has 8 % (90 %: {MINUS}8 to 22) more error than SysID on 5 trials"),
            ([1.2, 1.3, 1.1, 1.2, 1.2], "has 20 % (90 %: 14 to 26) more error than SysID on 5 trials"),
            ([0.5, None, 0.6, 0.5, 0.5], "fails: 1 of 5 held-out roll-outs diverged."),
        ],
    )
    def test_what_does_not_help_is_said_too(self, after, said):
        errors = {"sysid": [1.0] * 5, "simulation": [1.0] * 5, "resphys": after}
        sentence = said_of("resphys", gains(errors, {"resphys": [1]}))
        assert said in sentence
        assert sentence.endswith("does harm.") == (after == [1.2, 1.3, 1.1, 1.2, 1.2])

    def test_trials_of_very_different_errors_do_not_hide_a_gain_on_each(self):
        errors = {"simulation": [0.1, 3.0, 1.0, 1.0, 2.0], "resphys": [0.00001, 0.0006, 0.0001, 0.0001, 0.0004]}
        said = said_of("resphys", gains(errors, {}))
        assert "99.98 % (90 %: 99.98 to 99.99) less" in said
        assert said.endswith("it helps.")

    def test_one_trial_has_no_spread(self):
        identified, learned, alone = gains({"simulation": [2.0], "sysid": [1.0], "resphys": [4.0]}, {})
        assert "has 50 % less" in identified
        assert "has 300 % more" in learned
        assert "one held-out trial" in alone

    def test_a_base_that_diverged_is_nothing_to_compare_with(self):
        said = said_of("sysid", gains({"simulation": [2.0, None], "sysid": [1.0, 1.0]}, {}))
        assert "cannot be compared with the uncorrected simulation" in said

    def test_no_epoch_is_no_learned_force(self):
        """Its error is that of identification, 30 % below the uncorrected one: not its own merit."""
        errors = {"simulation": [1.0, 2.0], "sysid": [0.7, 1.4], "resphys": [0.7, 1.4]}
        assert "adds nothing to SysID" in said_of("resphys", gains(errors, {"resphys": [0, 0]}))
        assert "In 1 of 2 folds no epoch" in said_of("resphys", gains(errors, {"resphys": [0, 2]}))
        assert recommended(errors, untrained({"resphys": [0, 0], "simfree": [4, 0]})) == "sysid"


class TestRecommendation:
    ERRORS: ClassVar = {
        "rest": [9.0, 8.0, 9.0, 10.0, 9.0],
        "interpolation": [1.1, 1.0, 1.2, 1.1, 1.0],
        "simulation": [3.0] * 5,
        "sysid": [0.6, 0.5, 0.7, 0.6, 0.5],
        "resphys": [0.4, 0.5, 0.5, 0.4, 0.3],
        "reconstruction": [0.01] * 5,  # Fitted to these trials.
    }

    def test_the_best_corrected_model_stands_beside_the_best_of_all_others(self):
        first, second = recommendation(self.ERRORS)
        assert first.startswith("On 5 trials the best corrected model, ResPhys, has 61 % (90 %: ")
        assert first.endswith(
            "less error than the best of all others, interpolation between the training trials, which needs no physics "
            "(mean 1.08 to 0.42 mm): it helps."
        )
        assert second == "Recommended: ResPhys."

    def test_where_no_physics_is_needed_that_is_said(self):
        first, second = recommendation({**self.ERRORS, "regression": [0.1, 0.2, 0.1, 0.1, 0.1]})
        assert "more error than the best of all others, kernel regression over the training trials" in first
        assert first.endswith(": such trials need no simulator.")
        assert second.startswith("Recommended: kernel regression over the training trials. It is for trials like")

    def test_a_gain_that_other_draws_do_not_show_is_not_recommended(self):
        errors = {**self.ERRORS, "resphys": [0.5, 0.6, 0.5, 0.5, 0.6]}
        assert recommended(errors) == "sysid"
        first, second = recommendation(errors)
        assert first.endswith(": it helps.")  # Beside the best without a correction.
        assert "SysID, the simplest model that these trials do not show to be worse than the best, ResPhys" in second

    def test_a_harmful_correction_is_called_so(self):
        first, second = recommendation({"simulation": [1.0] * 5, "resphys": [2.0, 2.1, 2.0, 2.2, 2.0]})
        assert first.endswith(": it does harm.")
        assert second == "Recommended: the uncorrected simulation."

    def test_few_trials_give_their_errors_and_no_claim(self):
        errors = {model: values[:2] for model, values in self.ERRORS.items()}
        first, second = recommendation(errors)
        assert "(1.1 and 1 to 0.4 and 0.5 mm)" in first
        assert "helps" not in first
        assert "90 %" not in first
        assert second == "Recommended: ResPhys."

    def test_a_model_that_diverged_and_an_untrained_one_are_not_compared(self):
        errors = {**self.ERRORS, "interpolation": [1.0, None, 1.0, 1.0, 1.0]}
        first, _ = recommendation(errors, {"resphys"})
        assert "the best corrected model, SysID" in first
        assert "the uncorrected simulation (mean 3 to 0.58 mm)" in first
        assert recommended({"resphys": [None]}) == ""
        assert recommendation({"resphys": [1.0]}) == []


class TestAdvice:
    @staticmethod
    def modulus(value, lower=5e4, upper=2e6, start=264e3):
        return Identified("identify.parameters.youngs_modulus", value, lower, upper, start)

    @pytest.mark.parametrize(
        ("value", "said"),
        [
            (2e6, "at its upper bound, 2e+06: widen identify.parameters.youngs_modulus.upper"),
            (5e4 + 1.0, "at its lower bound, 50000: widen"),
            (264e3, "stayed at its first guess, 264000: raise identify.max_evaluations"),
        ],
    )
    def test_bounds_and_first_guesses_get_it(self, value, said):
        (only,) = advice([[self.modulus(value)]])
        assert said in only

    def test_a_value_between_or_one_with_a_prior_gets_none(self):
        prior = Identified("identify.parameters.density", 1300.0, 1000.0, 2000.0, 1300.0, has_prior=True)
        assert advice([[self.modulus(2.6e5), prior]]) == []

    def test_a_bound_of_zero_is_taken_out_and_folds_are_counted(self):
        (said,) = advice([[Identified("identify.parameters.mass_damping", 0.0, 0.0, 10.0, 1.0)]])
        assert "take it out (~identify.parameters.mass_damping)" in said
        (said,) = advice([[self.modulus(2e6)], [self.modulus(3e5)], [self.modulus(2e6)]])
        assert said.startswith("In 2 of 3 folds, youngs_modulus was identified at its upper bound")


SETTINGS = SimpleNamespace(
    name="my_robot",
    data=None,
    identify=parse(
        IdentifySettings,
        {
            "parameters": {"youngs_modulus": {"lower": 5e4, "upper": 2e6, "logarithmic": True}},
            "elastic": {"poissons_ratio": {"lower": 0.48, "upper": 0.4995}},
        },
    ),
)


def fold(simulation, sysid, resphys, epoch, modulus):
    return {
        "per_trajectory": [{"name": "a", "errors_mm": {"simulation": simulation, "sysid": sysid, "resphys": resphys}}],
        "networks": {"resphys": {"epoch": epoch}},
        "parameters": {"sysid": {"youngs_modulus": modulus}, "sysid_elastic": {"poissons_ratio": 0.4995}},
    }


def test_conclusions_of_folds_and_of_one_split():
    metrics = {"folds": {"a": fold(2.0, 1.0, 1.0, 0, 2e6), "b": fold(2.0, 1.2, 0.6, 3, 3e5)}}
    assert epochs_kept(metrics) == {"resphys": [0, 3]}
    sentences = conclusions(metrics, SETTINGS)
    assert "has 45 % less" in said_of("sysid", sentences)
    assert headline(metrics, SETTINGS)[0] == (
        "On 2 trials the best corrected model, ResPhys, has 60 % less error than the best of all others, the "
        "uncorrected simulation (2 and 2 to 1 and 0.6 mm)."
    )
    assert "In 1 of 2 folds no epoch of its training was kept." in said_of("resphys", sentences)
    for said in ("In 1 of 2 folds, youngs_modulus", "In 2 of 2 folds, poissons_ratio"):
        assert any(sentence.startswith(said) for sentence in sentences)
    alone = conclusions(metrics["folds"]["a"], SETTINGS)
    assert "has 50 % less" in said_of("sysid", alone)
    assert "adds nothing to SysID" in said_of("resphys", alone)
    assert conclusions({"errors_mm": {}}, SETTINGS) == []


def test_intervals_are_those_of_the_best_model():
    own = {"half_width_mm": 3.0, "coverage": 0.87}
    intervals = {"level": 0.9, "calibrated_on": "validation", "models": {"sysid": own}}
    (said,) = intervals_text({"intervals": intervals})
    assert "± 3 mm" in said
    assert "SysID" in said
    assert said.endswith("87 % do.")
    assert intervals_text({"intervals": {**intervals, "models": {}}}) == intervals_text({}) == []


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ([4.5], [0.5], "9.0 times closer"),
        ([4.5], [0.0], "all the way to its target"),
        ([1.0], [1.1], "does not help"),
        ([1.0], [np.inf], "1 of 1 test roll-outs diverged, so there is no mean error to report. Without it: 1.000"),
        ([np.nan], [1.0], "Uncorrected, 1 of 1 test roll-outs diverge"),
    ],
)
def test_verdict_on_vertices(before, after, said):
    errors = {"simulation": summarise([np.array(before)]), "resphys": summarise([np.array(after)])}
    assert said in vertex_verdict(errors, {}, "wrong", "right")


def test_verdict_on_markers():
    means = {"simulation": 0.9, "sysid_elastic": 0.8, "sysid": None, "resphys": 0.2}
    errors = {model: summary(mean) for model, mean in means.items()}
    assert marker_verdict(errors, ["a"], 1.4, folds=True) == marker_verdict(errors, ["a"], 1.4)
    said = marker_verdict(errors, ["a"], 1.4)
    assert "On trial a, " in said
    assert "0.200 mm from the measured ones over the first 1.4 s with ResPhys; diverged with SysID, " in said
    assert said.endswith("0.900 mm uncorrected.")
    lost = {"sysid": summary(2.0), "resphys": summary(None, 1)}
    assert "ResPhys diverged in 1 of 3 roll-outs" in marker_verdict(lost, ["a", "b"], None)
    said = marker_verdict({"sysid": {"mean": 1.0}}, ["step"], None, parted=True)
    assert "in the part held out from training and identification" in said


def test_a_trial_whose_rest_is_the_test_is_not_called_unseen():
    def parted(train, train_fraction):
        return SimpleNamespace(recorded=SimpleNamespace(train=train), train_fraction=train_fraction)

    assert learned_in_part(parted(("step",), 0.5), ["step"])
    assert not learned_in_part(parted(("step",), 0.5), ["step", "other"])
    assert not learned_in_part(parted(("step",), 1.0), ["step"])
    assert not learned_in_part(parted(35, 0.5), ["step"])


def test_growth_and_scales():
    horizons = PUBLISHED_WINDOWS_MM["sopra_extrapolation"]
    assert 100.0 * published_growth(horizons, "5", "10")["resphys"] == pytest.approx(5.4, abs=0.05)
    said = growth_text({"resphys": -0.021}, ["10", "5"], horizons)
    assert "falls by 2.1 % (published: 5.4 %)" in said
    assert growth_text({"resphys": -0.021}, ["5"], horizons) == ""
    errors = {"sysid": summary(2.0), "resphys": summary(2.1)}
    over = {"1": errors, "1.5": {"sysid": summary(3.0), "resphys": summary(None, 2)}, "1.25": errors}
    assert "At 1.5 times the training inputs the error is diverged with ResPhys, 3.000 mm" in scale_text(over)
    assert scale_text({}) == ""
    assert largest_filtered({}) == ""
    filtered = largest_filtered({"median_filtered": {"resphys": 1.5, "sysid": None}})
    assert "reaches 1.500 mm (ResPhys)" in filtered.replace(NO_BREAK_SPACE, " ")


def test_trials_out_of_range_are_counted_where_they_belong():
    none, some, late = {"first_s": {}}, {"first_s": {"b": 2.5, "a": 1.0}}, {"first_s": {"d": 0.25}}
    metrics = {
        "range": {"resphys": some, "simfree": none},
        "scales_range": {
            "1": {"resphys": some, "simfree": none},
            "1.5": {"resphys": late, "simfree": none},
            "1.25": {"resphys": none, "simfree": none},
        },
    }
    free, force = (text.replace(NO_BREAK_SPACE, " ") for text in range_texts(metrics, ["a", "b", "c"]))
    assert free.startswith("SimFree: none of 3 roll-outs")
    assert "higher" not in free
    assert "ResPhys: 2 of 3 roll-outs left the training range, the first after 1.00 s (a)." in force
    assert "none of 3 (1.25 times), 1 of 3 (1.5 times), the first after 0.25 s (d)" in force
    (alone,) = range_texts({"range": {"resphys": {"first_s": {"a": 0.5}}}}, ["a"])
    assert alone.startswith("ResPhys: the roll-out left")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["network=published", "trainer=published"], ("the published network", "5 blocks of 3", "as published, 1000")),
        ([], ("our network", "6 position, 6 velocity and 12 force modes", "ridge regression", "our way, 300 epochs")),
        (
            ["network=published", "network.width=64", "trainer=published", "trainer.epochs=10"],
            ("our network, in force, positions and velocities", "layers of 64", "our way, 10 epochs"),
        ),
    ],
)
def test_it_is_said_whose_network_it_is(options, said):
    note = network_note(settings(*options))
    assert all(words in note for words in said)
    more = network_note(settings(*options, "+in_the_loop=windows"))
    assert more == f"{note} Then trained through the simulator, on windows of 10 steps."


def test_it_is_said_which_weights_were_taken():
    kept = {"selection": "rollout", "epoch": 30, "validation_rollout_error_mm": 0.25}
    lost = {"selection": "validation_loss", "epoch": 9, "validation_rollout_error_mm": None}
    first = kept_note({"resphys": kept})
    assert "epoch 30, by roll-out error; its mean roll-out error on the validation split is 0.250 mm" in first
    assert "epoch 9, by validation loss; its roll-outs of the validation split diverge" in kept_note({"resphys": lost})
    assert kept_note({}) == ""


def test_what_of_the_errors_is_mesh():
    check = {"cells": [100, 800], "model": "sysid", "errors_mm": [1.0, 0.9], "moved_mm": 0.2}
    (said,) = error_notes({}, {}, check)
    assert "800 instead of 100 cells" in said
    assert "0.900 mm instead of 1.000 mm" in said
    (said,) = error_notes({}, {}, {**check, "failed": "it diverged."})
    assert said.endswith("it diverged.")
    assert len(error_notes({"a": 2.0}, {"noise_mm": 0.1}, {})) == 2


def test_numbers_have_sensible_digits():
    shown = [number_text(value) for value in (4.48812, 0.000721, 0.0, None)]
    assert shown == ["4.488", "0.00072", "0.000", "diverged"]
    assert number_text(2.14e-9) == "2.1 \N{MULTIPLICATION SIGN} 10⁻⁹"
    deviating = {"mean": 0.000721, "std": 0.00031, "trajectories": 5, "diverged": 0}
    assert error_parts(deviating) == ("0.00072", "± 0.00031")
    assert error_parts({**deviating, "std": None}) == ("0.00072", "")  # of one fold
    shown = [duration_text(seconds) for seconds in (0.421, 12.34, 59.97, 184.6)]
    assert shown == ["0.42 s", "12.3 s", "60.0 s", "3 min 05 s"]


def test_a_body_that_left_the_states_of_the_training_is_said_in_bold():
    """The corrected simulator counts, over all folds; without one that left, there is no sentence."""
    one = {"range": {"simfree": {"first_s": {"a": 0.1}}, "resphys": {"first_s": {}}}}
    other = {"range": {"simfree": {"first_s": {}}, "resphys": {"first_s": {"b": 0.25}}}}
    assert left_text(one) is None
    text = left_text({"folds": {"a": one, "b": other}})
    assert text.startswith("<strong>In 1 test trial the body left the training range, the first after 0.25")
    assert text.endswith("</strong>")
    assert left_text(other, "a") is None
    assert left_text(other, "b").startswith("<strong>In the test trial b the body left")
    assert "<script>" not in left_text({"range": {"resphys": {"first_s": {"<script>": 1.0}}}})
