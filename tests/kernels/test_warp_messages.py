"""Messages of Warp in a program that uses this package."""

import subprocess
import sys

import pytest
import warp as wp

from warp_resphys.kernels import QuietLogger

SCRIPT = """
from warp_resphys import Body, Corotated, Simulator, box_hexahedra, select_vertices

mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 1, 1))
simulator = Simulator(Body(mesh, fixed=select_vertices(mesh, x=0.0)), Corotated())
simulator.rollout(simulator.rest_state(), 2)
"""


@pytest.mark.slow
def test_a_script_whose_kernels_are_compiled_prints_nothing():
    for _ in range(2):
        run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert run.stdout == ""


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("Warp 1.19.0 initialized:\n   CUDA Toolkit 13.4", False),
        ("Module warp_resphys.kernels.elasticity d4f30f6 load on device 'cpu' took 0.26 ms  (cached)", False),
        ("Module warp_resphys.kernels.elasticity d4f30f6 load on device 'cpu' took 5120.26 ms  (compiled)", True),
        ("Module my_kernels d4f30f6 load on device 'cpu' took 0.26 ms  (cached)", True),
    ],
)
def test_compilation_and_other_modules_are_shown(message, shown, capsys, monkeypatch):
    QuietLogger().info(message)
    assert (message in capsys.readouterr().out) == shown
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_DEBUG)
    QuietLogger().info(message)
    assert message in capsys.readouterr().out
