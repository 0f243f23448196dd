"""Variances of predicted markers, predictions without a trial,
and what would remain if inputs or places were free.

Derivatives are made up, and so are the errors that are made of them.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from warp_resphys.data.rigid_bodies import arms
from warp_resphys.learning.identification.search import Identification
from warp_resphys.learning.identification.sensitivity import (
    Sensitivity,
    free_fits,
    left_out_changes,
    parameter_spread,
)
from warp_resphys.settings.performed import CORNERS

RANDOM = np.random.default_rng(0)
MARKERS = 2
PLACEMENT = 3 * MARKERS + 6
NAMES = ["a", "b"]  # of the sessions monday and friday
SESSIONS = {"a": "monday", "b": "friday"}
NEW_SESSION = 1e-3 * (1.0 + np.arange(PLACEMENT))
WITHOUT = {
    "change": {"density": 30.0, "youngs_modulus": -2e3},
    "placement": (1e-3 * RANDOM.standard_normal(PLACEMENT)).tolist(),
    "deviation": {"youngs_modulus": 4e3, "density": 50.0},
    "correlation": np.eye(2).tolist(),
}
PLACED = {"offsets": {}, "shift": [], "turn": [], "centre": []}
PLACED = {**PLACED, "sessions": {"monday": PLACED}}
UNLIMITED = {
    "poorest": {},
    "poorest_deviation": 0.0,
    "ranges": dict.fromkeys(("youngs_modulus", "density"), 1e12),
}
IDENTIFIED = {
    "uncertainty": {
        "deviation": {"youngs_modulus": 2e3, "density": 40.0},
        "correlation": [[1.0, 0.5], [0.5, 1.0]],
        **UNLIMITED,
        "left_out": {"a": WITHOUT},
    },
    "placement": {**PLACED, "new_session": np.diag(NEW_SESSION).tolist()},
}


def trials(labels=("A", "B"), session=SESSIONS.get, **inputs):
    return SimpleNamespace(
        observed=np.zeros((2, 1, len(labels), 3)), labels=labels, session=session, inputs=inputs
    )


FOUND = Identification.from_plain(IDENTIFIED)


def sensitivity(frames=1, **sizes):
    """Derivatives that have nothing in common, of given sizes by parameter."""
    shape = (frames, MARKERS, 3)
    slopes = {name: size * RANDOM.standard_normal(shape) for name, size in sizes.items()}
    points = np.cumsum(RANDOM.standard_normal(shape), 0)
    return Sensitivity(points, slopes, RANDOM.standard_normal((*shape, PLACEMENT)))


LINEAR = {name: sensitivity(youngs_modulus=1e-6, density=1e-4) for name in NAMES}


def due_to(name, deviation, correlation):
    slopes = np.stack([LINEAR[name].by_parameter[key] for key in deviation], -1)
    covariance = np.array(correlation) * np.outer([*deviation.values()], [*deviation.values()])
    return np.einsum("tmci,ij,tmcj->tmc", slopes, covariance, slopes).mean(-1)


def test_a_new_session_adds_the_prior_of_its_placement():
    uncertainty = IDENTIFIED["uncertainty"]
    spread = parameter_spread(trials(), NAMES, FOUND, LINEAR)
    of_parameters = [
        due_to(name, uncertainty["deviation"], uncertainty["correlation"]) for name in NAMES
    ]
    np.testing.assert_allclose(spread[0], of_parameters[0])
    added = np.einsum("tmck,k->tmc", LINEAR["b"].by_placement ** 2, NEW_SESSION**2).mean(-1)
    np.testing.assert_allclose(spread[1], of_parameters[1] + added)


def test_the_position_of_a_rigid_body_does_not_vary_with_its_orientation():
    """0.1 mm along x and 0.5 degrees about z, of a parameter,
    and again of the placement in a new session.
    """
    corners = arms(0.0573)
    turning = np.radians(0.5) * np.cross([0.0, 0.0, 1.0], corners)
    moved = np.stack([np.tile([1e-4, 0.0, 0.0], (4, 1)), turning], -1)  # (4, 3, 2)
    slopes = {"density": moved[None, ..., 0], "youngs_modulus": moved[None, ..., 1]}
    identified = {
        "uncertainty": {
            "deviation": dict.fromkeys(slopes, 1.0),
            "correlation": np.eye(2).tolist(),
            **UNLIMITED,
        },
        "placement": {**PLACED, "new_session": np.eye(2).tolist()},
    }
    plate = trials(tuple(f"plate {corner}" for corner in CORNERS))
    found = Identification.from_plain(identified)
    linear = dict.fromkeys(NAMES, Sensitivity(corners[None], slopes, moved[None]))
    spread = parameter_spread(plate, NAMES, found, linear)
    np.testing.assert_allclose(spread, np.array([[[1e-8 / 3.0]], [[2e-8 / 3.0]]]))


def test_a_trial_is_predicted_without_itself():
    spread = parameter_spread(trials(), ["a"], FOUND, LINEAR, left_out=True)
    np.testing.assert_allclose(spread[0], due_to("a", WITHOUT["deviation"], WITHOUT["correlation"]))
    changes = left_out_changes(trials(), NAMES, FOUND, LINEAR)
    slopes, places = LINEAR["a"].by_parameter, LINEAR["a"].by_placement
    expected = (
        30.0 * slopes["density"]
        - 2e3 * slopes["youngs_modulus"]
        + places @ np.array(WITHOUT["placement"])
    )
    np.testing.assert_allclose(changes[0], expected)
    assert not changes[1].any()
    assert left_out_changes(trials(), ["b"], FOUND, LINEAR) is None
    alone = replace(FOUND, uncertainty=replace(FOUND.uncertainty, left_out={}))
    for found in (Identification(), alone):  # which left out nothing
        assert left_out_changes(trials(), NAMES, found, LINEAR) is None


ROUNDING = 1e-9  # mm
DRIVEN = trials(
    session=lambda name: name[0], pressure=np.ones((1, 3, 1)), attached_mass=np.ones((1, 1))
)


def driven(frames=40):
    return sensitivity(frames, pressure_factor=1.0, pressure_zero=1.0, density=1.0)


def fitted(errors, linear):
    simulated = {name: linear[name].points for name in linear}
    observed = {name: linear[name].points - errors[name] for name in linear}
    return {entry["name"]: entry for entry in free_fits(DRIVEN, observed, simulated, linear)}


@pytest.mark.parametrize(
    ("key", "parameter"), [("scale", "pressure_factor"), ("zero", "pressure_zero")]
)
def test_an_error_of_one_kind_is_taken_away_by_that_kind(key, parameter):
    linear = {"a_1": driven()}
    entry = fitted({"a_1": -0.03 * linear["a_1"].by_parameter[parameter]}, linear)["a_1"]
    assert entry["values"][key] == pytest.approx(0.03)
    assert entry["left_mm"].pop(key) < ROUNDING
    assert min(entry["left_mm"].values()) > 0.5 * entry["as_is_mm"]


def test_trials_of_a_session_share_their_marker_places():
    linear = {name: driven() for name in ("a_1", "a_2", "b_1", "b_2")}
    places = {session: 1e-3 * RANDOM.standard_normal(PLACEMENT) for session in "ab"}
    errors = {name: -linear[name].by_placement @ places[name[0]] for name in linear}
    result = fitted(errors, linear)
    assert all(entry["left_mm"]["places"] < ROUNDING for entry in result.values())
    assert all(entry["as_is_mm"] > 0.5 for entry in result.values())
    errors["a_2"] = -linear["a_2"].by_placement @ places["b"]
    entry = fitted(errors, linear)["a_2"]
    assert entry["left_mm"]["places"] > 0.1 * entry["as_is_mm"]


def test_what_a_pose_does_not_determine_is_left_out():
    linear = {"a_1": driven(frames=1)}
    error = -0.03 * linear["a_1"].by_parameter["pressure_factor"]
    error[0, 1, 2] = np.nan  # not seen
    more = np.full((3, MARKERS, 3), np.nan)  # frames of motions in the same experiment
    observed = {"a_1": np.concatenate([linear["a_1"].points - error, more])}
    simulated = {"a_1": np.concatenate([linear["a_1"].points, more])}
    (entry,) = free_fits(DRIVEN, observed, simulated, linear)
    assert entry["left_mm"].keys() == {"scale", "zero"}
