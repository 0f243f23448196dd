"""The table of linear solvers by size."""

import json
import sys

import pytest

from warp_resphys import cli
from warp_resphys.studies.sizes import exponents


def run(monkeypatch, capsys, *arguments):
    """What the command printed, or, where it was refused, what was wrong."""
    monkeypatch.setattr(sys, "argv", ["warp-resphys", "benchmark", "sizes", *arguments])
    try:
        cli.main()
    except SystemExit:
        return capsys.readouterr().err
    return capsys.readouterr().out


def test_rows(folder, monkeypatch, capsys):
    said = run(
        monkeypatch,
        capsys,
        "elements=[hexahedron8]",
        "hexahedron_divisions=[[4,2,2],[8,2,2]]",
        "linear_solvers=[banded,multigrid]",
        "poissons_ratios=[0.45]",
        "repeats=1",
    )
    (written,) = folder.rglob("size_study.json")
    rows = json.loads(written.read_text())["rows"]
    assert [(row["linear_solver"], row["unknowns"]) for row in rows] == [
        ("banded", 108),
        ("multigrid", 108),
        ("banded", 216),
        ("multigrid", 216),
    ]
    assert all(row[key] > 0.0 for row in rows for key in ("forward_s", "adjoint_s", "memory_gib", "iterations"))
    # A factor for every iterate where it costs little, and one that serves several where it does not.
    assert all((row["factorisations"] == row["iterations"]) == (row["linear_solver"] == "multigrid") for row in rows)
    assert "Exponents" in said


def test_a_case_that_takes_too_long_leaves_out_the_larger_ones(folder, monkeypatch, capsys):
    said = run(
        monkeypatch,
        capsys,
        "elements=[tetrahedron10]",
        "tetrahedron_divisions=[[2,1,1],[4,1,1]]",
        "linear_solvers=[banded]",
        "poissons_ratios=[0.45]",
        "longest=0.2",
    )
    assert said.count("more than 0.2 s") == 1


def test_a_solver_that_is_not_there(folder, monkeypatch, capsys):
    assert "linear_solvers is ['lu']: it must be some of auto, banded" in run(
        monkeypatch, capsys, "linear_solvers=[lu]"
    )


def test_exponents():
    powers = {"forward_s": 1.5, "adjoint_s": 1.0, "memory_gib": 0.5}
    rows = [
        {"linear_solver": "banded", "unknowns": n, **{key: 3e-6 * n**power for key, power in powers.items()}}
        for n in (10, 100, 1000, 10_000)
    ]
    rows[0]["forward_s"] = 7.0  # not among the largest three
    rows.append({"linear_solver": "banded", "unknowns": 0, "failed": "more than 1 s"})
    assert exponents(rows)["banded"] == pytest.approx(powers)
