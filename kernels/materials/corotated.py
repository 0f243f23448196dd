"""``mu ||F - R||^2 + lambda / 2 ||F - D||^2``, with R the nearest rotation
and D the nearest matrix of determinant one.

The energy of projective dynamics (Bouaziz et al. 2014). A pure dilation ``F = (1 + e) I`` lies
``sqrt(3) e`` from D but has the trace ``3 e``: for small strains the second term is that of linear
elasticity with a third of its lambda.

F - D is normal to the surface det D = 1 at D, F - D = m cof(D) (Bouaziz et al. 2014, section 5.2).
With F = R U and D = R V, both V and U = V + m V^-1 are functions of C = F^T F, and their invariants
t and i obey

    i_1 = t_1 + m t_2
    i_2 = t_2 + m (t_1 t_2 - 3) + m^2 t_1
    J   = 1 + m (t_2^2 - 2 t_1) + m^2 (t_1^2 - 2 t_2) + m^3 .

As V^2 = U V - m I, the theorem of Cayley and Hamilton for V gives

    V^-1 = (m U + (1 - m t_1) I)^-1 (U^2 - t_1 U + (t_2 - m) I)

so that F - D = m F U^-1 V^-1 is a polynomial in C, whose coefficients need a few numbers and no
loop over matrices. U follows from C as in `kernels.lanes`.
"""

import warp as wp

from ..constants import EIGHT, FOUR, HALF, ONE, THREE, TWELVE, TWO, ZERO
from ..laws import Law
from ..matrices import (
    HALLEY_ITERATIONS,
    HALLEY_TOLERANCE,
    LARGEST_TRACE,
    NEWTON_TOLERANCE,
    SINGULAR,
    SMALLEST_STRETCH_SUM,
    cofactor,
    polar_rotation,
    signed_svd,
    spectral_blocks,
)

# Squared norm of the last projection's update, which converges linearly.
UPDATE_TOLERANCE = wp.float64(1.0e-30)
NEARLY_A_LINE = wp.float64(1.0e-3)
# |J - 1| up to which Newton's iteration converges, and to the nearest D
LARGEST_GROWTH = wp.float64(0.4)
NEWTON_ITERATIONS, PROJECTIONS = 8, 60


@wp.func
def trace_of_stretch(c1: wp.float64, c2: wp.float64, j: wp.float64):
    """Returns the trace of U, and whether the iteration converged (`kernels.lanes`)."""
    i = HALF * (c1 + THREE)
    change = ONE
    for _ in range(HALLEY_ITERATIONS):
        q = i * i - c1
        value, slope = q * q - EIGHT * j * i - FOUR * c2, FOUR * i * q - EIGHT * j
        step = TWO * value * slope / (TWO * slope * slope - value * (TWELVE * i * i - FOUR * c1))
        i -= step
        change = step * step
        if change < HALLEY_TOLERANCE:
            break
    return i, change < HALLEY_TOLERANCE


@wp.func
def multiplier(i1: wp.float64, i2: wp.float64, growth: wp.float64):
    """Returns m, t_2 and whether the iteration converged, for J = 1 + growth."""
    m = growth / (i2 * i2 - TWO * i1 * (ONE + growth))  # to first order: that is |cof U|^2
    t2 = i2 - m * (i1 * i2 - THREE)
    change = ONE
    for _ in range(NEWTON_ITERATIONS):
        t1 = i1 - m * t2
        p = t1 * t2 - THREE
        a, b = t2 * t2 - TWO * t1, t1 * t1 - TWO * t2
        first = t2 + m * (p + m * t1) - i2
        second = m * (a + m * (b + m)) - growth
        # derivatives by m and t_2, with t_1 = i_1 - m t_2
        first_m = p + TWO * m * t1 - m * t2 * (t2 + m)
        first_t = ONE + m * (t1 - m * (t2 + m))
        second_m = a + m * (TWO * (b + t2) + m * (THREE - TWO * t1 * t2))
        second_t = TWO * m * (t2 - m * m * t1)
        scale = ONE / (first_t * second_m - first_m * second_t)
        down = scale * (first * second_m - second * first_m)
        back = scale * (second * first_t - first * second_t)
        t2 -= down
        m -= back
        change = down * down + back * back
        if change < NEWTON_TOLERANCE:
            break
    return m, t2, change < NEWTON_TOLERANCE


@wp.func
def projected(f: wp.mat33d) -> wp.mat33d:
    """Returns D by successive projection of F on the tangent plane of {det D = 1} at the last D.

    The start is F, or the rotation of F if F is nearly a line or a point and its own tangent plane
    is undefined. For an inverted F the result may be another stationary point.
    """
    d = f
    c = cofactor(f)
    if wp.ddot(c, c) < NEARLY_A_LINE:
        d = polar_rotation(f)
    for _ in range(PROJECTIONS):
        c = cofactor(d)
        offset = wp.ddot(c, d - f) - (wp.ddot(c, d) / THREE - ONE)
        step = (f - d) + (offset / (wp.ddot(c, c) + SINGULAR)) * c
        d += step
        update = wp.ddot(step, step)
        if update < UPDATE_TOLERANCE:
            break
    return d


@wp.func
def unimodular_offset(f: wp.mat33d) -> wp.mat33d:
    """Returns F - D."""
    j, c = wp.determinant(f), wp.transpose(f) * f
    c1 = wp.trace(c)
    if wp.abs(j - ONE) < LARGEST_GROWTH and c1 < LARGEST_TRACE:
        c2 = c[0, 0] * c[1, 1] - c[0, 1] * c[0, 1]
        c2 += c[0, 0] * c[2, 2] - c[0, 2] * c[0, 2] + c[1, 1] * c[2, 2] - c[1, 2] * c[1, 2]
        i1, has_trace = trace_of_stretch(c1, c2, j)
        i2 = HALF * (i1 * i1 - c1)
        m, t2, converged = multiplier(i1, i2, j - ONE)
        if has_trace and converged:
            # (m U + d I)^-1 = (q_2 U^2 + q_1 U + q_0 I) / n; w_k: coefficients of U^k in its
            # product with the others
            t1 = i1 - m * t2
            d, e = ONE - m * t1, t2 - m
            q2, q1 = m * m, -m * (i1 * m + d)
            q0 = i2 * q2 + d * (i1 * m + d)
            n = d * d * d + m * (i1 * d * d + m * (i2 * d + m * j))
            w0, w1, w2, w3 = q0 * e, q1 * e - q0 * t1, q2 * e - q1 * t1 + q0, q1 - q2 * t1
            # by U^3 = i_1 U^2 - i_2 U + J I, V^-1 = (y_0 I + y_1 U + y_2 C) / n
            g = i1 * i2 - j
            bend = i1 * i1 - i2
            y0 = w0 + w3 * j + q2 * i1 * j
            y1 = w1 - w3 * i2 - q2 * g
            y2 = w2 + w3 * i1 + q2 * bend
            # by J U^-1 = C - i_1 U + i_2 I and g U = bend C - C^2 + i_1 J I
            k = y0 / j
            u = (y2 - k * i1) / g
            x = m / n * (y1 + k * i2 + u * i1 * j)
            s = f * c
            return x * f + (m / n * (k + u * bend)) * s - (m / n * u) * (s * c)
    return f - projected(f)


@wp.func
def response(f: wp.mat33d, m: wp.vec2d):
    """Returns energy and stress.

    Both terms are w/2 dist^2(F, manifold), so that P = w (F - projection of F).
    """
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
def slopes(f: wp.mat33d, df: wp.mat33d, m: wp.vec2d, carried: wp.vec2d) -> wp.vec2d:
    """Implements `Law`."""
    result = wp.vec2d()
    if carried[0] != ZERO:
        result[0] = TWO * wp.ddot(f - polar_rotation(f), df)
    if carried[1] != ZERO:
        result[1] = wp.ddot(unimodular_offset(f), df)
    return result


@wp.func
def second_derivatives(s: wp.vec3d, d: wp.vec3d, shape: wp.float64, volume: wp.float64):
    """Returns normal (3, 3), flip and twist (`spectral_blocks`); d are the singular values of D."""
    # D shares F's singular frame: s = d + m cof(d), prod d = 1. Differentiating both gives the 3x3
    # block of dD as the projection on the surface's tangent plane in the metric I + m (d off the
    # diagonal).
    cof = wp.vec3d(d[1] * d[2], d[0] * d[2], d[0] * d[1])
    m = wp.dot(s - d, cof) / wp.dot(cof, cof)
    inverse = wp.inverse(
        wp.mat33d(ONE, m * d[2], m * d[1], m * d[2], ONE, m * d[0], m * d[1], m * d[0], ONE)
    )
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


# The rotation R of F = R S turns by dR = [w]_x R, w = A^-1 a, where A = tr(S) I - R S R^T and a is
# the axial vector of dF R^T - R dF^T. A change x of column n of F has a = (R e_n) x x, so that
# block (k, n) of dR is
# -[R e_k]_x A^-1 [R e_n]_x.
@wp.func
def turning(f: wp.mat33d, r: wp.mat33d) -> wp.mat33d:
    """Returns A^-1, which makes the rotation w of dR = [w]_x R
    of the axial vector of dF R^T - R dF^T.
    """
    stretch = f * wp.transpose(r)
    t = wp.trace(stretch)
    return wp.inverse(
        wp.mat33d(t, ZERO, ZERO, ZERO, t, ZERO, ZERO, ZERO, t)
        - HALF * (stretch + wp.transpose(stretch))
    )


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
def tangent(f: wp.mat33d, m: wp.vec2d, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the blocks of dP/dF, by singular values unless the rotation suffices."""
    if clamp or m[1] != ZERO or wp.determinant(f) < SMALLEST_STRETCH_SUM:
        u, s, v = signed_svd(f)
        d = s
        if m[1] != ZERO:
            d = s - wp.get_diag(wp.transpose(u) * unimodular_offset(f) * v)
        normal, flip, twist = second_derivatives(s, d, m[0], m[1])
        spectral_blocks(u, v, normal, flip, twist, clamp, out)
    else:
        r = polar_rotation(f)  # of the shape term, 2 mu (dF - dR)
        rotation_blocks(r, TWO * m[0] * turning(f, r), m[0], out)


LAW = Law(
    "solid.corotated",
    wp.vec2d,  # mu and lambda
    response,
    slopes,
    tangent,
    lame=((1.0, 0.0), (0.0, 1.0 / 3.0)),
    has_lanes=True,
)
