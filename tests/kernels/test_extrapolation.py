"""Corrections that are polynomials of the step are extrapolated exactly, by the lowest order that suffices."""

import numpy as np
import pytest
import warp as wp

from warp_resphys.kernels.extrapolation import History, extrapolated, record_solution

wp.set_module_options({"enable_backward": False})


@wp.kernel
def record(history: History, positions: wp.array2d[wp.vec3d]):
    b, lane = wp.tid()
    record_solution(history, positions, b, lane)


@wp.kernel
def guess(history: History, guess_out: wp.array2d[wp.vec3d]):
    b, i = wp.tid()
    guess_out[b, i] = extrapolated(history, b, i, history.order[b])


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_polynomial(degree):
    random, n = np.random.default_rng(degree), 5
    coefficients = random.normal(size=(degree + 1, 1, n, 3))
    history, steps = History(), 7
    for name in ("stored", "newest", "order"):
        setattr(history, name, wp.zeros(1, dtype=int, device="cpu"))
    history.start = wp.zeros((1, n), dtype=wp.vec3d, device="cpu")
    history.correction = wp.zeros((1, 3, n), dtype=wp.vec3d, device="cpu")
    out = wp.zeros((1, n), dtype=wp.vec3d, device="cpu")
    for step in range(steps):
        correction = sum(c * step**k for k, c in enumerate(coefficients))
        if step > degree + 1:  # As many corrections as the polynomial has coefficients, and one that confirms them.
            wp.launch(guess, (1, n), [history, out], device="cpu")
            np.testing.assert_allclose(out.numpy(), correction, atol=1e-11)
            assert history.order.numpy()[0] == degree + 1
        start = random.normal(size=(1, n, 3))  # where inertia alone would lead
        history.start.assign(start)
        positions = wp.array(start + correction, dtype=wp.vec3d, device="cpu")
        wp.launch_tiled(record, dim=[1], inputs=[history, positions], block_dim=64, device="cpu")
    assert history.stored.numpy()[0] == 3
