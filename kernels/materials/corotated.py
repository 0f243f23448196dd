"""``mu ||F - R||^2 + lambda / 2 ||F - D||^2``, with R the nearest rotation and D the nearest matrix of determinant one.

The energy of projective dynamics (Bouaziz et al. 2014). A pure dilation ``F = (1 + e) I`` lies ``sqrt(3) e`` from D but
has the trace ``3 e``: for small strains the second term is that of linear elasticity with a third of its lambda.
"""

import warp as wp

from ..matrices import polar_rotation, signed_svd
from ..spectral import SMALLEST_STRETCH_SUM, spectral_blocks
from ..unimodular import unimodular_offset

NAME, LAME = "corotated", ((1.0, 0.0), (0.0, 1.0 / 3.0))
LANES = True  # `kernels.lanes` has the shape term
ZERO, HALF, ONE, TWO = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0)

moduli = wp.types.vector(2, wp.float64)  # (mu, lambda)


@wp.func
def response(f: wp.mat33d, m: moduli):
    """Returns energy and stress; both terms are w/2 dist^2(F, manifold), so that P = w (F - projection of F)."""
    energy = ZERO
    stress = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    if m[0] > ZERO:
        offset = f - polar_rotation(f)
        energy += m[0] * wp.ddot(offset, offset)
        stress += (TWO * m[0]) * offset
    if m[1] != ZERO:
        offset = unimodular_offset(f)
        energy += HALF * m[1] * wp.ddot(offset, offset)
        stress += m[1] * offset
    return energy, stress


@wp.func
def slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, carried: moduli) -> moduli:
    """Implements ``kernels.materials``."""
    result = moduli(ZERO, ZERO)
    if carried[0] != ZERO:
        result[0] = TWO * wp.ddot(f - polar_rotation(f), df)
    if carried[1] != ZERO:
        result[1] = wp.ddot(unimodular_offset(f), df)
    return result


@wp.func
def second_derivatives(s: wp.vec3d, d: wp.vec3d, shape: wp.float64, volume: wp.float64):
    """Returns normal (3, 3), flip and twist (`spectral_blocks`); d are the singular values of D."""
    # D shares F's singular frame: s = d + m cof(d), prod d = 1. Differentiating both gives the 3x3 block of
    # dD as the projection on the surface's tangent plane in the metric I + m (d off the diagonal).
    cof = wp.vec3d(d[1] * d[2], d[0] * d[2], d[0] * d[1])
    m = wp.dot(s - d, cof) / wp.dot(cof, cof)
    inverse = wp.inverse(wp.mat33d(ONE, m * d[2], m * d[1], m * d[2], ONE, m * d[0], m * d[1], m * d[0], ONE))
    icof = inverse * cof
    normal = volume * (wp.outer(icof, icof) / wp.dot(cof, icof) - inverse)
    flip = wp.vec3d(ZERO, ZERO, ZERO)
    twist = wp.vec3d(ZERO, ZERO, ZERO)
    for k in range(3):
        normal[k, k] += volume + TWO * shape
        stretch_sum = wp.max(s[(k + 1) % 3] + s[(k + 2) % 3], SMALLEST_STRETCH_SUM)
        flip[k] = TWO * shape + volume * (ONE - ONE / (ONE - m * d[k]))
        d_sum = d[(k + 1) % 3] + d[(k + 2) % 3]
        twist[k] = TWO * shape * (ONE - TWO / stretch_sum) + volume * (ONE - d_sum / stretch_sum)
    return normal, flip, twist


# The rotation R of F = R S turns by dR = [w]_x R, w = A^-1 a, where A = tr(S) I - R S R^T and a is the axial vector
# of dF R^T - R dF^T. A change x of column n of F has a = (R e_n) x x, so that block (k, n) of dR is
# -[R e_k]_x A^-1 [R e_n]_x.
@wp.func
def turning(f: wp.mat33d, r: wp.mat33d) -> wp.mat33d:
    """Returns A^-1, which makes the rotation w of dR = [w]_x R of the axial vector of dF R^T - R dF^T."""
    stretch = f * wp.transpose(r)
    t = wp.trace(stretch)
    return wp.inverse(wp.mat33d(t, ZERO, ZERO, ZERO, t, ZERO, ZERO, ZERO, t) - HALF * (stretch + wp.transpose(stretch)))


@wp.func
def rotation_blocks(r: wp.mat33d, scaled: wp.mat33d, shape: wp.float64, out: wp.array[wp.mat33d]):
    """Writes the blocks of 2 mu (dF - dR) from R and 2 mu A^-1 (`turning`)."""
    columns = wp.transpose(r)
    for k in range(3):
        turned = wp.skew(columns[k]) * scaled
        for n in range(k + 1):
            block = turned * wp.skew(columns[n])
            if k == n:
                block[0, 0] += TWO * shape
                block[1, 1] += TWO * shape
                block[2, 2] += TWO * shape
            out[(k * (k + 1)) / 2 + n] = block


@wp.func
def rotation_tangent(f: wp.mat33d, shape: wp.float64, out: wp.array[wp.mat33d]):
    """Writes the blocks of the shape term, 2 mu (dF - dR), for det F > 0."""
    r = polar_rotation(f)
    rotation_blocks(r, TWO * shape * turning(f, r), shape, out)


@wp.func
def tangent(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the blocks of dP/dF, by singular values unless the rotation suffices."""
    if clamp or m[1] != ZERO or wp.determinant(f) < SMALLEST_STRETCH_SUM:
        u, s, v = signed_svd(f)
        d = s
        if m[1] != ZERO:
            d = s - wp.get_diag(wp.transpose(u) * unimodular_offset(f) * v)
        normal, flip, twist = second_derivatives(s, d, m[0], m[1])
        spectral_blocks(u, v, normal, flip, twist, clamp, out)
    else:
        rotation_tangent(f, m[0], out)
