"""Ogden's terms with whole exponents, 2 / n^2 S_n of ``kernels.materials.convex``
without their part in j.
"""

import warp as wp

from ..constants import ONE, THREE, TWO, ZERO
from ..matrices import cofactor, polar_rotation, signed_svd

IDENTITY = wp.mat33d(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def whole_power(x: wp.float64, n: int) -> wp.float64:
    """Returns x^n for n >= 0."""
    result = ONE
    for _ in range(n):
        result *= x
    return result


@wp.func
def odd_power(x: wp.float64, n: int) -> wp.float64:
    """Returns the odd function |x|^n sgn x for n >= 0."""
    return wp.sign(x) * whole_power(wp.abs(x), n)


@wp.func
def quotient(x: wp.float64, y: wp.float64, n: int) -> wp.float64:
    """Returns the difference of `odd_power` between x and y over x - y,
    also where they are equal, for n >= 1.
    """
    if n % 2 == 0 and x * y <= ZERO:
        apart = x - y
        if apart == ZERO:
            return ZERO
        return (odd_power(x, n) - odd_power(y, n)) / apart
    total = ONE
    other = ONE
    for _ in range(1, n):
        other *= y
        total = total * x + other
    if n % 2 == 0 and x < ZERO:
        return -total
    return total


@wp.func
def matrix_power(a: wp.mat33d, n: int) -> wp.mat33d:
    """Returns A^n for n >= 0."""
    result = IDENTITY
    for _ in range(n):
        result = result * a
    return result


@wp.func
def unsigned_polar(f: wp.mat33d):
    """Returns R and U of F = R U, with U positive semi-definite and an orthogonal R,
    also where F is inverted.
    """
    if wp.determinant(f) > ZERO:
        r = polar_rotation(f)
        return r, wp.transpose(r) * f
    u, s, v = signed_svd(f)
    signs = wp.diag(wp.vec3d(ONE, ONE, -ONE))
    right = wp.transpose(v)
    return u * signs * right, v * wp.diag(wp.vec3d(s[0], s[1], -s[2])) * right


@wp.func
def term(f: wp.mat33d, turn: wp.mat33d, u: wp.mat33d, n: int):
    """Returns a term and its derivative by F = R U.

    For n > 0, R U^(n - 1) is R or F times a power of F^T F.
    """
    size = wp.float64(wp.abs(n))
    if n > 0:
        c = wp.transpose(f) * f
        slope = f
        if n % 2 == 1:
            slope = turn
        for _ in range((n - 1) / 2):
            slope = slope * c
        return TWO / (size * size) * (wp.ddot(slope, f) - THREE), TWO / size * slope
    cof = cofactor(u)
    lower = matrix_power(cof, -n - 1)
    change = wp.trace(lower)
    crossed = lower * u
    slope = crossed + wp.transpose(crossed) - change * u - wp.trace(u) * lower
    slope += IDENTITY * (change * wp.trace(u) - wp.trace(crossed))
    return TWO / (size * size) * (wp.ddot(lower, cof) - THREE), TWO / size * (turn * slope)


@wp.func
def with_term(
    n: int, modulus: wp.float64, s: wp.vec3d, normal: wp.mat33d, flip: wp.vec3d, twist: wp.vec3d
):
    """Returns normal, flip and twist of `spectral_blocks` with those of a term."""
    k = wp.abs(n) - 1
    scale = TWO * modulus / wp.float64(k + 1)
    bent = scale * wp.float64(k)
    for i in range(3):
        a, b = s[(i + 1) % 3], s[(i + 2) % 3]
        if n > 0:
            normal[i, i] += bent * whole_power(wp.abs(s[i]), k - 1)
            flip[i] += scale * quotient(a, b, k)
            twist[i] += scale * quotient(a, -b, k)
        else:
            x, slope = a * b, scale * odd_power(a * b, k)
            curvature = bent * whole_power(wp.abs(x), k - 1)
            normal[(i + 1) % 3, (i + 1) % 3] += curvature * b * b
            normal[(i + 2) % 3, (i + 2) % 3] += curvature * a * a
            normal[(i + 1) % 3, (i + 2) % 3] += curvature * x + slope
            normal[(i + 2) % 3, (i + 1) % 3] += curvature * x + slope
            square = scale * s[i] * s[i]
            flip[i] += square * quotient(s[i] * a, s[i] * b, k) - slope
            twist[i] += square * quotient(s[i] * a, -s[i] * b, k) + slope
    return normal, flip, twist


# The stress is 2 mu_n / n R U^(n - 1): L C^k with C = F^T F, k = (n - 1) // 2, and L = R for odd n,
# F for even ones.
@wp.func
def add_tangent(
    f: wp.mat33d,
    r: wp.mat33d,
    turn: wp.mat33d,
    n: int,
    modulus: wp.float64,
    out: wp.array[wp.mat33d],
):
    """Adds the blocks of dP/dF of a term with n > 0, for det F > 0,
    its rotation r and the `turning` of both.
    """
    back = wp.transpose(f)
    c = back * f
    scale = TWO * modulus / wp.float64(n)
    k = (n - 1) / 2
    power = matrix_power(c, k)
    left = f
    if n % 2 == 1:
        left = r
        moved, axes = wp.transpose(r * power), wp.transpose(r)
        for i in range(3):
            turned = scale * wp.skew(moved[i]) * turn
            for j in range(i + 1):
                out[(i * (i + 1)) / 2 + j] -= turned * wp.skew(axes[j])
    else:
        for i in range(3):
            for j in range(i + 1):
                out[(i * (i + 1)) / 2 + j] += scale * power[i, j] * IDENTITY
    for a in range(k):  # of dC^k, the sum of C^a (dF^T F + F^T dF) C^(k - 1 - a)
        right = matrix_power(c, k - 1 - a)
        columns, carried = wp.transpose(left), wp.transpose(f * right)
        across = left * back
        for i in range(3):
            for j in range(i + 1):
                block = wp.outer(columns[j], carried[i]) + right[i, j] * across
                out[(i * (i + 1)) / 2 + j] += scale * block
        left = left * c
