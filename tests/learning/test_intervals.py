"""Prediction intervals: coverage with known errors, and the choice of the scale."""

import numpy as np
import pytest

from warp_resphys.learning.intervals import Intervals

REST = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])


def trials(count, seed, noise, frames=60):
    """Swinging markers, and observed ones with slowly varying errors of size ``noise(displacement)`` [m]."""
    draw = np.random.default_rng(seed)
    simulated, observed = [], []
    for _ in range(count):
        time = np.linspace(0.0, 3.0, frames)[:, None, None]
        x = REST + draw.uniform(0.5, 1.5) * np.array([0.01, 0.03])[:, None] * np.sin(
            2.0 * time + draw.uniform(0.0, 6.0)
        )
        shocks = draw.normal(size=x.shape)
        for k in range(1, frames):
            shocks[k] = 0.8 * shocks[k - 1] + 0.6 * shocks[k]
        moved = np.linalg.norm(x - REST, axis=-1, keepdims=True)
        simulated.append(x)
        observed.append(x + noise(moved) * shocks)
    return simulated, observed


@pytest.mark.parametrize(
    ("noise", "scale"),
    [(lambda moved: 1e-3 + 0.0 * moved, "constant"), (lambda moved: 1e-4 + 0.2 * moved, "displacement")],
)
def test_intervals_have_their_coverage_on_other_trials(noise, scale):
    """Mean coverage over many calibrations, with few or many trials, for both kinds of errors."""
    for count in (3, 10):
        result, scales = [], []
        for seed in range(40):
            intervals = Intervals.calibrated(*trials(count, seed, noise), REST)
            result.append(intervals.coverage(*trials(20, 1000 + seed, noise), REST)["coverage"])
            scales.append(intervals.scale)
        assert 0.85 < np.mean(result) < 0.95, count
        assert scales.count(scale) > 30


def test_intervals_are_wider_for_a_marker_with_larger_errors():
    simulated, observed = trials(8, 0, lambda moved: 1e-3 + 0.0 * moved)
    for markers in observed:
        markers[:, 1] += 0.004
    intervals = Intervals.calibrated(simulated, observed, REST)
    assert intervals.factor[1] > 1.5 * intervals.factor[0]
    again = Intervals.from_plain(intervals.plain())
    assert again == intervals
    held = again.coverage(simulated, observed, REST)
    assert held["coverage"] > 0.9
    assert 1.5 < held["half_width_mm"] < 6.0


def test_unseen_markers_have_no_influence_on_intervals():
    simulated, observed = trials(6, 1, lambda moved: 1e-3 + 0.0 * moved)
    whole = Intervals.calibrated(simulated, observed, REST)
    for markers in observed[:3]:
        markers[10:, 0] = np.nan
    some = Intervals.calibrated(simulated, observed, REST)
    assert some.factor == pytest.approx(whole.factor, rel=0.3)
    observed[0][:] = np.nan
    assert np.isfinite(some.coverage(simulated, observed, REST)["coverage"])


def test_a_model_that_diverges_has_no_intervals():
    simulated, observed = trials(4, 2, lambda moved: 1e-3 + 0.0 * moved)
    simulated[2][30:] = np.nan
    assert Intervals.calibrated(simulated, observed, REST) is None


def test_a_marker_that_was_never_seen_has_the_widest_interval():
    simulated, observed = trials(4, 2, lambda moved: 1e-3 + 0.0 * moved)
    simulated, observed = ([x[:, [0, 1, 1]].copy() for x in some] for some in (simulated, observed))
    rest = REST[[0, 1, 1]]
    for markers in observed:
        markers[:, 1] += 0.004
    known = Intervals.calibrated(simulated, observed, rest)
    for markers in observed:
        markers[:, 2] = np.nan
    result = Intervals.calibrated(simulated, observed, rest)
    assert result.factor[2] == result.factor[1] > 1.5 * result.factor[0]
    assert result.factor[:2] == pytest.approx(known.factor[:2], rel=1e-9)
    assert result.standing == pytest.approx(known.standing)
    rest = REST
    observed = [x[:, :2] for x in observed]
    simulated = [x[:, :2] for x in simulated]
    for markers in observed:
        markers[:] = np.nan
    assert Intervals.calibrated(simulated, observed, rest) is None
