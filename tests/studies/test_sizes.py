"""The table of linear solvers by size."""

import pytest
import trimesh

from support.command_line import outcome, refusal
from warp_resphys.io.files import read_json
from warp_resphys.studies.sizes import exponents


def test_rows(folder):
    sizes = ["elements=[hexahedron8]", "hexahedron_divisions=[[4,2,2],[8,2,2]]", "poissons_ratios=[0.45]", "repeats=1"]
    ended = outcome("benchmark", "sizes", *sizes, "linear_solvers=[banded,multigrid]")
    (written,) = folder.rglob("size_study.json")
    rows = read_json(written)["rows"]
    cases = [("banded", 108), ("multigrid", 108), ("banded", 216), ("multigrid", 216)]
    assert [(row["linear_solver"], row["unknowns"]) for row in rows] == cases
    assert all(row[key] > 0.0 for row in rows for key in ("forward_s", "adjoint_s", "memory_gib", "iterations"))
    # A factor for every iterate where it costs little, and one that serves several where it does not.
    assert all((row["factorisations"] == row["iterations"]) == (row["linear_solver"] == "multigrid") for row in rows)
    assert "Exponents" in ended.out


def test_a_case_that_takes_too_long_leaves_out_the_larger_ones(folder):
    sizes = ["elements=[tetrahedron10]", "tetrahedron_divisions=[[2,1,1],[4,1,1]]", "poissons_ratios=[0.45]"]
    ended = outcome("benchmark", "sizes", *sizes, "linear_solvers=[banded]", "longest=0.2")
    assert ended.out.count("more than 0.2 s") == 1
    assert "2 x 1 x 1" in ended.out
    assert "4 x 1 x 1" not in ended.out


def test_a_surface_is_filled_with_cells_of_given_edges(folder):
    pytest.importorskip("gmsh")
    trimesh.creation.icosphere(3, 50.0).export(folder / "ball.stl")
    ball = [
        f"surface={folder / 'ball.stl'}",
        "lengths=[0.05,0.03]",
        "elements=[tetrahedron4]",
        "poissons_ratios=[0.45]",
    ]
    ended = outcome("benchmark", "sizes", *ball, "linear_solvers=[multigrid]", "repeats=1")
    (written,) = folder.rglob("size_study.json")
    coarse, fine = read_json(written)["rows"]
    assert 0 < coarse["unknowns"] < fine["unknowns"]
    assert "30 mm" in ended.out


def test_a_surface_without_lengths_or_of_hexahedra_is_refused(folder):
    surface = ("benchmark", "sizes", "surface=ball.stl")
    assert "given lengths" in refusal(*surface, "elements=[tetrahedron4]")
    assert "given lengths" in refusal(*surface, "elements=[hexahedron8]", "lengths=[0.01]")


def test_a_solver_that_is_not_there(folder):
    assert "linear_solvers is ['lu']" in refusal("benchmark", "sizes", "linear_solvers=[lu]")


def test_exponents():
    powers = {"forward_s": 1.5, "adjoint_s": 1.0, "memory_gib": 0.5}
    rows = [
        {"linear_solver": "banded", "unknowns": n, **{key: 3e-6 * n**power for key, power in powers.items()}}
        for n in (10, 100, 1000, 10_000)
    ]
    rows[0]["forward_s"] = 7.0  # not among the largest three
    rows.append({"linear_solver": "banded", "unknowns": 0, "failed": "more than 1 s"})
    assert exponents(rows)["banded"] == pytest.approx(powers)
