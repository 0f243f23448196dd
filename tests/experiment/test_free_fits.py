"""What would remain of errors if inputs or marker places were free, with errors that are made of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from warp_resphys.experiment.sensitivity import Sensitivity, free_fits

RANDOM = np.random.default_rng(0)
MARKERS = 2
EXPERIMENT = SimpleNamespace(
    dataset=SimpleNamespace(
        inputs={"pressure": np.ones((1, 3, 1)), "payload": np.ones((1, 1))},
        session=lambda name: name.partition("_")[0],
        labels=("A", "B"),
    )
)
ROUNDING = 1e-9  # mm


def sensitivity(frames=40):
    """Derivatives that have nothing in common."""
    shape = (frames, MARKERS, 3)
    points = np.cumsum(RANDOM.standard_normal(shape), 0)
    by_parameter = {name: RANDOM.standard_normal(shape) for name in ("pressure_factor", "pressure_zero", "density")}
    return Sensitivity(points, by_parameter, RANDOM.standard_normal((*shape, 3 * MARKERS + 6)))


def fitted(errors, linear):
    simulated = {name: linear[name].points for name in linear}
    observed = {name: linear[name].points - errors[name] for name in linear}
    return {entry["name"]: entry for entry in free_fits(EXPERIMENT, observed, simulated, linear)}


@pytest.mark.parametrize(("key", "parameter"), [("scale", "pressure_factor"), ("zero", "pressure_zero")])
def test_an_error_of_one_kind_is_taken_away_by_that_kind(key, parameter):
    linear = {"a_1": sensitivity()}
    entry = fitted({"a_1": -0.03 * linear["a_1"].by_parameter[parameter]}, linear)["a_1"]
    assert entry["values"][key] == pytest.approx(0.03)
    assert entry["left_mm"].pop(key) < ROUNDING
    assert min(entry["left_mm"].values()) > 0.5 * entry["as_is_mm"]


def test_trials_of_a_session_share_their_marker_places():
    linear = {name: sensitivity() for name in ("a_1", "a_2", "b_1", "b_2")}
    places = {session: 1e-3 * RANDOM.standard_normal(3 * MARKERS + 6) for session in "ab"}
    errors = {name: -linear[name].by_placement @ places[name[0]] for name in linear}
    result = fitted(errors, linear)
    assert all(entry["left_mm"]["places"] < ROUNDING for entry in result.values())
    assert all(entry["as_is_mm"] > 0.5 for entry in result.values())
    errors["a_2"] = -linear["a_2"].by_placement @ places["b"]
    entry = fitted(errors, linear)["a_2"]
    assert entry["left_mm"]["places"] > 0.1 * entry["as_is_mm"]


def test_what_a_pose_does_not_determine_is_left_out():
    linear = {"a_1": sensitivity(frames=1)}
    errors = {"a_1": -0.03 * linear["a_1"].by_parameter["pressure_factor"]}
    errors["a_1"][0, 1, 2] = np.nan  # not seen
    more = np.full((3, MARKERS, 3), np.nan)  # frames of motions in the same experiment
    observed = {"a_1": np.concatenate([linear["a_1"].points - errors["a_1"], more])}
    simulated = {"a_1": np.concatenate([linear["a_1"].points, more])}
    (entry,) = free_fits(EXPERIMENT, observed, simulated, linear)
    assert entry["left_mm"].keys() == {"scale", "zero"}
