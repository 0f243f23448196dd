"""The file of a dataset."""

import numpy as np
import pytest

from warp_resphys.experiment.files import Dataset, read_dataset
from warp_resphys.io.files import read_hdf5


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("pressure", "Pa"),
        ("tendon_tension", "N"),
        ("tendon_contraction", "m"),
        ("muscle_stress", "Pa"),
        ("muscle_contraction", "1"),
    ],
)
def test_inputs_have_the_unit_of_their_quantity(tmp_path, name, unit):
    observed, values = np.zeros((1, 3, 2, 3)), np.arange(4.0).reshape(1, 2, 2)
    words = ("a",), ("tip", "middle"), ("rest",)
    arrays = np.zeros((1, 3)), observed, observed[:, 0], np.zeros(1), np.zeros(3)
    dataset = Dataset(*words, *arrays, time_step=0.01, inputs={name: values}, channels={name: ("left", "right")})
    dataset.write(tmp_path / "dataset.h5")
    with read_hdf5(tmp_path / "dataset.h5", "dataset") as file:
        assert file[name].attrs["units"] == unit
    again = read_dataset(tmp_path / "dataset.h5")
    assert again.channels == dataset.channels
    np.testing.assert_array_equal(again.inputs[name], values)


def test_inputs_before_the_trials_are_kept_and_joined_with_trials_at_rest(tmp_path):
    observed, values = np.zeros((1, 3, 2, 3)), np.arange(4.0).reshape(1, 2, 2)

    def dataset(name, begins, resting):
        arrays = np.zeros((1, 3)), observed, observed[:, 0], np.zeros(1), np.zeros(3)
        fields = {"inputs": {"pressure": values}, "channels": {"pressure": ("left", "right")}, "resting": resting}
        return Dataset((name,), ("tip", "middle"), (begins,), *arrays, time_step=0.01, **fields)

    driven, rest = dataset("a", "driven", {"pressure": np.array([[3.0, 5.0]])}), dataset("b", "rest", {})
    driven.write(tmp_path / "dataset.h5")
    np.testing.assert_array_equal(read_dataset(tmp_path / "dataset.h5").resting["pressure"], [[3.0, 5.0]])
    np.testing.assert_array_equal(driven.joined(rest).resting["pressure"], [[3.0, 5.0], [0.0, 0.0]])
    np.testing.assert_array_equal(rest.joined(driven).resting["pressure"], [[0.0, 0.0], [3.0, 5.0]])
    assert rest.joined(rest).resting == {}
