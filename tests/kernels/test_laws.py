"""Tension laws: slopes against differences, closed forms and the integral of the force."""

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad

from warp_resphys.kernels.laws import muscle, string, thread

wp.set_module_options({"enable_backward": False})
TOE = 0.05
# The values of each law, the length at which it goes slack and its stiffness.
LAWS = {
    "muscle": (muscle, (0.7, 0.2, 3.0), 0.8, 3.0),
    "string": (string, (0.1, 0.2, 0.3, 40.0, 0.6), 0.6, 40.0),
    "thread": (thread, (5.0,), 1.0, 5.0),
}


def kernel_of(law):
    @wp.kernel(module="unique")
    def evaluate(lengths: wp.array[wp.float64], v: law.values, out: wp.array2d[wp.float64]):
        i = wp.tid()
        energy, force, slope, by_values = law.tension(lengths[i], wp.float64(TOE), v)
        out[i, 0] = energy
        out[i, 1] = force
        out[i, 2] = slope
        for k in range(wp.static(law.values._length_)):
            out[i, 3 + k] = by_values[k]

    return evaluate


@pytest.mark.parametrize("name", LAWS)
def test_a_tension_law(name):
    law, values, slack, stiffness = LAWS[name]
    kernel, size = kernel_of(law), len(values)
    lengths = slack + np.array([-0.3, -0.01, 0.004, 0.02, 0.043, 0.07, 0.5])

    def at(lengths, values):
        out = wp.zeros((len(lengths), 3 + size), dtype=wp.float64, device="cpu")
        inputs = [wp.array(lengths, dtype=wp.float64, device="cpu"), law.values(*values)]
        wp.launch(kernel, len(lengths), [*inputs, out], device="cpu")
        return out.numpy().T

    step = 1e-5
    energy, force, slope, *by_values = at(lengths, values)
    ahead, behind = (at(lengths + s * step, values) for s in (1, -1))
    np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * step), force, atol=1e-8 * stiffness)
    np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * step), slope, atol=1e-6 * stiffness)
    for k in range(3 if law.TIED else 0, size):
        moved = [at(lengths, np.array(values) + s * step * np.eye(size)[k])[1] for s in (1, -1)]
        np.testing.assert_allclose((moved[0] - moved[1]) / (2 * step), by_values[k], atol=1e-6 * stiffness)
    passive = force - (values[0] if name == "muscle" else 0.0)
    np.testing.assert_array_equal(passive[:2], 0.0)  # no compression
    np.testing.assert_allclose(passive[-2:], stiffness * (lengths[-2:] - slack - TOE / 2), rtol=1e-12)
    assert (np.diff(passive[1:]) > 0.0).all()
    np.testing.assert_allclose(slope[-2:], stiffness)
    work = energy[0] + [quad(lambda x: at(np.array([x]), values)[1, 0], lengths[0], end)[0] for end in lengths]
    np.testing.assert_allclose(energy, work, atol=1e-7 * stiffness)
