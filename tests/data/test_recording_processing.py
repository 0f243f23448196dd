"""Gaps, rates, releases, jumps and quality of recordings; when a valve opens.

And the published segment.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys import read_recording
from warp_resphys.data.recordings import marker_quality, processing, segment
from warp_resphys.data.recordings.marker_quality import compare_base, find_jumps, find_swaps
from warp_resphys.data.recordings.processing import Release, fill_gaps, find_release, release_of
from warp_resphys.data.recordings.recording import Recording
from warp_resphys.io.errors import DataFileError, InputError

NOISE = 5e-6
RELEASE = 60.4
TIP = ("tip 1", "tip 2")
BASE = ("base 1", "base 2", "base 3")
PLACES = np.array(
    [[0.1, 0.0, 0.02], [0.1, 0.02, 0.0], [0.0, 0.0, 0.0], [0.0, 0.04, 0.0], [0.0, 0.0, 0.03]]
)


def swinging(frames=300, rate=100.0, noise=NOISE, shift=0.0):
    """A beam that is held and let go in frame 60.4:
    two markers swing by 10 mm at 7.7 Hz, three stand on the clamp.
    """
    time = np.maximum(np.arange(frames) - RELEASE, 0.0) / rate
    sag = -0.01 * (1.0 - np.exp(-2.5 * time) * np.cos(48.0 * time))
    positions = np.tile(PLACES + shift, (frames, 1, 1))
    positions[:, :2, 2] += sag[:, None] * [1.0, 0.9]
    positions += np.random.default_rng(1).normal(scale=noise, size=positions.shape)
    return Recording(TIP + BASE, positions, rate, Path("swing.c3d"))


def test_masked_gaps_stay_and_short_ones_are_filled():
    recording = swinging()
    true = recording.positions.copy()
    recording.positions[100:103, 0] = np.nan
    recording.positions[150:170, 1] = np.nan
    recording.positions[:4, 2] = np.nan
    filled = fill_gaps(recording, 5)
    np.testing.assert_allclose(filled.positions[100:103, 0], true[100:103, 0], atol=2e-4)
    assert filled.seen[:, 0].all()
    np.testing.assert_array_equal(np.flatnonzero(~filled.seen[:, 1]), np.arange(150, 170))
    np.testing.assert_array_equal(np.flatnonzero(~filled.seen[:, 2]), np.arange(4))
    np.testing.assert_array_equal(
        filled.positions[recording.seen], recording.positions[recording.seen]
    )
    recording.positions[:, 3] = np.nan
    refuses(
        DataFileError,
        r"swing\.c3d: marker base 2 is seen in 0 of 300 frames",
        fill_gaps,
        recording,
        5,
    )


def test_a_multiple_of_the_rate_is_thinned_exactly():
    recording = dataclasses.replace(swinging(), actuation=np.arange(300.0)[:, None])
    thinned = processing.resample(recording, 50.0)
    np.testing.assert_array_equal(thinned.actuation[:, 0], np.arange(0.0, 300.0, 2.0))
    np.testing.assert_array_equal(thinned.positions, recording.positions[::2])
    assert thinned.rate == 50.0
    np.testing.assert_array_equal(
        processing.resample(recording, 100.0).positions, recording.positions
    )
    np.testing.assert_array_equal(
        processing.resample(recording, 1.0 / 0.03).positions, recording.positions[::3]
    )


@pytest.mark.parametrize("rate", [60.0, 130.0])
def test_interpolation_follows_a_swing(rate):
    """Far from the ends, to (2 pi f h)^4 / 384 of the amplitude: the error of a cubic spline."""
    omega, frames = 2.0 * np.pi * 7.7, np.arange(301)
    path = 0.01 * np.sin(omega * frames / 100.0)
    positions = np.stack([path, path**2, 0.0 * path], axis=1)[:, None] * [1.0, 100.0, 1.0]
    recording = Recording(
        ("a",), positions, 100.0, Path("swing.c3d"), actuation=path[:, None], start=0.004
    )
    new = processing.resample(recording, rate)
    assert len(new.positions) == int(3.0 * rate) + 1
    assert new.start == 0.004
    inside = slice(20, len(new.positions) - 20)
    true = 0.01 * np.sin(omega * (new.time - 0.004))
    bound = 0.01 * (omega / 100.0) ** 4 / 384.0
    error = np.abs(new.positions[inside, 0, 0] - true[inside]).max()
    assert error < 1.1 * bound
    assert bound < 2e-6
    np.testing.assert_allclose(new.actuation[:, 0], true, atol=0.01 * (omega / 100.0) ** 2 / 8.0)


def test_trimming_keeps_the_time_from_the_release():
    recording = swinging()
    release = release_of(recording, TIP, 5)
    assert release.frame == pytest.approx(RELEASE, abs=0.25)
    swing = processing.trim_to_release(recording, Release(RELEASE, release.rest), seconds=1.0)
    assert swing.start == pytest.approx(0.006)
    np.testing.assert_array_equal(swing.positions, recording.positions[61:161])
    assert swing.time[-1] == pytest.approx(0.996)
    with pytest.raises(DataFileError, match=r"swing\.c3d ends 1 frames after its release"):
        processing.trim_to_release(recording, Release(298.5, (200, 290)))


def test_the_release_is_found_from_the_markers_that_are_seen():
    recording = swinging()
    recording.positions[58:90, 0] = np.nan
    assert release_of(recording, TIP, 5).frame == pytest.approx(RELEASE, abs=0.25)
    recording.positions[:8] = np.nan
    recording.positions[200:220, 1] = np.nan
    result = release_of(recording, TIP, 5)
    assert result.frame == pytest.approx(RELEASE, abs=0.25)
    assert 8 <= result.rest[0] < result.rest[1] <= 61
    recording.positions[50:70, 1] = np.nan
    with pytest.raises(
        DataFileError,
        match=r"in swing\.c3d, frames 8 to 57, the first without a long gap: the tip never",
    ):
        release_of(recording, TIP, 5)
    recording = swinging()
    refuses(DataFileError, r"No release found in swing\.c3d", release_of, recording, BASE, 5)


def test_a_swing_has_no_jumps():
    """Neither its fastest steps (4.8 mm) nor the kink of the release, nor gaps, count."""
    recording = swinging()
    assert np.linalg.norm(np.diff(recording.positions, axis=0), axis=2).max() > 4e-3
    recording.positions[70:74, 0] = np.nan
    recording.positions[200:230, 1] = np.nan
    jumps = find_jumps(recording)
    assert not any(jumps.values())
    assert find_swaps(recording, jumps) == []


@pytest.mark.parametrize("column", [0, 3])
def test_jumps_are_found_with_frame_and_size(column):
    recording = swinging()
    recording.positions[64:, column] += [0.0, 0.0, 5e-4]
    recording.positions[150, column] += [8e-4, 0.0, 0.0]
    ((label, jumps),) = [found for found in find_jumps(recording).items() if found[1]]
    assert label == recording.labels[column]
    assert [jump.frame for jump in jumps] == [64, 150, 151]
    assert jumps[0].mm == pytest.approx(0.5, abs=0.1)
    recording = swinging()
    recording.positions[200:, column] += [0.0, 5e-4, 0.0]
    recording.positions[203:, column] += [0.0, 5e-4, 0.0]  # on, not back
    assert [jump.frame for jump in find_jumps(recording)[recording.labels[column]]] == [200, 203]


def test_exchanged_labels_and_a_marker_that_reappears_under_another_name_are_detected():
    recording = swinging()
    recording.positions[120:, [2, 3]] = recording.positions[120:, [3, 2]]
    swaps = find_swaps(recording, find_jumps(recording))
    assert swaps == [("base 1", "base 2", 120), ("base 2", "base 1", 120)]
    recording = swinging()
    recording.positions[120:140, [3, 4]] = np.nan
    recording.positions[140:, 3] = recording.positions[140:, 4]
    recording.positions[140:, 4] = np.nan
    swaps = find_swaps(recording, find_jumps(recording))
    assert swaps == [("base 2", "base 3", 140)]


@pytest.mark.parametrize("noise", [3e-6, 5e-5])
def test_noise_is_measured_beside_motion_jumps_and_gaps(noise):
    recording = swinging(frames=500, noise=noise)
    recording.positions[200:, 3] += 1e-3
    recording.positions[::11, 4] = np.nan
    result = marker_quality.noise_level(recording)
    np.testing.assert_allclose(result, noise, rtol=0.25)
    recording.positions[::3, 4] = np.nan
    assert np.isnan(marker_quality.noise_level(recording)[4])


def test_quality_of_a_recording():
    recording = swinging()
    recording.positions[100:103, 0] = np.nan
    recording.positions[297:, 0] = np.nan
    recording.positions[140:160, 1] = np.nan
    recording.positions[:, 2] += np.linspace(0.0, 1e-3, 300)[:, None] * [0.0, 0.6, 0.8]
    recording.positions[40:, 3] += 1e-3
    result = marker_quality.quality(recording, BASE, longest_gap=5)
    tip, tip2, drifting, jumping, good = result.markers
    assert (tip.gaps, tip.longest_gap_frames, tip.masked_frames, tip.seen) == (
        2,
        3,
        3,
        pytest.approx(294 / 300),
    )
    assert (tip2.gaps, tip2.longest_gap_frames, tip2.masked_frames) == (1, 20, 20)
    assert drifting.drift_mm == pytest.approx(0.9, rel=0.02)
    assert [jump.frame for jump in jumping.jumps] == [40]
    assert good.drift_mm < 5e-3
    assert tip.drift_mm is None
    assert result.warnings == (
        "tip 1 is hidden for up to 3 frames; 3 frames are masked.",
        "tip 2 is hidden for up to 20 frames; 20 frames are masked.",
        "base 1 should not move and drifts by 0.91 mm.",
        "base 2 jumps once, by 1.73 mm, in frame 40.",
        "base 2 should not move and drifts by 1.73 mm.",
    )
    table = marker_quality.quality_table(result.markers)
    assert table["tip 1"][:4] == ["98.0 %", "2", "3", "3"]
    assert table["base 2"][4] == "1 (1.73 mm)"
    refuses(
        DataFileError,
        r"swing\.c3d has no marker named 'foot'",
        marker_quality.quality,
        recording,
        ["foot"],
    )


def test_base_markers_that_were_moved():
    first, moved, bumped = swinging(), swinging(shift=0.005), swinging()
    bumped.positions[:, 3] += [0.0, 2e-3, 0.0]
    shift, distortion = compare_base([first, moved], BASE, 1e-3)
    np.testing.assert_allclose(shift, [[0.005 * np.sqrt(3.0)] * 3], atol=1e-5)
    np.testing.assert_allclose(distortion, [[0.0] * 3], atol=1e-5)
    with pytest.raises(DataFileError, match=r"base 1 stands 8\.66 mm from its place"):
        compare_base([first, moved], BASE, largest_shift=1e-3)
    with pytest.raises(
        DataFileError,
        match=r"swing\.c3d: base marker base 2 moved by 2\.00 mm against the other .*, "
        r"check the unit,",
    ):
        compare_base([first, moved, bumped], BASE, 1e-3)
    compare_base([first, bumped], BASE, 5e-3)
    refuses(InputError, "two or more", compare_base, [first, moved], BASE[:1])
    assert [len(of_others) for of_others in compare_base([first], BASE, 1e-3)] == [0, 0]
    bumped.positions[:, 3] = np.nan
    for recordings in ([first, bumped], [bumped]):
        refuses(DataFileError, "'base 2' is never seen", compare_base, recordings, BASE)


@pytest.mark.parametrize("release", [60.0, 60.5])
def test_release_of_a_free_fall_is_found_between_frames(release):
    time = np.maximum(np.arange(120) - release, 0.0) / 100.0
    path = np.zeros((120, 3))
    path[:, 2] = -0.01 * (1.0 - np.cos(48.0 * time) * np.exp(-2.5 * time))
    path += np.random.default_rng(0).normal(scale=5e-6, size=path.shape)
    path[:13] += [0.0, 3e-4, 0.0]  # a marker that was mistaken at first
    path[30, 2] += 8e-3  # one sample gone astray
    result = find_release(path, 100.0)
    assert result.frame == pytest.approx(release, abs=0.25)
    assert 13 <= result.rest[0] < result.rest[1] <= 61


def test_no_release():
    still = np.random.default_rng(0).normal(scale=1e-5, size=(200, 3))
    refuses(DataFileError, r"never moves by more than 0\.\d\d mm", find_release, still, 100.0)
    swinging = np.zeros((200, 3))
    swinging[:, 2] = 0.01 * np.cos(0.5 * np.arange(200))
    refuses(DataFileError, "not still", find_release, swinging, 100.0)
    refuses(DataFileError, "No release", find_release, still[:1], 100.0)


RATE = 100.0
DECAY = 4.0  # [1/s]
# Nominal positions [m]: four markers on the clamp, three at the tip, in the order of the labels.
SEGMENT_NOMINAL = np.array(
    [
        (-0.0505, -0.0205, 0.002),
        (-0.0305, -0.0505, 0.002),
        (-0.0105, 0.0505, 0.002),
        (-0.0505, 0.0235, 0.002),
        *((-0.0096, -0.0265, -0.1), (-0.0096, 0.0265, -0.1), (-0.0282, 0.0, -0.1)),
    ]
)


def swing(opening, amplitude=5e-3, frames=150, noise=5e-6, seed=0):
    """(T, 3) [m] a damped oscillator that a constant force acts on from an opening [s] on."""
    t = np.maximum(np.arange(frames) / RATE - opening, 0.0)
    turn = 2.0 * np.pi * 8.0
    way = amplitude * (
        1.0 - np.exp(-DECAY * t) * (np.cos(turn * t) + DECAY / turn * np.sin(turn * t))
    )
    still = np.random.default_rng(seed).normal(0.0, noise, (frames, 3))
    return way[:, None] * np.array([-0.8, 0.1, 0.6]) + still


def recorded(path, start=0.0):
    """Two markers that share a path, and one that stands."""
    here = np.stack([path, path + [0.02, 0.0, 0.0], 0.0 * path + [0.0, 0.0, 0.1]], axis=1)
    return Recording(("a", "b", "base"), here, RATE, Path("swing.h5"), start=start)


@pytest.mark.parametrize(("opening", "amplitude"), [(0.07, 1e-3), (0.0725, 30e-3), (0.2, 1e-3)])
def test_the_opening_is_found_between_frames(opening, amplitude):
    result = processing.valve_opening(recorded(swing(opening, amplitude)), ("a", "b"))
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
        processing.valve_opening(recorded(path), followed)
    assert "swing.h5" in str(refused.value)


def test_repeated_frames_are_masked():
    recording = recorded(swing(0.07))
    positions = recording.positions.copy()
    positions[4:6] = positions[3]
    positions[7, 0] = positions[6, 0]  # one marker alone is a coincidence, or held by someone
    positions[9:11, 1] = np.nan
    positions[10] = positions[9]
    masked = segment.mask_repeats(dataclasses.replace(recording, positions=positions))
    assert np.flatnonzero(~masked.seen[:, 2]).tolist() == [4, 5, 10]
    assert np.flatnonzero(~masked.seen[:, 1]).tolist() == [4, 5, 9, 10]
    np.testing.assert_array_equal(masked.positions[7, 0], positions[6, 0])


@pytest.fixture
def published(tmp_path):
    """Two trials in the layout that was published.

    Which marker is which shows in the first frame.
    """
    rest = np.empty((7, 3))
    rest[list(segment.MARKERS)] = SEGMENT_NOMINAL
    moved = np.isin(
        np.arange(7),
        [segment.MARKERS[segment.SEGMENT_LABELS.index(name)] for name in segment.TIP_LABELS],
    )
    trials = [
        rest + moved[:, None] * swing(*own)[:, None] for own in ((0.0725, 2e-3), (0.12, 9e-3))
    ]
    noisy = np.stack(trials) + np.random.default_rng(1).normal(0.0, 5e-6, (2, 150, 7, 3))
    noisy[0, 40] = noisy[0, 39]
    arrays = {"pressure_mbar": np.array([50.0, 325.0]), "markers": noisy, "rate_hz": np.array(RATE)}
    np.savez(tmp_path / "steps.npz", **arrays)
    return tmp_path / "steps.npz", arrays


def test_the_segment_is_converted(published, tmp_path):
    segment.convert_segment(published[0], tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "segment_050.h5",
        "segment_325.h5",
    ]
    first = read_recording(tmp_path / "out" / "segment_050.h5")
    assert first.labels == segment.SEGMENT_LABELS
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
        (
            {"markers": np.tile(SEGMENT_NOMINAL[np.argsort(segment.MARKERS)], (2, 150, 1, 1))},
            "seen together in 1 frames",
        ),
    ],
)
def test_another_layout_is_refused(published, change, message):
    path, arrays = published
    np.savez(
        path, **{name: array for name, array in {**arrays, **change}.items() if array is not None}
    )
    with pytest.raises(DataFileError, match=message) as refused:
        segment.read_published_segment(path)
    assert str(path) in str(refused.value)


def test_the_measured_segment(shared_data):
    """The tip goes towards -x and up, the further the higher the pressure; the clamp stands."""
    trials = segment.read_published_segment(shared_data / "segment_mocap" / "pressure_steps.npz")
    assert list(trials) == [50, 100, 125, 175, 200, 250, 275, 325, 350, 400]
    ends = []
    for mbar, trial in trials.items():
        assert 0.04 < -trial.start < 0.2
        assert 23 <= int((~trial.seen.any(axis=1)).sum()) <= 38
        tip = trial.select(segment.TIP_LABELS)
        opened = np.flatnonzero(trial.time >= 0.0)[0]
        early = np.nanmax(np.linalg.norm(tip.positions[:opened] - tip.rest, axis=2))
        assert early < 2e-4
        ends.append(
            float(
                np.linalg.norm(np.nanmedian(tip.positions[-20:], axis=0).mean(0) - tip.rest.mean(0))
            )
        )
        clamp = trial.select(segment.BASE_LABELS)
        assert np.nanmax(np.linalg.norm(clamp.positions - clamp.rest, axis=2)) < 3e-4, mbar
    assert ends == sorted(ends)
    assert ends[0] == pytest.approx(1.0e-3, rel=0.1)
    assert ends[-1] == pytest.approx(33.0e-3, rel=0.02)
