"""The table of elements."""

import pytest

from support.command_line import outcome, refusal


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


def test_too_fine(folder):
    assert "finest is 9" in refusal("benchmark", "elements", "finest=9")
