"""The file of a dataset.

What drives its trials at their frames, and since when that has not changed.
"""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from warp_resphys.data.driving import driving, first_change, phases_of, since_change
from warp_resphys.data.trials import Trials
from warp_resphys.io.errors import DataFileError
from warp_resphys.io.safe_files import read_hdf5

TIMES = 0.1 * np.arange(6)


def dataset(begins, names="abc", resting=None, **inputs):
    """Trials of one marker at rest at six frames, of two steps each."""
    rows = len(begins)
    times, observed = np.broadcast_to(TIMES, (rows, 6)), np.zeros((rows, 6, 1, 3))
    channels = {name: ("left", "right")[: values.shape[-1]] for name, values in inputs.items()}
    fields = {"inputs": inputs, "channels": channels, "resting": resting or {}}
    about = (times, observed, observed[:, 0], np.zeros(rows), np.zeros(3), 0.05)
    return Trials(
        tuple(names[:rows]), ("m",), begins, *about, bound=np.zeros((1, 3)), units=UNITS, **fields
    )


UNITS = {"pressure": "Pa", "tendon_tension": "N", "tendon_contraction": "m", "muscle_stress": "Pa"}
UNITS["muscle_contraction"] = "1"


def test_inputs_are_kept_with_the_unit_of_their_quantity(tmp_path):
    own = dataset(
        ("rest",), **{name: k + np.arange(24.0).reshape(1, 12, 2) for k, name in enumerate(UNITS)}
    )
    own.write(tmp_path / "dataset.h5")
    again = Trials.read(tmp_path / "dataset.h5")
    assert again.channels == own.channels
    with read_hdf5(tmp_path / "dataset.h5", "dataset") as file:
        assert {name: file[name].attrs["units"] for name in UNITS} == UNITS
    for name, values in own.inputs.items():
        np.testing.assert_array_equal(again.inputs[name], values)


def test_inputs_before_the_trials_are_kept_and_joined_with_trials_at_rest(tmp_path):
    values = np.arange(24.0).reshape(1, 12, 2)
    driven = dataset(("driven",), resting={"pressure": np.array([[3.0, 5.0]])}, pressure=values)
    rest = dataset(("rest",), "b", pressure=values)
    driven.write(tmp_path / "dataset.h5")
    np.testing.assert_array_equal(
        Trials.read(tmp_path / "dataset.h5").resting["pressure"], [[3.0, 5.0]]
    )
    np.testing.assert_array_equal(driven.joined(rest).resting["pressure"], [[3.0, 5.0], [0.0, 0.0]])
    np.testing.assert_array_equal(rest.joined(driven).resting["pressure"], [[0.0, 0.0], [3.0, 5.0]])
    assert rest.joined(rest).resting == {}


def test_constant_inputs_and_loads_before_the_trials_alone_are_kept_in_a_file(tmp_path):
    force, moved = np.arange(6.0).reshape(2, 1, 3), np.arange(24.0).reshape(2, 4, 1, 3)
    trials = dataset(("driven", "driven"), resting={"external_force": force})
    trials = replace(
        trials, inputs={"pressure": np.array([[3.0], [5.0]]), "fixed_positions": moved}, channels={}
    )
    trials.write(tmp_path / "dataset.h5")
    again = Trials.read(tmp_path / "dataset.h5")
    assert again.channels == {}
    for one, other in ((again.inputs, trials.inputs), (again.resting, trials.resting)):
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    "name", ["names", "inputs", "gravity", "time_step", "held", "payload", "observed"]
)
def test_a_file_that_lacks_something_is_named(tmp_path, name):
    path = tmp_path / "dataset.h5"
    dataset(("rest",)).write(path)
    with h5py.File(path, "a") as file:
        del (file.attrs if name in file.attrs else file)[name]
    with pytest.raises(
        DataFileError, match=f"dataset.h5 has no (attribute|dataset) '{name}': .*check the path"
    ):
        Trials.read(path)


def test_a_pose_is_under_its_last_or_constant_inputs_and_a_frame_under_those_of_its_step():
    steps = np.arange(8.0).reshape(2, 4, 1)
    for pressure in (steps, steps[:, 3]):
        acting, resting = dataset(("static", "static"), pressure=pressure).acting(
            ["a", "b"], None, None, 0.05
        )
        assert resting.fields["pressure"].tolist() == [[3.0], [7.0]]
        assert acting.at(3).fields["pressure"].tolist() == [[3.0], [7.0]]
    steps = np.arange(12.0)[None, :, None] * np.array([1.0, 2.0])[:, None, None]
    acting = driving(dataset(("rest", "static"), pressure=steps), ["b", "a"])["pressure"]
    np.testing.assert_array_equal(acting[1, :, 0], [0.0, 2.0, 4.0, 6.0, 8.0, 10.0])
    np.testing.assert_array_equal(acting[0, :, 0], 22.0)  # A pose has the last input.


def test_changes_are_those_of_all_inputs_beyond_noise_and_a_slow_fall_of_one_is_a_release():
    valve = np.zeros((3, 12, 1))
    valve[0, 4:] = 1.0
    other = np.zeros((3, 12, 2))
    other[0, 8:, 1] = 5.0
    since = since_change(
        dataset(("rest", "released", "static"), pressure=valve, tension=other), ["a", "b", "c"]
    )
    np.testing.assert_allclose(since[0], [0.0, 0.1, 0.0, 0.1, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(since[1], TIMES)  # Since its release.
    assert np.isinf(since[2]).all()
    valve = 1e-3 * (np.arange(24.0).reshape(2, 12, 1) % 4)
    valve[0, 6:] += 1.0
    own = dataset(("rest", "rest"), pressure=valve + 0.5)
    assert first_change(own, "a") == TIMES[3]
    assert first_change(own, "b") == 0.0
    right = np.repeat(np.linspace(0.3, 0.0, 6), 2)
    own = dataset(("rest",), pressure=np.stack([np.ones(12), right], axis=1)[None])
    assert phases_of(own, ["a"])[0].tolist() == [
        "rise",
        "rise",
        "release",
        "release",
        "release",
        "release",
    ]
