"""``mu/2 (||F||^2 - 3) - mu (J - 1) + mu/2 (J - 1)^2 + lambda / 2 (J - 1)^2``, J = det F.

Smith, de Goes and Kim (2018) without its logarithm, with lambda shifted by mu so that small strains give exactly linear
elasticity.
"""

import warp as wp

from ..matrices import cofactor, signed_svd
from ..spectral import spectral_blocks

NAME, LAME = "stable_neo_hookean", ((1.0, 0.0), (0.0, 1.0))
ZERO, HALF, ONE, TWO = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0)
THREE = wp.float64(3.0)

moduli = wp.types.vector(2, wp.float64)  # (mu, lambda)


@wp.func
def response(f: wp.mat33d, m: moduli):
    """Returns the energy above and its derivative."""
    energy = ZERO
    stress = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    change = wp.determinant(f) - ONE
    if m[0] > ZERO:
        energy += m[0] * (HALF * (wp.ddot(f, f) - THREE) - change + HALF * change * change)
        stress += m[0] * (f + (change - ONE) * cofactor(f))
    if m[1] != ZERO:
        energy += m[1] * (HALF * change * change)
        stress += (m[1] * change) * cofactor(f)
    return energy, stress


@wp.func
def slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, carried: moduli) -> moduli:
    """Implements ``kernels.materials``."""
    change = wp.determinant(f) - ONE
    along = wp.ddot(cofactor(f), df)
    return moduli(wp.ddot(f, df) + (change - ONE) * along, change * along)


@wp.func
def clamped_tangent(f: wp.mat33d, m: moduli, out: wp.array[wp.mat33d]):
    """Writes the blocks of the nearest tangent without negative eigenvalues."""
    u, s, v = signed_svd(f)
    jac = s[0] * s[1] * s[2]
    cof = wp.vec3d(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    slope = m[0] * (jac - TWO) + m[1] * (jac - ONE)
    normal = (m[0] + m[1]) * wp.outer(cof, cof)
    flip = wp.vec3d(ZERO, ZERO, ZERO)
    twist = wp.vec3d(ZERO, ZERO, ZERO)
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        normal[k, k] += m[0]
        normal[i, j] += slope * s[k]
        normal[j, i] += slope * s[k]
        flip[k] = m[0] - slope * s[k]
        twist[k] = m[0] + slope * s[k]
    spectral_blocks(u, v, normal, flip, twist, True, out)


@wp.func
def tangent(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the blocks of the derivative of mu F + (mu (J - 2) + lambda (J - 1)) cof F."""
    if clamp:
        clamped_tangent(f, m, out)
        return
    jac = wp.determinant(f)
    cof = cofactor(f)
    slope = m[0] * (jac - TWO) + m[1] * (jac - ONE)
    bulk = m[0] + m[1]
    columns = wp.transpose(f)
    normals = wp.transpose(cof)
    for k in range(3):
        for n in range(k + 1):
            block = bulk * wp.outer(normals[k], normals[n])
            if k == n:
                block[0, 0] += m[0]
                block[1, 1] += m[0]
                block[2, 2] += m[0]
            elif k - n == 1:
                block += slope * wp.skew(columns[3 - k - n])
            else:
                block -= slope * wp.skew(columns[1])
            out[(k * (k + 1)) / 2 + n] = block
