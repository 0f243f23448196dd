"""Predictions without physics, on motions whose law each of them contains."""

from dataclasses import replace

import numpy as np
import pytest

from warp_resphys.learning.baselines import predictions
from warp_resphys.learning.plain_trials import PlainTrials
from warp_resphys.learning.regression import regression

FRAMES = 60
TIMES = 0.02 * np.arange(FRAMES)


def motions(values, inputs=None, *, first=None, origin=None, known=None):
    """PlainTrials (R, T, P) that begin at the origin and are driven by inputs (R, T, C)."""
    rows, frames, points = values.shape
    zero = np.zeros((rows, points))
    return PlainTrials(
        values,
        zero if origin is None else origin,
        zero if first is None else first,
        np.zeros((rows, frames, 0)) if inputs is None else inputs,
        np.zeros((rows, 0)) if known is None else known,
        np.zeros((rows, 0 if inputs is None else inputs.shape[2])),
        TIMES[1],
    )


def steps(levels, response):
    """PlainTrials that follow steps of an input: a curve
    of the level times a response over time.
    """
    levels = np.asarray(levels)
    shape = np.array([1.0, 0.5, -0.2]) * (1.0 - np.exp(-TIMES / 0.2))[:, None]
    return motions(
        response(levels)[:, None, None] * shape,
        np.broadcast_to(levels[:, None, None], (len(levels), FRAMES, 1)),
    )


def error(model, trials, asked):
    return np.abs(predictions(trials, asked)[model].values - asked.values).max()


def test_between_two_levels_interpolation_is_a_straight_line_and_below_them_one_to_the_origin():
    trials = steps([1.0, 2.0, 4.0], np.square)
    assert error("interpolation", trials, steps([1.0, 2.0, 4.0], np.square)) < 1e-6
    lines = lambda x: np.interp(x, [0.0, 1.0, 2.0, 4.0], [0.0, 1.0, 4.0, 16.0])  # noqa: E731
    assert error("interpolation", trials, steps([0.5, 1.3, 3.0], lines)) < 1e-6


@pytest.mark.parametrize(
    ("kind", "response"),
    [("linear, ridge", lambda x: 0.7 * x), ("quadratic, ridge", lambda x: 0.3 * x + 0.2 * x**2)],
)
def test_regression_finds_the_form_by_leaving_trials_out_and_extrapolates_with_it(kind, response):
    trials, asked = steps([0.5, 0.8, 1.0, 1.5, 2.0], response), steps([3.0], response)
    predicted = regression(trials, asked)
    assert predicted.settings.startswith(kind)
    assert np.abs(predicted.values - asked.values).max() < 1e-4
    assert error("interpolation", trials, asked) > 0.05  # It stays where the outermost trial is.


def test_the_error_of_a_trial_that_is_left_out_chooses_a_broad_kernel_for_noise():
    random = np.random.default_rng(0)
    noise = 0.3 * random.normal(size=(12, FRAMES, 3))
    levels = np.linspace(0.5, 2.0, 12)
    clean = steps(levels, lambda x: 0.7 * x)
    noisy = motions(clean.values + noise, clean.inputs)
    asked = steps(levels + 0.03, lambda x: 0.7 * x)
    assert error("regression", noisy, asked) < 0.5 * error("interpolation", noisy, asked)


def test_a_coordinate_that_some_trials_do_not_show_is_predicted_from_the_others():
    trials = steps([1.0, 2.0, 3.0], lambda x: 0.7 * x)
    trials.values[1, 10:20, 0] = np.nan
    trials.values[:, :, 2] = np.nan
    predicted = predictions(trials, steps([1.5], lambda x: 0.7 * x))
    wanted = steps([1.5], lambda x: 0.7 * x).values
    for model in ("interpolation", "regression"):
        np.testing.assert_allclose(predicted[model].values[..., :2], wanted[..., :2], atol=1e-3)
        assert np.isnan(predicted[model].values[..., 2]).all()


def driven(seed, count=4, frames=200):
    """Two damped oscillators, seen by three coordinates and driven by two inputs
    that change all the time.
    """
    random = np.random.default_rng(seed)
    inputs = np.cumsum(0.2 * random.normal(size=(count, frames, 2)), axis=1)

    def turn(a, r):
        return r * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])

    matrix = np.zeros((4, 4))
    matrix[:2, :2], matrix[2:, 2:] = turn(0.3, 0.95), turn(0.8, 0.9)
    push = np.array([[0.0, 1.0, 0.0, 0.5], [0.3, 0.0, 0.0, 1.0]])
    seen = np.array([[1.0, 0.0, 0.3], [0.0, 0.0, 0.0], [0.0, 1.0, 0.4], [0.0, 0.0, 0.0]])
    states = [np.zeros((count, 4))]
    for t in range(1, frames):
        states.append(states[-1] @ matrix.T + inputs[:, t] @ push)
    return motions(np.stack(states, 1) @ seen, inputs)


def test_a_linear_model_predicts_a_linear_system_from_its_inputs():
    trials, asked = driven(1), driven(2)
    assert error("linear", trials, asked) < 0.02 * np.abs(asked.values).max()
    assert error("linear", trials, asked) < 0.1 * error("regression", trials, asked)


def test_a_model_linear_in_time_finds_the_degree_of_its_inputs():
    curved = lambda seed: motions(driven(seed).values, np.cbrt(driven(seed).inputs))  # noqa: E731
    predicted = predictions(curved(1), curved(2))["linear"]
    assert predicted.settings.startswith("degree 3")
    assert np.abs(predicted.values - driven(2).values).max() < 0.02 * np.abs(driven(2).values).max()


def lagging(seed, *, before, count=5, frames=300):
    """A body behind two inputs, by 0.1 s with their squares and by 3 s.

    It rests under the first or none.
    """
    random = np.random.default_rng(seed)
    inputs = np.repeat(random.normal(size=(count, 10, 2)), frames // 10, axis=1)
    begin = inputs[:, 0] if before else 0.0 * inputs[:, 0]
    fast, slow = [begin], [begin]
    for k in range(frames):
        fast.append(inputs[:, k] + np.exp(-TIMES[1] / 0.1) * (fast[-1] - inputs[:, k]))
        slow.append(inputs[:, k] + np.exp(-TIMES[1] / 3.0) * (slow[-1] - inputs[:, k]))
    series = np.concatenate([np.stack(fast, 1), np.stack(fast, 1) ** 2, np.stack(slow, 1)], 2)
    values = 7.0 + series @ np.random.default_rng(0).normal(size=(6, 3))
    first = values[:, 0]
    return replace(motions(values[:, 1:], inputs, first=first, origin=first), before=begin)


@pytest.mark.parametrize("before", [True, False])
def test_regression_finds_how_a_body_lags_behind_its_inputs(before):
    trials, asked = lagging(1, before=before), lagging(2, before=before)
    trials.values[0, 200:] = np.nan
    trials.values[1, 20:30, 1] = np.nan
    predicted = regression(trials, asked)
    assert predicted.settings.startswith("means of 0.1, 0.5, 3 s with products")
    assert np.abs(predicted.values - asked.values).max() < 0.01 * np.ptp(asked.values)
    trials.values[..., 2] = np.nan
    assert np.isnan(regression(trials, asked).values[..., 2]).all()


def test_after_the_end_of_the_training_the_last_value_holds_and_the_model_in_time_goes_on():
    trials, asked = driven(1), driven(2)
    trials.values[:, 120:] = np.nan
    trials.values[0, 100:] = np.nan
    made = predictions(trials, asked)
    assert made.keys() == {"rest", "interpolation", "regression", "linear"}
    held = np.broadcast_to(made["interpolation"].values[:, 119:120], (4, 80, 3))
    np.testing.assert_array_equal(made["interpolation"].values[:, 120:], held)
    assert np.abs(made["linear"].values - asked.values).max() < 0.02 * np.abs(asked.values).max()


def test_a_coordinate_that_a_trial_never_shows_follows_from_the_others():
    trials, asked = driven(1), driven(2)
    trials.values[0, :, 2] = np.nan
    assert error("linear", trials, asked) < 0.02 * np.abs(asked.values).max()
    trials.values[1:, :, :2] = np.nan  # No coordinate is common to all of them.
    asked.first[:, 1:] = np.nan
    assert (
        np.abs((predictions(trials, asked)["linear"].values - asked.values)[..., 0]).max()
        < 0.03 * asked.values.max()
    )


def test_a_single_trial_is_a_line_from_zero_inputs_and_trials_that_are_alike_have_their_mean():
    assert error("interpolation", steps([2.0], lambda x: x), steps([0.5, 1.5], lambda x: x)) < 1e-6
    pose = motions(np.ones((4, 1, 3)), np.arange(4.0).reshape(4, 1, 1))
    assert [*predictions(pose, pose)] == ["rest", "interpolation", "regression"]
    alike = motions(np.random.default_rng(0).normal(size=(3, 9, 3)))
    made = predictions(alike, alike)
    assert [*made] == ["rest", "interpolation", "linear"]
    np.testing.assert_allclose(made["interpolation"].values[0], alike.values.mean(0), atol=1e-6)
