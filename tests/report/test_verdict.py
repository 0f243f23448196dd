"""What a run shows, in words."""

import pytest

from warp_resphys.learning.metrics import paired_gain
from warp_resphys.report.page import MINUS
from warp_resphys.report.verdict import (
    Identified,
    advice,
    best,
    epochs_kept,
    gains,
    judgement,
    learned_in_part,
    marker_verdict,
    reduction_text,
    untrained,
)


def summary(mean):
    return {"mean": mean, "std": 0.1, "trajectories": 3, "diverged": int(mean is None)}


def said_of(model, sentences):
    name = {"sysid": "Identification (SysID)", "resphys": "The learned force (ResPhys)"}[model]
    (found,) = [each for each in sentences if each.startswith(name)]
    return found


def test_a_gain_that_other_draws_of_the_trials_show_helps():
    """Shares of 30, 20 and 40 % on each trial: draws of three lie between."""
    errors = {"simulation": [2.0, 2.0, 2.0], "sysid": [1.0, 1.0, 2.0], "resphys": [0.7, 0.8, 1.2]}
    assert said_of("resphys", gains(errors, {"resphys": [3]})) == (
        "The learned force (ResPhys) leaves 32 % (90 %: 20 to 40) less error than SysID on 3 trials (mean 1.33 to "
        "0.9 mm): it helps."
    )
    assert "leaves 33 % (90 %: 0 to 50) less error than the uncorrected" in said_of("sysid", gains(errors, {}))
    assert said_of("sysid", gains(errors, {})).endswith("other trials may show the opposite.")


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (
            [0.9, 1.2, 0.8],
            f"leaves 3 % (90 %: {MINUS}20 to 20) less error than SysID on 3 trials (mean 1 to 0.967 mm): other",
        ),
        (
            [1.1, 1.3, 0.9],
            f"leaves 10 % (90 %: {MINUS}10 to 30) more error than SysID on 3 trials (mean 1 to 1.1 mm): other",
        ),
        (
            [1.2, 1.3, 1.1],
            "leaves 20 % (90 %: 10 to 30) more error than SysID on 3 trials (mean 1 to 1.2 mm): it does harm.",
        ),
        ([0.5, None, 0.6], "fails: 1 of 3 held-out roll-outs diverged."),
    ],
)
def test_what_does_not_help_is_said_too(after, said):
    errors = {"sysid": [1.0, 1.0, 1.0], "simulation": [1.0, 1.0, 1.0], "resphys": after}
    assert f"The learned force (ResPhys) {said}" in said_of("resphys", gains(errors, {"resphys": [1]}))


def test_trials_of_very_different_errors_do_not_hide_a_gain_on_each():
    errors = {"simulation": [0.1, 3.0, 1.0], "resphys": [0.00001, 0.0006, 0.0001]}
    said = said_of("resphys", gains(errors, {}))
    assert "leaves 99.98 % (90 %: 99.98 to 99.99) less error than the uncorrected simulation on 3 trials" in said
    assert said.endswith("it helps.")


def test_one_trial_has_no_spread():
    assert gains({"simulation": [2.0], "sysid": [1.0], "resphys": [4.0]}, {}) == [
        "Identification (SysID) leaves 50 % less error than the uncorrected simulation (mean 2 to 1 mm).",
        "The learned force (ResPhys) leaves 300 % more error than SysID (mean 1 to 4 mm).",
        "All this is on one held-out trial: nothing tells whether another shows the same; test on more.",
    ]


def test_a_base_that_diverged_is_nothing_to_compare_with():
    said = said_of("sysid", gains({"simulation": [2.0, None], "sysid": [1.0, 1.0]}, {}))
    assert "cannot be compared with the uncorrected simulation, which diverged on held-out trials" in said


def test_no_epoch_is_no_learned_force():
    """Its error is that of identification, 30 % below the uncorrected one: not its own merit."""
    errors = {"simulation": [1.0, 2.0], "sysid": [0.7, 1.4], "resphys": [0.7, 1.4]}
    assert said_of("resphys", gains(errors, {"resphys": [0, 0]})) == (
        "The learned force (ResPhys) adds nothing to SysID: none of its training served held-out trials, and no epoch "
        "was kept."
    )
    said = said_of("resphys", gains(errors, {"resphys": [0, 2]}))
    assert said.endswith("In 1 of 2 folds none of its training was kept.")
    means = {model: summary(sum(each) / 2) for model, each in errors.items()}
    assert best(means, untrained({"resphys": [0, 0], "simfree": [4, 0]})) == "sysid"
    assert best({**means, "resphys": summary(0.6)}) == "resphys"
    assert best({"simulation": summary(1.0), "resphys": summary(2.0), "published": summary(0.1)}) == "simulation"
    assert best({"resphys": summary(None)}) == ""


def test_how_much_hangs_on_the_trials_is_told_in_the_words_of_the_gain():
    means = {"sysid": summary(1.0), "resphys": summary(0.7)}
    said = reduction_text(means, {}, paired_gain([1.0, 1.0, 1.0], [0.6, 0.7, 0.8]))
    assert (
        said
        == "The error of ResPhys is 30.0 % smaller than that of SysID (20 to 40 % in nine of ten draws of 3 trials)."
    )
    worse = {"sysid": summary(1.0), "resphys": summary(3.0)}
    said = reduction_text(worse, {}, paired_gain([1.0, 1.0, 1.0], [2.5, 3.0, 3.5]))
    assert (
        said == "The error of ResPhys is 3.0 times that of SysID (2.5 to 3.5 times in nine of ten draws of 3 trials)."
    )


def modulus(value, lower=5e4, upper=2e6, start=264e3):
    return Identified("identify.parameters.youngs_modulus", value, lower, upper, start)


def test_bounds_and_first_guesses_get_advice():
    assert advice([[modulus(2.6e5)]]) == []
    assert advice([[modulus(2e6)]]) == [
        "youngs_modulus was identified at its upper bound, 2e+06: widen identify.parameters.youngs_modulus.upper if "
        "the body can be so, or look for what it makes up for, such as a wrong weight, mesh or registration."
    ]
    assert advice([[modulus(5e4 + 1.0)]])[0].startswith(
        "youngs_modulus was identified at its lower bound, 50000: widen"
    )
    assert advice([[modulus(264e3)]]) == [
        "youngs_modulus stayed at its first guess, 264000: raise identify.max_evaluations or identify.starts, or take "
        "it out (~identify.parameters.youngs_modulus) if the trials do not tell about it."
    ]
    assert advice([[Identified("identify.parameters.density", 1300.0, 1000.0, 2000.0, 1300.0, known=True)]]) == []
    (said,) = advice([[Identified("identify.parameters.mass_damping", 0.0, 0.0, 10.0, 1.0)]])
    assert "mass_damping was identified at its lower bound, 0: take it out (~identify.parameters.mass_damping)" in said
    (said,) = advice([[modulus(2e6)], [modulus(3e5)], [modulus(2e6)]])
    assert said.startswith("In 2 of 3 folds, youngs_modulus was identified at its upper bound")


SETTINGS = {
    "simulation": {"youngs_modulus": 264e3, "poissons_ratio": 0.49, "model": "corotated"},
    "identify": {
        "parameters": {"youngs_modulus": {"lower": 5e4, "upper": 2e6, "logarithmic": True}},
        "elastic": {"poissons_ratio": {"lower": 0.48, "upper": 0.4995}},
        "first_guess": {},
    },
}


def fold(simulation, sysid, resphys, epoch, modulus):
    return {
        "per_trajectory": [{"name": "a", "errors_mm": {"simulation": simulation, "sysid": sysid, "resphys": resphys}}],
        "networks": {"resphys": {"epoch": epoch}},
        "parameters": {"sysid": {"youngs_modulus": modulus}, "sysid_elastic": {"poissons_ratio": 0.4995}},
    }


def test_metrics_of_folds_and_of_one_split():
    metrics = {"folds": {"a": fold(2.0, 1.0, 1.0, 0, 2e6), "b": fold(2.0, 1.2, 0.6, 3, 3e5)}}
    assert epochs_kept(metrics) == {"resphys": [0, 3]}
    sentences = judgement(metrics, SETTINGS)
    assert "leaves 45 % (90 %: 40 to 50) less error than the uncorrected simulation on 2 trials" in said_of(
        "sysid", sentences
    )
    assert "In 1 of 2 folds none of its training was kept." in said_of("resphys", sentences)
    assert any(
        each.startswith("In 1 of 2 folds, youngs_modulus was identified at its upper bound") for each in sentences
    )
    bound = "poissons_ratio was identified at its upper bound, 0.4995: widen identify.elastic.poissons_ratio.upper"
    assert any(each.startswith(f"In 2 of 2 folds, {bound}") for each in sentences)
    alone = judgement(metrics["folds"]["a"], SETTINGS)
    assert "leaves 50 % less error than the uncorrected simulation (mean 2 to 1 mm)." in said_of("sysid", alone)
    assert "adds nothing to SysID" in said_of("resphys", alone)
    assert judgement({"errors_mm": {}}, {}) == []


def test_a_trial_whose_rest_is_the_test_is_not_called_unseen():
    half = {"data": {"train": ["step"], "train_fraction": 0.5}}
    assert learned_in_part(half, ["step"])
    assert not learned_in_part(half, ["step", "other"])
    assert not learned_in_part({"data": {"train": ["step"], "train_fraction": 1.0}}, ["step"])
    assert not learned_in_part({"data": {"train": 35, "train_fraction": 0.5}}, ["step"])
    errors = {"sysid": {"mean": 1.0}}
    said = marker_verdict(errors, ["step"], None, parted=True)
    assert said.startswith("On trial step, in the part that no training or identification saw, the simulated markers")
