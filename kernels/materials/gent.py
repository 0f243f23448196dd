"""``-mu J_m / 2 ln(1 - x) + lambda / 2 (J - 1)^2``, x = (I1 - 3 - 2 (J - 1) + (J - 1)^2) / J_m.

The rubber of Gent (Rubber Chemistry and Technology 69, 1996), made compressible like the stable
neo-Hookean material (`mooney_rivlin`), which is its limit for large J_m. The values are mu, J_m and
the bulk modulus lambda + 2/3 mu.
"""

import warp as wp

# In a function it would be divided in single precision.
TWO_THIRDS = wp.constant(wp.float64(2.0 / 3.0))
ROOM = wp.constant(wp.float64(0.95))  # fraction of the limit above which the energy is extrapolated


@wp.func
def energy_density(f: wp.mat33d, p: wp.vec3d) -> wp.float64:
    """Returns -mu J_m / 2 ln(1 - x) as in the module's docstring,
    its parabola beyond 95 % of the limit.
    """
    change = wp.determinant(f) - wp.float64(1.0)
    x = (wp.ddot(f, f) - wp.float64(3.0) - wp.float64(2.0) * change + change * change) / p[1]
    inside = wp.min(x, ROOM)
    beyond = (x - inside) / (wp.float64(1.0) - ROOM)
    rise = beyond + wp.float64(0.5) * beyond * beyond - wp.log(wp.float64(1.0) - inside)
    return wp.float64(0.5) * p[0] * p[1] * rise


@wp.func
def volume_energy(f: wp.mat33d, p: wp.vec3d) -> wp.float64:
    """Returns lambda / 2 (J - 1)^2."""
    change = wp.determinant(f) - wp.float64(1.0)
    return wp.float64(0.5) * (p[2] - TWO_THIRDS * p[0]) * change * change
