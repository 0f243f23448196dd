"""The check of a device, small, on the CPU."""

import pytest
import torch

from support.command_line import outcome, refusal, settings_of
from warp_resphys.io.errors import InputError
from warp_resphys.studies import device_check
from warp_resphys.studies.beam import beam_mesh
from warp_resphys.studies.device_check import (
    DeviceCheck,
    beam_between_obstacles,
    bounded,
    contact_checks,
    experiment_checks,
    pushed,
    trajectory_checks,
)
from warp_resphys.studies.gradient_check import GradientRow

COARSE = {(10, 3, 3): (4, 2, 2), (5, 2, 2): (2, 1, 1)}  # divisions of beams without contact


@pytest.fixture
def coarse(monkeypatch):
    """Beams without contact of few cells."""
    monkeypatch.setattr(
        device_check, "beam_mesh", lambda kind, size, counts: beam_mesh(kind, size, COARSE.get(counts, counts))
    )


@pytest.mark.numerics
@pytest.mark.usefixtures("coarse")
def test_the_cpu_passes(folder):
    small = ("check.experiments=[]", "check.steps=1", "hydra.run.dir=check")
    ended = outcome("verify", "device", *small, "check.results=pages")
    assert ended.code == 0, ended.out
    assert "FAILED" not in ended.out
    for solver in ("projective_dynamics", "newton", "quasi_newton, tiled, float64", "quasi_newton, auto, float32"):
        assert f"10-node tetrahedra, nu 0.499, {solver}" in ended.out
    assert "positions, quasi_newton, tiled, float64" in ended.out
    (page,) = (folder / "pages").glob("*-check-cpu.md")
    text = page.read_text()
    assert "all passed" in text
    assert (folder / "check" / "check.html").is_file()


@pytest.mark.usefixtures("coarse")
def test_a_solver_beyond_its_bound_fails():
    bounds = {torch.float64: 0.0, torch.float32: 1e-5}
    checks = list(trajectory_checks(torch.device("cpu"), 1, bounds))
    assert {check.name.rpartition(", ")[2]: check.passed for check in checks} == {"float64": False, "float32": True}


def test_contact_or_gradients_beyond_their_bound_fail(monkeypatch):
    wrong = [GradientRow("q", 1.0, 1.0 + 1e-5)]
    monkeypatch.setattr(device_check, "check_gradients", lambda *_, **__: wrong)
    checks = list(contact_checks(torch.device("cpu"), 1, {torch.float64: 0.0, torch.float32: 1e-5}))
    passed = {check.name.rpartition(", ")[2]: check.passed for check in checks}
    assert passed == {"float64": False, "float32": True, "gradients": False, "gradients of two beams": False}


def test_a_beam_between_obstacles_slides_on_all_of_them():
    simulator = beam_between_obstacles(moves=False)
    start = simulator.rest_state()
    before, _ = simulator.step(start)
    after, _ = simulator.step(before)
    forces = simulator.contacts(before, after)[""]
    assert bool((forces.normal.norm(dim=-1).sum(1) > 0.0).all())
    assert bool((forces.friction.norm(dim=-1).sum(1) > 1e-3 * forces.normal.norm(dim=-1).sum(1)).all())


def test_plates_push_beams_by_different_ways():
    moved = pushed(beam_between_obstacles(moves=True), 5)
    still = pushed(beam_between_obstacles(moves=True), 1)[-1]
    lifts = (moved[-1] - still)[..., 2].amax(1)
    assert 1e-5 < float(lifts[0]) < 0.9 * float(lifts[1])


def test_an_error_in_the_place_of_a_figure_fails():
    def raises() -> float:
        raise InputError("no equilibrium")

    assert bounded("step", raises, 1.0)[1:] == ("no equilibrium", "no error", False)
    assert bounded("step", lambda: 2e-3, 1e-3, "m")[1:] == ("2.0e-03 m", "1e-03 m", False)


@pytest.mark.parametrize("key", ["check.overrides", "check.smaller.beam_oscillation"])
def test_an_experiment_that_fails_is_a_failed_check(key, folder):
    overrides = ("check.experiments=[beam_oscillation]", f"{key}=['trainer.epochs=0']")
    settings = settings_of(DeviceCheck, "verify_device", *overrides)
    (check,) = experiment_checks(settings.check, "cpu", folder)
    assert not check.passed
    assert "trainer.epochs is 0" in check.result


def test_a_device_that_is_not_there(folder):
    assert refusal("verify", "device", "device=tpu") == "error: device is 'tpu': choose auto, cpu or cuda.\n"
