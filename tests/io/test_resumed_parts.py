"""Work in parts: interrupted, resumed, in memory and in other processes."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from warp_resphys.io.fan_out import Workers
from warp_resphys.io.parts import Parts, TrialPart, cut, padded

NAMES, FRAMES = ["2", "3", "5"], 6


def growing(names, kept, report):
    """Powers of a number of every trial; interrupted at a frame of a part."""
    numbers = np.array([float(name) for name in names])
    powers = [np.ones_like(numbers)]
    for frame in range(1, FRAMES):
        if (names, frame) == kept.get("fails_at"):
            raise KeyboardInterrupt
        kept["computed"].append((names, frame))
        powers.append(powers[-1] * numbers)
        report(frame=frame)
    return {"power": (np.stack(powers, 1), "m"), "number": (numbers, "m")}


def parts_of(kept):
    return [
        TrialPart(f"part_{first}", names, FRAMES, partial(growing, names, kept))
        for first, names in cut(NAMES, 2)
    ]


@pytest.mark.parametrize("settings", ["same", "other"])
def test_interrupted_work_keeps_its_finished_parts(tmp_path, settings):
    kept = {"computed": [], "fails_at": (("5",), 4)}
    work, folder = parts_of(kept), tmp_path / "parts"
    assert [part.names for part in work] == [("2", "3"), ("5",)]
    with pytest.raises(KeyboardInterrupt):
        Parts("powers", folder=folder, fingerprint="same").run(work)
    assert [path.name for path in folder.iterdir()] == ["part_0.h5"]
    del kept["fails_at"]
    kept["computed"].clear()
    parts = Parts("powers", folder=folder, fingerprint=settings)
    parts.run(work)
    assert len(kept["computed"]) == (5 if settings == "same" else 10)
    np.testing.assert_array_equal(
        parts.joined(work, "power"), [[n**k for k in range(FRAMES)] for n in (2, 3, 5)]
    )
    assert parts.read(work[0], "number").tolist() == [2.0, 3.0]
    parts.remove()
    assert not folder.exists()


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_without_a_folder_the_arrays_stay_in_memory(count):
    work, parts = parts_of({"computed": []}), Parts("powers", Workers(count))
    parts.run(work)
    np.testing.assert_array_equal(
        parts.joined(work, "power"), [[n**k for k in range(FRAMES)] for n in (2, 3, 5)]
    )
    assert parts.joined(work, "power", 8).shape == (3, 8)
    other = [
        replace(part, work=partial(growing, ["7"] * len(part.names), {"computed": []}))
        for part in work
    ]
    parts.run(other)  # other work with the same labels
    assert [parts.read(part, "number").tolist() for part in (*other, *work)] == [
        [7.0] * 2,
        [7.0],
        [2.0, 3.0],
        [5.0],
    ]


def test_shorter_trials_end_with_nan():
    joined = padded([np.ones((1, 2, 3)), np.ones((2, 4, 3))], 3)
    assert joined.shape == (3, 4, 3)
    np.testing.assert_array_equal(
        np.isnan(joined[..., 0]), [[False] * 2 + [True] * 2, [False] * 4, [False] * 4]
    )
    assert padded([np.ones((1, 2), int)]).dtype == int
