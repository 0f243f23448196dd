"""Trials that are computed in parts: finished parts are kept, and parts are joined."""

import numpy as np
import pytest

from warp_resphys.experiment.parts import (
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


def growing(part, report):
    """Powers of a number of every trial; interrupted at a frame of a part."""
    numbers = np.array([float(name) for name in part.names])
    powers = [np.ones_like(numbers)]
    for frame in range(1, part.frames):
        if (part.names, frame) == part.more.get("fails_at"):
            raise KeyboardInterrupt
        part.more["computed"].append((part.names, frame))
        powers.append(powers[-1] * numbers)
        report(frame=frame)
    return {"power": (np.stack(powers, 1), "m"), "number": (numbers, "m")}


@pytest.mark.parametrize("settings", ["same", "other"])
def test_an_interrupted_stage_keeps_its_finished_parts(tmp_path, settings):
    kept, names = {"computed": [], "fails_at": (("5",), 4)}, ["2", "3", "5"]
    parts = split_into_parts(StageContext("powers", tmp_path, "same", None), names, 6, more=kept, batch=2)
    assert [part.names for part in parts] == [("2", "3"), ("5",)]
    with pytest.raises(KeyboardInterrupt):
        work_on(parts, growing, Workers(1))
    assert [part.done for part in parts] == [True, False]
    del kept["fails_at"]
    kept["computed"].clear()
    context = StageContext("powers", tmp_path, settings, None)
    parts = split_into_parts(context, names, 6, more=kept, batch=2)
    work_on(parts, growing, Workers(1))
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
