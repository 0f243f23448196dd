"""The law of follower pressure in a chamber or on open faces."""

import warp as wp

from .constants import ZERO
from .laws import Law
from .matrices import cofactor

vec4d = wp.types.vector(4, wp.float64)


# The potential of a uniform gauge pressure p is -p V (Bonet and Wood 2008, section 8.5.2). The
# faces are oriented into the chamber: V = -sum_q w_q det F, F = [x - c, t1, t2], with the values
# v = (p, c). The apex c is constant.
@wp.func
def seen_from_apex(f: wp.mat33d, v: vec4d) -> wp.mat33d:
    """Returns F = [x - c, t1, t2] from [x, t1, t2]."""
    return f - wp.mat33d(v[1], ZERO, ZERO, v[2], ZERO, ZERO, v[3], ZERO, ZERO)


@wp.func
def response(f: wp.mat33d, v: vec4d):
    """Returns p det F and its derivative."""
    seen = seen_from_apex(f, v)
    return v[0] * wp.determinant(seen), v[0] * cofactor(seen)


@wp.func
def slopes(f: wp.mat33d, df: wp.mat33d, v: vec4d, carried: vec4d) -> vec4d:
    """Returns cof F : dF, and zero for the apex."""
    return vec4d(wp.ddot(cofactor(seen_from_apex(f, v)), df), ZERO, ZERO, ZERO)


@wp.func
def tangent(f: wp.mat33d, v: vec4d, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the derivative of cof F, whose column k is the cross product
    of the next two columns of F.

    With `clamp` it is zero, as the eigenvalues have both signs.
    """
    columns, p = wp.transpose(seen_from_apex(f, v)), v[0]
    if clamp:
        p = ZERO
    # Blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2).
    out[0] = wp.mat33d()
    out[1] = p * wp.skew(columns[2])
    out[2] = wp.mat33d()
    out[3] = -p * wp.skew(columns[1])
    out[4] = p * wp.skew(columns[0])
    out[5] = wp.mat33d()


PRESSURE = Law("follower_pressure", vec4d, response, slopes, tangent)
