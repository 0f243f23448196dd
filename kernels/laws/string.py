"""Tension-only spring from a given point, ``k s(l - L)``."""

import warp as wp

from .thread import pull

NAME, TIED = "string", True
ZERO = wp.float64(0.0)

values = wp.types.vector(5, wp.float64)  # (position of the point [m], k [N/m], L [m])


@wp.func
def tension(length: wp.float64, toe: wp.float64, v: values):
    """Implements ``kernels.laws``."""
    energy, force, slope = pull(length - v[4], toe)
    by_values = values(ZERO, ZERO, ZERO, force, -v[3] * slope)
    return v[3] * energy, v[3] * force, v[3] * slope, by_values
