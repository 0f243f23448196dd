"""Predictions without physics of observed trials."""

from types import SimpleNamespace

import numpy as np
import pytest

from warp_resphys.data.trials import Trials
from warp_resphys.learning.observed_motions import ObservedMotions
from warp_resphys.learning.without_physics import without_physics
from warp_resphys.settings.learning import ReleaseSettings

FRAMES, STEP = 40, 0.01
TIMES = 2.0 * STEP * np.arange(FRAMES)  # of every second step
MODELS = ("rest", "interpolation", "regression", "linear")
SHAPE = np.array([[1.0, 0.0, 0.5], [0.2, 0.0, 0.1]])  # of two markers


def experiment(levels, begins, learned, **changes):
    """Trials of two markers.

    A pressed body follows a step of the pressure, a pose its last value.
    """
    rows = len(levels)
    held = np.arange(6.0).reshape(2, 3) + 0.1 * np.arange(rows)[:, None, None]
    rise = 1.0 - np.exp(-TIMES / 0.1)
    pressure = np.broadcast_to(
        1e3 * np.asarray(levels)[:, None, None], (rows, 2 * FRAMES, 1)
    ).copy()
    given = {
        "names": tuple("abcdef"[:rows]),
        "labels": ("m1", "m2"),
        "begins": begins,
        "times": np.broadcast_to(TIMES, (rows, FRAMES)),
        "observed": held[:, None] + (np.asarray(levels)[:, None] * rise)[..., None, None] * SHAPE,
        "held": held,
        "payload": np.zeros(rows),
        "gravity": np.zeros(3),
        "time_step": STEP,
        "bound": held[0],
        "inputs": {"pressure": pressure},
    }
    dataset = Trials(**given | changes)
    return SimpleNamespace(trials=dataset, train=learned, motions=ObservedMotions(dataset))


def predicted(fake, names, **options):
    return without_physics(fake.motions, names, fake.train, **options)


def test_trials_are_predicted_from_training_trials_that_begin_in_the_same_way():
    fake = experiment(
        [1.0, 2.0, 3.0, 1.5, 2.5], ("rest",) * 3 + ("released", "rest"), ["a", "b", "c"]
    )
    values, _, missing = predicted(fake, ["e", "d"])  # Nothing was learned of released bodies.
    assert [*values] == ["rest"]
    assert missing == dict.fromkeys(MODELS[1:], "no other training trial begins like d")
    np.testing.assert_array_equal(
        values["rest"], np.broadcast_to(fake.trials.held[[4, 3], None], (2, FRAMES, 2, 3))
    )
    values, settings, missing = predicted(fake, ["e"])
    assert (*values,) == (*settings,) == MODELS
    assert not missing
    truth = fake.trials.observed[[4]]
    for model in MODELS[1:]:
        np.testing.assert_allclose(values[model][0], truth[0], atol=1e-2)
    np.testing.assert_array_equal(
        values["rest"][0], np.broadcast_to(fake.trials.held[4], (FRAMES, 2, 3))
    )


def test_the_delay_of_a_trial_is_that_of_its_first_frames_as_for_simulators():
    fake = experiment([1.0, 2.0, 3.0, 1.5, 2.5], ("rest",) * 5, ["a", "b", "c"])
    late = 1.0 - np.exp(-np.maximum(TIMES - 0.013, 0.0) / 0.1)
    fake.trials.observed[3] = fake.trials.held[3] + (1.5 * late)[:, None, None] * SHAPE
    fake.trials.observed[3, 30:] = np.nan
    before = predicted(fake, ["e", "d"])[0]["interpolation"]
    fake.motions = ObservedMotions(
        fake.trials, release=ReleaseSettings(delay=0.01, window=0.3, noise=1e-3)
    )
    after = predicted(fake, ["e", "d"])[0]["interpolation"]
    np.testing.assert_allclose(after[0], before[0], atol=1e-6)
    seen, expected = slice(0, 30), fake.trials.observed[3, :30]
    assert np.abs(before[1, seen] - expected).max() > 0.1
    assert np.abs(after[1, seen] - expected).max() < 0.1 * np.abs(before[1, seen] - expected).max()
    assert np.isfinite(after).all()


def test_nothing_is_learned_from_the_part_of_a_trial_that_is_kept_back():
    fake = experiment([1.0, 2.0, 1.5], ("rest",) * 3, ["a", "b"])
    fake.motions = ObservedMotions(fake.trials, train_fraction=(FRAMES // 2 - 1) / (FRAMES - 1))
    fake.trials.observed[:2, FRAMES // 2 + 1 :] = 1e6
    values, _, missing = predicted(fake, ["c"])
    assert missing == {"regression": "needs three training trials that differ in inputs or loads"}
    assert np.abs(values["linear"]).max() < 10.0
    halfway = values["interpolation"][:, FRAMES // 2 - 1]
    np.testing.assert_allclose(halfway, fake.trials.observed[2:, FRAMES // 2 - 1], atol=1e-6)
    np.testing.assert_array_equal(values["interpolation"][:, -1], halfway)
    assert fake.trials.observed.max() == 1e6  # The data are as they were.


def test_a_pose_is_interpolated_in_its_last_input():
    fake = experiment([1.0, 2.0, 1.5], ("static",) * 3, ["a", "b"])
    fake.trials.inputs["pressure"][:, :-1] = 7.0
    one = {name: getattr(fake.trials, name)[:, -1:] for name in ("times", "observed")}
    fake = experiment(
        [1.0, 2.0, 1.5], ("static",) * 3, ["a", "b"], inputs=fake.trials.inputs, **one
    )
    values, *_ = predicted(fake, ["c"])
    np.testing.assert_allclose(values["interpolation"][0], fake.trials.observed[2], atol=1e-6)


def test_released_bodies_come_to_rest_where_the_training_ends_and_differ_by_where_they_were_held():
    ends = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -0.5]])
    decay = np.exp(-TIMES / 0.02)[:, None, None]
    held = np.array([0.5, 1.0, 0.8])[:, None, None] * SHAPE
    fake = experiment(
        [1.0, 2.0, 1.5],
        ("released",) * 3,
        ["a", "b"],
        inputs={},
        held=ends + held,
        observed=ends + held[:, None] * decay,
    )
    values, *_ = predicted(fake, ["c"])
    np.testing.assert_allclose(values["rest"][0, 0], ends, atol=1e-6)
    np.testing.assert_allclose(values["interpolation"], fake.trials.observed[2:], atol=1e-3)


def test_released_bodies_are_compared_at_the_same_times_whatever_the_rate_of_their_recordings():
    times = np.stack([TIMES, 0.3 * TIMES + 0.004, 1.5 * TIMES + 0.002])
    levels = np.array([1.0, 2.0, 1.5])
    waves = np.cos(3.0 * times) * levels[:, None]
    held = levels[:, None, None] * SHAPE
    more = {"inputs": {}, "held": held, "observed": waves[..., None, None] * SHAPE, "times": times}
    fake = experiment(levels, ("released",) * 3, ["a", "b"], **more)
    values, *_ = predicted(fake, ["c"])
    assert values["interpolation"].shape == (1, FRAMES, 2, 3)
    # While both are known; the shape of a motion does not depend on its level.
    seen = times[2] <= times[1, -1]
    np.testing.assert_allclose(
        values["interpolation"][0, seen], fake.trials.observed[2, seen], atol=2e-3
    )
    last = values["interpolation"][0, times[2] >= TIMES[-1] + STEP]
    np.testing.assert_allclose(last, np.broadcast_to(last[0], last.shape), atol=1e-6)


def test_a_marker_of_other_trials_stays_at_rest_and_a_training_trial_is_predicted_without_itself():
    fake = experiment([1.0, 2.0, 1.5], ("rest",) * 3, ["a", "b"])
    fake.trials.observed[:2, :, 1] = np.nan
    values, *_ = predicted(fake, ["c"])
    for model in ("interpolation", "linear"):
        np.testing.assert_allclose(values[model][0, :, 0], fake.trials.observed[2, :, 0], atol=2e-2)
        np.testing.assert_array_equal(values[model][0, :, 1], values["rest"][0, :, 1])
    fake = experiment([1.0, 2.0, 1.5], ("rest",) * 3, ["a", "b", "c"])
    fake.trials.observed[2] += 0.3
    fitted, left_out = (
        predicted(fake, ["c", "a"], left_out=out)[0]["interpolation"] for out in (False, True)
    )
    np.testing.assert_allclose(fitted[0], fake.trials.observed[2], atol=1e-5)
    np.testing.assert_allclose(left_out[0], fake.trials.observed[2] - 0.3, atol=1e-5)


@pytest.mark.parametrize("driven_by", ["payload", "base", None])
def test_a_payload_and_the_motion_of_a_base_are_inputs(driven_by):
    levels = np.array([1.0, 2.0, 3.0, 1.5])
    base = np.zeros((4, 2 * FRAMES + 1, 6))
    base[:, :, 0] = levels[:, None]
    more = {"payload": {"payload": 0.05 * levels}, "base": {"base": base}}.get(driven_by, {})
    values, *_ = predicted(
        experiment(levels, ("rest",) * 4, ["a", "b", "c"], inputs={}, **more), ["d"]
    )
    assert ("regression" in values) == (driven_by is not None)
    if driven_by:
        expected = experiment(levels, ("rest",) * 4, []).trials.observed[3]
        np.testing.assert_allclose(values["interpolation"][0], expected, atol=1e-6)
