import numpy as np
import pytest

from warp_resphys.data.oscillation import measure_oscillation, turning_points
from warp_resphys.data.recordings.reading import read_recording
from warp_resphys.data.recordings.release import find_release
from warp_resphys.io.errors import InputError


def swing(period, decay_rate, sag, *, rate=100.0, seconds=4.0, drift=0.0):
    """A body let go from straight: -|sag| (1 - cos), and a drift that has come to an end in the tail."""
    time = np.arange(round(seconds * rate)) / rate
    return sag * (1.0 - np.exp(-decay_rate * time) * np.cos(2 * np.pi / period * time)) + drift * time


@pytest.mark.parametrize(("period", "decay_rate"), [(0.13, 2.5), (0.231, 1.5), (0.3, 1.3), (0.3, 0.0)])
@pytest.mark.parametrize("rate", [100.0, 173.0])
def test_exact_signal(period, decay_rate, rate):
    measured = measure_oscillation(swing(period, decay_rate, -6.4e-3, rate=rate, seconds=12.0), rate)
    assert measured.period == pytest.approx(period, rel=1e-7)
    assert measured.decay_rate == pytest.approx(decay_rate, abs=1e-5)
    assert measured.damping_ratio == pytest.approx(decay_rate / np.hypot(decay_rate, 2 * np.pi / period), abs=1e-6)
    assert measured.fit_residual < 1e-9
    if decay_rate > 0.0:
        assert measured.sag == pytest.approx(-6.4e-3, abs=1e-6)
        assert measured.tail_spread < 1e-5


def test_noise_offset_drift_and_a_higher_mode():
    signal = swing(0.13, 2.5, -6.4e-3, drift=-1e-4) + 2e-3
    time = np.arange(len(signal)) / 100.0
    signal += 4e-4 * np.exp(-8.0 * time) * np.sin(2 * np.pi * 31.0 * time)
    signal += np.random.default_rng(0).normal(scale=5e-5, size=len(signal))
    measured = measure_oscillation(signal, 100.0)
    assert measured.period == pytest.approx(0.13, rel=2e-3)
    assert measured.decay_rate == pytest.approx(2.5, rel=0.05)
    assert measured.sag == pytest.approx(2e-3 - 6.4e-3 - 3.5e-4, abs=2e-5)
    assert measured.fit_residual == pytest.approx(5e-5, rel=0.5)


def test_a_window_too_short_for_a_period_is_refused():
    with pytest.raises(InputError, match=r"turns 3 times within 0\.25 s"):
        measure_oscillation(swing(0.2, 1.0, -5e-3), 100.0, window=0.25)


def test_the_fit_keeps_to_its_window():
    signal = swing(0.2, 1.0, -5e-3, seconds=6.0)
    late = signal.copy()
    late[250:] = signal[250]
    assert measure_oscillation(late, 100.0, window=1.4).period == pytest.approx(0.2, rel=1e-7)
    assert measure_oscillation(late, 100.0, window=5.0).period != pytest.approx(0.2, rel=1e-5)


def test_turning_points_are_the_extremes_and_not_the_noise():
    time = np.arange(100)
    signal = np.cos(2 * np.pi * time / 20.0)
    noisy = signal + np.random.default_rng(1).normal(scale=0.002, size=100)
    np.testing.assert_array_equal(turning_points(signal), np.arange(10, 91, 10))
    assert len(turning_points(noisy)) == 9
    assert len(turning_points(np.ones(50))) == 0


def test_recordings(shared_data):
    """Periods of 13, 23 and 30 frames, as published with the data."""
    for name, frames in (("gravity", 13), ("load52", 23), ("load101", 30)):
        recording = read_recording(shared_data / "beam_mocap" / f"beam_{name}_V2_a.c3d")
        path = recording.select(["Tip - 1", "Tip - 2", "Tip - 3"]).positions.mean(axis=1)
        start = round(find_release(path, recording.rate).frame)
        measured = measure_oscillation(path[start:, 0] - path[start, 0], recording.rate)
        assert measured.period == pytest.approx(frames / 100.0, abs=0.003)
        assert 0.03 < measured.damping_ratio < 0.08
        assert measured.fit_residual < 0.02 * abs(measured.sag)
        assert measured.tail_spread < 0.01 * abs(measured.sag)


@pytest.mark.parametrize(
    ("signal", "reason"),
    [
        (np.full(300, np.nan), "finite"),
        (np.zeros((300, 3)), "one finite displacement"),
        (swing(0.13, 2.5, -1.0)[:90], "lasts 0.90 s"),
        (-np.linspace(0.0, 1.0, 300), "turns 0 times"),
        (np.zeros(300), "turns 0 times"),
        (np.empty(0), "lasts 0.00 s"),
    ],
)
def test_refused_signals(signal, reason):
    with pytest.raises(InputError, match=reason):
        measure_oscillation(signal, 100.0)
