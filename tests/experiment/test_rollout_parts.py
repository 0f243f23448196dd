"""Trials that are computed in parts: finished parts are kept, and parts are joined."""

import numpy as np
import pytest
import torch

from warp_resphys.experiment.parts import (
    PartRollout,
    padded,
    read_parts,
    remove_parts,
    split_into_parts,
    work_on,
    workers_for,
)
from warp_resphys.io.errors import InputError
from warp_resphys.io.fan_out import Workers
from warp_resphys.io.stages import StageContext
from warp_resphys.settings.run import ParallelSettings
from warp_resphys.stepping.state import State


class Growing(PartRollout):
    """Powers of a number of every trial, in its only coordinate; interrupted at a frame of a part."""

    def __init__(self, part):
        self.part, self.frames, self.units = part, part.frames, {"power": "m"}

    def begin(self):
        return State(torch.ones(len(self.part.names), 1, 1).double(), torch.zeros(len(self.part.names), 1, 1).double())

    def step(self, number):
        if (self.part.names, number) == self.part.more.get("fails_at"):
            raise KeyboardInterrupt
        self.part.more["computed"].append((self.part.names, number))
        growth = torch.tensor([float(name) for name in self.part.names]).double()
        return State(self.state.q * growth[:, None, None], self.state.v)

    def frame_arrays(self, number):
        return {"power": self.state.q.flatten().numpy()}

    def constants(self):
        return {"number": (np.array([float(name) for name in self.part.names]), "m")}


@pytest.mark.parametrize("settings", ["same", "other"])
def test_an_interrupted_stage_keeps_its_finished_parts(tmp_path, settings):
    kept, names = {"computed": [], "fails_at": (("5",), 4)}, ["2", "3", "5"]
    parts = split_into_parts(StageContext("powers", tmp_path, "same", None), names, 6, more=kept, batch=2)
    assert [part.names for part in parts] == [("2", "3"), ("5",)]
    with pytest.raises(KeyboardInterrupt):
        work_on(parts, Growing, Workers(1))
    assert [part.done for part in parts] == [True, False]
    del kept["fails_at"]
    kept["computed"].clear()
    context = StageContext("powers", tmp_path, settings, None)
    parts = split_into_parts(context, names, 6, more=kept, batch=2)
    work_on(parts, Growing, Workers(1))
    assert len(kept["computed"]) == (5 if settings == "same" else 10)
    np.testing.assert_array_equal(read_parts(parts, "power"), [[n**k for k in range(6)] for n in (2, 3, 5)])
    assert parts[0].read("number").tolist() == [2.0, 3.0]
    assert all(part.done for part in parts)
    remove_parts(context)
    assert not any(part.done for part in parts)


def test_shorter_trials_end_with_nan():
    joined = padded([np.ones((1, 2, 3)), np.ones((2, 4, 3))], 3)
    assert joined.shape == (3, 4, 3)
    np.testing.assert_array_equal(np.isnan(joined[..., 0]), [[False] * 2 + [True] * 2, [False] * 4, [False] * 4])
    assert padded([np.ones((1, 2), int)]).dtype == int


def test_workers_of_clusters_are_counted():
    assert workers_for(ParallelSettings(), 3, "cpu") == Workers(3, None)
    assert workers_for(ParallelSettings(), None, "cpu").count >= 1
    with pytest.raises(InputError, match="workers of the Dask cluster"):
        workers_for(ParallelSettings(address="tcp://head:8786"), None, "cpu")
