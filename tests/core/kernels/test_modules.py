"""Settings of Warp modules, and messages of Warp in a program that uses this package."""

import subprocess
import sys

import pytest
import torch
import warp as wp

from support.clamped import clamped
from warp_resphys import Corotated, Simulator, StableNeoHookean, box_hexahedra, box_tetrahedra
from warp_resphys.core.dynamics import workspace
from warp_resphys.core.energies.launcher import Launcher
from warp_resphys.kernels import QuietLogger
from warp_resphys.kernels.modules import launch_stream, named_module, shareable


def test_generated_modules_have_no_adjoints_and_are_made_once():
    module = named_module("tests.adjoints")
    assert not module.options["enable_backward"]
    assert named_module("tests.adjoints") is module


def test_warps_setting_is_restored_also_after_an_error():
    before = wp.config.enable_tiles_in_stack_memory
    inside = []

    def load():
        with shareable():
            inside.append(wp.config.enable_tiles_in_stack_memory)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        load()
    assert inside == [False]
    assert wp.config.enable_tiles_in_stack_memory == before


def test_launches_are_on_the_stream_of_torch(device):
    stream = launch_stream(torch.device(device))
    if device == "cpu":
        assert stream is None
    else:
        assert stream.cuda_stream == torch.cuda.current_stream().cuda_stream


@pytest.mark.parametrize("law", [Corotated(1e5, 0.45), StableNeoHookean(1e5, 0.45)])
@pytest.mark.parametrize("box", [box_hexahedra, box_tetrahedra])
def test_a_solve_launches_the_modules_that_were_compiled_together(law, box, monkeypatch):
    together, recorded = set(), set()
    monkeypatch.setattr(
        workspace,
        "compile_together",
        lambda kernels, *_: together.update(k.module for k in kernels),
    )
    for name in ("record", "record_blocks"):
        before = getattr(Launcher, name)

        def note(own, kernel, *rest, _to=before):
            recorded.add(kernel.module)
            return _to(own, kernel, *rest)

        monkeypatch.setattr(Launcher, name, note)
    simulator = Simulator(clamped(box((0.1, 0.02, 0.02), (4, 1, 1))), law)
    simulator.step(simulator.rest_state())
    assert together == recorded


SCRIPT = """
from warp_resphys import Body, Corotated, Simulator, box_hexahedra, select_vertices

mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
simulator = Simulator(Body(mesh, fixed=select_vertices(mesh, x=0.0)), Corotated())
simulator.rollout(simulator.rest_state(), 2)
"""


@pytest.mark.slow
def test_a_script_whose_kernels_are_compiled_prints_nothing():
    for _ in range(2):
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
        )
    assert run.stdout == ""


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("Warp 1.19.0 initialized:\n   CUDA Toolkit 13.4", False),
        (
            "Module warp_resphys.kernels.elasticity d4f30f6 load "
            "on device 'cpu' took 0.26 ms  (cached)",
            False,
        ),
        (
            "Module warp_resphys.kernels.elasticity d4f30f6 load "
            "on device 'cpu' took 5120.26 ms  (compiled)",
            True,
        ),
        ("Module my_kernels d4f30f6 load on device 'cpu' took 0.26 ms  (cached)", True),
    ],
)
def test_compilation_and_other_modules_are_shown(message, shown, capsys, monkeypatch):
    QuietLogger().info(message)
    assert (message in capsys.readouterr().out) == shown
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_DEBUG)
    QuietLogger().info(message)
    assert message in capsys.readouterr().out
