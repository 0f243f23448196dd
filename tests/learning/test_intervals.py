"""Prediction intervals: coverage with known errors, also by displacement and time since a change of the inputs."""

from dataclasses import replace

import numpy as np
import pytest

from warp_resphys.data.driving import time_since_change
from warp_resphys.learning.intervals import Intervals, Predicted, coverage

REST = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])


def constant(moved, since):
    return 1e-3 + 0.0 * moved


def growing(moved, since):
    return 1e-4 + 0.2 * moved


def transient(moved, since):
    return 1e-4 + (0.02 + 0.4 * np.exp(-since / 0.3)) * moved


def trials(count, seed, noise, frames=60):
    """Swinging markers, and observed ones with slowly varying errors of a size ``noise(displacement, time)`` [m]."""
    draw = np.random.default_rng(seed)
    made = {}
    for number in range(count):
        time = np.linspace(0.0, 3.0, frames)[:, None, None]
        x = REST + draw.uniform(0.5, 1.5) * np.array([0.01, 0.03])[:, None] * np.sin(
            2.0 * time + draw.uniform(0.0, 6.0)
        )
        shocks = draw.normal(size=x.shape)
        for k in range(1, frames):
            shocks[k] = 0.8 * shocks[k - 1] + 0.6 * shocks[k]
        moved = np.linalg.norm(x - REST, axis=-1, keepdims=True)
        made[str(number)] = Predicted(x, x + noise(moved, time) * shocks, time[:, 0, 0])
    return made


def by_amplitude(intervals, some):
    """Coverage in the thirds of the displacements, from the smallest."""
    moved = np.concatenate([np.linalg.norm(trial.simulated - REST, axis=-1).ravel() for trial in some.values()])
    inside = np.concatenate([intervals.covered(trial, REST)[0] for trial in some.values()])
    return [part.mean() for part in np.array_split(inside[np.argsort(moved)], 3)]


def covered(intervals, some):
    return coverage({name: intervals.covered(trial, REST) for name, trial in some.items()})


@pytest.mark.parametrize("noise", [constant, growing, transient])
@pytest.mark.parametrize("count", [3, 10])
def test_intervals_have_their_coverage_on_other_trials_of_any_amplitude(noise, count):
    """Mean coverage over many calibrations, with few or many trials."""
    made = [(Intervals.calibrated(trials(count, s, noise), REST), trials(20, 1000 + s, noise)) for s in range(30)]
    results = [covered(*pair) for pair in made]
    assert 0.86 < np.mean([result["coverage"] for result in results]) < 0.96
    thirds = np.mean([by_amplitude(*pair) for pair in made], axis=0)
    assert (thirds > 0.84).all(), thirds
    assert (thirds < 0.97).all(), thirds


def test_intervals_are_as_wide_as_the_errors_are_large():
    """Of the growing ones of Gaussian errors 90 % lie within 1.64 deviations."""
    intervals = Intervals.calibrated(trials(30, 3, transient), REST)
    x = REST + np.array([0.02, 0.0, 0.0])
    for since in (0.05, 0.5, 3.0):
        expected = 1.64 * transient(0.02, since)
        np.testing.assert_allclose(intervals.half_widths(x, REST, since), expected, rtol=0.35)
    assert (intervals.half_widths(x, REST) >= intervals.half_widths(x, REST, 0.05)).all()  # At an unknown time.
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


def test_unseen_markers_have_no_influence_on_intervals():
    made = trials(6, 1, constant)
    whole = Intervals.calibrated(made, REST)
    for trial in [*made.values()][:3]:
        trial.observed[10:, 0] = np.nan
    some = Intervals.calibrated(made, REST)
    at = REST + 0.01
    assert some.half_widths(at, REST, 1.0) == pytest.approx(whole.half_widths(at, REST, 1.0), rel=0.3)
    made["0"].observed[:] = np.nan
    assert np.isfinite(covered(some, made)["coverage"])


def test_a_model_that_diverges_has_no_intervals():
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
    """Outside of the calibration trials, where the spread is a hundred times as large and the errors follow it."""

    def spread_out(count, seed, size):
        draw = np.random.default_rng(seed)
        made = {}
        for name, trial in trials(count, seed, constant).items():
            off = size * draw.normal() * np.ones((1, 2, 3))  # An error of a parameter lasts.
            made[name] = replace(trial, observed=trial.observed + off, spread=np.full((60, 2), size**2))
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
