"""The law of follower pressure in a chamber."""

import warp as wp

from .laws import Law
from .matrices import cofactor

ZERO = wp.float64(0.0)

vec1d = wp.types.vector(1, wp.float64)


# The potential of a uniform gauge pressure p is -p V (Bonet and Wood 2008, section 8.5.2). The faces are oriented into
# the chamber: V = -sum_q w_q det F, F = [x, t1, t2].
@wp.func
def response(f: wp.mat33d, v: vec1d):
    """Returns p det F and its derivative."""
    return v[0] * wp.determinant(f), v[0] * cofactor(f)


@wp.func
def slopes(f: wp.mat33d, df: wp.mat33d, v: vec1d, carried: vec1d) -> vec1d:
    """Returns cof F : dF."""
    return vec1d(wp.ddot(cofactor(f), df))


@wp.func
def tangent(f: wp.mat33d, v: vec1d, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the derivative of cof F, whose column k is the cross product of the next two columns of F.

    With `clamp` it is zero, as the eigenvalues have both signs.
    """
    columns, p = wp.transpose(f), v[0]
    if clamp:
        p = ZERO
    # Blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2).
    out[0] = wp.mat33d()
    out[1] = p * wp.skew(columns[2])
    out[2] = wp.mat33d()
    out[3] = -p * wp.skew(columns[1])
    out[4] = p * wp.skew(columns[0])
    out[5] = wp.mat33d()


PRESSURE = Law("follower_pressure", vec1d, response, slopes, tangent)
