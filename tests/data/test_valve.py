"""When a valve opens, frames that repeat the one before, and the published segment."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from warp_resphys import DataFileError, read_recording
from warp_resphys.data.recordings.processing import valve_opening
from warp_resphys.data.recordings.recording import Recording
from warp_resphys.data.recordings.segment import (
    CLAMP_LABELS,
    MARKERS,
    SEGMENT_LABELS,
    TIP_LABELS,
    convert_segment,
    mask_repeats,
    read_published_segment,
)

RATE = 100.0
DECAY = 4.0  # [1/s]
# Nominal positions [m]: four markers on the clamp, three at the tip, in the order of the labels.
SEGMENT_NOMINAL = np.array(
    [
        *((-0.0505, -0.0205, 0.002), (-0.0305, -0.0505, 0.002), (-0.0105, 0.0505, 0.002), (-0.0505, 0.0235, 0.002)),
        *((-0.0096, -0.0265, -0.1), (-0.0096, 0.0265, -0.1), (-0.0282, 0.0, -0.1)),
    ]
)


def swing(opening, amplitude=5e-3, frames=150, noise=5e-6, seed=0):
    """(T, 3) [m] a damped oscillator that a constant force acts on from an opening [s] on."""
    t = np.maximum(np.arange(frames) / RATE - opening, 0.0)
    turn = 2.0 * np.pi * 8.0
    way = amplitude * (1.0 - np.exp(-DECAY * t) * (np.cos(turn * t) + DECAY / turn * np.sin(turn * t)))
    still = np.random.default_rng(seed).normal(0.0, noise, (frames, 3))
    return way[:, None] * np.array([-0.8, 0.1, 0.6]) + still


def recorded(path, start=0.0):
    """Two markers that share a path, and one that stands."""
    here = np.stack([path, path + [0.02, 0.0, 0.0], 0.0 * path + [0.0, 0.0, 0.1]], axis=1)
    return Recording(("a", "b", "base"), here, RATE, Path("swing.h5"), start=start)


@pytest.mark.parametrize(("opening", "amplitude"), [(0.07, 1e-3), (0.0725, 30e-3), (0.2, 1e-3)])
def test_the_opening_is_found_between_frames(opening, amplitude):
    result = valve_opening(recorded(swing(opening, amplitude)), ("a", "b"))
    assert result == pytest.approx(opening, abs=3e-3)


@pytest.mark.parametrize(
    ("path", "followed", "message"),
    [
        (swing(0.07), ("base",), "never move by more than 0.00 mm"),
        (swing(0.01), ("a",), "move from the first frame on"),
        (swing(0.07) * np.nan, ("a",), "are seen together in 0 frames"),
        (swing(0.07), ("tip",), "no marker named 'tip'"),
    ],
)
def test_recordings_without_an_opening_are_refused(path, followed, message):
    with pytest.raises(DataFileError, match=message) as refused:
        valve_opening(recorded(path), followed)
    assert "swing.h5" in str(refused.value)


def test_repeated_frames_are_masked():
    recording = recorded(swing(0.07))
    positions = recording.positions.copy()
    positions[4:6] = positions[3]
    positions[7, 0] = positions[6, 0]  # one marker alone is a coincidence, or held by someone
    positions[9:11, 1] = np.nan
    positions[10] = positions[9]
    masked = mask_repeats(dataclasses.replace(recording, positions=positions))
    assert np.flatnonzero(~masked.seen[:, 2]).tolist() == [4, 5, 10]
    assert np.flatnonzero(~masked.seen[:, 1]).tolist() == [4, 5, 9, 10]
    np.testing.assert_array_equal(masked.positions[7, 0], positions[6, 0])


@pytest.fixture
def published(tmp_path):
    """Two trials in the layout that was published; which marker is which shows in the first frame."""
    rest = np.empty((7, 3))
    rest[list(MARKERS)] = SEGMENT_NOMINAL
    moved = np.isin(np.arange(7), [MARKERS[SEGMENT_LABELS.index(name)] for name in TIP_LABELS])
    trials = [rest + moved[:, None] * swing(*own)[:, None] for own in ((0.0725, 2e-3), (0.12, 9e-3))]
    noisy = np.stack(trials) + np.random.default_rng(1).normal(0.0, 5e-6, (2, 150, 7, 3))
    noisy[0, 40] = noisy[0, 39]
    arrays = {"pressure_mbar": np.array([50.0, 325.0]), "markers": noisy, "rate_hz": np.array(RATE)}
    np.savez(tmp_path / "steps.npz", **arrays)
    return tmp_path / "steps.npz", arrays


def test_the_segment_is_converted(published, tmp_path):
    convert_segment(published[0], tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["segment_050.h5", "segment_325.h5"]
    first = read_recording(tmp_path / "out" / "segment_050.h5")
    assert first.labels == SEGMENT_LABELS
    assert first.start == pytest.approx(-0.0725, abs=2.5e-3)
    np.testing.assert_allclose(first.rest, SEGMENT_NOMINAL, atol=3e-5)
    assert first.actuation is not None
    np.testing.assert_array_equal(first.actuation[:, 0], np.where(first.time >= 0.0, 5000.0, 0.0))
    assert np.flatnonzero(~first.seen.any(axis=1)).tolist() == [40]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"markers": None}, "'markers'"),
        ({"markers": np.zeros((2, 150, 6, 3))}, "must have the shapes"),
        ({"pressure_mbar": np.array([50.0, 50.2])}, "two trials have the same pressure"),
        ({"rate_hz": np.array("200")}, "'rate_hz' does not hold numbers"),
        ({"markers": np.tile(SEGMENT_NOMINAL[np.argsort(MARKERS)], (2, 150, 1, 1))}, "seen together in 1 frames"),
    ],
)
def test_another_layout_is_refused(published, change, message):
    path, arrays = published
    np.savez(path, **{name: array for name, array in {**arrays, **change}.items() if array is not None})
    with pytest.raises(DataFileError, match=message) as refused:
        read_published_segment(path)
    assert str(path) in str(refused.value)


def test_the_measured_segment(shared_data):
    """The tip goes towards -x and up, the further the higher the pressure; the clamp stands."""
    trials = read_published_segment(shared_data / "segment_mocap" / "pressure_steps.npz")
    assert list(trials) == [50, 100, 125, 175, 200, 250, 275, 325, 350, 400]
    ends = []
    for mbar, trial in trials.items():
        assert 0.04 < -trial.start < 0.2
        assert 23 <= int((~trial.seen.any(axis=1)).sum()) <= 38
        tip = trial.select(TIP_LABELS)
        opened = np.flatnonzero(trial.time >= 0.0)[0]
        early = np.nanmax(np.linalg.norm(tip.positions[:opened] - tip.rest, axis=2))
        assert early < 2e-4
        ends.append(float(np.linalg.norm(np.nanmedian(tip.positions[-20:], axis=0).mean(0) - tip.rest.mean(0))))
        clamp = trial.select(CLAMP_LABELS)
        assert np.nanmax(np.linalg.norm(clamp.positions - clamp.rest, axis=2)) < 3e-4, mbar
    assert ends == sorted(ends)
    assert ends[0] == pytest.approx(1.0e-3, rel=0.1)
    assert ends[-1] == pytest.approx(33.0e-3, rel=0.02)
