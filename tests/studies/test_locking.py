"""The study of locking: extrapolation, choice, and a small study from end to end."""

import csv

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from warp_resphys.io.errors import InputError
from warp_resphys.io.files import read_json
from warp_resphys.mesh.arm import mesh_arm
from warp_resphys.mesh.arm_geometry import ArmGeometry
from warp_resphys.studies import locking as report
from warp_resphys.studies.locking import (
    BIQUADRATIC,
    HEXAHEDRA,
    LINEAR,
    QUADRATIC,
    SERENDIPITY,
    cases,
    cheapest,
    converged,
    measure,
)

SMALL = (
    "study.hexahedra=[[0.01,0.06,true],[0.005,0.03,false]]",
    "study.hexahedra_20=[]",
    "study.hexahedra_27=[]",
    "study.linear_tetrahedra=[]",
    "study.quadratic_tetrahedra=[]",
    "study.steps=2",
    "study.repeats=1",
)


def configured(*overrides):
    with initialize_config_module("warp_resphys.conf", version_base="1.3"):
        return OmegaConf.to_container(compose("benchmark_locking", list(overrides)), resolve=True)


def row(size, layers, value, element=HEXAHEDRA, vertices=None):
    vertices = round(1e-3 / size**3) if vertices is None else vertices
    return {"element": element, "size": size, "layers": layers, "vertices": vertices, "fibres_mm": value}


def test_an_error_of_second_order_is_extrapolated_away():
    exact, sizes = -14.0, (0.009, 0.006, 0.003)
    rows = [row(h, 2.0 * h, exact * (1.0 - 300.0 * h**2)) for h in sizes]
    rows += [row(0.003, 0.02, -9.0), row(0.001, 0.001, -8.0), row(0.002, None, -13.9, QUADRATIC, 10**6)]
    limit = converged(rows, "fibres")
    assert limit["mm"] == pytest.approx(exact, rel=1e-12)
    assert limit["finest_mm"] == rows[2]["fibres_mm"]
    assert limit["other_mm"] == -13.9
    assert converged(rows[2:], "fibres") is None


def test_the_cheapest_mesh_is_good_under_both_loads():
    def made(name, step, gravity, fibres, size=0.01):
        return {
            "name": name,
            "step_ms": step,
            "gravity_deviation": gravity,
            "fibres_deviation": fibres,
            "pressure_deviation": 3.0,
            "size": size,
        }

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
    study = configured()["study"] | {"steps": 2, "repeats": 1}
    result = measure(mesh_arm(ArmGeometry(), 0.01, layers=0.06)[0], study)
    assert result["chamber_cm3"] == pytest.approx(26.3, abs=0.05)
    assert result["gravity_mm"] > 20.0  # base tilted: gravity pulls towards +x
    assert -16.0 < result["fibres_mm"] < 0.9 * result["pressure_mm"] < 0.0  # chamber 1 lies towards +x and bends away
    opposite = measure(mesh_arm(ArmGeometry(), 0.01, layers=0.06)[0], study | {"tilt": -20.0}, timed=False)
    assert opposite["gravity_mm"] == pytest.approx(-result["gravity_mm"], rel=0.02)
    assert opposite["pressure_mm"] is opposite["step_ms"] is None
    assert result["step_ms"] > 0.0
    assert result["iterations"] >= 1.0


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("chamber", 7, "is 7, but the mesh has 6 closed chambers"),
        ("chamber", 0, "is 0: it must be a whole number, one or more"),
        ("steps", 2.5, "is 2.5: it must be a whole number, one or more"),
        ("repeats", 0, "is 0: it must be a whole number, one or more"),
    ],
)
def test_a_chamber_that_is_not_there_and_counts_that_are_none(key, value, message):
    study = configured()["study"] | {key: value}
    with pytest.raises(InputError, match=f"study.{key} {message}"):
        measure(mesh_arm(ArmGeometry(), 0.01, layers=0.06)[0], study)


def test_default_study_can_be_extrapolated_and_takes_a_file():
    known = list(cases(configured("study.file=own.vtk", "study.units=mm")["study"]))
    assert [case.element for case in known[:2]] == [LINEAR, QUADRATIC]
    assert {case.units for case in known if case.file} == {"mm"}
    assert len({case.name for case in known}) == len(known)
    rows = [
        {"element": c.element, "size": c.size, "layers": c.layers, "vertices": i, "fibres_mm": -1.0}
        for i, c in enumerate(known)
    ]
    assert converged(rows, "fibres")["mm"] == pytest.approx(-1.0)


def test_quadratic_hexahedra_are_nearer_to_the_converged_deflection_than_linear_ones():
    """31.63 mm under gravity, of docs/results/2026-11-20-arm-mesh.md."""
    study, geometry = configured()["study"], configured()["mesh"]
    keys = {SERENDIPITY: "hexahedra_20", BIQUADRATIC: "hexahedra_27", HEXAHEDRA: "hexahedra"}
    found = {}
    for element, key in keys.items():
        (case,) = (
            each
            for each in cases(study | {name: [] for name in keys.values()} | {key: [[0.01, 0.06, False]]})
            if each.element == element
        )
        mesh = case.mesh(geometry)
        assert mesh.cells.shape[1] == int(element.partition("-")[0])
        found[element] = measure(mesh, study, timed=False)["gravity_mm"]
    assert found[HEXAHEDRA] < 0.9 * 31.63
    assert found[SERENDIPITY] == pytest.approx(31.63, rel=0.03)
    assert found[BIQUADRATIC] == pytest.approx(31.63, rel=0.03)


def test_study_goes_on_where_it_was_interrupted(tmp_path, monkeypatch):
    config = configured(*SMALL)
    first, real = [], measure

    def interrupted(mesh, study, timed):
        if first:
            raise KeyboardInterrupt
        first.append(len(mesh.vertices))
        return real(mesh, study, timed)

    monkeypatch.setattr(report, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        report.run_study(config, tmp_path)
    second = []

    def counted(mesh, study, timed):
        second.append(len(mesh.vertices))
        return real(mesh, study, timed)

    monkeypatch.setattr(report, "measure", counted)
    _, text = report.run_study(config, tmp_path)
    assert len(second) == 1
    assert second[0] > first[0]
    result = read_json(tmp_path / "study.json")
    deviations = np.array([row["fibres_deviation"] for row in result["rows"]])
    assert np.all(deviations < 0.0)
    assert deviations[0] == pytest.approx(4.0 * deviations[1], rel=1e-9)  # as the extrapolation has it
    assert "No mesh whose steps were timed is within" in text
    with open(tmp_path / "study.csv") as file:
        assert [int(each["vertices"]) for each in csv.DictReader(file)] == [*first, *second]
    assert (tmp_path / "study.png").stat().st_size > 10_000

    report.run_study(config, tmp_path)
    assert len(second) == 1
    config["study"]["pressure"] = 5e3
    report.run_study(config, tmp_path)
    assert len(second) == 3
