"""The table of elements."""

import sys

import pytest

from warp_resphys import cli


def rows(monkeypatch, capsys, *arguments):
    """First cells of each row of the table, the sag, and the time of a step; without a table, what was wrong."""
    monkeypatch.setattr(sys, "argv", ["warp-resphys", "benchmark", "elements", *arguments])
    try:
        cli.main()
    except SystemExit:
        return capsys.readouterr().err
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    return [([cell.strip() for cell in line[:3]], float(line[-2]), float(line[-1])) for line in lines]


def test_table(folder, monkeypatch, capsys):
    table = rows(monkeypatch, capsys, "finest=1", "poissons_ratios=[0.499]", "steps=1", "repeats=1")
    assert [row for row, *_ in table[:2]] == [["8-node hexahedra", rule, "176"] for rule in ("centre", "full")]
    sags = {(element, rule): sag for (element, rule, _), sag, _ in table}
    assert all(cost > 0.0 for *_, cost in table)
    assert sags["8-node hexahedra", "centre"] == pytest.approx(-6.42, abs=0.03)
    assert sags["8-node hexahedra", "full"] == pytest.approx(-3.07, abs=0.03)
    for element in ("27-node hexahedra", "10-node tetrahedra"):  # near what refinement leads to, as others are not yet
        assert sags[element, "centre"] == pytest.approx(-6.77, rel=0.02)
    assert sags["20-node hexahedra", "centre"] == pytest.approx(-6.77, rel=0.06)


def test_too_fine(folder, monkeypatch, capsys):
    assert rows(monkeypatch, capsys, "finest=9") == "error: finest is 9: it must be a whole number from 1 to 4.\n"
