"""Settings of Warp modules."""

import pytest
import torch
import warp as wp

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
