"""Errors of roll-outs against values computed by hand,
and the coverage of prediction intervals with known errors.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from warp_resphys.data.driving import phases, time_since_change
from warp_resphys.io.errors import InputError
from warp_resphys.learning import metrics
from warp_resphys.learning.intervals import Intervals, Predicted, coverage
from warp_resphys.learning.scores import held_out_test, text_of


def two_vertices(*distances: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A roll-out whose two vertices are off by the given distances [m]
    at each state, and its target.
    """
    target = np.random.default_rng(0).normal(size=(len(distances), 2, 3))
    directions = np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])  # Unit vectors.
    return target + np.asarray(distances)[:, :, None] * directions, target


def test_summary_pools_steps_and_takes_the_deviation_of_the_vertex_means() -> None:
    # Per-step means 1, 2 | 3, 6: mean 3, population variance ((2^2 + 1^2 + 0 + 3^2) / 4) = 3.5.
    summary = metrics.summarise([np.array([1.0, 2.0]), np.array([3.0, 6.0])])
    assert summary == {
        "mean": 3.0,
        "std": pytest.approx(np.sqrt(3.5)),
        "trajectories": 2,
        "diverged": 0,
    }


@pytest.mark.parametrize("bad", [np.nan, 1e300])
def test_a_diverged_rollout_is_counted_and_leaves_no_mean(bad: float) -> None:
    positions, target = two_vertices((0.0, 0.0), (0.001, 0.001), (0.001, 0.001))
    good = metrics.marker_errors(positions[1:], target[1:])
    positions[2, 1] = bad
    errors = metrics.marker_errors(positions[1:], target[1:])
    assert errors[0] == pytest.approx(1.0)
    summary = metrics.summarise([good, errors])
    assert (summary["mean"], summary["std"], summary["diverged"], summary["trajectories"]) == (
        None,
        None,
        1,
        2,
    )
    entries = metrics.summarise_trajectories(["a", "b"], {"resphys": [good, errors]})
    assert [entry["errors_mm"]["resphys"] for entry in entries] == [pytest.approx(1.0), None]
    json.dumps([summary, entries], allow_nan=False)


def test_trials_have_equal_weight() -> None:
    folds = [
        {
            "resphys": metrics.summarise([np.array([1.0, 1.0, 1.0])]),
            "simfree": metrics.summarise([np.array([2.0])]),
        },
        {
            "resphys": metrics.summarise([np.array([3.0]), np.array([5.0])]),
            "simfree": metrics.summarise([np.array([np.nan])]),
        },
    ]
    result = metrics.summarise_folds(folds)
    assert result["resphys"] == {"mean": 3.0, "std": 1.5, "trajectories": 3, "diverged": 0}
    assert result["simfree"] == {"mean": None, "std": None, "trajectories": 2, "diverged": 1}
    assert metrics.summarise([np.array([1.0, 1.0, 1.0]), np.array([3.0])])["mean"] == 2.0
    simulated, seen = 1e-3 * np.array([[1.0], [4.0]]) * np.ones((2, 3)), np.zeros((2, 3))
    seen[1, 1:] = np.nan
    by_marker = metrics.errors_per_marker(
        *(x[..., None, None] * [1.0, 0.0, 0.0] for x in (simulated, seen)), ["tip"]
    )
    assert by_marker == {"tip": pytest.approx(2.5)}
    assert metrics.summarise_folds(folds[:1])["resphys"] == {
        "mean": 1.0,
        "std": None,
        "trajectories": 1,
        "diverged": 0,
    }


def test_a_paired_gain_is_that_of_the_means_with_the_spread_of_the_trials():
    result = metrics.paired_gain([2.0, 1.0, 3.0], [1.0, 0.5, 1.5])
    # The same on each trial, however large.
    assert result.share == result.lower == result.upper == pytest.approx(0.5)
    assert metrics.paired_gain([1.0], [1.2]) == (
        pytest.approx(-0.2),
        pytest.approx(-0.2),
        pytest.approx(-0.2),
        1,
    )
    two = metrics.paired_gain([1.0, 1.0], [0.5, 0.9])
    assert (two.share, two.lower, two.upper) == (
        pytest.approx(0.3),
        pytest.approx(0.1),
        pytest.approx(0.5),
    )


@pytest.mark.parametrize("count", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_intervals_of_gains_have_their_stated_coverage(count):
    """Trials whose gains scatter by as much again as their mean:
    85 to 95 % where 90 % are meant.
    """
    draw, inside = np.random.default_rng(3), 0
    for _ in range(300):
        before = draw.uniform(0.5, 2.0, count)
        result = metrics.paired_gain(before, before * (0.8 + 0.2 * draw.normal(size=count)))
        inside += result.lower <= 0.2 <= result.upper
    assert 0.85 < inside / 300 < 0.95


def test_a_driven_trial_rises_holds_and_is_released():
    times = 0.25 * np.arange(12)
    # Noise is no change.
    inputs = np.array([0.0, 1.0, 1.005, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 0.5, 0.5, 0.5])

    def found(inputs, before=0.0):
        since = time_since_change(times[:, None], [inputs[:, None, None]])[:, 0]
        return " ".join(word[:3] or "-" for word in phases(since, np.abs(inputs), before))

    assert found(inputs) == "- ris ris ris hol ris ris ris hol rel rel rel"
    assert found(-np.ones(12)) == "ris ris ris" + 9 * " hol"
    assert found(np.ones(12), before=1.0) == " ".join(12 * "-")
    assert found(0.2 * np.ones(12), before=1.0) == " ".join(12 * ["rel"])


def test_published_numbers_are_those_of_the_same_experiment():
    assert (
        metrics.published_errors("sopra_extrapolation")
        is metrics.PUBLISHED_MM["sopra_extrapolation"]
    )
    assert metrics.published_errors("sopra_overpressure") is metrics.PUBLISHED_MM["sopra"]
    assert metrics.published_errors("beam_real_repeated") is metrics.PUBLISHED_MM["beam_real"]
    assert metrics.published_errors("segment_real") == {}


def test_mean_distances_count_what_was_seen():
    measured = np.zeros((1, 4, 2, 3))
    measured[0, 1, 0] = np.nan
    measured[0, 2] = np.nan
    markers = np.zeros((1, 4, 2, 3))
    markers[0, :, 0, 0], markers[0, :, 1, 2] = 0.001, 0.003
    markers[0, 2:, 0] = np.nan
    np.testing.assert_allclose(
        metrics.mean_distance(markers, measured)[0], [2.0, 3.0, np.nan, np.inf]
    )


def test_the_median_filter_is_one_of_a_second_and_leaves_out_what_is_not_known():
    values = np.random.default_rng(1).normal(size=(2, 300))
    smooth = metrics.median_filter(values, 0.01)
    for at in (0, 20, 50, 150, 299):  # half a second to both sides: 50 steps
        np.testing.assert_allclose(
            smooth[:, at], np.median(values[:, max(0, at - 50) : at + 51], axis=1)
        )
    step = (np.arange(300) >= 150).astype(float)
    np.testing.assert_array_equal(metrics.median_filter(step, 0.01), step)
    spike = np.zeros(300)
    spike[100:150] = 5.0  # shorter than half of the window
    assert metrics.median_filter(spike, 0.01).max() == 0.0
    assert metrics.median_filter(spike, 0.02).max() == 5.0  # at this step it lasts a second
    values = np.array([1.0, np.nan, 3.0, np.inf, np.nan, np.nan, np.nan])
    filtered = metrics.median_filter(values, 1.0, 2.0)
    np.testing.assert_array_equal(filtered, [1.0, 2.0, np.inf, np.inf, np.inf, np.nan, np.nan])
    for step, window in ((0.0, 1.0), (0.01, -1.0), (np.nan, 1.0)):
        with pytest.raises(InputError, match="both must be positive"):
            metrics.median_filter(values, step, window)


REST = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])


def constant(moved, since):
    return 1e-3 + 0.0 * moved


def growing(moved, since):
    return 1e-4 + 0.2 * moved


def transient(moved, since):
    return 1e-4 + (0.02 + 0.4 * np.exp(-since / 0.3)) * moved


def trials(count, seed, noise, frames=60):
    """Swinging markers, and observed ones with slowly varying errors of a size
    ``noise(displacement, time)`` [m].
    """
    draw = np.random.default_rng(seed)
    made = {}
    for number in range(count):
        time = np.linspace(0.0, 3.0, frames)[:, None, None]
        x = REST + draw.uniform(0.5, 1.5) * np.array([0.01, 0.03])[:, None] * np.sin(
            2.0 * time + draw.uniform(0.0, 6.0)
        )
        shocks = draw.normal(size=x.shape)
        shocks[1:] *= 0.6
        shocks = lfilter([1.0], [1.0, -0.8], shocks, axis=0)
        moved = np.linalg.norm(x - REST, axis=-1, keepdims=True)
        made[str(number)] = Predicted(x, x + noise(moved, time) * shocks, time[:, 0, 0])
    return made


def by_amplitude(intervals, some):
    """Coverage in the thirds of the displacements, from the smallest."""
    moved = np.concatenate(
        [np.linalg.norm(trial.simulated - REST, axis=-1).ravel() for trial in some.values()]
    )
    inside = np.concatenate([intervals.covered(trial, REST)[0] for trial in some.values()])
    return [part.mean() for part in np.array_split(inside[np.argsort(moved)], 3)]


def covered(intervals, some):
    return coverage({name: intervals.covered(trial, REST) for name, trial in some.items()})


@pytest.mark.parametrize("noise", [constant, growing, transient])
@pytest.mark.parametrize("count", [3, 10])
def test_intervals_have_their_coverage_on_other_trials_of_any_amplitude(noise, count):
    """Mean coverage over many calibrations, with few or many trials."""
    seeds = range(30 if count == 3 else 12)  # few trials calibrate to more different intervals
    made = [
        (Intervals.calibrated(trials(count, s, noise), REST), trials(20, 1000 + s, noise))
        for s in seeds
    ]
    results = [covered(*pair) for pair in made]
    assert 0.86 < np.mean([result["coverage"] for result in results]) < 0.96
    thirds = np.mean([by_amplitude(*pair) for pair in made], axis=0)
    assert (thirds > 0.84).all(), thirds
    assert (thirds < 0.97).all(), thirds


def test_intervals_are_as_wide_as_the_errors_are_large():
    """Intervals that grow with time hold 90 % of Gaussian errors,
    which lie within 1.64 deviations.
    """
    intervals = Intervals.calibrated(trials(30, 3, transient), REST)
    x = REST + np.array([0.02, 0.0, 0.0])
    for since in (0.05, 0.5, 3.0):
        expected = 1.64 * transient(0.02, since)
        np.testing.assert_allclose(intervals.half_widths(x, REST, since), expected, rtol=0.35)
    # At an unknown time.
    assert (intervals.half_widths(x, REST) >= intervals.half_widths(x, REST, 0.05)).all()
    times = np.array([0.05, 3.0])
    series = intervals.half_widths(np.stack([x, x]), REST, times)
    assert series.shape == (2, 2)
    assert (series[0] > 3.0 * series[1]).all()


def test_intervals_are_wider_for_a_marker_with_larger_errors():
    made = trials(8, 0, constant)
    for trial in made.values():
        trial.observed[:, 1] += 0.004
    intervals = Intervals.calibrated(made, REST)
    assert intervals.factor[1] > 1.5 * intervals.factor[0]
    again = Intervals.from_plain(intervals.plain())
    assert again == intervals
    held = covered(again, made)
    assert held["coverage"] > 0.9
    assert 1.5 < held["half_width_mm"] < 6.0
    assert Intervals.from_plain({"coverage": 0.9, "half_width_mm": 1.0}) is None  # Of folds.
    assert Intervals.from_plain(None) is None


def test_unseen_markers_have_no_influence_on_intervals_and_diverged_models_have_none():
    made = trials(6, 1, constant)
    whole = Intervals.calibrated(made, REST)
    for trial in [*made.values()][:3]:
        trial.observed[10:, 0] = np.nan
    some = Intervals.calibrated(made, REST)
    at = REST + 0.01
    assert some.half_widths(at, REST, 1.0) == pytest.approx(
        whole.half_widths(at, REST, 1.0), rel=0.3
    )
    made["0"].observed[:] = np.nan
    assert np.isfinite(covered(some, made)["coverage"])
    made = trials(4, 2, constant)
    made["2"].simulated[30:] = np.nan
    assert Intervals.calibrated(made, REST) is None


def test_the_time_since_a_change_is_not_reset_by_noise():
    times = np.broadcast_to(0.1 * np.arange(8.0)[:, None], (8, 2))
    valve = np.zeros((8, 2, 1))
    valve[3:, 0] = 1.0
    valve[:, 1, 0] = np.linspace(0.0, 1.0, 8)  # A ramp changes throughout.
    noise = 0.01 * np.random.default_rng(0).uniform(-1.0, 1.0, valve.shape)
    since = time_since_change(times, [valve + noise * [[[1.0], [0.0]]]])
    np.testing.assert_allclose(since[:, 0], [0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(since[:, 1], 0.0)
    np.testing.assert_allclose(time_since_change(times, []), times)
    assert np.isinf(time_since_change(times[:1], [valve[:1]])).all()


def test_intervals_grow_with_the_uncertainty_of_the_parameters():
    """Outside of the calibration trials, where the spread is a hundred times
    as large and the errors follow it.
    """

    def spread_out(count, seed, size):
        draw = np.random.default_rng(seed)
        made = {}
        for name, trial in trials(count, seed, constant).items():
            off = size * draw.normal() * np.ones((1, 2, 3))  # An error of a parameter lasts.
            made[name] = replace(
                trial, observed=trial.observed + off, spread=np.full((60, 2), size**2)
            )
        return made

    intervals = Intervals.calibrated(spread_out(20, 6, 1e-3), REST)
    outside = covered(intervals, spread_out(200, 7, 0.1))
    assert outside["coverage"] > 0.85
    assert outside["half_width_mm"] < 3.0 * 100.0  # deviations of the error
    known, new = (
        {name: replace(t, spread=None) for name, t in spread_out(*which).items()}
        for which in ((20, 6, 1e-3), (200, 7, 0.1))
    )
    assert covered(Intervals.calibrated(known, REST), new)["coverage"] < 0.1
    assert 1.0 <= intervals.variance[-1] < 2.0


def test_intervals_grow_beyond_the_training_as_the_errors_of_its_largest_trial_do():
    """A model lacks a tenth of what it moves beyond its training,
    which calibration within the training cannot show.
    """

    def moved(size, reach, seed):
        along = np.linspace(0.0, size, 60)[:, None, None] * np.array([1.0, 0.0, 0.0])
        x = REST + along + np.zeros((60, 2, 3))
        off = 0.1 * np.maximum(np.linalg.norm(along, axis=-1, keepdims=True) - reach, 0.0)
        noise = np.random.default_rng(seed).normal(scale=1e-4, size=x.shape)
        return Predicted(x, x + off + noise, np.full(60, np.inf))

    within = Intervals.calibrated({str(k): moved(0.010, 1.0, k) for k in range(5)}, REST)
    growing = within.growing(moved(0.015, 0.010, 5), 0.010, 0.015, REST)
    tested, inside = {"x": moved(0.030, 0.015, 6)}, {"x": moved(0.012, 1.0, 7)}
    assert covered(within, tested)["coverage"] < 0.65
    assert covered(growing, tested)["coverage"] > 0.9
    # Student's quantile, as it is known from one trial
    assert growing.growth == pytest.approx(6.31 * 0.1, rel=0.1)
    assert covered(growing, inside) == covered(within, inside)
    assert Intervals.from_plain(growing.plain()) == growing
    exact = within.growing(moved(0.015, 1.0, 8), 0.010, 0.015, REST)
    assert exact.growth < 0.2 * growing.growth
    # 0.1 mm show nothing
    assert within.growing(moved(0.0101, 1.0, 9), 0.010, 0.0101, REST).growth == 0.0
    # What the scale contains does not count again.
    unsure = Intervals(within.factor, (0.25e-6, 0.0, 0.0, 0.0, 0.0))
    assert unsure.growing(moved(0.015, 0.010, 5), 0.010, 0.015, REST).growth < 0.2 * growing.growth


class TestHeldOut:
    """A model beside the simulator alone, by mean distances of frames [mm]."""

    FRAMES = np.full(50, 1.0)

    def used(self, errors, below, sizes):
        trials = [str(number) for number in range(len(sizes))]
        rows = ([x * self.FRAMES for x in some] for some in (errors, below))
        return held_out_test(trials, "validation", *rows, sizes)["used"]

    def test_a_gain_counts_if_it_is_larger_than_its_spread_over_the_trials(self):
        assert self.used([0.8, 0.7, 0.9], [1.0, 1.0, 1.0], [20.0] * 3)
        # It gains on one trial alone.
        assert not self.used([1.05] * 5 + [1.0], [1.0] * 5 + [2.0], [20.0] * 6)
        assert not self.used([0.9999], [1.0], [20.0])
        assert not self.used([1.0], [0.0], [20.0])

    def test_a_trial_that_hardly_moves_decides_nothing(self):
        assert self.used([0.1, 0.1, 0.1, 0.05], [0.3, 0.3, 0.3, 0.04], [20.0, 20.0, 20.0, 0.02])
        assert self.used([0.1, 0.1], [0.9, 0.9], [20.0, np.nan])

    def test_trials_without_a_marker_are_refused(self):
        with pytest.raises(
            InputError, match=r"none of the validation trials shows a marker: a; take others"
        ):
            held_out_test(["a"], "validation", [np.zeros(0)], [np.zeros(0)], [20.0])

    def test_what_diverged_is_not_used_and_said_to(self):
        lost = held_out_test(["a"], "validation", [np.full(1, np.nan)], [self.FRAMES], [20.0])
        assert (lost["used"], lost["error_mm"]) == (False, None)
        assert text_of(lost).startswith(
            "on the validation trials (a) it diverges, and the simulator without it has 1 mm"
        )
        assert held_out_test(["a"], "validation", [self.FRAMES], [np.full(1, np.nan)], [20.0])[
            "used"
        ]
