"""Families of fibres in a solid, k_f s(l - 1 - slack) + k_3 <q>^3 + k_c <-q>^2
(``kernels.materials.convex``).
"""

import warp as wp

from ..axial import muscle_pull
from ..constants import FOUR, HALF, ONE, SIX, THREE, TWO, ZERO

SMALLEST = wp.float64(1.0e-12)  # lower bound of a squared length in a denominator

Family = wp.types.vector(8, wp.float64)  # unit vector e, slack, toe, k_f, k_3 and k_c


@wp.func
def by_square(q: wp.float64, m: Family) -> wp.vec3d:
    """Returns the energy of a family and its first two derivatives by q = l^2 - 1."""
    if q <= ZERO:
        return m[7] * wp.vec3d(q * q, TWO * q, TWO)
    stretch = wp.sqrt(ONE + q)
    energy, force, slope = muscle_pull(stretch - ONE - m[3], m[4])
    by_q = HALF / stretch * force
    cubic = m[6] * q
    w = wp.vec3d(cubic * q * q, THREE * cubic * q, SIX * cubic)
    return w + m[5] * wp.vec3d(energy, by_q, (HALF * slope - by_q) * HALF / (ONE + q))


@wp.func
def fibre_response(f: wp.mat33d, m: Family):
    """Returns energy and stress of a family."""
    e = wp.vec3d(m[0], m[1], m[2])
    c = f * e
    w = by_square(wp.dot(c, c) - ONE, m)
    return w[0], (TWO * w[1]) * wp.outer(c, e)


@wp.func
def fibre_slopes(f: wp.mat33d, df: wp.mat33d, m: Family) -> Family:
    """Returns the derivatives of its stress : dF."""
    e = wp.vec3d(m[0], m[1], m[2])
    c, moved = f * e, df * e
    q, change = wp.dot(c, c) - ONE, TWO * wp.dot(c, moved)
    w = by_square(q, m)
    back = wp.transpose(f)
    by_direction = (TWO * w[2] * change) * (back * c) + (TWO * w[1]) * (
        back * moved + wp.transpose(df) * c
    )
    taut = wp.max(q, ZERO)
    stretch = wp.sqrt(ONE + taut)
    strain, toe = stretch - ONE - m[3], m[4]
    _energy, force, slope = muscle_pull(strain, toe)
    longer = HALF / stretch * change
    t = wp.clamp(strain / toe, ZERO, ONE)
    return Family(
        by_direction[0],
        by_direction[1],
        by_direction[2],
        -m[5] * slope * longer,
        -m[5] * t * t * t * (TWO - THREE * HALF * t) * longer,
        force * longer,
        THREE * taut * taut * change,
        TWO * wp.min(q, ZERO) * change,
    )


@wp.func
def add_fibre_tangent(f: wp.mat33d, m: Family, clamp: bool, out: wp.array[wp.mat33d]):
    """Adds the blocks of dP/dF of a family, with `clamp` without negative eigenvalues."""
    e = wp.vec3d(m[0], m[1], m[2])
    c = f * e
    square = wp.dot(c, c)
    w = by_square(square - ONE, m)
    across, along = TWO * w[1], FOUR * w[2]
    if clamp and across < ZERO:
        along = wp.max(across / wp.max(square, SMALLEST) + along, ZERO)
        across = ZERO
    for r in range(3):
        for n in range(r + 1):
            block = (along * e[r] * e[n]) * wp.outer(c, c)
            same = across * e[r] * e[n]
            block[0, 0] += same
            block[1, 1] += same
            block[2, 2] += same
            out[(r * (r + 1)) / 2 + n] += block
