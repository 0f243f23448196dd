"""Acceptance, by decrease or within rounding, of the trials of a line search."""

import numpy as np
import pytest
import warp as wp

from warp_resphys.kernels.line_search import decreases_enough


@wp.kernel
def decide(
    energy: wp.array[wp.float64],
    before: wp.float64,
    rounding: wp.float64,
    slope: wp.float64,
    after: wp.float64,
    out: wp.array[wp.bool],
):
    i = wp.tid()
    out[i] = decreases_enough(before, energy[i], rounding, wp.float64(1.0), slope, after)


@pytest.mark.parametrize("rounding", [0.5, np.inf])
def test_a_trial_of_infinite_energy_is_never_accepted(rounding):
    energies = np.array([0.5, 0.9999, 1.2, 1.8, np.inf, np.nan])
    for after, expected in (
        (0.0, [True, True, True, rounding > 1.0, False, False]),  # flat after the step
        (1.0, [True, True, False, False, False, False]),  # rises as steeply as it fell before
    ):
        trials = wp.array(energies, dtype=wp.float64, device="cpu")
        out = wp.zeros(len(energies), dtype=wp.bool, device="cpu")
        wp.launch(decide, len(energies), [trials, 1.0, rounding, -1.0, after], [out], device="cpu")
        assert out.numpy().tolist() == expected
