"""A sum of terms with non-negative coefficients: powers of polyconvex invariants, Ogden's terms, and fibres.

    W = sum_p c_p a^p + sum_p d_p b^p + e j^2 + sum_n 2 mu_n / n^2 S_n
        + sum_f (k_f s(l_f - 1 - slack_f) + k_3 <q_f>^3 + k_c <-q_f>^2)
    U = g_2 j^2 + g_4 j^4

with j = J - 1, a = I1 - 3 - 2 j + j^2, b = I2 - 3 - 4 j, l_f = |F e_f| the stretch of fibres along unit vectors e_f,
q_f = l_f^2 - 1, and <x> = max(x, 0). With the singular values s_i of F and a whole number n, at least 3 or at most -3,

    S_n = sum_i s_i^n - 3 - n j + n / 2 j^2  for n > 0,     sum_{i < k} (s_i s_k)^-n - 3 + 2 n j  for n < 0

(Ogden, Proceedings of the Royal Society A 326, 1972: for J = 1 they are his). s(x) = max(x, 0)^2 / 2 is smoothed over
a toe (`kernels.axial.muscle_pull`); its strain is less by the slack, as fibres are wavy. W is integrated at the points
of the shape rule, U at those of the volume rule.

All terms and their derivatives vanish at rest, and stay finite where elements invert. a, S_n for n > 0, and l_f are
convex in (F, J), b and the other S_n in (cof F, J). a, b and l_f are not negative, so that their powers are convex too,
and every combination with non-negative coefficients is polyconvex (Ball, Archive for Rational Mechanics and Analysis
63, 1976). The exception is the compression of fibres, <-q_f>^2. At small strains mu is 2 (c_1 + d_1) + sum_n mu_n, and
lambda, without fibres, 2 (e + g_2), and 2 (1 + 2 / n) mu_n more for each negative n.

The moduli named unit_shear and unit_bulk, of value one, carry the volumes of viscosity alone: its coefficients are
viscosities and moduli of branches, not ratios to the elastic ones.
"""

import warp as wp

from ..axial import muscle_pull
from ..laws import Law
from ..matrices import SMALLEST_STRETCH_SUM, cofactor, polar_rotation, signed_svd, spectral_blocks
from ..modules import generated, named_module
from . import corotated, mooney_rivlin

POWERS_OF_A, POWERS_OF_B = 3, 2
_B, _J = POWERS_OF_A, POWERS_OF_A + POWERS_OF_B
_G2, _G4 = _J + 1, _J + 2
ISOTROPIC = _J + 3  # number of coefficients of invariants
_OGDEN = ISOTROPIC + 2  # index of the first of Ogden's moduli
PER_FIBRE = 8  # e_f, slack, toe, k_f, k_3 and k_c
ZERO, ONE, TWO, FOUR = wp.float64(0.0), wp.float64(1.0), wp.float64(2.0), wp.float64(4.0)
THREE, SIX, TWELVE = wp.float64(3.0), wp.float64(6.0), wp.float64(12.0)
HALF = wp.float64(0.5)
IDENTITY = wp.mat33d(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
SMALLEST = wp.float64(1.0e-12)  # lower bound of a squared length in a denominator


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
    """Returns the difference of `odd_power` between x and y over x - y, also where they are equal, for n >= 1."""
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
    """Returns R and U of F = R U, with U positive semi-definite and an orthogonal R, also where F is inverted."""
    if wp.determinant(f) > ZERO:
        r = polar_rotation(f)
        return r, wp.transpose(r) * f
    u, s, v = signed_svd(f)
    signs = wp.diag(wp.vec3d(ONE, ONE, -ONE))
    right = wp.transpose(v)
    return u * signs * right, v * wp.diag(wp.vec3d(s[0], s[1], -s[2])) * right


@generated
def convex_law(ogden: tuple[int, ...], fibres: int) -> Law:
    """Returns the law with Ogden's terms of some exponents, and a number of families of fibres.

    Its moduli are c_1 to c_3, d_1, d_2, e, g_2, g_4, unit_shear, unit_bulk, mu_n of each of Ogden's terms, and
    e_f (3 components), slack, toe, k_f, k_3 and k_c of each family.
    """
    terms, has_negative = len(ogden), min(ogden, default=1) < 0
    exponents = wp.types.vector(max(terms, 1), wp.int32)(*(ogden or (0,)))
    first_fibre = _OGDEN + terms
    count = first_fibre + PER_FIBRE * fibres
    moduli = wp.types.vector(count, wp.float64)
    name = ".".join(str(part).replace("-", "m") for part in ("convex", *ogden, f"f{fibres}"))
    module = named_module(f"solid.{name}")
    wp.set_module_options({"max_unroll": 1}, module)

    @wp.func(module=module)
    def invariants(first: wp.float64, second: wp.float64, jac: wp.float64) -> wp.vec3d:
        """Returns a, b and j."""
        j = jac - ONE
        return wp.vec3d(first - THREE - TWO * j + j * j, second - THREE - FOUR * j, j)

    @wp.func(module=module)
    def powers(x: wp.float64, m: moduli, start: int, stop: int) -> wp.vec3d:
        """Returns the sum of m_p x^p over p = 1, ..., and its first two derivatives."""
        total = wp.vec3d()
        lower = ZERO  # x^(p - 2)
        for k in range(start, stop):
            p = wp.float64(k - start + 1)
            slope = ONE
            if k > start:
                slope = lower * x
            total[0] += m[k] * slope * x
            total[1] += m[k] * p * slope
            total[2] += m[k] * p * (p - ONE) * lower
            lower = slope
        return total

    @wp.func(module=module)
    def by_volume(j: wp.float64, m: moduli) -> wp.vec3d:
        """Returns the terms in j, and their first two derivatives."""
        linear = ZERO
        quadratic = m[_J] + m[_G2]
        for k in range(terms):
            share = m[_OGDEN + k] / wp.float64(exponents[k])
            if share > ZERO:
                linear -= TWO * share
                quadratic += share
            else:
                linear += FOUR * share
        quartic = m[_G4] * j * j
        slope = TWO * quadratic * j + FOUR * quartic * j
        return wp.vec3d((linear + (quadratic + quartic) * j) * j, linear + slope, TWO * quadratic + TWELVE * quartic)

    @wp.func(module=module)
    def derivatives(first: wp.float64, second: wp.float64, jac: wp.float64, m: moduli):
        """Returns j, and the terms in a, in b and in j with their first two derivatives."""
        k = invariants(first, second, jac)
        return k[2], powers(k[0], m, 0, _B), powers(k[1], m, _B, _J), by_volume(k[2], m)

    @wp.func(module=module)
    def by_stretches(f: wp.mat33d, turn: wp.mat33d, u: wp.mat33d, n: int):
        """Returns 2 / n^2 S_n without its terms in j, and its derivative by F = R U.

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

    @wp.func(module=module)
    def add_by_stretches(s: wp.vec3d, m: moduli, normal: wp.mat33d, flip: wp.vec3d, twist: wp.vec3d):
        """Returns normal, flip and twist of `spectral_blocks` with those of Ogden's terms."""
        for term in range(terms):
            n = wp.abs(exponents[term]) - 1
            scale = TWO * m[_OGDEN + term] / wp.float64(n + 1)
            bent = scale * wp.float64(n)
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                if exponents[term] > 0:
                    normal[i, i] += bent * whole_power(wp.abs(s[i]), n - 1)
                    flip[i] += scale * quotient(s[j], s[k], n)
                    twist[i] += scale * quotient(s[j], -s[k], n)
                else:
                    x, slope = s[j] * s[k], scale * odd_power(s[j] * s[k], n)
                    curvature = bent * whole_power(wp.abs(x), n - 1)
                    normal[j, j] += curvature * s[k] * s[k]
                    normal[k, k] += curvature * s[j] * s[j]
                    normal[j, k] += curvature * x + slope
                    normal[k, j] += curvature * x + slope
                    square = scale * s[i] * s[i]
                    flip[i] += square * quotient(s[i] * s[j], s[i] * s[k], n) - slope
                    twist[i] += square * quotient(s[i] * s[j], -s[i] * s[k], n) + slope
        return normal, flip, twist

    @wp.func(module=module)
    def direction(m: moduli, fibre: int) -> wp.vec3d:
        first = first_fibre + PER_FIBRE * fibre
        return wp.vec3d(m[first], m[first + 1], m[first + 2])

    @wp.func(module=module)
    def along_fibre(q: wp.float64, m: moduli, fibre: int) -> wp.vec3d:
        """Returns the energy of a family and its first two derivatives by q."""
        first = first_fibre + PER_FIBRE * fibre + 3
        if q <= ZERO:
            return m[first + 4] * wp.vec3d(q * q, TWO * q, TWO)
        stretch = wp.sqrt(ONE + q)
        energy, force, slope = muscle_pull(stretch - ONE - m[first], m[first + 1])
        by_q = HALF / stretch * force
        cubic = m[first + 3] * q
        w = wp.vec3d(cubic * q * q, THREE * cubic * q, SIX * cubic)
        return w + m[first + 2] * wp.vec3d(energy, by_q, (HALF * slope - by_q) * HALF / (ONE + q))

    @wp.func(module=module)
    def response(f: wp.mat33d, m: moduli):
        cof = cofactor(f)
        first = wp.ddot(f, f)
        j, by_a, by_b, by_j = derivatives(first, wp.ddot(cof, cof), wp.determinant(f), m)
        energy = by_a[0] + by_b[0] + by_j[0]
        stress = TWO * (by_a[1] + by_b[1] * first) * f - (TWO * by_b[1]) * (f * (wp.transpose(f) * f))
        stress += (TWO * by_a[1] * (j - ONE) - FOUR * by_b[1] + by_j[1]) * cof
        if terms > 0:
            turn, u = unsigned_polar(f)
            for k in range(terms):
                stretched, by_f = by_stretches(f, turn, u, exponents[k])
                energy += m[_OGDEN + k] * stretched
                stress += m[_OGDEN + k] * by_f
        for fibre in range(fibres):
            e = direction(m, fibre)
            c = f * e
            w = along_fibre(wp.dot(c, c) - ONE, m, fibre)
            energy += w[0]
            stress += (TWO * w[1]) * wp.outer(c, e)
        return energy, stress

    @wp.func(module=module)
    def slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, carried: moduli) -> moduli:
        result = moduli()
        cof = cofactor(f)
        first = wp.ddot(f, f)
        invariant = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
        change_j = wp.ddot(cof, df)
        change_a = TWO * wp.ddot(f, df) + TWO * (invariant[2] - ONE) * change_j
        change_b = TWO * (first * wp.ddot(f, df) - wp.ddot(f * (wp.transpose(f) * f), df)) - FOUR * change_j
        power = ONE
        for n in range(0, _B):
            result[n] = wp.float64(n + 1) * power * change_a
            power = power * invariant[0]
        power = ONE
        for n in range(_B, _J):
            result[n] = wp.float64(n - _B + 1) * power * change_b
            power = power * invariant[1]
        result[_J] = TWO * invariant[2] * change_j
        result[_G2] = result[_J]
        result[_G4] = FOUR * invariant[2] * invariant[2] * invariant[2] * change_j
        if terms > 0:
            turn, u = unsigned_polar(f)
            for k in range(terms):
                _energy, by_f = by_stretches(f, turn, u, exponents[k])
                share = TWO / wp.float64(exponents[k])
                by_j = TWO * share
                if exponents[k] > 0:
                    by_j = share * (invariant[2] - ONE)
                result[_OGDEN + k] = wp.ddot(by_f, df) + by_j * change_j
        for fibre in range(fibres):
            e = direction(m, fibre)
            c = f * e
            q = wp.dot(c, c) - ONE
            moved = df * e
            change = TWO * wp.dot(c, moved)
            w = along_fibre(q, m, fibre)
            back = wp.transpose(f) * c
            by_direction = (TWO * w[2] * change) * back + (TWO * w[1]) * (
                wp.transpose(f) * moved + wp.transpose(df) * c
            )
            at = first_fibre + PER_FIBRE * fibre
            result[at] = by_direction[0]
            result[at + 1] = by_direction[1]
            result[at + 2] = by_direction[2]
            taut = wp.max(q, ZERO)
            stretch = wp.sqrt(ONE + taut)
            toe = m[at + 4]
            _energy, force, slope = muscle_pull(stretch - ONE - m[at + 3], toe)
            lengthened = HALF / stretch * change
            t = wp.clamp((stretch - ONE - m[at + 3]) / toe, ZERO, ONE)
            result[at + 3] = -m[at + 5] * slope * lengthened
            result[at + 4] = -m[at + 5] * t * t * t * (TWO - THREE * HALF * t) * lengthened
            result[at + 5] = force * lengthened
            result[at + 6] = THREE * taut * taut * change
            result[at + 7] = TWO * wp.min(q, ZERO) * change
        return result

    @wp.func(module=module)
    def write_isotropic(f: wp.mat33d, m: moduli, out: wp.array[wp.mat33d]):
        """Writes the blocks of dP/dF of the isotropic terms."""
        cof = cofactor(f)
        first = wp.ddot(f, f)
        j, by_a, by_b, by_j = derivatives(first, wp.ddot(cof, cof), wp.determinant(f), m)
        slope = TWO * by_a[1] * (j - ONE) - FOUR * by_b[1] + by_j[1]
        mooney_rivlin.write_tangent(f, by_a[1], by_b[1], slope, TWO * by_a[1] + by_j[2], out)
        columns = wp.transpose(f)
        normals = wp.transpose(cof)
        a = TWO * columns + (TWO * (j - ONE)) * normals  # rows: columns of da/dF
        b = TWO * (first * columns - columns * (f * columns)) - FOUR * normals
        for r in range(3):
            for n in range(r + 1):
                out[(r * (r + 1)) / 2 + n] += by_a[2] * wp.outer(a[r], a[n]) + by_b[2] * wp.outer(b[r], b[n])

    @wp.func(module=module)
    def add_by_rotation(f: wp.mat33d, m: moduli, out: wp.array[wp.mat33d]):
        """Adds those of Ogden's terms of positive exponents, for det F > 0.

        Their stress, without terms in j, is 2 mu_n / n R U^(n - 1): L C^k with C = F^T F, k = (n - 1) // 2, and L = R
        for odd n, F for even ones.
        """
        r = polar_rotation(f)
        back = wp.transpose(f)
        c = back * f
        turn = corotated.turning(f, r)
        for term in range(terms):
            n = exponents[term]
            scale = TWO * m[_OGDEN + term] / wp.float64(n)
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

    @wp.func(module=module)
    def write_principal(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
        """Writes these blocks, and those of Ogden's terms, in the principal frame."""
        u, s, v = signed_svd(f)
        cof = wp.vec3d(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        j, by_a, by_b, by_j = derivatives(wp.dot(s, s), wp.dot(cof, cof), s[0] * cof[0], m)
        slope = TWO * by_a[1] * (j - ONE) - FOUR * by_b[1] + by_j[1]
        normal, flip, twist = mooney_rivlin.principal_tangent(s, by_a[1], by_b[1], slope, TWO * by_a[1] + by_j[2])
        squares = wp.cw_mul(s, s)
        around = wp.vec3d(squares[1] + squares[2], squares[0] + squares[2], squares[0] + squares[1])
        a = TWO * s + (TWO * (j - ONE)) * cof
        b = TWO * wp.cw_mul(s, around) - FOUR * cof
        normal += by_a[2] * wp.outer(a, a) + by_b[2] * wp.outer(b, b)
        normal, flip, twist = add_by_stretches(s, m, normal, flip, twist)
        spectral_blocks(u, v, normal, flip, twist, clamp, out)

    @wp.func(module=module)
    def tangent(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
        if clamp or has_negative or (terms > 0 and wp.determinant(f) < SMALLEST_STRETCH_SUM):
            write_principal(f, m, clamp, out)
        else:
            write_isotropic(f, m, out)
            if terms > 0:
                add_by_rotation(f, m, out)
        for fibre in range(fibres):
            e = direction(m, fibre)
            c = f * e
            length = wp.dot(c, c)
            w = along_fibre(length - ONE, m, fibre)
            across = TWO * w[1]
            along = FOUR * w[2]
            if clamp and across < ZERO:
                along = wp.max(across / wp.max(length, SMALLEST) + along, ZERO)
                across = ZERO
            for r in range(3):
                for n in range(r + 1):
                    block = (along * e[r] * e[n]) * wp.outer(c, c)
                    same = across * e[r] * e[n]
                    block[0, 0] += same
                    block[1, 1] += same
                    block[2, 2] += same
                    out[(r * (r + 1)) / 2 + n] += block

    # Viscosity has moduli of its own, so that the elastic ones contribute nothing to it.
    lame = ((0.0, 0.0),) * ISOTROPIC + ((1.0, 0.0), (0.0, 1.0)) + ((0.0, 0.0),) * (count - _OGDEN)
    return Law(f"solid.{name}", moduli, response, slopes, tangent, lame)
