"""The table of elements."""

import sys

import pytest

from warp_resphys import cli


def rows(monkeypatch, capsys, *arguments):
    """First cells of each row of the table, and its last; without a table, what was wrong."""
    monkeypatch.setattr(sys, "argv", ["warp-resphys", "element-study", *arguments])
    try:
        cli.main()
    except SystemExit:
        return capsys.readouterr().err
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    return [([cell.strip() for cell in line[:3]], float(line[-1])) for line in lines]


def test_table(folder, monkeypatch, capsys):
    table = rows(monkeypatch, capsys, "finest=1", "poissons_ratios=[0.499]")
    assert [row for row, _ in table[:2]] == [["8-node hexahedra", rule, "176"] for rule in ("centre", "full")]
    sags = [sag for _, sag in table]
    assert sags[:2] == pytest.approx([-6.42, -3.07], abs=0.03)
    assert sags[4] == pytest.approx(-6.79, rel=0.02)  # 10-node tetrahedra, and what refinement leads to


def test_too_fine(folder, monkeypatch, capsys):
    assert rows(monkeypatch, capsys, "finest=9") == "error: finest is 9: choose a whole number from 1 to 4.\n"
