"""Tension-only thread, ``k s(l - 1)``, with s(e) = max(e, 0)^2 / 2 smoothed over a short toe."""

import warp as wp

NAME, TIED = "thread", False
ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
SIXTH, TWENTY_FOURTH = wp.float64(1.0 / 6.0), wp.float64(1.0 / 24.0)

values = wp.types.vector(1, wp.float64)  # (k)


@wp.func
def pull(strain: wp.float64, toe: wp.float64):
    """Returns energy s, force and slope of a thread of stiffness one: zero in compression, linear beyond the toe."""
    energy = ZERO
    force = ZERO
    slope = ZERO
    if strain > toe:
        force = strain - HALF * toe
        energy = HALF * force * force + TWENTY_FOURTH * toe * toe
        slope = ONE
    elif strain > ZERO:
        slope = strain / toe
        force = HALF * strain * slope
        energy = SIXTH * strain * strain * slope
    return energy, force, slope


@wp.func
def tension(length: wp.float64, toe: wp.float64, v: values):
    """Implements ``kernels.laws``."""
    energy, force, slope = pull(length - ONE, toe)
    return v[0] * energy, v[0] * force, v[0] * slope, values(force)
