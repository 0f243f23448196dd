"""Materials of convex terms, the rubbers of Gent and of Mooney and Rivlin,
and laws of silicones and from files.
"""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import warp_resphys as wr
from support.clamped import clamped
from support.refusals import refuses
from support.slopes import check_rows
from warp_resphys import InputError, Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.core.dynamics.gradient_check import check_gradients
from warp_resphys.core.energies.catalogue import LAW_FORMAT, law_path, make_material, read_law
from warp_resphys.core.energies.convex_material import ConvexMaterial, FibreFamily
from warp_resphys.energies import Gent, MooneyRivlin

BODY = clamped(box_hexahedra((0.1, 0.03, 0.03), (5, 2, 2)))
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
C10, C01, BULK = 36e3, 8e3, 4e6
FIBRES = [FibreFamily(0.3, 0.2, 0.0, 0.5, 40e3, 10e3), FibreFamily(-0.4, 0.1, 0.005, 0.5, 20e3)]


def simulator(material):
    return Simulator(BODY, material, solver=TIGHT, integrator="bdf2")


def test_two_coefficients_and_a_bulk_modulus_are_mooney_rivlin():
    mu, lame, beta = 2.0 * (C10 + C01), BULK - 4.0 / 3.0 * (C10 + C01), 1e-3
    viscosities = {"shear_viscosity": beta * mu, "bulk_viscosity": beta * lame}
    convex = ConvexMaterial(
        C10, c01=C01, bulk_1=0.5 * lame, **viscosities, prony=[(0.3 * mu, 0.05)]
    )
    rivlin = MooneyRivlin(C10, C01, BULK, stiffness_damping=beta, prony=[(0.3, 0.05)])
    runs = [sim.rollout(sim.rest_state(), 10).q for sim in map(simulator, (convex, rivlin))]
    torch.testing.assert_close(runs[0], runs[1], rtol=0.0, atol=1e-10)
    assert (runs[0][-1] - runs[0][0]).abs().max() > 1e-3


def compared(pose, **terms):
    """Rows of the larger gradients, as rounding limits differences of the others."""
    material = ConvexMaterial(C10, bulk_1=1e6, **terms)
    small = replace(simulator(material), body=clamped(box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))))
    return [row for row in check_gradients(small, pose) if abs(row.adjoint) > 1e-6]


@pytest.mark.parametrize("pose", [pytest.param("bent", marks=pytest.mark.slow), "twisted"])
def test_gradients_by_every_coefficient(pose):
    elastic = {"c20": 20e3, "c30": 10e3, "c01": C01, "c02": 5e3, "dilation": 10e3, "bulk_2": 1e9}
    viscous = {"shear_viscosity": 40.0, "bulk_viscosity": 900.0, "mass_damping": 0.5}
    rows = compared(pose, **elastic, **viscous, prony=[(20e3, 0.03)], ogden={3: 30e3, -3: 5e3})
    twisted = "c20", "c02", "bulk_1", "bulk_2", *(f"{name}, each environment" for name in viscous)
    check_rows(
        rows, "c10", "dilation", "ogden_3", "ogden_m3", *(twisted if pose == "twisted" else ())
    )


@pytest.mark.slow
def test_gradients_by_directions_and_parameters_of_fibres():
    """Differences do not see jumps of the tangent's slope,
    nor of the modulus at the end of compression.
    """
    rows = [row for row in compared("twisted", fibres=FIBRES) if "fibre" in row.parameter]
    check_rows(
        rows, "fibre_azimuth_1", "fibre_tension_2", "fibre_slack_2", "fibre_toe_1", bound=1e-3
    )


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: ConvexMaterial(-1.0), "c10"),
        (lambda: ConvexMaterial(c02=math.inf), "c02"),
        (lambda: ConvexMaterial(fibres=[FibreFamily(tension=-1.0)]), "fibre_tension_1"),
        (lambda: ConvexMaterial(fibres=[(1.0, 0.0, 0.0)]), "for each family"),
        (lambda: ConvexMaterial(ogden={1.5: 1e4}), "exponent 1.5: give whole numbers from 3 up"),
        (lambda: ConvexMaterial(ogden={3: -1.0}), "ogden_3"),
        (
            lambda: simulator(ConvexMaterial(fibres=[FibreFamily(np.zeros(3))])),
            "3 values for 20 elements",
        ),
    ],
)
def test_invalid_coefficients_are_refused(make, key):
    refuses(InputError, key, lambda: make().prepare())


class TestByName:
    """The model `law` of a configuration."""

    def test_every_constant_by_its_name(self):
        fibre = {
            "azimuth": 0.3,
            "elevation": 0.2,
            "slack": 0.01,
            "toe": 0.05,
            "tension": 4e4,
            "stiffening": 1e4,
        }
        fibre["compression"] = 2e3
        parameters = {"c10": C10, "bulk_1": 1e6, "shear_viscosity": 40.0}
        given = {"ogden_m3": 5e3, "ogden_4": 3e4, "prony_modulus_1": 2e4, "prony_time_1": 0.03}
        given |= {f"fibre_{name}_1": value for name, value in fibre.items()}
        made = make_material("law", **parameters, **given)
        terms = {
            "ogden": {-3: 5e3, 4: 3e4},
            "prony": [(2e4, 0.03)],
            "fibres": [FibreFamily(**fibre)],
        }
        direct = ConvexMaterial(**parameters, **terms)
        assert isinstance(made, ConvexMaterial)
        assert made.values == direct.values
        assert made.law is direct.law
        assert {
            "ogden_m3",
            "ogden_4",
            "fibre_compression_1",
            "prony_modulus_1",
        } <= made.values.keys()
        assert "stiffness_damping" not in made.values
        assert ConvexMaterial.from_parameters(made.values).values == made.values

    @pytest.mark.parametrize(
        ("parameters", "message"),
        [
            (
                {"youngs_modulus": 1e5},
                "no parameter 'youngs_modulus': it has c10, .*, prony_modulus_1, .*fibre_azimuth",
            ),
            ({"stiffness_damping": 1e-3}, "no parameter 'stiffness_damping'"),
            (
                {"prony_ratio_1": 0.3, "prony_time_1": 0.1},
                "prony has prony_time_1: give each branch",
            ),
            (
                {"prony_modulus_1": 1e3},
                "prony has prony_modulus_1: give each branch, numbered from 1",
            ),
            (
                {"fibre_tension_1": 1e3},
                "fibres has fibre_tension_1: give each family, numbered from 1",
            ),
            ({"ogden_2": 1e3}, "exponent 2: give whole numbers from 3 up"),
            ({"ogden_x": 1e3}, "no parameter 'ogden_x'"),
            ({"c10": "soft"}, "c10"),
        ],
    )
    def test_what_is_no_law_is_refused(self, parameters, message):
        refuses(InputError, message, make_material, "law", **parameters)


CUBE = box_hexahedra((0.01, 0.01, 0.01), (1, 1, 1))
MU, LIMIT, STIFF = 90e3, 8.0, 90e8


def pulled(stretches, material):
    """(T,) nominal stresses of a bar that is free at its sides [Pa],
    by the force that balances each stretch.
    """
    s = Simulator(
        clamped(CUBE), material, gravity=(0.0, 0.0, 0.0), solver="newton", relative_tolerance=1e-10
    )
    here, stresses = s.linearise(s.rest_state(), parameters={"density": 1e-9}), []
    for stretch in stretches:
        # Nearly incompressible: the sides follow from what little the volume changes, by
        # J - 1 = p / lambda.
        across = stretch**-0.5
        for _ in range(20):
            x = s.rest_positions * torch.tensor([stretch, across, across], dtype=torch.float64)
            residual = here.residual(x[None])[0]
            sideways = float(residual[select_vertices(CUBE, y=0.01), 1].sum())
            force = float(residual[select_vertices(CUBE, x=0.01), 0].sum())
            across -= sideways / (STIFF * 1e-4 * stretch**2 * across**2)
        stresses.append(force / 1e-4)
    return np.array(stresses)


def test_uniaxial_tension_is_that_of_the_closed_form():
    """At constant volume mu J_m (l - l^-2) / (J_m - I1 + 3) at the stretch l (Gent 1996)."""
    stretch = np.array([0.7, 1.0, 1.5, 2.0, 2.8])
    first = stretch**2 + 2.0 / stretch
    expected = MU * LIMIT * (stretch - stretch**-2) / (LIMIT - first + 3.0)
    np.testing.assert_allclose(
        pulled(stretch, Gent(MU, LIMIT, STIFF)), expected, rtol=1e-4, atol=1.0
    )


DAMPED = {"mass_damping": 0.5, "stiffness_damping": 2e-3}


@pytest.mark.parametrize(
    ("material", "start", "names"),
    [
        (Gent(90e3, 3.0, 4e6, **DAMPED), "twisted", ("shear_modulus", "limit, each element")),
        (MooneyRivlin(36e3, 8e3, 4e5, **DAMPED), "rest", ("c10", "c01, each element")),
        (MooneyRivlin(36e3, 8e3, 4e7, **DAMPED), "twisted", ("c10", "c01, each element")),
    ],
    ids=["gent", "mooney_rivlin", "nearly incompressible"],
)
def test_gradients_by_every_constant_of_rubbers(material, start, names, device):
    beam = clamped(box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1)))
    rubber = Simulator(beam, material, solver=TIGHT, device=device)
    check_rows(check_gradients(rubber, start, steps=2), *names, "bulk_modulus, each environment")


@pytest.mark.parametrize(("name", "value"), [("c10", -1), ("bulk_modulus", 0)])
def test_parameters_out_of_range(name, value):
    refuses(
        InputError,
        f"{name} is {value}: it must be positive, in Pa",
        MooneyRivlin,
        **{name: float(value)},
    )


SHIPPED = sorted(path.stem for path in (Path(wr.__file__).parent / "laws").glob("*.json"))


def written(folder, **changes):
    """A law.json as a run writes it."""
    parameters = {
        "density": 1100.0,
        "mass_damping": 3.0,
        "c10": 40e3,
        "bulk_1": 5e6,
        "prony_modulus_1": 8e3,
    }
    content = {
        "format": LAW_FORMAT,
        "model": "law",
        "parameters": parameters | {"prony_time_1": 0.1},
    }
    path = folder / "law.json"
    path.write_text(json.dumps(content | changes))
    return str(path)


def test_the_material_of_a_run_has_its_parameters_without_the_damping_of_the_robot(tmp_path):
    material = wr.read_material(written(tmp_path))
    assert isinstance(material, wr.energies.ConvexMaterial)
    assert material.values["c10"] == 40e3
    assert material.values["density"] == 1100.0
    assert material.values["prony_time_1"] == 0.1
    assert material.values["mass_damping"] == 0.0


@pytest.mark.parametrize("name", SHIPPED)
def test_a_silicone_of_the_package_is_stiff_as_silicones_are_and_says_where_it_comes_from(name):
    law, material = read_law(name), wr.read_material(name)
    ogden = [value for key, value in material.values.items() if key.startswith("ogden_")]
    shear = 2.0 * (material.values["c10"] + material.values["c01"]) + sum(ogden)
    assert 10e3 < shear < 300e3
    assert {"deviation", "stretches", "data", "versions", "units"} <= law.keys()
    assert law["accepted"]


def test_there_are_silicones_and_an_unknown_one_is_refused_with_their_names():
    assert "dragon_skin_10" in SHIPPED
    with pytest.raises(
        wr.DataFileError,
        match=r"no law dragon_skin_99: give the law\.json of a run, or one of .*dragon_skin_10",
    ):
        law_path("dragon_skin_99")


@pytest.mark.parametrize(
    ("stretches", "inside"),
    [
        ((2.0, 0.5**0.5, 0.5**0.5), {"tension"}),
        ((0.5**0.5, 2.0, 0.5**0.5), {"tension"}),  # along another axis
        ((0.5, 2.0**0.5, 2.0**0.5), {"compression"}),
        ((1.4, 1.4, 1.4**-2), {"compression"}),  # tension in two directions
        ((2.0, 1.0, 0.5), {"shear"}),
        ((1.0, 1.0, 1.0), {"tension", "shear", "compression"}),
        # Strains so small that all modes are alike.
        ((0.97, 1.015, 1.015), {"tension", "shear", "compression"}),
    ],
)
def test_a_load_of_another_mode_is_outside_of_the_range_of_a_law(tmp_path, stretches, inside):
    mesh = wr.box_hexahedra((0.1, 0.1, 0.1), (1, 1, 1))
    states = mesh.vertices[None] * np.array(stretches)

    def within(*modes):
        law = written(tmp_path, stretches=[0.5, 2.0], modes=modes)
        return wr.energies.share_outside_law(law, mesh, states) == 0.0

    assert {mode for mode in ("tension", "shear", "compression") if within(mode)} == inside
    assert within("tension", "compression")  # Shear is between them.
    assert (
        wr.energies.share_outside_law(written(tmp_path, stretches=[0.5, 2.0]), mesh, states) == 0.0
    )


def test_silicones_from_tensile_tests_are_tested_in_tension_alone():
    assert read_law("dragon_skin_10_tensile")["modes"] == ["tension"]
    assert "modes" not in read_law("dragon_skin_10")  # from a beam that bends


NUMBER = r"parameters\.c10 is .*: a law has a finite number there"
UNITS = "units is .*: give the unit of each parameter"
STRETCHES = "stretches is .*: give the least and the largest stretch"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        *(
            ("parameters", {"c10": value, "bulk_1": 1e6}, NUMBER)
            for value in (True, "4e4", float("nan"))
        ),
        *(("units", value, UNITS) for value in (None, "Pa")),
        *(
            ("stretches", pair, STRETCHES)
            for pair in ([True, 2.0], [1.1, 0.9], [0.0, 1.1], [0.9, math.inf], [0.9], 1.1)
        ),
        *(
            ("modes", value, r"modes is .*: give a list of 'tension', 'shear', 'compression'")
            for value in ([], "tension")
        ),
        ("modes", ["torsion"], "modes is"),
        *(
            (key, value, "not a law of this version")
            for key, value in (("format", 0), ("parameters", {}), ("model", 3))
        ),
    ],
)
def test_a_file_that_is_no_law_is_refused(tmp_path, key, value, message):
    with pytest.raises(wr.DataFileError, match=rf"law\.json.*{message}"):
        wr.read_material(written(tmp_path, **{key: value}))


def test_cells_that_are_stretched_further_than_in_the_recordings_are_counted(tmp_path):
    mesh = wr.box_hexahedra((0.2, 0.1, 0.1), (2, 1, 1))
    half = mesh.vertices.copy()
    half[:, 0] += np.clip(half[:, 0] - 0.1, 0.0, None)  # The second of two cells is twice as long.
    states = np.stack([mesh.vertices, half])
    assert wr.energies.share_outside_law("dragon_skin_10", mesh, states) == 0.25
    assert (
        wr.energies.share_outside_law(written(tmp_path, stretches=[0.5, 2.1]), mesh, states) == 0.0
    )
    with pytest.raises(
        wr.DataFileError, match=r"law\.json has no stretches: identify the law again"
    ):
        wr.energies.share_outside_law(written(tmp_path), mesh, states)
    with pytest.raises(wr.InputError, match="no finite state"):
        wr.energies.share_outside_law("dragon_skin_10", mesh, np.full_like(states, np.nan))
