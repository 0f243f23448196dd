"""The benchmark of steps."""

import math

import pytest
import torch

from support.command_line import outcome, settings_of
from warp_resphys.experiment.build import build_simulator
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_json
from warp_resphys.studies.benchmark import PARTS, BenchmarkRun, benchmark_cases, released, run_benchmark

TINY = [
    "mesh.divisions=[2,1,1]",
    "benchmark.refinements=[1,2]",
    "benchmark.batches.cpu=[1,2]",
    "benchmark.batches.cuda=[1,2]",
    "benchmark.contact.batches={cpu: [1, 2, 900], cuda: [1, 2, 900]}",
    "benchmark.steps={1: 2, 2: 1}",
    "benchmark.projective_dynamics.steps=1",
    "benchmark.repeats=2",
    "benchmark.parts_repeats=2",
]


def test_every_case_is_measured_and_stands_on_the_page(folder, device):
    ended = outcome("benchmark", *TINY, f"device={device}", "benchmark.results=pages")
    assert ended.code == 0, ended.err
    result = read_json(folder / "outputs/benchmark/benchmark.json")
    touching = [row for row in result["steps"] if row["contact"]]
    cases = [(row["solver"], row["poissons_ratio"], row["refinement"], row["batch"]) for row in touching]
    assert cases == [("quasi_newton", 0.45, r, b) for r in (1, 2) for b in (1, 2)]
    elastic = [row for row in result["steps"] if row["model"] == "corotated" and row not in touching]
    cases = [(r["solver"], r["poissons_ratio"], r["refinement"], r["batch"]) for r in elastic]
    laws = [(r["model"], r["refinement"], r["batch"]) for r in result["steps"] if r not in elastic + touching]
    assert sorted(laws) == [("law", r, 1) for r in (1, 2)]
    grid = [(s, nu, r, b) for s in ("quasi_newton", "newton") for nu in (0.45, 0.499) for r in (1, 2) for b in (1, 2)]
    assert sorted(cases) == sorted([*grid, *(("projective_dynamics", nu, 1, 1) for nu in (0.45, 0.499))])
    (page,) = (folder / "pages").glob(f"*-benchmark-{device}.md")
    text = page.read_text()
    for row in result["steps"]:
        assert row["iterations"] >= 1.0
        assert row["repeats"] == 2
        assert row["unknowns"] == {1: 24, 2: 108}[row["refinement"]]
        assert row["steps"] == (1 if row["solver"] == "projective_dynamics" or row["refinement"] == 2 else 2)
        assert 0.0 < row["fastest_forward_ms"] <= row["forward_ms"]
        assert 0.0 < row["fastest_backward_ms"] <= row["backward_ms"]
        assert row["solver"] != "newton" or row["factorisations"] >= row["iterations"]
        times = [f"{row[name]:.2f}" for name in ("plain_ms", "forward_ms", "backward_ms")]
        for shown in (text, ended.out):
            assert any(all(cell in line for cell in (row["solver"], *times)) for line in shown.splitlines())
    assert [(p["refinement"], p["batch"]) for p in result["parts"]] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert all(p[f"{name}_ms"] > 0.0 for p in result["parts"] for name in PARTS)
    cold, warm = (result["cold_start"][kind] for kind in ("cold", "warm"))
    assert all(seconds > 0.0 for seconds in (*cold.values(), *warm.values()))
    assert cold["kernels_s"] > warm["kernels_s"]
    assert result["yardstick_ms"] > 0.0
    assert "| warp-lang |" in text


def test_quick_measures_the_coarsest_mesh_alone():
    quick = ("benchmark.quick=true", "benchmark.cold_start=false", "device=cpu")
    result = run_benchmark(settings_of(BenchmarkRun, "benchmark", *TINY, *quick))
    assert {(r["refinement"], r["batch"]) for r in result["steps"]} == {(1, 1)}
    assert [row["contact"] for row in result["steps"]].count(True) == 1
    assert result["cold_start"] is None


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_beam_hangs_under_the_weight(dtype):
    settings = settings_of(BenchmarkRun, "benchmark", *TINY, "device=cpu", f"dtype={dtype}")
    simulator = build_simulator(settings, settings.simulation)
    heavy, light = released(simulator, 0.1, 2), released(simulator, 0.0, 2)
    sag = (heavy.q - light.q)[:, :, 2].min(1).values
    assert float(sag[0]) < 1.3 * float(sag[1]) < 0.0
    assert math.isclose(float(heavy.v.abs().max()), 0.0)


def test_the_beam_falls_on_the_floor():
    settings = settings_of(BenchmarkRun, "benchmark", *TINY, "device=cpu").benchmark.contact
    cases = benchmark_cases(settings_of(BenchmarkRun, "benchmark", *TINY, "device=cpu", "benchmark.steps={1: 40}"), 1)
    assert settings is not None
    (floor,) = settings.obstacles.values()
    height, gap = floor.position[2], settings.contact.distance
    lowest = []
    for case in cases[-2:]:
        with torch.no_grad():
            trajectory = case.timed.simulator.rollout(case.timed.start, case.timed.steps)
        lowest.append(trajectory.q[..., 2].flatten(1).amin(1) - height)
    for z in lowest:
        assert float(z[0]) > gap > float(z.min()) > 0.0
    # Without contact: no rows, nor obstacles.
    none = settings_of(BenchmarkRun, "benchmark", *TINY, "device=cpu", "benchmark.contact=null")
    assert not any(case.touches for case in benchmark_cases(none, 1))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("benchmark.batches.cpu=[0]", "benchmark.batches.cpu"),
        ("benchmark.steps={1: 2.5}", "benchmark.steps"),
        ("benchmark.projective_dynamics.steps=2.5", "benchmark.projective_dynamics.steps"),
        ("benchmark.solvers=[]", "benchmark.solvers"),
        ("benchmark.materials=[{E: 1.0}]", "benchmark.materials.*E"),
        ("+benchmark.colour=red", "benchmark.colour"),
        ("benchmark.batches.cpu=[300];benchmark.solvers=[newton]", "leave none of refinement 1"),
        ("+mesh.path=arm.vtk;~mesh.divisions", "mesh.path"),
    ],
)
def test_what_cannot_be_measured_is_refused_first(overrides, message):
    with pytest.raises(InputError, match=message):
        run_benchmark(settings_of(BenchmarkRun, "benchmark", *TINY, "device=cpu", *overrides.split(";")))
