"""Scores of laws on trials, and the constants that a refined law keeps."""

import math

import numpy as np
import pytest

from warp_resphys.experiment.law_trials import Score, branches_of, strong_names, unit_of

SHEAR = 100e3  # Pa


def frames(seed, scale=1.0, count=400):
    """Mean squares of two trials, with noise of its own."""
    draw = np.random.default_rng(seed)
    return tuple(scale * (1.0 + 0.1 * draw.standard_normal(count)) for _ in range(2))


class TestScore:
    def test_its_error_is_the_root_of_the_mean_of_the_trials(self):
        score = Score((np.array([1.0, 3.0]), np.array([6.0, 6.0, 6.0])))
        assert score.error == pytest.approx(2.0)
        assert Score((np.array([1.0, np.nan]),)).error == math.inf

    def test_a_small_but_certain_gain_counts(self):
        better, worse = Score(frames(0, 0.97)), Score(frames(1))
        assert better.beats(worse)
        assert not worse.beats(better)

    def test_an_uncertain_gain_does_not(self):
        less = np.where(np.arange(400) < 200, 0.9, 1.07)  # in one half of the time alone
        trial = frames(0)
        better = Score(tuple(less * own for own in trial))
        assert better.error < Score(trial).error
        assert not better.beats(Score(trial))
        assert not Score(trial).beats(Score(trial))

    def test_a_large_gain_does(self):
        few = Score((np.array([1.0, 4.0, 2.0]),))
        assert Score((0.5 * few.frames[0],)).beats(few)

    def test_one_that_fails_loses(self):
        failed = Score((np.array([1.0, np.inf]),))
        assert Score((np.array([5.0, 5.0]),)).beats(failed)
        assert not failed.beats(Score((np.array([5.0, 5.0]),)))


def test_terms_branches_and_families_that_hardly_resist_are_left_out_and_the_others_numbered_anew():
    law = {"c10": 0.0, "c01": 50e3, "ogden_3": 5.0, "bulk_1": 1e6, "shear_viscosity": 1e-3, "bulk_viscosity": 40.0}
    law |= branches_of([1.0, 2e4], [0.01, 0.5]) | {"fibre_tension_1": 3.0, "fibre_toe_1": 0.02}
    law |= {"fibre_tension_2": 5e4, "fibre_toe_2": 0.03, "fibre_azimuth_2": 0.0}
    names = strong_names(law, SHEAR)
    kept = {name: law[old] for name, old in names.items()}
    assert kept == {
        **{"c10": 0.0, "c01": 50e3, "bulk_1": 1e6, "bulk_viscosity": 40.0},
        **{"prony_modulus_1": 2e4, "prony_time_1": 0.5},
        **{"fibre_tension_1": 5e4, "fibre_toe_1": 0.03, "fibre_azimuth_1": 0.0},
    }
    assert names["prony_time_1"] == "prony_time_2"


def test_branches_are_numbered_from_a_number():
    assert branches_of([1.0], [0.5], 3) == {"prony_modulus_3": 1.0, "prony_time_3": 0.5}
    assert [unit_of(n) for n in ("c10", "prony_time_3", "bulk_viscosity", "fibre_toe_1")] == ["Pa", "s", "Pa s", ""]
