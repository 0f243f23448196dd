"""The study of contact: its closed forms, and its smallest form from end to end."""

import math

import numpy as np
import pytest
import scipy.linalg

from support.command_line import outcome, settings_of
from warp_resphys.studies.contact_check import ContactStudy
from warp_resphys.studies.indentation import hertz_force, layer_force, layer_response


def test_a_thick_layer_is_a_half_space():
    """The correction of Dimitriadis et al., whose first term for an incompressible layer is 1.133 chi."""
    hertz = 4.0 / 3.0 * 1e5 / (1.0 - 0.25) * math.sqrt(0.01) * 1e-4**1.5
    assert hertz_force(0.01, 1e-4, 1e3, 1e5, 0.5) == pytest.approx(hertz, rel=2e-6)
    chi = math.sqrt(0.01 * 1e-4) / 0.01
    series = 1.0 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    assert hertz_force(0.01, 1e-4, 0.01, 1e5, 0.5) / hertz == pytest.approx(series, abs=1e-4)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_the_response_of_a_layer_solves_the_equations_of_plane_strain(nu):
    """For u_x = U sin kx, u_z = W cos kx and the stresses at constant z, their derivatives by z are linear in them."""
    young, thickness = 2.0, 0.7
    shear, modulus = young / (2.0 + 2.0 * nu), young * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    lame = modulus - 2.0 * shear
    for k in (0.3, 2.0, 9.0):
        slopes = [
            [0.0, k, 1.0 / shear, 0.0],
            [-lame * k / modulus, 0.0, 0.0, 1.0 / modulus],
            [k**2 * (modulus - lame**2 / modulus), 0.0, 0.0, lame * k / modulus],
            [0.0, 0.0, -k, 0.0],
        ]
        to_surface = scipy.linalg.expm(thickness * np.array(slopes))[:, 2:]  # from the stresses at the base
        displacement = to_surface[1] @ np.linalg.solve(to_surface[2:], [0.0, 1.0])
        assert layer_response(np.array([k]), thickness, young, nu) == pytest.approx(displacement, rel=1e-10)


def test_a_cylinder_on_a_thin_layer_presses_columns_and_on_a_thick_one_a_half_space():
    """Columns of nu = 0 carry E d / t; on a half-space, the depth falls with the distance as ln, by Hertz's force."""
    radius, depth, young = 0.05, 1e-5, 2e5
    columns = young / 1e-4 * 4.0 / 3.0 * math.sqrt(2.0 * radius * depth) * depth
    assert layer_force(radius, depth, 1e-4, young, 0.0) == pytest.approx(columns, rel=1e-3)
    # With 4 R F = pi a^2 E*, the depth is F / (pi E*) (2 ln (t / a) + c) (Johnson 1985), where c depends on nu alone.
    constants = []
    for depth in (1e-6, 4e-6, 1.6e-5):
        force = layer_force(radius, depth, 0.02, young, 0.3)
        stiffness = math.pi * young / (1.0 - 0.09)
        a = math.sqrt(4.0 * radius * force / stiffness)
        constants.append(stiffness * depth / force - 2.0 * math.log(0.02 / a))
    assert constants == pytest.approx([constants[0]] * 3, abs=0.02)


def test_the_quick_form_is_smaller():
    study = settings_of(ContactStudy, "verify_contact")
    assert study.chosen == study
    small = settings_of(ContactStudy, "verify_contact", "quick=true").chosen
    assert small.throws < study.throws
    assert len(small.frictions) == len(small.cells) == len(small.cylinder_cells) == len(small.batches) == 1


def test_the_smallest_check_passes_and_writes_a_page(folder):
    ended = outcome("verify", "contact", "quick=true", "throws=1", "results=docs", "hydra.run.dir=out")
    assert ended.code == 0, ended.out
    assert "FAILED" not in ended.out
    (page,) = (folder / "docs").glob("*-contact.md")
    text = page.read_text()
    assert "checks: all passed" in text
    for title in (
        "Inclined plane",
        "Stopping distance",
        "A sphere on a block",
        "A cylinder on a block",
        "Thrown blocks",
        "Closing plates",
        "Energy",
        "A body on a slope",
        "Bodies thrown at one another",
        "Momentum of bodies",
        "An arch",
        "A house of cards",
        "Surfaces that must not cross",
    ):
        assert title in text
    assert "warp-resphys verify contact" in text
    assert (folder / "out" / "contact.html").is_file()
