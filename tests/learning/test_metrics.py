"""Roll-out errors against values computed by hand."""

import json

import numpy as np
import pytest

from warp_resphys.data.driving import phases, time_since_change
from warp_resphys.io.errors import InputError
from warp_resphys.learning.metrics import (
    PUBLISHED_MM,
    errors_per_marker,
    marker_errors,
    mean_distance,
    median_filter,
    paired_gain,
    published_errors,
    summarise,
    summarise_folds,
    summarise_trajectories,
)


def two_vertices(*distances: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A roll-out whose two vertices are off by the given distances [m] at each state, and its target."""
    target = np.random.default_rng(0).normal(size=(len(distances), 2, 3))
    directions = np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])  # Unit vectors.
    return target + np.asarray(distances)[:, :, None] * directions, target


def test_summary_pools_steps_and_takes_the_deviation_of_the_vertex_means() -> None:
    # Per-step means 1, 2 | 3, 6: mean 3, population variance ((2^2 + 1^2 + 0 + 3^2) / 4) = 3.5.
    summary = summarise([np.array([1.0, 2.0]), np.array([3.0, 6.0])])
    assert summary == {"mean": 3.0, "std": pytest.approx(np.sqrt(3.5)), "trajectories": 2, "diverged": 0}


@pytest.mark.parametrize("bad", [np.nan, 1e300])
def test_a_diverged_rollout_is_counted_and_leaves_no_mean(bad: float) -> None:
    positions, target = two_vertices((0.0, 0.0), (0.001, 0.001), (0.001, 0.001))
    good = marker_errors(positions[1:], target[1:])
    positions[2, 1] = bad
    errors = marker_errors(positions[1:], target[1:])
    assert errors[0] == pytest.approx(1.0)
    summary = summarise([good, errors])
    assert (summary["mean"], summary["std"], summary["diverged"], summary["trajectories"]) == (None, None, 1, 2)
    entries = summarise_trajectories(["a", "b"], {"resphys": [good, errors]})
    assert [entry["errors_mm"]["resphys"] for entry in entries] == [pytest.approx(1.0), None]
    json.dumps([summary, entries], allow_nan=False)


def test_trials_have_equal_weight() -> None:
    folds = [
        {"resphys": summarise([np.array([1.0, 1.0, 1.0])]), "simfree": summarise([np.array([2.0])])},
        {"resphys": summarise([np.array([3.0]), np.array([5.0])]), "simfree": summarise([np.array([np.nan])])},
    ]
    result = summarise_folds(folds)
    assert result["resphys"] == {"mean": 3.0, "std": 1.5, "trajectories": 3, "diverged": 0}
    assert result["simfree"] == {"mean": None, "std": None, "trajectories": 2, "diverged": 1}
    assert summarise([np.array([1.0, 1.0, 1.0]), np.array([3.0])])["mean"] == 2.0
    simulated, seen = 1e-3 * np.array([[1.0], [4.0]]) * np.ones((2, 3)), np.zeros((2, 3))
    seen[1, 1:] = np.nan
    by_marker = errors_per_marker(*(x[..., None, None] * [1.0, 0.0, 0.0] for x in (simulated, seen)), ["tip"])
    assert by_marker == {"tip": pytest.approx(2.5)}
    assert summarise_folds(folds[:1])["resphys"] == {"mean": 1.0, "std": None, "trajectories": 1, "diverged": 0}


def test_a_paired_gain_is_that_of_the_means_with_the_spread_of_the_trials():
    result = paired_gain([2.0, 1.0, 3.0], [1.0, 0.5, 1.5])
    assert result.share == result.lower == result.upper == pytest.approx(0.5)  # the same on each trial, however large
    assert paired_gain([1.0], [1.2]) == (pytest.approx(-0.2), pytest.approx(-0.2), pytest.approx(-0.2), 1)
    two = paired_gain([1.0, 1.0], [0.5, 0.9])
    assert (two.share, two.lower, two.upper) == (pytest.approx(0.3), pytest.approx(0.1), pytest.approx(0.5))


@pytest.mark.parametrize("count", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_intervals_of_gains_have_their_stated_coverage(count):
    """Trials whose gains scatter by as much again as their mean: 85 to 95 % where 90 % are meant."""
    draw, inside = np.random.default_rng(3), 0
    for _ in range(300):
        before = draw.uniform(0.5, 2.0, count)
        result = paired_gain(before, before * (0.8 + 0.2 * draw.normal(size=count)))
        inside += result.lower <= 0.2 <= result.upper
    assert 0.85 < inside / 300 < 0.95


def test_a_driven_trial_rises_holds_and_is_released():
    times = 0.25 * np.arange(12)
    inputs = np.array([0.0, 1.0, 1.005, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 0.5, 0.5, 0.5])  # noise is no change

    def found(inputs, before=0.0):
        since = time_since_change(times[:, None], [inputs[:, None, None]])[:, 0]
        return " ".join(word[:3] or "-" for word in phases(since, np.abs(inputs), before))

    assert found(inputs) == "- ris ris ris hol ris ris ris hol rel rel rel"
    assert found(-np.ones(12)) == "ris ris ris" + 9 * " hol"
    assert found(np.ones(12), before=1.0) == " ".join(12 * "-")
    assert found(0.2 * np.ones(12), before=1.0) == " ".join(12 * ["rel"])


def test_published_numbers_are_those_of_the_same_experiment():
    assert published_errors("sopra_extrapolation") is PUBLISHED_MM["sopra_extrapolation"]
    assert published_errors("sopra_overpressure") is PUBLISHED_MM["sopra"]
    assert published_errors("beam_real_repeated") is PUBLISHED_MM["beam_real"]
    assert published_errors("segment_real") == {}


def test_mean_distances_count_what_was_seen():
    measured = np.zeros((1, 4, 2, 3))
    measured[0, 1, 0] = np.nan
    measured[0, 2] = np.nan
    markers = np.zeros((1, 4, 2, 3))
    markers[0, :, 0, 0], markers[0, :, 1, 2] = 0.001, 0.003
    markers[0, 2:, 0] = np.nan
    np.testing.assert_allclose(mean_distance(markers, measured)[0], [2.0, 3.0, np.nan, np.inf])


class TestMedianFilter:
    def test_it_is_one_of_a_second(self):
        values = np.random.default_rng(1).normal(size=(2, 300))
        smooth = median_filter(values, 0.01)
        for at in (0, 20, 50, 150, 299):  # half a second to both sides: 50 steps
            np.testing.assert_allclose(smooth[:, at], np.median(values[:, max(0, at - 50) : at + 51], axis=1))
        step = (np.arange(300) >= 150).astype(float)
        np.testing.assert_array_equal(median_filter(step, 0.01), step)
        spike = np.zeros(300)
        spike[100:150] = 5.0  # shorter than half of the window
        assert median_filter(spike, 0.01).max() == 0.0
        assert median_filter(spike, 0.02).max() == 5.0  # at this step it lasts a second

    def test_it_leaves_out_what_is_not_known(self):
        values = np.array([1.0, np.nan, 3.0, np.inf, np.nan, np.nan, np.nan])
        filtered = median_filter(values, 1.0, 2.0)
        np.testing.assert_array_equal(filtered, [1.0, 2.0, np.inf, np.inf, np.inf, np.nan, np.nan])
        for step, window in ((0.0, 1.0), (0.01, -1.0), (np.nan, 1.0)):
            with pytest.raises(InputError, match="both must be positive"):
                median_filter(values, step, window)
