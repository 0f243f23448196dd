"""``mu/2 (||F||^2 - 3) - mu (J - 1) + mu/2 (J - 1)^2 + lambda / 2 (J - 1)^2``, J = det F.

Smith, de Goes and Kim (2018) without its logarithm, with lambda shifted by mu so that small strains give exactly linear
elasticity.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..matrices import matrix_functions
from ..modules import decorators
from ..spectral import spectral_functions


@functools.cache
def stable_neo_hookean(scalar: type) -> SimpleNamespace:
    """Functions of the moduli (mu, lambda); see ``kernels.materials``."""
    _, function = decorators(scalar, "stable_neo_hookean")
    functions = matrix_functions(scalar)
    mat33, vec3, moduli = functions.mat33, functions.vec3, wp.types.vector(2, scalar)
    cofactor, signed_svd = functions.cofactor, functions.signed_svd
    spectral_blocks = spectral_functions(scalar).spectral_blocks
    zero, half, one, two, three = (scalar(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0))

    @function
    def response(f: mat33, m: moduli):
        energy = zero
        stress = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        change = wp.determinant(f) - one
        if m[0] > zero:
            energy += m[0] * (half * (wp.ddot(f, f) - three) - change + half * change * change)
            stress += m[0] * (f + (change - one) * cofactor(f))
        if m[1] != zero:
            energy += m[1] * (half * change * change)
            stress += (m[1] * change) * cofactor(f)
        return energy, stress

    @function
    def slopes(f: mat33, df: mat33) -> moduli:
        change = wp.determinant(f) - one
        along = wp.ddot(cofactor(f), df)
        return moduli(wp.ddot(f, df) + (change - one) * along, change * along)

    @function
    def clamped_tangent(f: mat33, m: moduli, out: wp.array[mat33]):
        """The blocks of the nearest tangent without negative eigenvalues."""
        u, s, v = signed_svd(f)
        jac = s[0] * s[1] * s[2]
        cof = vec3(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        slope = m[0] * (jac - two) + m[1] * (jac - one)
        normal = (m[0] + m[1]) * wp.outer(cof, cof)
        flip = vec3(zero, zero, zero)
        twist = vec3(zero, zero, zero)
        for k in range(3):
            i = (k + 1) % 3
            j = (k + 2) % 3
            normal[k, k] += m[0]
            normal[i, j] += slope * s[k]
            normal[j, i] += slope * s[k]
            flip[k] = m[0] - slope * s[k]
            twist[k] = m[0] + slope * s[k]
        spectral_blocks(u, v, normal, flip, twist, 1, out)

    @function
    def tangent(f: mat33, m: moduli, positive: int, out: wp.array[mat33]):
        """The blocks of mu F + (mu (J - 2) + lambda (J - 1)) cof F."""
        if positive == 1:
            clamped_tangent(f, m, out)
            return
        jac = wp.determinant(f)
        cof = cofactor(f)
        slope = m[0] * (jac - two) + m[1] * (jac - one)
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

    lame = ((1.0, 0.0), (0.0, 1.0))
    return SimpleNamespace(name="stable_neo_hookean", lame=lame, response=response, slopes=slopes, tangent=tangent)
