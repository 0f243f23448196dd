"""``mu ||F - R||^2 + lambda / 2 ||F - D||^2``, with R the nearest rotation and D the nearest matrix of determinant one.

The energy of projective dynamics (Bouaziz et al. 2014). A pure dilation ``F = (1 + e) I`` lies ``sqrt(3) e`` from D but
has the trace ``3 e``: for small strains the second term is that of linear elasticity with a third of its lambda.
"""

import functools
from types import SimpleNamespace

import warp as wp

from ..matrices import matrix_functions
from ..modules import decorators
from ..spectral import SMALLEST_STRETCH_SUM, spectral_functions


@functools.cache
def corotated(scalar: type) -> SimpleNamespace:
    """Functions of the moduli (mu, lambda); see ``kernels.materials``."""
    _, function = decorators(scalar, "corotated")
    functions = matrix_functions(scalar)
    mat33, vec3, moduli = functions.mat33, functions.vec3, wp.types.vector(2, scalar)
    signed_svd, polar_rotation = functions.signed_svd, functions.polar_rotation
    nearest_unimodular, spectral_blocks = functions.nearest_unimodular, spectral_functions(scalar).spectral_blocks
    zero, half, one, two = scalar(0.0), scalar(0.5), scalar(1.0), scalar(2.0)
    smallest_stretch_sum = scalar(SMALLEST_STRETCH_SUM)

    # Both terms are w/2 dist^2(F, manifold), so that P = w (F - its projection).
    @function
    def response(f: mat33, m: moduli):
        energy = zero
        stress = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        if m[0] > zero:
            offset = f - polar_rotation(f)
            energy += m[0] * wp.ddot(offset, offset)
            stress += (two * m[0]) * offset
        if m[1] != zero:
            offset = f - nearest_unimodular(f)
            energy += half * m[1] * wp.ddot(offset, offset)
            stress += m[1] * offset
        return energy, stress

    @function
    def slopes(f: mat33, df: mat33) -> moduli:
        return moduli(two * wp.ddot(f - polar_rotation(f), df), wp.ddot(f - nearest_unimodular(f), df))

    @function
    def second_derivatives(s: vec3, d: vec3, shape: scalar, volume: scalar):
        """Normal (3, 3), flip and twist by the index of the axis left out; d are the singular values of D."""
        # D shares F's singular frame: s = d + m cof(d), prod d = 1. Differentiating both gives the 3x3 block of
        # dD as the projection on the surface's tangent plane in the metric I + m (d off the diagonal).
        cof = vec3(d[1] * d[2], d[0] * d[2], d[0] * d[1])
        m = wp.dot(s - d, cof) / wp.dot(cof, cof)
        inverse = wp.inverse(mat33(one, m * d[2], m * d[1], m * d[2], one, m * d[0], m * d[1], m * d[0], one))
        icof = inverse * cof
        normal = volume * (wp.outer(icof, icof) / wp.dot(cof, icof) - inverse)
        flip = vec3(zero, zero, zero)
        twist = vec3(zero, zero, zero)
        for k in range(3):
            normal[k, k] += volume + two * shape
            stretch_sum = wp.max(s[(k + 1) % 3] + s[(k + 2) % 3], smallest_stretch_sum)
            flip[k] = two * shape + volume * (one - one / (one - m * d[k]))
            d_sum = d[(k + 1) % 3] + d[(k + 2) % 3]
            twist[k] = two * shape * (one - two / stretch_sum) + volume * (one - d_sum / stretch_sum)
        return normal, flip, twist

    # The rotation R of F = R S turns by dR = [w]_x R, w = A^-1 a, where A = tr(S) I - R S R^T and a is the axial vector
    # of dF R^T - R dF^T. A change x of column n of F has a = (R e_n) x x, so that block (k, n) of dR is
    # -[R e_k]_x A^-1 [R e_n]_x.
    @function
    def rotation_tangent(f: mat33, shape: scalar, out: wp.array[mat33]):
        """The blocks of the shape term, 2 mu (dF - dR), for det F > 0."""
        r = polar_rotation(f)
        stretch = f * wp.transpose(r)
        t = wp.trace(stretch)
        a = mat33(t, zero, zero, zero, t, zero, zero, zero, t) - half * (stretch + wp.transpose(stretch))
        scaled = two * shape * wp.inverse(a)
        columns = wp.transpose(r)
        for k in range(3):
            turned = wp.skew(columns[k]) * scaled
            for n in range(k + 1):
                block = turned * wp.skew(columns[n])
                if k == n:
                    block[0, 0] += two * shape
                    block[1, 1] += two * shape
                    block[2, 2] += two * shape
                out[(k * (k + 1)) / 2 + n] = block

    @function
    def tangent(f: mat33, m: moduli, positive: int, out: wp.array[mat33]):
        if positive == 1 or m[1] != zero or wp.determinant(f) < smallest_stretch_sum:
            u, s, v = signed_svd(f)
            d = s
            if m[1] != zero:
                d = wp.get_diag(wp.transpose(u) * nearest_unimodular(f) * v)
            normal, flip, twist = second_derivatives(s, d, m[0], m[1])
            spectral_blocks(u, v, normal, flip, twist, positive, out)
        else:
            rotation_tangent(f, m[0], out)

    lame = ((1.0, 0.0), (0.0, 1.0 / 3.0))
    return SimpleNamespace(name="corotated", lame=lame, response=response, slopes=slopes, tangent=tangent)
