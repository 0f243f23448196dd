"""Random pressures, and the check of recorded ones."""

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys.core.energies.pressure import PRESSURE
from warp_resphys.core.energies.tendons import TENSION
from warp_resphys.data.input_response import check_inputs, draw_inputs
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.settings.played import SequenceSettings

STEP = 0.01


def drawn(count=40, steps=150, chambers=2, limit=20e3, **settings):
    sequences = SequenceSettings(**settings)
    random = [np.random.default_rng(number) for number in range(count)]
    return np.stack([draw_inputs(sequences, limit, steps, STEP, chambers, own) for own in random])


def test_sequences_rest_at_their_ends_within_the_limit_and_have_the_moments_asked_for():
    p = drawn(rest=0.1)
    assert p.min() == 0.0
    assert p.max() == 20e3
    assert not p[:, :11].any()
    assert not p[:, -11:].any()
    # Zero slope too: the first steps under pressure are small beside the typical change of a step.
    typical = np.abs(np.diff(p, axis=1)).max()
    assert np.abs(np.diff(p, axis=1))[:, 10:13].max() < 0.25 * typical
    # Far from the ends and the limits the process is stationary.
    settings = {
        "mean": 5e4,
        "deviation": 1e3,
        "correlation_time": 0.1,
        "limit": 1e5,
        "correlation": 0.6,
    }
    p = drawn(200, **settings)[:, 60:90] - 5e4
    assert abs(p.mean()) < 150.0
    assert p.std() == pytest.approx(1e3, rel=0.08)
    for lag in (5, 10):
        result = (p[:, lag:] * p[:, :-lag]).mean() / p.var()
        assert result == pytest.approx(np.exp(-0.5 * (lag * STEP / 0.1) ** 2), abs=0.06)
    assert np.corrcoef(p[..., 0].ravel(), p[..., 1].ravel())[0, 1] == pytest.approx(0.6, abs=0.08)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rest": 2.0}, "leave no time between two rests"),
        ({"correlation": -0.6}, "no inputs of 3 parts have the correlation -0.6"),
        ({"correlation": [[1.0, 0.0], [0.0, 1.0]]}, r"correlation is .*3 rows and 3 columns"),
    ],
)
def test_bad_sequences(settings, message):
    refuses(InputError, message, drawn, 1, 300, 3, **settings)


def test_recorded_inputs_are_checked_but_for_a_small_zero_error_of_a_gauge():
    good = np.full((4, 2), 1e4)
    np.testing.assert_array_equal(check_inputs(good, PRESSURE, 2e4, "a.h5"), good)
    high = good.copy()
    high[3, 1] = 2.5e4
    refuses(DataFileError, r"data\.input_limit", check_inputs, high, PRESSURE, 2e4, "a.h5")
    tension = np.array([[-0.01, 1.0], [0.2, 0.5]])
    np.testing.assert_array_equal(
        check_inputs(tension, TENSION, 2.0, "a.h5"), [[0.0, 1.0], [0.2, 0.5]]
    )
    with pytest.raises(
        DataFileError,
        match=r"a\.h5: the tension of tendon 1 is -0.5 N in frame 1: it must be zero or",
    ):
        check_inputs(np.array([[0.0], [-0.5]]), TENSION, 2.0, "a.h5")
