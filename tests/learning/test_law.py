"""The classes of laws that the weak form gives: the smallest one that made the motions is among them."""

import math

import numpy as np
import pytest

from support.known_law import STIFF, beam, released
from warp_resphys.learning.law import WeakForm, _constants, fit_classes

TERMS, TIMES = ("c20", "c01", "ogden_4"), np.geomspace(0.01, 0.2, 8).tolist()
PULLS = [(0.4, 0.0, -0.15), (-0.2, 0.15, 0.05), (0.1, -0.1, 0.15)]  # N
HELD_OUT = [(0.25, 0.12, 0.12)]
NEO_HOOKEAN = {"c10": 30e3, "bulk_1": 2e6}
SHAPE = {"prony_time_1": 0.05, "fibre_toe_1": 0.02}
FIBRE = {f"fibre_{name}_1": 0.0 for name in ("azimuth", "elevation", "slack", "tension", "stiffening", "compression")}


def classes(truth, terms=TERMS, times=TIMES, families=0, steps=12):
    """Classes that fit motions of a law, by their groups."""
    zero = dict.fromkeys((*terms, "c10", "bulk_1", "shear_viscosity", "prony_modulus_1"), 0.0)
    unknown = beam({**zero, **FIBRE, **SHAPE})
    true = beam(truth)
    forms = [WeakForm(unknown, [released(true, pulls, steps)], SHAPE, STIFF, 3) for pulls in (PULLS, HELD_OUT)]
    laws = fit_classes(*forms, terms, times, families)
    sizes = [len(law.groups) for law in laws]
    assert sizes == sorted(sizes)
    assert laws[0].groups == ()
    assert laws[0].constants.keys() == {"c10", "bulk_1"}
    return {law.groups: law for law in laws}


def test_terms_that_the_beam_has_are_found_and_no_others():
    truth = {**NEO_HOOKEAN, "ogden_4": 20e3, "shear_viscosity": 30.0}
    laws = classes(truth)
    found = laws["elastic", "viscosity"]
    assert found.constants == pytest.approx(truth, rel=1e-3)
    assert found.residual < 1e-6
    assert laws["viscosity",].constants["shear_viscosity"] == pytest.approx(30.0, rel=0.02)
    smaller = [law for groups, law in laws.items() if not {"elastic", "viscosity"} <= {*groups}]
    assert min(law.residual for law in smaller) > 100.0 * found.residual
    assert laws["viscosity",].residual < 0.1 * laws[()].residual


def test_a_branch_between_two_times_of_the_grid_is_one_branch():
    truth = {**NEO_HOOKEAN, "prony_modulus_1": 15e3, "prony_time_1": math.sqrt(TIMES[3] * TIMES[4])}
    laws = classes(truth)
    found = laws["branches",]
    assert {name for name in found.constants if name.startswith("prony")} == {"prony_modulus_1", "prony_time_1"}
    assert found.constants["prony_time_1"] == pytest.approx(truth["prony_time_1"], rel=0.05)
    assert found.constants["prony_modulus_1"] == pytest.approx(15e3, rel=0.05)
    assert found.residual < 0.01 * laws[()].residual


def branch(time):
    return {"prony_modulus_1": 1e5, "prony_time_1": time}


def test_neighbouring_relaxation_times_become_one_branch():
    candidates = [{"c10": 1e5}, {"bulk_1": 1e5}, *map(branch, (0.01, 0.015, 0.1, 0.4)), {"shear_viscosity": 1e2}]
    found = _constants(candidates, np.array([0.4, 20.0, 0.1, 0.3, 0.2, 1e-5, 0.5]))
    assert {name: found[name] for name in ("c10", "bulk_1", "shear_viscosity")} == pytest.approx(
        {"c10": 4e4, "bulk_1": 2e6, "shear_viscosity": 50.0}
    )
    together = 0.01 ** (1 / 4) * 0.015 ** (3 / 4)  # the mean of the logarithms, weighted by the moduli
    branches = {"prony_modulus_1": 4e4, "prony_time_1": together, "prony_modulus_2": 2e4, "prony_time_2": 0.1}
    assert {name: value for name, value in found.items() if name.startswith("prony")} == pytest.approx(branches)
