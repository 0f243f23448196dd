"""The table of elements."""

import pytest

from support.command_line import outcome, refusal
from warp_resphys import Body, Corotated, Simulator, select_vertices
from warp_resphys.mesh.mesh import box_hexahedra
from warp_resphys.studies.elements import sag_mm


def test_table(folder):
    out = outcome("benchmark", "elements", "finest=1", "poissons_ratios=[0.499]", "steps=1", "repeats=1").out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if line.startswith("│")]
    assert [row[:3] for row in rows[:2]] == [["8-node hexahedra", rule, "176"] for rule in ("centre", "full")]
    assert all(float(row[-1]) > 0.0 for row in rows)
    sags = {(element, rule): float(sag) for element, rule, _, sag, _ in rows}
    assert sags["8-node hexahedra", "centre"] == pytest.approx(-6.42, abs=0.03)
    assert sags["8-node hexahedra", "full"] == pytest.approx(-3.07, abs=0.03)
    for element in ("27-node hexahedra", "10-node tetrahedra"):  # near the limit of refinement, as others are not yet
        assert sags[element, "centre"] == pytest.approx(-6.77, rel=0.02)
    assert sags["20-node hexahedra", "centre"] == pytest.approx(-6.77, rel=0.06)


def test_the_sag_is_that_of_a_slender_beam():
    """A tip's sag of rho g A L^4 / (8 E I) under the beam's weight."""
    length, width, modulus, density = 0.2, 0.01, 1e7, 1000.0
    mesh = box_hexahedra((length, width, width), (20, 1, 1), nodes=27)
    beam = Simulator(Body(mesh, select_vertices(mesh, x=0.0)), Corotated(modulus, 0.0, density=density))
    expected = density * 9.80709 * width**2 * length**4 / (8.0 * modulus * width**4 / 12.0)
    assert sag_mm(beam) == pytest.approx(-1e3 * expected, rel=0.01)


def test_too_fine(folder):
    assert "finest is 9" in refusal("benchmark", "elements", "finest=9")
