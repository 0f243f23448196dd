"""The balance of forces of simulated motions gives the coefficients that made them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from support.known_law import STIFF, beam, pulled, released
from warp_resphys import Inputs
from warp_resphys.io.errors import InputError
from warp_resphys.learning.law import KnownMotion, NormalEquations, WeakForm

UNIT = {
    "c10": 1e5,
    "c20": 1e5,
    "bulk_1": 1e6,
    "ogden_4": 1e5,
    "shear_viscosity": 1e2,
    "prony_modulus_1": 1e5,
    "fibre_tension_1": 1e5,
}
TRUE = np.array([0.3, 0.25, 2.0, 0.2, 0.4, 0.15, 0.5])  # in these units
SHAPE = {"prony_time_1": 0.04, "fibre_azimuth_1": 0.6, "fibre_toe_1": 0.02}
REST = {f"fibre_{name}_1": 0.0 for name in ("elevation", "slack", "stiffening", "compression")}
CANDIDATES = [{name: unit} for name, unit in UNIT.items()]
PULLS = [(0.3, 0.0, -0.2), (-0.2, 0.2, 0.05)]  # N


def simulator(values, integrator="implicit_euler"):
    """A beam whose forces are linear in `values`, in the order of `UNIT`."""
    constants = dict(zip(UNIT, values * np.array([*UNIT.values()]), strict=True))
    return beam({**constants, **SHAPE, **REST}, integrator)


def residual_of(forces, target):
    return np.linalg.norm(forces - target) / np.linalg.norm(target)


def fit(columns, target):
    """Coefficients of all columns, and their residual."""
    coefficients = NormalEquations.of(columns, target).fit(range(columns.shape[1]))
    return SimpleNamespace(coefficients=coefficients, residual=residual_of(columns @ coefficients, target))


def unknown(integrator="implicit_euler"):
    return simulator(np.zeros(len(UNIT)), integrator)


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2", "midpoint"])
def balance(request):
    """Rows of a motion whose coefficients are known, and the simulator that has none of them."""
    motion = released(simulator(TRUE, request.param), PULLS)
    return WeakForm(unknown(request.param), [motion], SHAPE, STIFF, stride=2)


def test_known_coefficients_are_recovered(balance):
    columns = balance.columns(CANDIDATES)
    assert columns.shape == (6 * 2 * 16 * 3, len(UNIT))  # steps, motions, free vertices, coordinates
    found = fit(columns, balance.target)
    np.testing.assert_allclose(found.coefficients, TRUE, rtol=1e-4)
    assert found.residual < 1e-7
    assert residual_of(columns @ (1.1 * TRUE), balance.target) == pytest.approx(0.1, rel=1e-3)


def test_terms_that_the_law_does_not_have_get_no_coefficient(balance):
    without = fit(balance.columns([*CANDIDATES[:3], *CANDIDATES[4:]]), balance.target)
    others = {"c01": 1e5, "c02": 1e5, "dilation": 1e5, "fibre_stiffening_1": 1e5}
    found = fit(balance.columns([*CANDIDATES, *({name: unit} for name, unit in others.items())]), balance.target)
    np.testing.assert_allclose(found.coefficients[len(UNIT) :], 0.0, atol=1e-3)
    np.testing.assert_allclose(found.coefficients[: len(UNIT)], TRUE, rtol=0.02)
    assert without.residual > 1e4 * found.residual


def test_a_branch_remembers_the_steps_between_two_rows():
    """Rows of a larger stride are among those of every step."""
    sim = simulator(TRUE)
    motion = released(sim, PULLS[:1])
    fine, coarse = (WeakForm(unknown(), [motion], SHAPE, STIFF, stride).columns(CANDIDATES) for stride in (1, 4))
    rows = fine.reshape(12, -1, len(UNIT))[::4].reshape(-1, len(UNIT))
    np.testing.assert_allclose(coarse, rows, rtol=0.0, atol=1e-12 * np.abs(rows).max())
    assert np.abs(fine[:, 5]).max() > 0.0


def test_loads_during_the_motion_are_part_of_the_balance():
    sim = simulator(TRUE)
    inputs = Inputs(external_force=pulled([(0.0, 0.2, 0.0)]))
    with torch.no_grad():
        q = sim.rollout(sim.rest_state(), 12, inputs).q
    motion = KnownMotion(q, torch.zeros_like(q[0]), inputs)
    form = WeakForm(unknown(), [motion], SHAPE, STIFF)
    assert residual_of(form.columns(CANDIDATES) @ TRUE, form.target) < 1e-7
    unloaded = WeakForm(unknown(), [replace(motion, inputs=Inputs())], SHAPE, STIFF)
    assert residual_of(unloaded.columns(CANDIDATES) @ TRUE, unloaded.target) > 0.1


def test_a_fit_has_no_negative_coefficient():
    random = np.random.default_rng(0)
    columns = random.normal(size=(200, 4)) * [1.0, 1e-3, 1e4, 0.0]
    true = np.array([2.0, -3e3, 5e-5, 0.0])
    found = fit(columns, columns @ true)
    assert found.coefficients.min() == 0.0
    assert found.coefficients[1] == found.coefficients[3] == 0.0
    least = np.linalg.lstsq(columns[:, [0, 2]], columns @ true, rcond=None)[0]
    np.testing.assert_allclose(found.coefficients[[0, 2]], least, rtol=1e-6)
    equations = NormalEquations.of(columns, columns @ true)
    assert equations.residual(range(4), found.coefficients) == pytest.approx(found.residual, rel=1e-6)


@pytest.mark.parametrize(("motions", "stride"), [(0, 5), (1, 0)])
def test_nothing_to_balance_is_refused(motions, stride):
    sim = simulator(TRUE)
    still = KnownMotion(sim.rest_positions.expand(3, 1, -1, -1), torch.zeros_like(sim.rest_positions)[None])
    with pytest.raises(InputError, match="no step to balance"):
        WeakForm(sim, [still] * motions, SHAPE, STIFF, stride)
