"""Settings of Warp modules."""

import pytest
import torch
import warp as wp

from support.clamped import clamped
from warp_resphys import Corotated, Simulator, StableNeoHookean, box_hexahedra, box_tetrahedra
from warp_resphys.dynamics import workspace
from warp_resphys.energies.launcher import Launcher
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
    monkeypatch.setattr(workspace, "compile_together", lambda kernels, *_: together.update(k.module for k in kernels))
    for name in ("record", "record_blocks"):
        before = getattr(Launcher, name)
        note = lambda own, kernel, *rest, _to=before: (recorded.add(kernel.module), _to(own, kernel, *rest))[1]  # noqa: E731
        monkeypatch.setattr(Launcher, name, note)
    simulator = Simulator(clamped(box((0.1, 0.02, 0.02), (4, 1, 1))), law)
    simulator.step(simulator.rest_state())
    assert together == recorded
