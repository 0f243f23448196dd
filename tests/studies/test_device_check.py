"""The check of a device, small, on the CPU."""

import sys

import pytest
import torch

from warp_resphys import cli
from warp_resphys.studies import device_check

SMALL = ("check.experiments=[]", "check.steps=1", "benchmark.quick=true", "hydra.run.dir=check")


def run(monkeypatch, capsys, *arguments):
    """Exit code, and what was printed."""
    monkeypatch.setattr(sys, "argv", ["warp-resphys", "verify", "device", *arguments])
    try:
        cli.main()
    except SystemExit as end:
        return end.code, "".join(capsys.readouterr())
    return 0, "".join(capsys.readouterr())


@pytest.mark.numerics
def test_the_cpu_passes(folder, monkeypatch, capsys):
    code, said = run(monkeypatch, capsys, *SMALL, "check.results=pages")
    assert code == 0, said
    assert "FAILED" not in said
    for solver in ("projective_dynamics", "newton", "quasi_newton, tiled, float64", "quasi_newton, auto, float32"):
        assert f"10-node tetrahedra, nu 0.499, {solver}" in said
    (page,) = (folder / "pages").glob("*-check-cpu.md")
    text = page.read_text()
    assert "all passed" in text
    assert "Robots' steps/s" in text
    assert (folder / "check" / "check.html").is_file()


def test_a_device_that_computes_something_else_fails(folder, monkeypatch, capsys):
    sections = {name: work for name, work in device_check._SECTIONS.items() if name.startswith("Trajectories")}
    monkeypatch.setattr(device_check, "_SECTIONS", sections)
    departure = device_check._departure
    monkeypatch.setattr(
        device_check,
        "_departure",
        lambda mesh, ratio, solver, linear, dtype, device, reference: departure(
            mesh, ratio, solver, linear, dtype, device, reference + 1e-7 * (dtype == torch.float64)
        ),
    )
    code, said = run(monkeypatch, capsys, *SMALL)
    assert code == 1
    lines = [line for line in said.splitlines() if "float" in line and "nu 0.45" in line]
    assert lines
    assert all(("FAILED" in line) == ("float64" in line) for line in lines)
    assert "checks on" in (folder / "check" / "check.html").read_text()


def test_an_experiment_that_fails_is_a_failed_check(folder, monkeypatch, capsys):
    monkeypatch.setattr(device_check, "_SECTIONS", {})
    small = ("check.experiments=[beam_oscillation]", "check.overrides=['trainer.epochs=0']", *SMALL[1:])
    code, said = run(monkeypatch, capsys, *small)
    assert code == 1
    assert "trainer.epochs is 0" in said


def test_a_device_that_is_not_there(folder, monkeypatch, capsys):
    code, said = run(monkeypatch, capsys, "device=tpu")
    assert (code, said) == (2, "error: device is 'tpu': choose auto, cpu or cuda.\n")
