"""Contractile fibre, ``sigma l + k s(l - 1 + c)``: active stress, and a spring shortened by a contraction."""

import warp as wp

NAME, TIED = "muscle", False
ZERO, HALF, ONE, TWO, THREE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0), wp.float64(3.0)
QUARTER, TENTH, FORTIETH = wp.float64(0.25), wp.float64(0.1), wp.float64(0.025)

values = wp.types.vector(3, wp.float64)  # (sigma, c, k)


@wp.func
def pull(strain: wp.float64, toe: wp.float64):
    """Returns energy s, force and slope of a fibre of stiffness one; the slope rises as 3 t^2 - 2 t^3 over the toe.

    Smoother than `thread.pull`, with the same force beyond the toe: a solid has fibres at every strain, and derivatives
    are compared with differences over all of them.
    """
    energy = ZERO
    force = ZERO
    slope = ZERO
    t = strain / toe
    if t > ONE:
        force = strain - HALF * toe
        energy = HALF * force * force + FORTIETH * toe * toe
        slope = ONE
    elif t > ZERO:
        slope = t * t * (THREE - TWO * t)
        force = toe * t * t * t * (ONE - HALF * t)
        energy = toe * toe * t * t * t * t * (QUARTER - TENTH * t)
    return energy, force, slope


@wp.func
def tension(length: wp.float64, toe: wp.float64, v: values):
    """Implements ``kernels.laws``."""
    energy, force, slope = pull(length - ONE + v[1], toe)
    by_values = values(ONE, v[2] * slope, force)
    return v[0] * length + v[2] * energy, v[0] + v[2] * force, v[2] * slope, by_values
