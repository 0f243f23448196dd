"""The identified law on the page: its section, its stress,
and trials outside of the training loads.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize
import torch
import warp as wp

from support.made_up_run import vertex_settings, write_vertex_run
from support.report_page import report
from warp_resphys.core.energies.convex_material import ConvexMaterial
from warp_resphys.io.safe_files import read_json, write_json
from warp_resphys.report import law_section
from warp_resphys.report.law_section import ACROSS, ALONG, uniaxial_stress
from warp_resphys.report.page import Cell
from warp_resphys.report.pages.run_page import range_table
from warp_resphys.report.wording import number_text
from warp_resphys.settings.body import MaterialSettings
from warp_resphys.settings.learning import LawSettings

OTHER = "0.12 <kg>"
TERMS = {
    "c10": 30e3,
    "c20": 4e3,
    "c01": 6e3,
    "c02": 2e3,
    "bulk_1": 2e6,
    "bulk_2": 1e6,
    "dilation": 5e3,
}
TERMS |= {"ogden_4": 20e3, "ogden_m3": 5e3}
FIBRES = {"tension": 50e3, "slack": 0.01, "toe": 0.02, "stiffening": 10e3, "compression": 8e3}
FIBRES = {f"fibre_{name}_1": value for name, value in FIBRES.items()} | {"fibre_elevation_1": 0.0}


def errors_on(trials, error, below):
    """Errors of a law on trials."""
    return {"trials": trials, "split": "validation", "law": error, "below": below}


def law(**changes):
    """Content of law.json, and what metrics.json adds."""
    parameters = {
        "c10": 40e3,
        "bulk_1": 7e6,
        "ogden_3": 8e3,
        "prony_modulus_1": 20e3,
        "prony_time_1": 0.08,
    }
    own = {
        "model": "law",
        "accepted": True,
        "groups": ["elastic", "branches"],
        "parameters": parameters,
        "units": {
            "c10": "Pa",
            "bulk_1": "Pa",
            "ogden_3": "Pa",
            "prony_modulus_1": "Pa",
            "prony_time_1": "s",
        },
        "others": {},
        "deviation": {
            "c10": 400.0,
            "bulk_1": 6.5e6,
            "ogden_3": 100.0,
            "prony_modulus_1": 10.0,
            "prony_time_1": 1e-3,
        },
        "at_bounds": ["prony_time_1"],
        "validation": errors_on(["80 g", "180 g"], 4.9e-5, 0.1025),
        "classes": [
            {
                "groups": [],
                "parameters": {"c10": 44e3, "bulk_1": 7e6},
                "residual": 0.02,
                "validation": None,
            },
            {
                "groups": ["elastic", "branches"],
                "parameters": parameters,
                "residual": 0.003,
                "validation": 1.2e-4,
            },
        ],
        "data": {"name": "own", "trials": ["0.05 kg"]},
        "against": "simulation",
    }
    return {**own, **changes}


def run(folder, own, **more):
    """Writes a run with a law, whose last trial is held in another way, and returns its page."""
    models = ("simulation", *(["law"] if own["accepted"] else []), "simfree", "resphys")
    plain = vertex_settings()
    write_vertex_run(folder, plain, models=models, **more)
    write_json(folder / "law.json", own)
    others = {OTHER: {"weight_g": 120.0}}
    return report(folder, plain.changed(law=LawSettings(), data=plain.data.changed(others=others)))


@pytest.mark.usefixtures("no_drawing")
def test_page_has_the_law_and_the_errors_by_load(tmp_path):
    page = run(tmp_path, law())
    means = {
        row["name"]: row["errors_mm"]
        for row in read_json(tmp_path / "errors.json")["per_trajectory"]
    }
    inside, outside = (number_text(means[name]["law"]) for name in ("0.07 kg", OTHER))
    assert inside != outside
    page.says(
        "On a simulated target, beyond the training loads, ",
        "mean error of the vertices [mm]weights of the paperother loads",
        f"+ law of its material{inside}{outside}",
        "is used: its root mean square error on the validation trials (80 g, 180 g) is 0.0049 % of",
        "40.00 ± 0.40kPa",
        "Ogden's term of exponent 3",
        "One test trial: 0.12 <kg>, beyond the training loads",
        "did not need: second-order term in I₁, Mooney-Rivlin term, ",
        "the shear modulus of the law is 108 kPa",
        "With elastic terms and relaxation40.30 %0.012 %chosen",
        "Shape and volume alone (neo-Hookean)22.0 %failed",
    )
    assert (tmp_path / "figures" / "law.png").is_file()
    assert (tmp_path / "figures" / "error_over_time.png").is_file()


@pytest.mark.usefixtures("no_figures")
def test_a_law_that_is_not_used_is_said_to_be_so(tmp_path):
    page = run(tmp_path, law(accepted=False, validation=errors_on(["80 g"], 0.2, 0.1)))
    said = (
        "The identified law is not used: "
        "its root mean square error on the validation trials (80 g) is 20 %"
    )
    assert said in page.text
    assert "with the law" not in page.text
    assert "failed" in law_section.law_text(law(validation=errors_on(["0.05 kg"], 0.1, None)))


def test_a_law_that_its_own_run_did_not_use_and_terms_that_it_does_not_have_are_named():
    given = law(file="other.json", validation=errors_on(["80 g"], 0.1, 0.2))
    assert "did not use it" not in law_section.law_text({**given, "accepted_there": True})
    assert law_section.law_text({**given, "accepted_there": False}).endswith(
        "did not use it: it was not clearly closer there."
    )
    assert "viscosity in volume and fibres." in law_section.not_needed_text(
        law(), LawSettings(terms=())
    )
    assert law_section.wording("ogden_m3")[0][0] == "Ogden's term of exponent -3"


def test_where_the_force_fades_out_the_law_remains_and_stretches_beyond_the_training_are_said():
    metrics = {"errors_mm": {"law": {}}, "range": {"resphys": {"first_s": {"up": 0.0}}}}
    table = range_table(metrics, ["50 g", "up"])
    assert table.rows[0].cells == [Cell("1 of 2", "from the start (up)")]
    assert table.note.endswith("fades out, and the law remains.")
    stretches = {"all test trials": (0.7, 1.4), "the training": (0.9, 1.1)}
    metrics = {"law": {}}
    said = law_section.outside_text(
        SimpleNamespace(outside=0.123, stretches=stretches, metrics=metrics)
    )
    assert said.startswith(
        "In 12 % of the cells and times of all test trials, a principal stretch lies outside of "
    )
    assert said.endswith("0.90 to 1.10: there it extrapolates.")
    metrics["law"]["modes"] = ["tension", "shear"]
    said = law_section.outside_text(
        SimpleNamespace(outside=0.123, stretches=stretches, metrics=metrics)
    )
    assert said.endswith(
        "0.90 to 1.10 in tension and shear, or the load is another one: there it extrapolates."
    )
    assert law_section.outside_text(SimpleNamespace(outside=0.001, stretches=stretches)) == ""
    assert law_section.outside_text(SimpleNamespace(outside=None, stretches={})) == ""


def test_a_class_is_named_with_the_viscosity_that_its_law_has():
    tried = [
        {"groups": ["elastic"], "parameters": {"c10": 1e4, "bulk_viscosity": x}}
        for x in (0.0, 200.0)
    ]
    (table,) = law_section._classes({"groups": ["elastic"], "classes": tried})
    assert [row.head for row in table.rows] == [
        "With elastic terms",
        "With elastic terms and viscosity",
    ]


def test_a_term_with_the_coefficient_zero_is_not_listed():
    parameters = {
        "c10": 4e4,
        "c20": 0.0,
        "shear_viscosity": 0.0,
        "fibre_azimuth_1": 0.0,
        "fibre_slack_1": 0.0,
    }
    content = {
        "parameters": parameters,
        "deviation": {"c10": 1.0, "c20": 1.0, "fibre_azimuth_1": 0.1},
    }
    heads = [row.head for row in law_section._terms_table(content).rows]
    assert heads == ["Neo-Hookean term", "Fibres 1: azimuth"]  # An angle may be zero.
    said = law_section.not_needed_text(content, LawSettings(terms=["c20", "c01"], families=0))
    assert "second-order term in I₁, Mooney-Rivlin term, viscosity in shear" in said


@pytest.mark.parametrize("direction", [None, ALONG, ACROSS])
def test_stress_is_that_of_the_simulated_law(direction):
    """At stretches with free sides, the kernels' stress is along the load alone,
    and has the value of the curve.
    """
    azimuth = 0.0 if direction in (None, ALONG) else np.pi / 2.0
    parameters = {**TERMS, **({} if direction is None else {**FIBRES, "fibre_azimuth_1": azimuth})}
    material = ConvexMaterial.from_parameters(parameters)
    own = {
        name: torch.tensor([[value]], dtype=torch.float64)
        for name, value in material.values.items()
    }
    law_of, module = material.law, wp.get_module(f"test_law.{material.law.name}")
    moduli = law_of.values(*(float(modulus) for modulus in material.moduli(own)))

    @wp.kernel(module=module, enable_backward=False)
    def stress_of(f: wp.array[wp.mat33d], m: law_of.values, stress_out: wp.array[wp.mat33d]):
        _energy, stress = law_of.response(f[wp.tid()], m)
        stress_out[wp.tid()] = stress

    for stretch in (0.85, 1.25):
        (found,) = uniaxial_stress(parameters, np.array([stretch]), direction)
        sides = scipy.optimize.root(
            lambda s, x=stretch: stresses(stress_of, moduli, x, s)[1:], np.ones(2)
        ).x
        expected = stresses(stress_of, moduli, stretch, sides)
        assert np.abs(expected[1:]).max() < 1e-6 * abs(expected[0])
        assert found == pytest.approx(expected[0], rel=1e-6)
        assert found * (stretch - 1.0) > 0.0


def stresses(kernel, moduli, stretch, sides):
    """Nominal stresses (3,) [Pa] along the axes."""
    f = wp.array(np.diag([stretch, *sides])[None], dtype=wp.mat33d, device="cpu")
    out = wp.zeros(1, dtype=wp.mat33d, device="cpu")
    wp.launch(kernel, 1, [f, moduli], [out], device="cpu")
    return np.diagonal(out.numpy()[0])


def test_moduli_at_small_strains():
    moduli = law_section.small_strain(TERMS)
    step = 1e-5
    low, high = uniaxial_stress(TERMS, np.array([1.0 - step, 1.0 + step]))
    assert (high - low) / (2.0 * step) == pytest.approx(moduli.youngs_modulus, rel=1e-6)
    hookean = MaterialSettings(
        model="stable_neo_hookean", youngs_modulus=264e3, poissons_ratio=0.45
    )
    found = law_section.small_strain_of(hookean)
    assert (found.youngs_modulus, found.poissons_ratio) == pytest.approx((264e3, 0.45))
    assert law_section.small_strain_of(MaterialSettings(model="law", **TERMS)) == moduli
    x = law_section.drawn_stretches({"all trials": (0.8, 1.3)})
    assert x[0] < 0.8 < 1.3 < x[-1]
    assert 1.0 in x
