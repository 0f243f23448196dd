"""The balance of forces gives the coefficients that made the motions, and classes of laws with the smallest one."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from warp_resphys import Body, InputError, Inputs, Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.energies import make_material
from warp_resphys.learning.identification.law import _parameters, fit_classes
from warp_resphys.learning.identification.weak_form import KnownMotion, NormalEquations, WeakForm

MESH = box_hexahedra((0.08, 0.02, 0.02), (4, 1, 1))
TIP = select_vertices(MESH, x=0.08)
STIFF = {"c10": 3e4, "bulk_1": 3e6}  # Pa, of the weight
BODY = Body(MESH, fixed=select_vertices(MESH, x=0.0))
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
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


def beam(parameters, integrator="implicit_euler"):
    """A beam of a law, all of whose parameters are given."""
    material = make_material("law", **parameters)
    return Simulator(BODY, material, time_step=0.005, solver=TIGHT, integrator=integrator)


def pulled(pulls):
    """(B, N, 3) nodal forces of pulls (B, 3) at the tip [N]."""
    force = torch.zeros(len(pulls), len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP] = torch.tensor(pulls, dtype=torch.float64)[:, None] / len(TIP)
    return force


def released(sim, pulls, steps=12):
    """Motions of beams that are released from pulls (B, 3) at the tip [N]."""
    with torch.no_grad():
        held = sim.static_equilibrium(Inputs(external_force=pulled(pulls)))
        return KnownMotion(sim.rollout(held, steps).q, held.v)


def simulator(values, integrator="implicit_euler"):
    """A beam whose forces are linear in `values`, in the order of `UNIT`."""
    parameters = dict(zip(UNIT, values * np.array([*UNIT.values()]), strict=True))
    return beam({**parameters, **SHAPE, **REST}, integrator)


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


TERMS, TIMES = ("c20", "c01", "ogden_4"), np.geomspace(0.01, 0.2, 8).tolist()
WIDE = [(0.4, 0.0, -0.15), (-0.2, 0.15, 0.05), (0.1, -0.1, 0.15)]  # N
HELD_OUT = [(0.25, 0.12, 0.12)]
NEO_HOOKEAN = {"c10": 30e3, "bulk_1": 2e6}


def classes(truth):
    """Classes without fibres that fit motions of a law, by their groups."""
    zero = dict.fromkeys((*TERMS, "c10", "bulk_1", "shear_viscosity", "prony_modulus_1"), 0.0)
    shape = {"prony_time_1": 0.05}
    unknown, true = beam({**zero, **shape}), beam(truth)
    forms = [WeakForm(unknown, [released(true, pulls)], shape, STIFF, 3) for pulls in (WIDE, HELD_OUT)]
    laws = fit_classes(*forms, TERMS, TIMES, 0)
    sizes = [len(law.groups) for law in laws]
    assert sizes == sorted(sizes)
    assert laws[0].groups == ()
    assert laws[0].parameters.keys() == {"c10", "bulk_1"}
    return {law.groups: law for law in laws}


def test_terms_that_the_beam_has_are_found_and_no_others():
    truth = {**NEO_HOOKEAN, "ogden_4": 20e3, "shear_viscosity": 30.0}
    laws = classes(truth)
    found = laws["elastic", "viscosity"]
    assert found.parameters == pytest.approx(truth, rel=1e-3)
    assert found.residual < 1e-6
    assert laws["viscosity",].parameters["shear_viscosity"] == pytest.approx(30.0, rel=0.02)
    smaller = [law for groups, law in laws.items() if not {"elastic", "viscosity"} <= {*groups}]
    assert min(law.residual for law in smaller) > 100.0 * found.residual
    assert laws["viscosity",].residual < 0.1 * laws[()].residual


def test_a_branch_between_two_times_of_the_grid_is_one_branch():
    truth = {**NEO_HOOKEAN, "prony_modulus_1": 15e3, "prony_time_1": math.sqrt(TIMES[3] * TIMES[4])}
    laws = classes(truth)
    found = laws["branches",]
    assert {name for name in found.parameters if name.startswith("prony")} == {"prony_modulus_1", "prony_time_1"}
    assert found.parameters["prony_time_1"] == pytest.approx(truth["prony_time_1"], rel=0.05)
    assert found.parameters["prony_modulus_1"] == pytest.approx(15e3, rel=0.05)
    assert found.residual < 0.01 * laws[()].residual


def test_neighbouring_relaxation_times_become_one_branch():
    branches = [{"prony_modulus_1": 1e5, "prony_time_1": time} for time in (0.01, 0.015, 0.1, 0.4)]
    candidates = [{"c10": 1e5}, {"bulk_1": 1e5}, *branches, {"shear_viscosity": 1e2}]
    found = _parameters(candidates, np.array([0.4, 20.0, 0.1, 0.3, 0.2, 1e-5, 0.5]))
    assert {name: found[name] for name in ("c10", "bulk_1", "shear_viscosity")} == pytest.approx(
        {"c10": 4e4, "bulk_1": 2e6, "shear_viscosity": 50.0}
    )
    together = 0.01 ** (1 / 4) * 0.015 ** (3 / 4)  # the mean of the logarithms, weighted by the moduli
    branches = {"prony_modulus_1": 4e4, "prony_time_1": together, "prony_modulus_2": 2e4, "prony_time_2": 0.1}
    assert {name: value for name, value in found.items() if name.startswith("prony")} == pytest.approx(branches)
