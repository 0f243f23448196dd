"""The study of locking: extrapolation, choice, and a small study from end to end."""

import csv

import numpy as np
import pytest

from support.command_line import outcome, settings_of
from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_json
from warp_resphys.mesh.arm import mesh_arm
from warp_resphys.mesh.arm_geometry import ArmGeometry
from warp_resphys.studies.locking import LockingCase, LockingRun, cases, cheapest, converged, measure


def study(*overrides):
    return settings_of(LockingRun, "benchmark_locking", *overrides).study


def row(size, layers, value, element="hexahedron8", vertices=None):
    vertices = round(1e-3 / size**3) if vertices is None else vertices
    return {"element": element, "size": size, "layers": layers, "vertices": vertices, "fibres_mm": value}


def test_an_error_of_second_order_is_extrapolated_away():
    exact, sizes = -14.0, (0.009, 0.006, 0.003)
    rows = [row(h, 2.0 * h, exact * (1.0 - 300.0 * h**2)) for h in sizes]
    rows += [row(0.003, 0.02, -9.0), row(0.001, 0.001, -8.0), row(0.002, None, -13.9, "tetrahedron10", 10**6)]
    limit = converged(rows, "fibres")
    assert limit["mm"] == pytest.approx(exact, rel=1e-12)
    assert limit["finest_mm"] == rows[2]["fibres_mm"]
    assert limit["other_mm"] == -13.9
    assert converged(rows[2:], "fibres") is None


def test_the_cheapest_mesh_is_good_under_both_loads():
    def made(name, step, gravity, fibres, size=0.01):
        deviations = {"gravity_deviation": gravity, "fibres_deviation": fibres, "pressure_deviation": 3.0}
        return {"name": name, "step_ms": step, "size": size, **deviations}

    rows = [
        made("stiff", 1.0, -0.3, -0.3),
        made("half", 2.0, -0.01, -0.06),
        made("good", 5.0, 0.02, -0.049),
        made("fine", 9.0, 0.0, 0.0),
        made("untimed", None, 0.0, 0.0),
        made("file", 1.0, 0.0, 0.0, size=None),
    ]
    assert cheapest(rows, 0.05)["name"] == "good"
    assert cheapest(rows[:2], 0.05) is None
    assert cheapest([{"name": "no limit", "step_ms": 1.0, "size": 0.01}], 0.05) is None


def test_deflections_have_their_directions_and_sizes():
    arm = mesh_arm(ArmGeometry(), 0.01, layers=0.06)[0]
    result = measure(arm, study("study.steps=2", "study.repeats=1"))
    assert result["chamber_cm3"] == pytest.approx(26.3, abs=0.05)
    assert result["gravity_mm"] > 20.0  # base tilted: gravity pulls towards +x
    assert -16.0 < result["fibres_mm"] < 0.9 * result["pressure_mm"] < 0.0  # chamber 1 lies towards +x and bends away
    opposite = measure(arm, study("study.tilt=-20"), timed=False)
    assert opposite["gravity_mm"] == pytest.approx(-result["gravity_mm"], rel=0.02)
    assert opposite["pressure_mm"] is opposite["step_ms"] is None
    assert result["step_ms"] > 0.0
    assert result["iterations"] >= 1.0


@pytest.mark.parametrize("override", ["chamber=7", "chamber=0", "steps=2.5", "repeats=0"])
def test_a_chamber_that_is_not_there_and_counts_that_are_none(override):
    key, _, value = override.partition("=")
    with pytest.raises(InputError, match=f"study.{key} is {value}"):
        measure(mesh_arm(ArmGeometry(), 0.01, layers=0.06)[0], study(f"study.{override}"))


def test_the_default_study_can_be_extrapolated_and_takes_a_file():
    chosen = cases(study("study.file=own.vtk", "study.units=mm"))
    assert [case.element for case in chosen[:2]] == ["tetrahedron4", "tetrahedron10"]
    assert {case.units for case in chosen if case.file} == {"mm"}
    assert len({case.name for case in chosen}) == len(chosen)
    rows = [row(case.size, case.layers, -1.0, case.element, number) for number, case in enumerate(chosen)]
    assert converged(rows, "fibres")["mm"] == pytest.approx(-1.0)


def test_quadratic_hexahedra_are_nearer_to_the_converged_deflection_than_linear_ones():
    """31.63 mm under gravity, of docs/results/elements.md#the-arm."""
    deflection = {}
    for nodes in (8, 20, 27):
        mesh = LockingCase(f"hexahedron{nodes}", 0.01, 0.06).mesh(settings_of(LockingRun, "benchmark_locking").mesh)
        assert mesh.cells.shape[1] == nodes
        deflection[nodes] = measure(mesh, study(), timed=False)["gravity_mm"]
    assert deflection[8] < 0.9 * 31.63
    assert deflection[20] == pytest.approx(31.63, rel=0.03)
    assert deflection[27] == pytest.approx(31.63, rel=0.03)


def test_a_mesh_with_the_same_settings_is_not_measured_again(folder):
    empty = [f"study.meshes.{element}=[]" for element in ("hexahedron20", "hexahedron27")]
    empty += [f"study.meshes.{element}=[]" for element in ("tetrahedron4", "tetrahedron10")]
    small = ["benchmark", "locking", *empty, "study.steps=2", "study.repeats=1", "hydra.run.dir=locking"]
    coarse, fine = "[0.01,0.06,true]", "[0.005,0.03,false]"
    assert "nothing was extrapolated" in outcome(*small, f"study.meshes.hexahedron8=[{coarse}]").out
    (first,) = read_json(folder / "locking/study.json")["rows"]

    both = [*small, f"study.meshes.hexahedron8=[{coarse},{fine}]"]
    said = outcome(*both).out.replace("\n", " ")
    assert "No mesh whose steps were timed is within" in said
    rows = read_json(folder / "locking/study.json")["rows"]
    assert rows[0]["step_ms"] == first["step_ms"]  # to the last digit, as a second measurement would not be
    deviations = np.array([row["fibres_deviation"] for row in rows])
    assert np.all(deviations < 0.0)
    assert deviations[0] == pytest.approx(4.0 * deviations[1], rel=1e-9)  # as the extrapolation has it
    with open(folder / "locking/study.csv") as file:
        assert [int(line["vertices"]) for line in csv.DictReader(file)] == [row["vertices"] for row in rows]
    assert (folder / "locking/study.png").stat().st_size > 10_000

    outcome(*both, "study.pressure=5e3")
    halved = read_json(folder / "locking/study.json")["rows"]
    assert all(0.3 < now["fibres_mm"] / before["fibres_mm"] < 0.7 for now, before in zip(halved, rows, strict=True))
