"""A polyconvex energy that is a small network of three invariants, with weights shared by all points.

    W = S (N(x) - N(0) - n y_3),    x = (a / L, b / L, j / L_j)
    U = g_2 j^2 + g_4 j^4

with j = J - 1, a = I1 - 3 - 2 j + j^2, b = I2 - 3 - 4 j as in `convex`, and n = dN/dx_3 at rest. W is integrated at the
points of the shape rule, U at those of the volume rule. N is an input-convex network (Amos, Xu and Kolter, ICML 2017)
of two layers of `UNITS` units with the activation s(z) = (z + sqrt(z^2 + 1)) / 2:

    h_k = s(R_k . x + r_k),    y_i = s(sum_k C_ki h_k + Q_i . x + q_i),    N = sum_i u_i y_i + k_a x_1 + k_b x_2

C, u, k_a, k_b and the first two components of R_k and Q_i must not be negative: then N is convex in x and does not
decrease with a and b. As a is convex in (F, J), b convex in (cof F, J) and j linear in J, W is polyconvex (Ball,
Archive for Rational Mechanics and Analysis 63, 1976; with such networks Klein et al., Journal of the Mechanics and
Physics of Solids 159, 2022).
Since a and b are not negative, W has its minimum at rest. At small strains mu is 2 S (N_1 + N_2) / L, and lambda is
S N_33 / L_j^2 + 2 g_2, with derivatives N_1, N_2 and N_33 at rest.

The viscous potential of a step is mu / c phi(|A|^2) with A = c E - W (`energies.viscosity`), where

    phi(p) = kappa p + Y^2 (M(y) - M(0)),    y = sqrt(1 + p / Y^2) - 1,    M(y) = sum_k v_k s(g_k y + e_k)

and kappa, v and g must not be negative. As y and M are convex and do not decrease, phi is convex in A; it may grow like
|A|, which is a viscosity that falls with the rate, or faster than |A|^2. Kelvin-Voigt viscosity has A = beta dE/dt and
kappa = 1, v = 0.

The shared values are R and r, C, Q and q, u, k, then kappa, v, g, e, and N(0), n and M(0).
"""

import warp as wp

from ..matrices import cofactor, signed_svd
from ..modules import named_module
from ..spectral import spectral_blocks
from . import mooney_rivlin

NAME, LAME = "neural", ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 2.0), (0.0, 0.0))
UNITS = 8
LENGTH, LENGTH_J = 0.25, 0.1  # L and L_j: stretches of 1.5 have invariants a of 0.6
# First index of each part of the shared values: (R_k, r_k), C_k, (Q_i, q_i), u, k, kappa, and v, g, e.
_COUPLING = 4 * UNITS
_SECOND = _COUPLING + UNITS * UNITS
_OUTPUT = _SECOND + 4 * UNITS
_DIRECT = _OUTPUT + UNITS
_KAPPA = _DIRECT + 2
_RATE = _KAPPA + 1
WEIGHTS = _RATE + 3 * UNITS
SHARED = WEIGHTS + 3
RATE = 0.01  # Y
ZERO, HALF, ONE, TWO = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0)
THREE, FOUR, TWELVE = wp.float64(3.0), wp.float64(4.0), wp.float64(12.0)
SQUARE = wp.float64(RATE * RATE)
SCALES = wp.constant(wp.vec3d(1.0 / LENGTH, 1.0 / LENGTH, 1.0 / LENGTH_J))

moduli = wp.types.vector(5, wp.float64)  # (S, mu, lambda of W, g_2, g_4); the second and third serve viscosity
units = wp.types.vector(UNITS, wp.float64)
rows = wp.types.matrix((3, UNITS), wp.float64)
wp.set_module_options({"max_unroll": 1}, named_module(f"solid.{NAME}"))


@wp.func
def activation(z: wp.float64) -> wp.vec3d:
    """Returns s(z) and its first two derivatives."""
    root = wp.sqrt(z * z + ONE)
    inverse = ONE / root
    return wp.vec3d(HALF * (z + root), HALF + HALF * z * inverse, HALF * inverse * inverse * inverse)


@wp.func
def row_at(w: wp.array[wp.float64], first: int, k: int) -> wp.vec3d:
    """Returns R_k or Q_k."""
    return wp.vec3d(w[first + 4 * k], w[first + 4 * k + 1], w[first + 4 * k + 2])


@wp.func
def network(x: wp.vec3d, w: wp.array[wp.float64]):
    """Returns N(x), its gradient and its second derivative."""
    into = units()
    along = rows()  # derivatives of the second layer's arguments by x
    curved = units()
    for i in range(UNITS):
        row = row_at(w, _SECOND, i)
        into[i] = wp.dot(row, x) + w[_SECOND + 4 * i + 3]
        for c in range(3):
            along[c, i] = row[c]
    for k in range(UNITS):
        row = row_at(w, 0, k)
        h = activation(wp.dot(row, x) + w[4 * k + 3])
        curved[k] = h[2]
        for i in range(UNITS):
            weight = w[_COUPLING + UNITS * k + i]
            into[i] += weight * h[0]
            for c in range(3):
                along[c, i] += weight * h[1] * row[c]
    value = w[_DIRECT] * x[0] + w[_DIRECT + 1] * x[1]
    gradient = wp.vec3d(w[_DIRECT], w[_DIRECT + 1], ZERO)
    hessian = wp.mat33d()
    back = units()
    for i in range(UNITS):
        y = w[_OUTPUT + i] * activation(into[i])
        slope = wp.vec3d(along[0, i], along[1, i], along[2, i])
        value += y[0]
        gradient += y[1] * slope
        hessian += y[2] * wp.outer(slope, slope)
        back[i] = y[1]
    for k in range(UNITS):
        total = ZERO
        for i in range(UNITS):
            total += back[i] * w[_COUPLING + UNITS * k + i]
        row = row_at(w, 0, k)
        hessian += total * curved[k] * wp.outer(row, row)
    return value, gradient, hessian


@wp.func
def invariants(first: wp.float64, second: wp.float64, jac: wp.float64) -> wp.vec3d:
    """Returns a, b and j."""
    j = jac - ONE
    return wp.vec3d(first - THREE - TWO * j + j * j, second - THREE - FOUR * j, j)


@wp.func
def derivatives(k: wp.vec3d, m: moduli, w: wp.array[wp.float64]):
    """Returns the energy, its gradient and its second derivative by a, b and j."""
    energy = ZERO
    gradient = wp.vec3d()
    hessian = wp.mat33d()
    if m[0] > ZERO:
        x = wp.cw_mul(SCALES, k)
        value, by_input, by_inputs = network(x, w)
        energy = m[0] * (value - w[WEIGHTS] - w[WEIGHTS + 1] * x[2])
        by_input[2] = by_input[2] - w[WEIGHTS + 1]
        gradient = m[0] * wp.cw_mul(SCALES, by_input)
        hessian = m[0] * wp.cw_mul(wp.outer(SCALES, SCALES), by_inputs)
    square = m[3] * k[2]
    quartic = m[4] * k[2] * k[2]
    energy += (square + quartic * k[2]) * k[2]
    gradient[2] = gradient[2] + TWO * square + FOUR * quartic * k[2]
    hessian[2, 2] = hessian[2, 2] + TWO * m[3] + TWELVE * quartic
    return energy, gradient, hessian


@wp.func
def response(f: wp.mat33d, m: moduli, w: wp.array[wp.float64]):
    """Implements ``kernels.materials``."""
    cof = cofactor(f)
    first = wp.ddot(f, f)
    k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
    energy, g, _hessian = derivatives(k, m, w)
    stress = TWO * (g[0] + g[1] * first) * f - (TWO * g[1]) * (f * (wp.transpose(f) * f))
    return energy, stress + (TWO * g[0] * (k[2] - ONE) - FOUR * g[1] + g[2]) * cof


@wp.func
def changes(f: wp.mat33d, df: wp.mat33d):
    """Returns a, b and j, and their changes along dF."""
    cof = cofactor(f)
    first = wp.ddot(f, f)
    k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
    along = wp.ddot(f, df)
    j = wp.ddot(cof, df)
    a = TWO * along + TWO * (k[2] - ONE) * j
    b = TWO * (first * along - wp.ddot(f * (wp.transpose(f) * f), df)) - FOUR * j
    return k, wp.vec3d(a, b, j)


@wp.func
def slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, carried: moduli) -> moduli:
    """Implements ``kernels.materials``; the first three moduli are a volume and serve viscosity."""
    k, d = changes(f, df)
    return moduli(ZERO, ZERO, ZERO, TWO * k[2] * d[2], FOUR * k[2] * k[2] * k[2] * d[2])


# With dots for derivatives along v, the slope along v is D = sum_i u_i s'(.) y_i + k . v, y_i and h_k being here the
# arguments of s. Its derivatives follow backwards: those by y_i are A_i = u_i s'(y_i) (by its rate) and
# B_i = u_i s''(y_i) times the rate, those by h_k and its rate are sums of them with C.
@wp.func
def shared_slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, w: wp.array[wp.float64], out: wp.array[wp.float64]):
    """Subtracts the derivatives of P : dF by the shared values from `out`."""
    if m[0] <= ZERO:
        return
    here, change = changes(f, df)
    x = wp.cw_mul(SCALES, here)
    v = wp.cw_mul(SCALES, change)
    into = units()
    rate = units()
    for i in range(UNITS):
        row = row_at(w, _SECOND, i)
        into[i] = wp.dot(row, x) + w[_SECOND + 4 * i + 3]
        rate[i] = wp.dot(row, v)
    for k in range(UNITS):
        row = row_at(w, 0, k)
        h = activation(wp.dot(row, x) + w[4 * k + 3])
        moved = h[1] * wp.dot(row, v)
        for i in range(UNITS):
            into[i] += w[_COUPLING + UNITS * k + i] * h[0]
            rate[i] += w[_COUPLING + UNITS * k + i] * moved
    for i in range(UNITS):
        y = activation(into[i])
        out[_OUTPUT + i] -= m[0] * y[1] * rate[i]
        # From here on the derivatives of D by the arguments, and by their rates.
        into[i] = m[0] * w[_OUTPUT + i] * y[2] * rate[i]
        rate[i] = m[0] * w[_OUTPUT + i] * y[1]
        add_row(x, v, into[i], rate[i], out, _SECOND + 4 * i)
    for k in range(UNITS):
        row = row_at(w, 0, k)
        h = activation(wp.dot(row, x) + w[4 * k + 3])
        along = wp.dot(row, v)
        by_value = ZERO
        by_rate = ZERO
        for i in range(UNITS):
            by_value += into[i] * w[_COUPLING + UNITS * k + i]
            by_rate += rate[i] * w[_COUPLING + UNITS * k + i]
            out[_COUPLING + UNITS * k + i] -= into[i] * h[0] + rate[i] * h[1] * along
        add_row(x, v, by_value * h[1] + by_rate * h[2] * along, by_rate * h[1], out, 4 * k)
    out[_DIRECT] -= m[0] * v[0]
    out[_DIRECT + 1] -= m[0] * v[1]
    out[WEIGHTS + 1] += m[0] * v[2]


@wp.func
def add_row(x: wp.vec3d, v: wp.vec3d, by_argument: wp.float64, by_rate: wp.float64, out: wp.array[wp.float64], at: int):
    """Subtracts the derivatives by R_k and r_k, or by Q_i and q_i."""
    for c in range(3):
        out[at + c] -= by_argument * x[c] + by_rate * v[c]
    out[at + 3] -= by_argument


@wp.func
def write_tangent(f: wp.mat33d, m: moduli, w: wp.array[wp.float64], out: wp.array[wp.mat33d]):
    """Writes the blocks of dP/dF: those of `mooney_rivlin`, and the terms of the second derivative."""
    cof = cofactor(f)
    first = wp.ddot(f, f)
    k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
    _energy, g, h = derivatives(k, m, w)
    turn = TWO * (k[2] - ONE)  # a changes by dI1 + turn dJ
    slope = turn * g[0] - FOUR * g[1] + g[2]
    mooney_rivlin.write_tangent(f, g[0], g[1], slope, TWO * g[0] + h[2, 2], out)
    if m[0] <= ZERO:
        return
    columns = wp.transpose(f)
    normals = wp.transpose(cof)
    a = TWO * columns + turn * normals  # rows: columns of da/dF
    b = TWO * (first * columns - columns * (f * columns)) - FOUR * normals
    by_a = h[0, 0] * a + h[0, 1] * b + h[0, 2] * normals
    by_b = h[0, 1] * a + h[1, 1] * b + h[1, 2] * normals
    by_j = h[0, 2] * a + h[1, 2] * b
    for r in range(3):
        for n in range(r + 1):
            block = wp.outer(a[r], by_a[n]) + wp.outer(b[r], by_b[n]) + wp.outer(normals[r], by_j[n])
            out[(r * (r + 1)) / 2 + n] += block


@wp.func
def write_clamped(f: wp.mat33d, m: moduli, w: wp.array[wp.float64], out: wp.array[wp.mat33d]):
    """Writes these blocks without negative eigenvalues."""
    u, s, v = signed_svd(f)
    cof = wp.vec3d(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    first = wp.dot(s, s)
    k = invariants(first, wp.dot(cof, cof), s[0] * cof[0])
    _energy, g, h = derivatives(k, m, w)
    turn = TWO * (k[2] - ONE)
    slope = turn * g[0] - FOUR * g[1] + g[2]
    normal, flip, twist = mooney_rivlin.principal_tangent(s, g[0], g[1], slope, TWO * g[0] + h[2, 2])
    a = TWO * s + turn * cof
    b = TWO * (first * s - wp.cw_mul(s, wp.cw_mul(s, s))) - FOUR * cof
    normal += wp.outer(a, h[0, 0] * a + h[0, 1] * b + h[0, 2] * cof)
    normal += wp.outer(b, h[0, 1] * a + h[1, 1] * b + h[1, 2] * cof)
    normal += wp.outer(cof, h[0, 2] * a + h[1, 2] * b)
    spectral_blocks(u, v, normal, flip, twist, True, out)


@wp.func
def tangent(f: wp.mat33d, m: moduli, w: wp.array[wp.float64], clamp: bool, out: wp.array[wp.mat33d]):
    """Implements ``kernels.materials``."""
    if clamp:
        write_clamped(f, m, w, out)
    else:
        write_tangent(f, m, w, out)


@wp.func
def dissipation(p: wp.float64, w: wp.array[wp.float64]) -> wp.vec3d:
    """Returns phi and its first two derivatives."""
    root = wp.sqrt(ONE + p / SQUARE)  # 1 + y
    m = wp.vec3d(-w[WEIGHTS + 2], ZERO, ZERO)  # M(y) - M(0), M' and M''
    for k in range(UNITS):
        g = w[_RATE + UNITS + k]
        s = activation(g * (root - ONE) + w[_RATE + 2 * UNITS + k])
        m += w[_RATE + k] * wp.vec3d(s[0], g * s[1], g * g * s[2])
    second = (m[2] * root - m[1]) / (FOUR * SQUARE * root * root * root)
    return wp.vec3d(w[_KAPPA] * p + SQUARE * m[0], w[_KAPPA] + m[1] / (TWO * root), second)


@wp.func
def dissipation_slopes(p: wp.float64, factor: wp.float64, w: wp.array[wp.float64], out: wp.array[wp.float64]):
    """Subtracts the derivatives of factor phi' by the shared values from `out`."""
    root = wp.sqrt(ONE + p / SQUARE)
    share = factor / (TWO * root)
    out[_KAPPA] -= factor
    for k in range(UNITS):
        v, g = w[_RATE + k], w[_RATE + UNITS + k]
        s = activation(g * (root - ONE) + w[_RATE + 2 * UNITS + k])
        out[_RATE + k] -= share * g * s[1]
        out[_RATE + UNITS + k] -= share * v * (s[1] + g * (root - ONE) * s[2])
        out[_RATE + 2 * UNITS + k] -= share * v * g * s[2]
