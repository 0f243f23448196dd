"""A sum of terms with non-negative coefficients: powers of polyconvex invariants,
Ogden's terms, and fibres.

    W = sum_p c_p a^p + sum_p d_p b^p + e j^2 + sum_n 2 mu_n / n^2 S_n
        + sum_f (k_f s(l_f - 1 - slack_f) + k_3 <q_f>^3 + k_c <-q_f>^2)
    U = g_2 j^2 + g_4 j^4

with j = J - 1, a = I1 - 3 - 2 j + j^2, b = I2 - 3 - 4 j, l_f = |F e_f| the stretch of fibres along
unit vectors e_f, q_f = l_f^2 - 1, and <x> = max(x, 0). With the singular values s_i of F and a
whole number n, at least 3 or at most -3,

    S_n = sum_i s_i^n - 3 - n j + n / 2 j^2           for n > 0,
          sum_{i < k} (s_i s_k)^-n - 3 + 2 n j        for n < 0

(Ogden, Proceedings of the Royal Society A 326, 1972: for J = 1 they are his).
s(x) = max(x, 0)^2 / 2 is smoothed over a toe (`kernels.axial.muscle_pull`); its strain is less by
the slack, as fibres are wavy. W is integrated at the points of the shape rule, U at those of the
volume rule.

All terms and their derivatives vanish at rest, and stay finite where elements invert. a, l_f, and
S_n for n > 0, are convex in (F, J), b and the other S_n in (cof F, J). a, b and l_f are not
negative, so that their powers are convex too, and every combination with non-negative coefficients
is polyconvex (Ball, Archive for Rational Mechanics and Analysis 63, 1976). The exception is the
compression of fibres, <-q_f>^2. At small strains mu is 2 (c_1 + d_1) + sum_n mu_n, and lambda,
without fibres, 2 (e + g_2), and 2 (1 + 2 / n) mu_n more for each negative n.

The moduli named unit_shear and unit_bulk, of value one, carry the volumes of viscosity alone: its
coefficients are viscosities and moduli of branches, not ratios to the elastic ones.
"""

from typing import Any

import warp as wp

from ..constants import FOUR, ONE, THREE, TWELVE, TWO, ZERO
from ..laws import Law
from ..matrices import SMALLEST_STRETCH_SUM, cofactor, polar_rotation, signed_svd, spectral_blocks
from ..modules import generated, named_module
from . import corotated, mooney_rivlin, ogden
from .fibre_families import Family, add_fibre_tangent, fibre_response, fibre_slopes

POWERS_OF_A, POWERS_OF_B = 3, 2
_B, _J = POWERS_OF_A, POWERS_OF_A + POWERS_OF_B
_G2, _G4 = _J + 1, _J + 2
ISOTROPIC = _J + 3  # number of coefficients of invariants
_OGDEN = ISOTROPIC + 2  # index of the first of Ogden's moduli

coefficients = wp.types.vector(ISOTROPIC, wp.float64)


@wp.func
def invariants(first: wp.float64, second: wp.float64, jac: wp.float64) -> wp.vec3d:
    """Returns a, b and j."""
    j = jac - ONE
    return wp.vec3d(first - THREE - TWO * j + j * j, second - THREE - FOUR * j, j)


@wp.func
def powers(x: wp.float64, m: Any, start: int, stop: int) -> wp.vec3d:
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


@wp.func
def by_volume(j: wp.float64, m: Any, exponents: Any, terms: int) -> wp.vec3d:
    """Returns the terms in j, also those of Ogden's, and their first two derivatives."""
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
    return wp.vec3d(
        (linear + (quadratic + quartic) * j) * j, linear + slope, TWO * quadratic + TWELVE * quartic
    )


@wp.func
def invariant_response(f: wp.mat33d, m: Any, exponents: Any, terms: int):
    """Returns energy and stress of the terms in invariants."""
    cof = cofactor(f)
    first = wp.ddot(f, f)
    k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
    by_a = powers(k[0], m, 0, _B)
    by_b = powers(k[1], m, _B, _J)
    by_j = by_volume(k[2], m, exponents, terms)
    stress = TWO * (by_a[1] + by_b[1] * first) * f - (TWO * by_b[1]) * (f * (wp.transpose(f) * f))
    stress += (TWO * by_a[1] * (k[2] - ONE) - FOUR * by_b[1] + by_j[1]) * cof
    return by_a[0] + by_b[0] + by_j[0], stress


@wp.func
def invariant_slopes(f: wp.mat33d, df: wp.mat33d) -> coefficients:
    """Returns the derivatives of the stress of terms in invariants : dF by their coefficients."""
    cof = cofactor(f)
    first = wp.ddot(f, f)
    k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
    j, change_j = k[2], wp.ddot(cof, df)
    change_a = TWO * wp.ddot(f, df) + TWO * (j - ONE) * change_j
    change_b = (
        TWO * (first * wp.ddot(f, df) - wp.ddot(f * (wp.transpose(f) * f), df)) - FOUR * change_j
    )
    result = coefficients()
    power = ONE
    for n in range(0, _B):
        result[n] = wp.float64(n + 1) * power * change_a
        power = power * k[0]
    power = ONE
    for n in range(_B, _J):
        result[n] = wp.float64(n - _B + 1) * power * change_b
        power = power * k[1]
    result[_J] = TWO * j * change_j
    result[_G2] = result[_J]
    result[_G4] = FOUR * j * j * j * change_j
    return result


@wp.func
def write_invariant_tangent(
    f: wp.mat33d, m: Any, exponents: Any, terms: int, out: wp.array[wp.mat33d]
):
    """Writes the blocks of dP/dF of the terms in invariants."""
    cof = cofactor(f)
    first = wp.ddot(f, f)
    k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
    by_a = powers(k[0], m, 0, _B)
    by_b = powers(k[1], m, _B, _J)
    by_j = by_volume(k[2], m, exponents, terms)
    slope = TWO * by_a[1] * (k[2] - ONE) - FOUR * by_b[1] + by_j[1]
    mooney_rivlin.write_tangent(f, by_a[1], by_b[1], slope, TWO * by_a[1] + by_j[2], out)
    columns = wp.transpose(f)
    normals = wp.transpose(cof)
    a = TWO * columns + (TWO * (k[2] - ONE)) * normals  # rows: columns of da/dF
    b = TWO * (first * columns - columns * (f * columns)) - FOUR * normals
    for r in range(3):
        for n in range(r + 1):
            out[(r * (r + 1)) / 2 + n] += by_a[2] * wp.outer(a[r], a[n]) + by_b[2] * wp.outer(
                b[r], b[n]
            )


@wp.func
def principal_tangent(s: wp.vec3d, m: Any, exponents: Any, terms: int):
    """Returns normal, flip and twist of `spectral_blocks` for signed singular values."""
    cof = wp.vec3d(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    k = invariants(wp.dot(s, s), wp.dot(cof, cof), s[0] * cof[0])
    by_a = powers(k[0], m, 0, _B)
    by_b = powers(k[1], m, _B, _J)
    by_j = by_volume(k[2], m, exponents, terms)
    slope = TWO * by_a[1] * (k[2] - ONE) - FOUR * by_b[1] + by_j[1]
    normal, flip, twist = mooney_rivlin.principal_tangent(
        s, by_a[1], by_b[1], slope, TWO * by_a[1] + by_j[2]
    )
    squares = wp.cw_mul(s, s)
    around = wp.vec3d(squares[1] + squares[2], squares[0] + squares[2], squares[0] + squares[1])
    a = TWO * s + (TWO * (k[2] - ONE)) * cof
    b = TWO * wp.cw_mul(s, around) - FOUR * cof
    normal += by_a[2] * wp.outer(a, a) + by_b[2] * wp.outer(b, b)
    for term in range(terms):
        normal, flip, twist = ogden.with_term(
            exponents[term], m[_OGDEN + term], s, normal, flip, twist
        )
    return normal, flip, twist


@wp.func
def family(m: Any, first: int) -> Family:
    """Returns the moduli of a family of fibres from the first one on."""
    out = Family()
    for k in range(8):
        out[k] = m[first + k]
    return out


@generated
def convex_law(ogdens: tuple[int, ...], fibres: int) -> Law:
    """Returns the law with Ogden's terms of some exponents, and a number of families of fibres.

    Its moduli are c_1 to c_3, d_1, d_2, e, g_2, g_4, unit_shear, unit_bulk, mu_n of each of Ogden's
    terms, and e_f (3 components), slack, toe, k_f, k_3 and k_c of each family.
    """
    terms, negative = len(ogdens), min(ogdens, default=1) < 0
    exponents = wp.types.vector(max(terms, 1), wp.int32)(*(ogdens or (0,)))
    first_fibre = _OGDEN + terms
    count = first_fibre + Family._length_ * fibres
    moduli = wp.types.vector(count, wp.float64)
    name = ".".join(
        str(part).replace("-", "m") for part in ("solid", "convex", *ogdens, f"f{fibres}")
    )
    module = named_module(name)
    wp.set_module_options({"max_unroll": 1}, module)

    @wp.func(module=module)
    def response(f: wp.mat33d, m: moduli):
        energy, stress = invariant_response(f, m, exponents, terms)
        if terms > 0:
            turn, u = ogden.unsigned_polar(f)
            for k in range(terms):
                stretched, by_f = ogden.term(f, turn, u, exponents[k])
                energy += m[_OGDEN + k] * stretched
                stress += m[_OGDEN + k] * by_f
        for fibre in range(fibres):
            along, pull = fibre_response(f, family(m, first_fibre + 8 * fibre))
            energy += along
            stress += pull
        return energy, stress

    @wp.func(module=module)
    def tangent(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
        if clamp or negative or (terms > 0 and wp.determinant(f) < SMALLEST_STRETCH_SUM):
            u, s, v = signed_svd(f)
            normal, flip, twist = principal_tangent(s, m, exponents, terms)
            spectral_blocks(u, v, normal, flip, twist, clamp, out)
        else:
            write_invariant_tangent(f, m, exponents, terms, out)
            if terms > 0:
                r = polar_rotation(f)
                turn = corotated.turning(f, r)
                for k in range(terms):
                    ogden.add_tangent(f, r, turn, exponents[k], m[_OGDEN + k], out)
        for fibre in range(fibres):
            add_fibre_tangent(f, family(m, first_fibre + 8 * fibre), clamp, out)

    slopes = _slopes(moduli, module, exponents, terms, fibres)
    # Viscosity has moduli of its own, so that the elastic ones contribute nothing to it.
    lame = ((0.0, 0.0),) * ISOTROPIC + ((1.0, 0.0), (0.0, 1.0)) + ((0.0, 0.0),) * (count - _OGDEN)
    return Law(name, moduli, response, slopes, tangent, lame)


def _slopes(moduli: Any, module: wp.Module, exponents: Any, terms: int, fibres: int) -> Any:
    """Returns the function for derivatives by the moduli (`Law`)."""
    first_fibre = _OGDEN + terms

    @wp.func(module=module)
    def slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, carried: moduli) -> moduli:
        result = moduli()
        by_invariants = invariant_slopes(f, df)
        for k in range(ISOTROPIC):
            result[k] = by_invariants[k]
        if terms > 0:
            turn, u = ogden.unsigned_polar(f)
            jac, change = wp.determinant(f), wp.ddot(cofactor(f), df)
            for k in range(terms):
                _energy, by_f = ogden.term(f, turn, u, exponents[k])
                share = TWO / wp.float64(exponents[k])
                by_j = TWO * share
                if exponents[k] > 0:
                    by_j = share * (jac - TWO)
                result[_OGDEN + k] = wp.ddot(by_f, df) + by_j * change
        for fibre in range(fibres):
            at = first_fibre + 8 * fibre
            by_fibres = fibre_slopes(f, df, family(m, at))
            for k in range(8):
                result[at + k] = by_fibres[k]
        return result

    return slopes
