"""Variances of predicted markers, and predictions without a trial, against sums over made-up derivatives."""

from types import SimpleNamespace

import numpy as np
import pytest

from warp_resphys.data.rigid_bodies import arms
from warp_resphys.experiment.sensitivity import Sensitivity, left_out_changes, parameter_spread
from warp_resphys.settings.trials import CORNERS

RANDOM = np.random.default_rng(0)
MARKERS = 2
NAMES = ["a", "b"]  # of the sessions monday and friday
NEW_SESSION = 1e-3 * (1.0 + np.arange(3 * MARKERS + 6))
WITHOUT = {
    "change": {"density": 30.0, "youngs_modulus": -2e3},
    "placement": (1e-3 * RANDOM.standard_normal(3 * MARKERS + 6)).tolist(),
    "deviation": {"youngs_modulus": 4e3, "density": 50.0},
    "correlation": np.eye(2).tolist(),
}
IDENTIFIED = {
    "uncertainty": {
        "deviation": {"youngs_modulus": 2e3, "density": 40.0},
        "correlation": [[1.0, 0.5], [0.5, 1.0]],
        "left_out": {"a": WITHOUT},
    },
    "placement": {"sessions": {"monday": {}}, "new_session": np.diag(NEW_SESSION).tolist()},
}
EXPERIMENT = SimpleNamespace(
    dataset=SimpleNamespace(
        observed=np.zeros((2, 1, MARKERS, 3)), labels=("A", "B"), session={"a": "monday", "b": "friday"}.get
    ),
    identification=lambda model: IDENTIFIED,
)


def sensitivity():
    shape = (1, MARKERS, 3)
    sizes = {"youngs_modulus": 1e-6, "density": 1e-4}
    slopes = {name: size * RANDOM.standard_normal(shape) for name, size in sizes.items()}
    return Sensitivity(np.zeros(shape), slopes, RANDOM.standard_normal((*shape, 3 * MARKERS + 6)))


LINEAR = {name: sensitivity() for name in NAMES}


def due_to(name, deviation, correlation):
    slopes = np.stack([LINEAR[name].by_parameter[key] for key in deviation], -1)
    covariance = np.array(correlation) * np.outer([*deviation.values()], [*deviation.values()])
    return np.einsum("tmci,ij,tmcj->tmc", slopes, covariance, slopes).mean(-1)


def test_a_new_session_adds_the_prior_of_its_placement():
    uncertainty = IDENTIFIED["uncertainty"]
    spread = parameter_spread(EXPERIMENT, "sysid", NAMES, LINEAR)
    of_parameters = [due_to(name, uncertainty["deviation"], uncertainty["correlation"]) for name in NAMES]
    np.testing.assert_allclose(spread[0], of_parameters[0])
    added = np.einsum("tmck,k->tmc", LINEAR["b"].by_placement ** 2, NEW_SESSION**2).mean(-1)
    np.testing.assert_allclose(spread[1], of_parameters[1] + added)


def test_the_position_of_a_rigid_body_does_not_vary_with_its_orientation():
    """0.1 mm along x and 0.5 degrees about z, of a parameter, and again of the placement in a new session."""
    corners = arms(0.0573)
    turning = np.radians(0.5) * np.cross([0.0, 0.0, 1.0], corners)
    moved = np.stack([np.tile([1e-4, 0.0, 0.0], (4, 1)), turning], -1)  # (4, 3, 2)
    slopes = {"density": moved[None, ..., 0], "youngs_modulus": moved[None, ..., 1]}
    identified = {
        "uncertainty": {"deviation": dict.fromkeys(slopes, 1.0), "correlation": np.eye(2).tolist()},
        "placement": {"sessions": {"monday": {}}, "new_session": np.eye(2).tolist()},
    }
    labels = tuple(f"plate {corner}" for corner in CORNERS)
    dataset = SimpleNamespace(observed=np.zeros((2, 1, 4, 3)), labels=labels, session=EXPERIMENT.dataset.session)
    experiment = SimpleNamespace(dataset=dataset, identification=lambda model: identified)
    linear = dict.fromkeys(NAMES, Sensitivity(corners[None], slopes, moved[None]))
    spread = parameter_spread(experiment, "sysid", NAMES, linear)
    np.testing.assert_allclose(spread, np.array([[[1e-8 / 3.0]], [[2e-8 / 3.0]]]))


def test_a_trial_is_predicted_without_itself():
    spread = parameter_spread(EXPERIMENT, "sysid", ["a"], LINEAR, left_out=True)
    np.testing.assert_allclose(spread[0], due_to("a", WITHOUT["deviation"], WITHOUT["correlation"]))
    changes = left_out_changes(EXPERIMENT, "sysid", NAMES, LINEAR)
    slopes, places = LINEAR["a"].by_parameter, LINEAR["a"].by_placement
    expected = 30.0 * slopes["density"] - 2e3 * slopes["youngs_modulus"] + places @ np.array(WITHOUT["placement"])
    np.testing.assert_allclose(changes[0], expected)
    assert not changes[1].any()


def test_nothing_changes_without_trials_that_are_left_out():
    assert left_out_changes(EXPERIMENT, "sysid", ["b"], LINEAR) is None


@pytest.mark.parametrize("uncertainty", [None, {"deviation": {}}])
def test_identifications_that_left_out_nothing_change_nothing(uncertainty):
    experiment = SimpleNamespace(dataset=EXPERIMENT.dataset, identification=lambda model: {"uncertainty": uncertainty})
    assert left_out_changes(experiment, "sysid", NAMES, LINEAR) is None
