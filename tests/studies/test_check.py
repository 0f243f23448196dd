"""The check of a device, a part at a time, on the CPU; tests/validation runs all of it."""

import copy
import pickle

import pytest
import torch

from support.command_line import outcome, refusal
from warp_resphys.core.dynamics.gradient_check import GradientRow
from warp_resphys.io.errors import InputError
from warp_resphys.studies import check

CPU = torch.device("cpu")


@pytest.mark.numerics
def test_a_motion_passes_with_every_solver_and_fails_beyond_its_bound(monkeypatch):
    name = "quadratic tetrahedra"
    monkeypatch.setattr(check, "EVERY_SOLVER", (name,))
    done = list(check.motion_checks(name, CPU))
    assert all(own.passed for own in done), done
    names = [own.name for own in done]
    assert {
        f"{name}, quasi_newton, {linear}, float64"
        for linear in ("auto", "tiled", "dense", "sparse")
    } < {*names}
    assert {f"{name}, height on the CPU", f"{name}, the last one alone"} < {*names}
    monkeypatch.setitem(check.POSITION_BOUND, torch.float64, 0.0)
    wrong = [own.name for own in check.motion_checks(name, CPU) if not own.passed]
    assert wrong == [name for name in names if "float32" not in name]


def test_a_wrong_gradient_or_an_error_is_a_failed_check(monkeypatch):
    def fails() -> float:
        raise InputError("no equilibrium")

    assert check.bounded("step", fails, 1.0)[1:] == ("no equilibrium", "no error", False)
    assert check.bounded("step", lambda: 2e-3, 1e-3, "m")[1:] == ("2.0e-03 m", "1e-03 m", False)
    rows = [GradientRow("q", 1.0, 1.0), GradientRow("v", 1.0, 1.0 + 1e-5)]
    monkeypatch.setattr(check, "check_gradients", lambda *_, **__: rows)
    assert check.gradient_error("two beams", CPU) == pytest.approx(1e-5, rel=1e-3)


@pytest.mark.parametrize(("height", "code"), [(None, 0), (0.1, 1)])
def test_the_exit_code_says_whether_all_checks_passed(height, code, folder, monkeypatch):
    build, own = check.MOTIONS["quadratic tetrahedra"]
    monkeypatch.setattr(
        check, "MOTIONS", {"quadratic tetrahedra": (build, own if height is None else height)}
    )
    monkeypatch.setattr(
        check, "GRADIENTS", {"hexahedra at rest": check.GRADIENTS["hexahedra at rest"]}
    )
    monkeypatch.setattr(check, "_TIMED", (1,))
    ended = outcome("check", "cpu")
    assert ended.code == code, ended.err
    assert ("FAILED" in ended.out) == (code == 1)
    assert ("checks failed, in" if code else "checks passed, in") in ended.out
    for title in ("hexahedra at rest, gradients", "gradient of 1", "quasi_newton, auto, float32"):
        assert title in ended.out


def test_a_device_that_is_not_there(folder):
    assert refusal("check", "device=tpu") == "error: device is 'tpu': choose auto, cpu or cuda.\n"


@pytest.mark.parametrize("name", check.MOTIONS)
def test_copies_of_a_used_simulator_move_as_it_does(name, recwarn):
    """For every kind of energy; buffers, factors and Warp's arrays stay behind, and no warning is
    repeated.
    """
    sim = check.MOTIONS[name][0]()
    expected = check.positions(sim)
    copies = {"pickle": pickle.loads(pickle.dumps(sim)), "copy": copy.copy(sim)}
    copies["deepcopy"] = copy.deepcopy(sim)
    assert not recwarn
    for way, other in copies.items():
        torch.testing.assert_close(check.positions(other), expected, rtol=0.0, atol=1e-12, msg=way)
    assert copies["copy"].body is sim.body
    assert copies["deepcopy"].body is not sim.body
