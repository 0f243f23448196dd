"""``c10 ((I1 - 3) - 2 (J - 1) + (J - 1)^2) + c01 ((I2 - 3) - 4 (J - 1)) + lambda / 2 (J - 1)^2``.

The rubber of Mooney (1940) and Rivlin (1948), with I1 = ||F||^2, I2 = ||cof F||^2 and J = det F, made compressible by
polynomials of J that leave the rest shape free of stress and give the first two terms no volume stiffness for small
strains: these are linear elasticity with mu = 2 (c10 + c01) and lambda. With c01 = 0 it is `stable_neo_hookean`, and as
that one it stays finite where elements invert.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..matrices import matrix_functions
from ..modules import decorators
from ..spectral import spectral_functions


@functools.cache
def mooney_rivlin(scalar: type) -> SimpleNamespace:
    """Functions of the moduli (c10, c01, lambda); see ``kernels.materials``."""
    _, function = decorators(scalar, "mooney_rivlin")
    functions = matrix_functions(scalar)
    mat33, vec3, moduli = functions.mat33, functions.vec3, wp.types.vector(3, scalar)
    cofactor, signed_svd = functions.cofactor, functions.signed_svd
    spectral_blocks = spectral_functions(scalar).spectral_blocks
    zero, half, one, two, three, four = (scalar(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0))

    @function
    def volume_slope(m: moduli, jac: scalar) -> scalar:
        """Derivative of the terms in J by J."""
        return two * m[0] * (jac - two) - four * m[1] + m[2] * (jac - one)

    @function
    def response(f: mat33, m: moduli):
        first = wp.ddot(f, f)
        cof = cofactor(f)
        jac = wp.determinant(f)
        change = jac - one
        energy = m[0] * (first - three - two * change + change * change)
        energy += m[1] * (wp.ddot(cof, cof) - three - four * change) + half * m[2] * change * change
        stress = two * (m[0] + m[1] * first) * f - (two * m[1]) * (f * (wp.transpose(f) * f))
        return energy, stress + volume_slope(m, jac) * cof

    @function
    def slopes(f: mat33, df: mat33) -> moduli:
        jac = wp.determinant(f)
        along = wp.ddot(cofactor(f), df)
        second = wp.ddot(f, f) * wp.ddot(f, df) - wp.ddot(f * (wp.transpose(f) * f), df)
        return moduli(
            two * wp.ddot(f, df) + two * (jac - two) * along, two * second - four * along, (jac - one) * along
        )

    # With the principal stresses sigma_i of I2, 2 s_i (s_j^2 + s_k^2), and of a function g of J, g' s_j s_k:
    # the flip of the pair (i, j) is 2 (s_k^2 - s_i s_j) and -g' s_k, its twist 2 (s_k^2 + s_i s_j) and g' s_k.
    @function
    def clamped_tangent(f: mat33, m: moduli, out: wp.array[mat33]):
        """The blocks of the nearest tangent without negative eigenvalues."""
        u, s, v = signed_svd(f)
        cof = vec3(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        slope = volume_slope(m, s[0] * s[1] * s[2])
        normal = (two * m[0] + m[2]) * wp.outer(cof, cof)
        flip = vec3(zero, zero, zero)
        twist = vec3(zero, zero, zero)
        for k in range(3):
            i = (k + 1) % 3
            j = (k + 2) % 3
            normal[k, k] += two * m[0] + two * m[1] * (s[i] * s[i] + s[j] * s[j])
            normal[i, j] += four * m[1] * s[i] * s[j] + slope * s[k]
            normal[j, i] += four * m[1] * s[i] * s[j] + slope * s[k]
            flip[k] = two * m[0] + two * m[1] * (s[k] * s[k] - s[i] * s[j]) - slope * s[k]
            twist[k] = two * m[0] + two * m[1] * (s[k] * s[k] + s[i] * s[j]) + slope * s[k]
        spectral_blocks(u, v, normal, flip, twist, 1, out)

    # A change x of column n of F changes column k of I1 F - F F^T F by
    # (2 f_k f_n^T - f_n f_k^T - C_kn I + [k = n] (I1 I - F F^T)) x, with C = F^T F.
    @function
    def tangent(f: mat33, m: moduli, positive: int, out: wp.array[mat33]):
        if positive == 1:
            clamped_tangent(f, m, out)
            return
        first = wp.ddot(f, f)
        slope = volume_slope(m, wp.determinant(f))
        columns = wp.transpose(f)
        left = f * columns
        normals = wp.transpose(cofactor(f))
        for k in range(3):
            for n in range(k + 1):
                block = (two * m[0] + m[2]) * wp.outer(normals[k], normals[n])
                block += (four * m[1]) * wp.outer(columns[k], columns[n])
                block -= (two * m[1]) * wp.outer(columns[n], columns[k])
                same = -two * m[1] * wp.dot(columns[k], columns[n])
                if k == n:
                    block -= (two * m[1]) * left
                    same += two * m[0] + two * m[1] * first
                elif k - n == 1:
                    block += slope * wp.skew(columns[3 - k - n])
                else:
                    block -= slope * wp.skew(columns[1])
                block[0, 0] += same
                block[1, 1] += same
                block[2, 2] += same
                out[(k * (k + 1)) / 2 + n] = block

    lame = ((2.0, 0.0), (2.0, 0.0), (0.0, 1.0))
    return SimpleNamespace(name="mooney_rivlin", lame=lame, response=response, slopes=slopes, tangent=tangent)
