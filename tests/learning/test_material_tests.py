"""Laws from tests of specimens: coefficients, machines,
classes by what they predict, simulated specimens, refusals.
"""

from dataclasses import replace

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys.core.energies.catalogue import law_content, read_law
from warp_resphys.core.energies.isochoric import bulk_of, stress, stress_columns
from warp_resphys.core.energies.silicones import silicone_files
from warp_resphys.io.errors import InputError
from warp_resphys.learning.identification.material_tests import identify_from_tests
from warp_resphys.learning.identification.specimens import MaterialTest, Specimen

SILICONE = {"c10": 25e3, "ogden_3": 20e3}
STRAINS = np.linspace(0.02, 1.0, 120)
MADE_OF = {"density": 1070.0, "poissons_ratio": 0.4995}


def measured(
    kind, strains=STRAINS, law=SILICONE, noise=0.01, zero=0.0, toe=0.0, compliance=0.0, **known
):
    """A test of a law by a machine with a zero [Pa],
    a toe and a compliance [1/Pa], and relative noise.
    """
    exact = stress(kind, strains, law)
    noisy = exact * (1.0 + noise * np.random.default_rng(1).standard_normal(len(strains)))
    return MaterialTest(kind, strains + toe + compliance * exact, noisy + zero, **known)


def test_coefficients_from_several_tests():
    tests = {
        kind: measured(kind)
        for kind in ("tension", "compression", "shear", "biaxial", "planar")
        if kind != "compression"
    }
    tests["compression"] = measured("compression", np.linspace(0.01, 0.4, 60))
    law = identify_from_tests(tests, **MADE_OF)
    assert law.groups == ["ogden_3"]
    for name, true in SILICONE.items():
        assert abs(law.parameters[name] - true) < 3.0 * law.deviation[name] < 0.1 * true
    assert law.parameters["bulk_1"] == pytest.approx(bulk_of(law.parameters, 0.4995))
    assert all(0.008 < error < 0.012 for error in law.errors.values())
    assert law.stretches == pytest.approx((0.25, 2.0))  # of the biaxial test, and of tension


def test_machine_with_unknown_zero_toe_and_compliance():
    """Unknown constants do not spoil the law, which is wrong without them."""
    machine = {"zero": -4e3, "toe": 0.01, "compliance": 0.3e-6}
    given = measured("tension", **machine)
    knowing = replace(given, zero=5e3, toe=0.02, compliance=0.5e-6)
    law, without = (
        identify_from_tests({"a": test}, terms=("ogden_3",), **MADE_OF) for test in (knowing, given)
    )
    modulus, naive, true = (
        stress("tension", np.array([1.0]), one)[0]
        for one in (law.parameters, without.parameters, SILICONE)
    )
    assert modulus == pytest.approx(true, rel=0.04)
    assert abs(naive / true - 1.0) > 0.05
    assert law.machines["a"]["zero"] == pytest.approx(-4e3, abs=2e3)
    assert without.errors["a"] > 2.0 * law.errors["a"]


def test_smallest_class_that_predicts():
    plain = identify_from_tests({"a": measured("tension", law={"c10": 30e3})}, **MADE_OF)
    assert plain.groups == []
    assert [tried["groups"] for tried in plain.classes] == [
        [],
        ["c01"],
        ["ogden_3"],
        ["c01", "ogden_3"],
    ]
    stiffening = identify_from_tests({"a": measured("tension")}, **MADE_OF)
    assert stiffening.groups == ["ogden_3"]
    content = stiffening.content()
    assert content["validation"]["law"] < 0.5 * content["validation"]["below"]
    assert {"c10", "ogden_3", "bulk_1", "density"} == {*content["parameters"]}


def test_interval_grows_beyond_the_range():
    law = identify_from_tests({"a": measured("tension")}, **MADE_OF)
    value, half = law.interval("tension", np.array([0.5, 1.0, 2.0]))
    true = stress("tension", np.array([0.5, 1.0, 2.0]), SILICONE)
    assert (np.abs(value - true) < half).all()
    assert (half[:2] < 0.03 * value[:2]).all()
    assert 0.2 * value[2] < half[2] < 0.3 * value[2]


def test_branches_from_a_hold():
    seconds = np.concatenate([np.linspace(0.0, 0.5, 40), np.linspace(0.55, 12.0, 120)])
    strain = np.minimum(seconds, 0.5)
    columns = stress_columns("tension", strain, ("c10", "prony_1"), seconds)
    exact = 25e3 * columns["c10"] + 8e3 * columns["prony_1"]
    held = MaterialTest("tension", strain, exact, seconds)
    law = identify_from_tests({"hold": held}, times=(0.1, 1.0, 10.0), terms=(), **MADE_OF)
    assert law.parameters["c10"] == pytest.approx(25e3, rel=1e-3)
    assert law.parameters["prony_modulus_1"] == pytest.approx(8e3, rel=1e-2)
    assert law.parameters["prony_time_1"] == 1.0
    assert "prony_modulus_2" not in law.parameters


def test_law_of_another_source_is_a_prior_and_gives_its_branches():
    """A vague prior changes nothing, a sharp one rules.

    The stress of known branches is left to them.
    """
    seconds = np.linspace(0.0, 1.0, len(STRAINS))
    columns = stress_columns("tension", STRAINS, ("c10", "prony_0.5"), seconds)
    test = MaterialTest(
        "tension", STRAINS, 25e3 * columns["c10"] + 6e3 * columns["prony_0.5"], seconds
    )
    other = law_content(
        "law", {"c10": 28e3, "bulk_1": 1e7, "prony_modulus_1": 6e3, "prony_time_1": 0.5}
    )
    vague, sharp = ({**other, "shear_deviation": deviation} for deviation in (1e6, 1.0))
    from_vague, from_sharp = (
        identify_from_tests({"a": test}, terms=(), known=law, **MADE_OF) for law in (vague, sharp)
    )
    assert from_vague.parameters["c10"] == pytest.approx(25e3, rel=1e-3)
    assert from_sharp.parameters["c10"] == pytest.approx(28e3, rel=1e-3)
    assert from_vague.parameters["prony_modulus_1"] == 6e3
    assert identify_from_tests({"a": test}, terms=(), **MADE_OF).parameters["c10"] > 27e3


def test_glued_ends_against_gent_and_lindley():
    """Apparent modulus of a flat rubber cylinder in compression:
    E (1 + 2 S^2), S = radius / (2 height) (1959).
    """
    specimen = Specimen(0.0125, (0.029,))
    law = {"c10": 30e3, "bulk_1": bulk_of({"c10": 30e3}, 0.4999)}
    value, columns, slope = specimen.response("compression", np.array([0.005, 0.01]), law)
    shape = 0.029 / (4.0 * 0.0125)
    assert value[1] / 0.01 == pytest.approx(180e3 * (1.0 + 2.0 * shape**2), rel=0.06)
    # All of the stress, but for the volume.
    assert columns["c10"][1] == pytest.approx(value[1] / 30e3, rel=0.02)
    assert slope[1] == pytest.approx((value[1] - value[0]) / 0.005, rel=0.02)


def test_a_specimen_is_simulated_where_samples_count():
    """A table up to rupture, of which the first tenth counts."""
    specimen, strains = Specimen(0.004, (0.01, 0.01), cells=1), np.linspace(0.02, 3.0, 150)
    law = {"c10": 30e3, "bulk_1": bulk_of({"c10": 30e3}, 0.4995)}
    exact = specimen.response("shear", strains[:15], law)[0]
    table = np.append(exact, np.full(135, exact[-1]))
    test = MaterialTest("shear", strains, table, specimen=specimen, counted=strains < 0.31)
    found = identify_from_tests({"a": test}, terms=(), **MADE_OF)
    assert found.parameters["c10"] == pytest.approx(30e3, rel=1e-3)
    assert found.largest == pytest.approx(0.3)


def test_derivatives_of_a_simulated_specimen():
    specimen = Specimen(0.004, (0.01, 0.01), cells=1)
    law = {"c10": 30e3, "ogden_3": 10e3, "bulk_1": 5e6}
    strains = np.array([0.1, 0.2, 0.3])
    for kind in ("tension", "compression", "shear"):
        _, columns, _ = specimen.response(kind, strains, law)
        for name in ("c10", "ogden_3"):
            low, high = (
                specimen.response(kind, strains, {**law, name: f * law[name]})[0]
                for f in (0.99, 1.01)
            )
            np.testing.assert_allclose(columns[name], (high - low) / (0.02 * law[name]), rtol=1e-4)


@pytest.mark.slow
def test_indentation_against_hertz():
    """A sphere of radius R in a half-space: F = 16/9 E sqrt(R) d^(3/2)
    for an incompressible material.
    """
    specimen = Specimen(0.03, (0.06, 0.06), indenter=0.006)
    law = {"c10": 30e3, "bulk_1": bulk_of({"c10": 30e3}, 0.4995)}
    depth = np.array([0.0015, 0.002, 0.0024])
    value, _, _ = specimen.response("indentation", depth / 0.03, law)
    np.testing.assert_allclose(
        value * specimen.area, 16.0 / 9.0 * 180e3 * 0.006**0.5 * depth**1.5, rtol=0.08
    )


def test_refusals():
    x = np.linspace(0.1, 1.0, 6)
    refuses(InputError, "3 samples count: give 5 or more", MaterialTest, "tension", x[:3], x[:3])
    refuses(InputError, "give 5 or more", MaterialTest, "tension", x, 0.0 * x)
    refuses(InputError, "finite number for every sample", MaterialTest, "tension", x, x[:4])
    refuses(InputError, "kind is 'tensile'", MaterialTest, "tensile", x, x)
    refuses(InputError, "indentation of a specimen", MaterialTest, "indentation", x, x)
    refuses(InputError, "mostly negative", MaterialTest, "compression", -0.5 * x, -x)
    refuses(InputError, "mostly negative", MaterialTest, "tension", x, -x)
    refuses(InputError, "strains from 0.1 to 1", MaterialTest, "compression", x, x)
    refuses(InputError, "not per cent", MaterialTest, "tension", 100.0 * x, x)
    refuses(
        InputError,
        "terms has 'gent'",
        identify_from_tests,
        {"a": measured("tension")},
        terms=("gent",),
        **MADE_OF,
    )
    refuses(
        InputError,
        "poissons_ratio is 0.5",
        identify_from_tests,
        {"a": measured("tension")},
        density=1e3,
        poissons_ratio=0.5,
    )
    refuses(InputError, "section is 0.03", Specimen, 0.1, 0.03)
    refuses(InputError, "seconds do not rise", MaterialTest, "tension", x, x, x[::-1])
    refuses(
        InputError,
        "times of a homogeneous test are missing",
        identify_from_tests,
        {"a": measured("tension")},
        times=(1.0,),
        **MADE_OF,
    )
    refuses(InputError, "tests is empty", identify_from_tests, {}, **MADE_OF)
    refuses(InputError, "give a positive length", Specimen, 0.0, (0.01, 0.01))
    refuses(InputError, "presses on a block", Specimen, 0.1, (0.01,), indenter=0.01)
    refuses(
        InputError,
        "glued ends have",
        Specimen(0.1, (0.1, 0.1)).response,
        "biaxial",
        x,
        {"c10": 1.0, "bulk_1": 1.0},
    )


@pytest.mark.parametrize("name", sorted(silicone_files()))
def test_a_shipped_law_is_a_source(name):
    source = read_law(name)
    seconds = np.linspace(0.0, 4.0, len(STRAINS))
    test = MaterialTest("tension", STRAINS, stress("tension", STRAINS, SILICONE), seconds)
    law = identify_from_tests({"a": test}, known=source, **MADE_OF)
    for parameter in ("prony_time_1", "shear_viscosity"):
        assert law.parameters.get(parameter) == source["parameters"].get(parameter)
    assert source["shear_deviation"] > 0.0


def test_history_outside_the_range_counts():
    """Branches remember strains that do not count.

    Without them the same samples give another law.
    """
    seconds = np.linspace(0.0, 12.0, 240)
    strain = np.interp(seconds, [0.0, 1.0, 6.0, 7.0, 12.0], [0.0, 1.0, 1.0, 0.2, 0.2])
    columns = stress_columns("tension", strain, ("c10", "prony_1.0"), seconds)
    exact = 25e3 * columns["c10"] + 15e3 * columns["prony_1.0"]
    options = {"times": (1.0,), "terms": (), **MADE_OF}
    late = seconds > 3.0
    law = identify_from_tests(
        {"a": MaterialTest("tension", strain, exact, seconds, counted=late)}, **options
    )
    assert law.parameters["c10"] == pytest.approx(25e3, rel=1e-6)
    assert law.parameters["prony_modulus_1"] == pytest.approx(15e3, rel=1e-6)
    assert law.errors["a"] < 1e-9
    cut = identify_from_tests(
        {"a": MaterialTest("tension", strain[late], exact[late], seconds[late])}, **options
    )
    assert cut.errors["a"] > 1e-3


def test_exact_data_need_no_larger_class():
    for kind in ("tension", "shear"):
        assert (
            identify_from_tests(
                {"a": measured(kind, law={"c10": 30e3}, noise=0.0)}, **MADE_OF
            ).groups
            == []
        )


def test_deviations_are_those_of_repeated_tests():
    """Over noise, (found - true) / deviation has a scatter of about one, also of few samples."""
    for count in (6, 20):
        x, found = np.linspace(0.05, 1.0, count), []
        exact = stress("tension", x, {"c10": 30e3})
        for seed in range(60):
            noisy = exact * (1.0 + 0.02 * np.random.default_rng(seed).standard_normal(count))
            law = identify_from_tests({"a": MaterialTest("tension", x, noisy)}, terms=(), **MADE_OF)
            found.append((law.parameters["c10"] - 30e3) / law.deviation["c10"])
        assert 0.6 < np.std(found) < 1.6
