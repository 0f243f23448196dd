import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from warp_resphys import cli
from warp_resphys.experiment.build import build_simulator
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_json, write_json
from warp_resphys.studies.benchmark import released, run_benchmark
from warp_resphys.studies.benchmark_tables import PARTS, benchmark_sheets

TINY = [
    "mesh.divisions=[2,1,1]",
    "benchmark.refinements=[1,2]",
    "benchmark.batches.cpu=[1,2]",
    "benchmark.batches.cuda=[1,2]",
    "benchmark.steps={1: 2, 2: 1}",
    "benchmark.projective_dynamics.steps=1",
    "benchmark.repeats=2",
    "benchmark.parts_repeats=2",
]


def configuration(*overrides: str) -> dict[str, Any]:
    with initialize_config_module("warp_resphys.conf", version_base="1.3"):
        config = compose("benchmark", [*TINY, *overrides])
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return plain


def test_every_case_is_measured(device: str, tmp_path: Path) -> None:
    write_json(tmp_path / "benchmark.json", run_benchmark(configuration(f"device={device}")))
    result = read_json(tmp_path / "benchmark.json")
    cases = [(r["solver"], r["poissons_ratio"], r["refinement"], r["batch"]) for r in result["steps"]]
    grid = [(s, nu, r, b) for s in ("quasi_newton", "newton") for nu in (0.45, 0.499) for r in (1, 2) for b in (1, 2)]
    assert sorted(cases) == sorted([*grid, *(("projective_dynamics", nu, 1, 1) for nu in (0.45, 0.499))])
    for row in result["steps"]:
        assert row["iterations"] >= 1.0
        assert row["repeats"] == 2
        assert row["unknowns"] == {1: 24, 2: 108}[row["refinement"]]
        assert row["steps"] == (1 if row["solver"] == "projective_dynamics" or row["refinement"] == 2 else 2)
        assert 0.0 < row["fastest_forward_ms"] <= row["forward_ms"]
        assert 0.0 < row["fastest_backward_ms"] <= row["backward_ms"]
    newton = [r for r in result["steps"] if r["solver"] == "newton"]
    assert all(r["factorisations"] >= r["iterations"] for r in newton)
    assert [(p["refinement"], p["batch"]) for p in result["parts"]] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert all(p[f"{name}_ms"] > 0.0 for p in result["parts"] for name in PARTS)
    for kind in ("cold", "warm"):
        assert all(seconds > 0.0 for seconds in result["cold_start"][kind].values())
    assert result["yardstick_ms"] > 0.0
    assert result["hardware"]["processor"]
    assert {"torch", "warp-lang", "python"} <= set(result["versions"])
    assert [len(sheet.rows) for sheet in benchmark_sheets(result)] == [len(result["steps"]), 4, 2]


def test_quick_measures_the_coarsest_mesh_alone() -> None:
    result = run_benchmark(configuration("benchmark.quick=true", "benchmark.cold_start=false", "device=cpu"))
    assert {(r["refinement"], r["batch"]) for r in result["steps"]} == {(1, 1)}
    assert result["cold_start"] is None
    assert len(benchmark_sheets(json.loads(json.dumps(result)))) == 2


def test_a_page_holds_what_the_terminal_shows(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    small = ["benchmark.quick=true", "benchmark.cold_start=false", "benchmark.results=pages", "device=cpu"]
    monkeypatch.setattr(sys, "argv", ["warp-resphys", "benchmark", *TINY, *small])
    cli.main()
    said = capsys.readouterr().out
    (page,) = (folder / "pages").glob("*-benchmark-cpu.md")
    text = page.read_text()
    (result,) = (read_json(path) for path in folder.glob("outputs/benchmark/benchmark.json"))
    for row in result["steps"]:
        cells = [f"{row['forward_ms']:.2f}", f"{row['backward_ms']:.2f}"]
        assert any(all(cell in line for cell in (row["solver"], *cells)) for line in text.splitlines())
        assert all(cell in said for cell in cells)
    assert "warp-resphys benchmark" in text
    assert "| warp-lang |" in text


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_beam_hangs_under_the_weight(dtype: str) -> None:
    simulator = build_simulator(configuration("device=cpu", f"dtype={dtype}"))
    heavy, light = released(simulator, 0.1, 2), released(simulator, 0.0, 2)
    sag = (heavy.q - light.q)[:, :, 2].min(1).values
    assert float(sag[0]) < 1.3 * float(sag[1]) < 0.0
    assert math.isclose(float(heavy.v.abs().max()), 0.0)


def test_a_mesh_from_a_file_cannot_be_refined() -> None:
    with pytest.raises(InputError, match="choose mesh=beam_hexahedra"):
        run_benchmark({**configuration(), "mesh": {"kind": "file", "path": "arm.vtk"}})


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("benchmark.batches.cpu=[0]", r"benchmark.batches.cpu is \[0\]: it must be a list of whole numbers"),
        ("benchmark.steps={1: 2.5}", "benchmark.steps is .*: it must be whole numbers by refinement"),
        ("benchmark.projective_dynamics.steps=2.5", "benchmark.projective_dynamics.steps is 2.5: it must be a whole"),
        ("benchmark.repeats=0", "benchmark.repeats is 0: it must be a whole number"),
        ("benchmark.solvers=[]", r"benchmark.solvers is \[\]"),
        ("benchmark.tip_mass=heavy", "benchmark.tip_mass is 'heavy': it must be a number, zero or more"),
        ("benchmark.materials=[{E: 1.0}]", "unknown key 'benchmark.materials.0.E'"),
        ("+benchmark.colour=red", "unknown key 'benchmark.colour'"),
        (
            "benchmark.batches.cpu=[300];benchmark.solvers=[newton]",
            "benchmark.largest_batch leave none of refinement 1",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused_first(overrides: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        run_benchmark(configuration("device=cpu", *overrides.split(";")))
