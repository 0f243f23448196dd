"""``c10 ((I1 - 3) - 2 (J - 1) + (J - 1)^2) + c01 ((I2 - 3) - 4 (J - 1)) + lambda / 2 (J - 1)^2``.

The rubber of Mooney (1940) and Rivlin (1948), with I1 = ||F||^2, I2 = ||cof F||^2 and J = det F,
made compressible by polynomials of J for which the rest shape is free of stress and the first two
terms have no volume stiffness at small strains: there the material is linear elasticity with mu = 2
(c10 + c01) and lambda. It stays finite where elements invert. With c01 = 0 it is the stable
neo-Hookean material of Smith, de Goes and Kim (2018) without its logarithm, and with lambda shifted
by mu so that small strains give exactly linear elasticity.
"""

import warp as wp

from ..constants import FOUR, HALF, ONE, THREE, TWO, ZERO
from ..laws import Law
from ..matrices import cofactor, signed_svd, spectral_blocks


@wp.func
def volume_slope(m: wp.vec3d, jac: wp.float64) -> wp.float64:
    """Returns the derivative of the terms in J by J."""
    return TWO * m[0] * (jac - TWO) - FOUR * m[1] + m[2] * (jac - ONE)


@wp.func
def response(f: wp.mat33d, m: wp.vec3d):
    """Returns the energy above and its derivative."""
    first = wp.ddot(f, f)
    cof = cofactor(f)
    jac = wp.determinant(f)
    change = jac - ONE
    energy = m[0] * (first - THREE - TWO * change + change * change) + HALF * m[2] * change * change
    stress = TWO * m[0] * f + volume_slope(m, jac) * cof
    if m[1] != ZERO:
        energy += m[1] * (wp.ddot(cof, cof) - THREE - FOUR * change)
        stress += (TWO * m[1]) * (first * f - f * (wp.transpose(f) * f))
    return energy, stress


@wp.func
def slopes(f: wp.mat33d, df: wp.mat33d, m: wp.vec3d, carried: wp.vec3d) -> wp.vec3d:
    """Implements `Law`."""
    jac = wp.determinant(f)
    along = wp.ddot(cofactor(f), df)
    second = wp.ddot(f, f) * wp.ddot(f, df) - wp.ddot(f * (wp.transpose(f) * f), df)
    return wp.vec3d(
        TWO * wp.ddot(f, df) + TWO * (jac - TWO) * along,
        TWO * second - FOUR * along,
        (jac - ONE) * along,
    )


# With the principal stresses sigma_i of I2, 2 s_i (s_j^2 + s_k^2), and of a function g of J, g' s_j
# s_k: the flip of the pair (i, j) is 2 (s_k^2 - s_i s_j) and -g' s_k, its twist 2 (s_k^2 + s_i s_j)
# and g' s_k.
@wp.func
def principal_tangent(
    s: wp.vec3d, first: wp.float64, second: wp.float64, slope: wp.float64, curvature: wp.float64
):
    """Returns normal, flip and twist of `spectral_blocks` for an energy of I1, I2 and J.

    Args:
        s: signed singular values of F.
        first: derivative of the energy by I1.
        second: derivative by I2.
        slope: derivative by J.
        curvature: second derivative by J.
    """
    cof = wp.vec3d(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    normal = curvature * wp.outer(cof, cof)
    flip = wp.vec3d(ZERO, ZERO, ZERO)
    twist = wp.vec3d(ZERO, ZERO, ZERO)
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        normal[k, k] += TWO * first + TWO * second * (s[i] * s[i] + s[j] * s[j])
        normal[i, j] += FOUR * second * s[i] * s[j] + slope * s[k]
        normal[j, i] += FOUR * second * s[i] * s[j] + slope * s[k]
        flip[k] = TWO * first + TWO * second * (s[k] * s[k] - s[i] * s[j]) - slope * s[k]
        twist[k] = TWO * first + TWO * second * (s[k] * s[k] + s[i] * s[j]) + slope * s[k]
    return normal, flip, twist


# A change x of column n of F changes column k of I1 F - F F^T F by
# (2 f_k f_n^T - f_n f_k^T - C_kn I + [k = n] (I1 I - F F^T)) x, with C = F^T F.
@wp.func
def write_tangent(
    f: wp.mat33d,
    first: wp.float64,
    second: wp.float64,
    slope: wp.float64,
    curvature: wp.float64,
    out: wp.array[wp.mat33d],
):
    """Writes the blocks of dP/dF by the equation above.

    The arguments are those of `principal_tangent`.
    """
    columns = wp.transpose(f)
    normals = wp.transpose(cofactor(f))
    for k in range(3):
        for n in range(k + 1):
            block = curvature * wp.outer(normals[k], normals[n])
            if k == n:
                block[0, 0] += TWO * first
                block[1, 1] += TWO * first
                block[2, 2] += TWO * first
            elif k - n == 1:
                block += slope * wp.skew(columns[3 - k - n])
            else:
                block -= slope * wp.skew(columns[1])
            out[(k * (k + 1)) / 2 + n] = block
    if second != ZERO:
        square, left = wp.ddot(f, f), f * columns
        for k in range(3):
            for n in range(k + 1):
                block = (FOUR * second) * wp.outer(columns[k], columns[n])
                block -= (TWO * second) * wp.outer(columns[n], columns[k])
                same = -TWO * second * wp.dot(columns[k], columns[n])
                if k == n:
                    block -= (TWO * second) * left
                    same += TWO * second * square
                block[0, 0] += same
                block[1, 1] += same
                block[2, 2] += same
                out[(k * (k + 1)) / 2 + n] += block


@wp.func
def tangent(f: wp.mat33d, m: wp.vec3d, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the blocks of dP/dF, with `clamp` those of the nearest tangent
    without negative eigenvalues.
    """
    curvature = TWO * m[0] + m[2]
    if clamp:
        u, s, v = signed_svd(f)
        slope = volume_slope(m, s[0] * s[1] * s[2])
        normal, flip, twist = principal_tangent(s, m[0], m[1], slope, curvature)
        spectral_blocks(u, v, normal, flip, twist, True, out)
        return
    write_tangent(f, m[0], m[1], volume_slope(m, wp.determinant(f)), curvature, out)


# Of the values c10, c01 and lambda.
LAW = Law(
    "solid.mooney_rivlin",
    wp.vec3d,
    response,
    slopes,
    tangent,
    lame=((2.0, 0.0), (2.0, 0.0), (0.0, 1.0)),
)
