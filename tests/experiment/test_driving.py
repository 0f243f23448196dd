"""What drives trials at their frames, and since when it has not changed."""

import numpy as np
import pytest

from warp_resphys.experiment.files import Dataset, driving, since_change

TIMES = 0.1 * np.arange(6)


def dataset(begins, **inputs):
    rows = len(begins)
    held = np.zeros((rows, 1, 3))
    return Dataset(
        names=tuple("abc"[:rows]),
        labels=("m",),
        begins=begins,
        times=np.broadcast_to(TIMES, (rows, 6)),
        observed=np.zeros((rows, 6, 1, 3)),
        held=held,
        payload=np.zeros(rows),
        gravity=np.zeros(3),
        time_step=0.05,
        bound=held[0],
        inputs=inputs,
    )


def test_inputs_are_those_of_the_step_that_begins_with_a_frame():
    steps = np.arange(12.0)[None, :, None] * np.array([1.0, 2.0])[:, None, None]
    acting = driving(dataset(("rest", "static"), pressure=steps), ["b", "a"])["pressure"]
    np.testing.assert_array_equal(acting[1, :, 0], [0.0, 2.0, 4.0, 6.0, 8.0, 10.0])
    np.testing.assert_array_equal(acting[0, :, 0], 22.0)  # A pose has the last input.


def test_the_time_since_a_change_counts_all_inputs_of_a_trial():
    valve = np.zeros((3, 12, 1))
    valve[0, 4:] = 1.0
    other = np.zeros((3, 12, 2))
    other[0, 8:, 1] = 5.0
    since = since_change(dataset(("rest", "released", "static"), pressure=valve, tension=other), ["a", "b", "c"])
    np.testing.assert_allclose(since[0], [0.0, 0.1, 0.0, 0.1, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(since[1], TIMES)  # Since its release.
    assert np.isinf(since[2]).all()
    assert since[0, 1] == pytest.approx(0.1)
