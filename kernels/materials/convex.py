"""A sum of terms with non-negative coefficients: powers of polyconvex invariants, and families of fibres.

    W = sum_p c_p a^p + sum_p d_p b^p + e j^2 + sum_f (k_2 <q_f>^2 + k_3 <q_f>^3 + k_c <-q_f>^2)
    U = g_2 j^2 + g_4 j^4

with j = J - 1, a = I1 - 3 - 2 j + j^2, b = I2 - 3 - 4 j, and q_f = |F e_f|^2 - 1 of fibres along unit vectors e_f.
W is integrated at the points of the shape rule, U at those of the volume rule; <x> = max(x, 0).

All terms and their derivatives vanish at rest, and stay finite where elements invert. a is convex in (F, J), b in
(cof F, J), both are non-negative, and q_f is convex in F; so their powers, and every combination with non-negative
coefficients, are polyconvex (Ball, Archive for Rational Mechanics and Analysis 63, 1976). The exception is the
compression of fibres, <-q_f>^2. At small strains mu is 2 (c_1 + d_1), and lambda is 2 (e + g_2) without fibres.
"""

import functools

import warp as wp

from ..matrices import cofactor, signed_svd
from ..modules import named_module
from ..spectral import spectral_blocks
from . import mooney_rivlin
from .density import Law

POWERS_OF_A, POWERS_OF_B = 3, 2
_B, _J = POWERS_OF_A, POWERS_OF_A + POWERS_OF_B
_G2, _G4 = _J + 1, _J + 2
ISOTROPIC = _J + 3  # number of isotropic coefficients
PER_FIBRE = 6  # e_f, k_2, k_3 and k_c
ZERO, ONE, TWO, FOUR = wp.float64(0.0), wp.float64(1.0), wp.float64(2.0), wp.float64(4.0)
THREE, SIX, TWELVE = wp.float64(3.0), wp.float64(6.0), wp.float64(12.0)
SMALLEST = wp.float64(1.0e-12)  # lower bound of a squared length in a denominator


@functools.cache
def convex_law(fibres: int) -> Law:
    """Returns the law with a number of families of fibres.

    Its moduli are c_1 to c_3, d_1, d_2, e, g_2, g_4, and e_f (3 components), k_2, k_3 and k_c of each family.
    """
    count = ISOTROPIC + PER_FIBRE * fibres
    moduli = wp.types.vector(count, wp.float64)
    name = f"convex.{fibres}"
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
        square = (m[_J] + m[_G2]) * j
        quartic = m[_G4] * j * j
        return wp.vec3d(
            (square + quartic * j) * j, TWO * square + FOUR * quartic * j, TWO * (m[_J] + m[_G2]) + TWELVE * quartic
        )

    @wp.func(module=module)
    def derivatives(first: wp.float64, second: wp.float64, jac: wp.float64, m: moduli):
        """Returns j, and the terms in a, in b and in j with their first two derivatives."""
        k = invariants(first, second, jac)
        return k[2], powers(k[0], m, 0, _B), powers(k[1], m, _B, _J), by_volume(k[2], m)

    @wp.func(module=module)
    def direction(m: moduli, fibre: int) -> wp.vec3d:
        first = ISOTROPIC + PER_FIBRE * fibre
        return wp.vec3d(m[first], m[first + 1], m[first + 2])

    @wp.func(module=module)
    def along_fibre(q: wp.float64, m: moduli, fibre: int) -> wp.vec3d:
        """Returns the energy of a family and its first two derivatives by q."""
        first = ISOTROPIC + PER_FIBRE * fibre + 3
        if q <= ZERO:
            return m[first + 2] * wp.vec3d(q * q, TWO * q, TWO)
        square = m[first]
        cubic = m[first + 1] * q
        return wp.vec3d((square + cubic) * q * q, (TWO * square + THREE * cubic) * q, TWO * square + SIX * cubic)

    @wp.func(module=module)
    def response(f: wp.mat33d, m: moduli):
        cof = cofactor(f)
        first = wp.ddot(f, f)
        j, by_a, by_b, by_j = derivatives(first, wp.ddot(cof, cof), wp.determinant(f), m)
        energy = by_a[0] + by_b[0] + by_j[0]
        stress = TWO * (by_a[1] + by_b[1] * first) * f - (TWO * by_b[1]) * (f * (wp.transpose(f) * f))
        stress += (TWO * by_a[1] * (j - ONE) - FOUR * by_b[1] + by_j[1]) * cof
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
        k = invariants(first, wp.ddot(cof, cof), wp.determinant(f))
        change_j = wp.ddot(cof, df)
        change_a = TWO * wp.ddot(f, df) + TWO * (k[2] - ONE) * change_j
        change_b = TWO * (first * wp.ddot(f, df) - wp.ddot(f * (wp.transpose(f) * f), df)) - FOUR * change_j
        power = ONE
        for n in range(0, _B):
            result[n] = wp.float64(n + 1) * power * change_a
            power = power * k[0]
        power = ONE
        for n in range(_B, _J):
            result[n] = wp.float64(n - _B + 1) * power * change_b
            power = power * k[1]
        result[_J] = TWO * k[2] * change_j
        result[_G2] = result[_J]
        result[_G4] = FOUR * k[2] * k[2] * k[2] * change_j
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
            at = ISOTROPIC + PER_FIBRE * fibre
            result[at] = by_direction[0]
            result[at + 1] = by_direction[1]
            result[at + 2] = by_direction[2]
            pull = wp.max(q, ZERO)
            result[at + 3] = TWO * pull * change
            result[at + 4] = THREE * pull * pull * change
            result[at + 5] = TWO * wp.min(q, ZERO) * change
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
    def write_clamped(f: wp.mat33d, m: moduli, out: wp.array[wp.mat33d]):
        """Writes these blocks without negative eigenvalues."""
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
        spectral_blocks(u, v, normal, flip, twist, True, out)

    @wp.func(module=module)
    def tangent(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
        if clamp:
            write_clamped(f, m, out)
        else:
            write_isotropic(f, m, out)
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

    both = [(2.0, 0.0), *((0.0, 0.0),) * (POWERS_OF_A - 1), (2.0, 0.0), *((0.0, 0.0),) * (POWERS_OF_B - 1)]
    lame = (*both, (0.0, 2.0), (0.0, 2.0), (0.0, 0.0), *((0.0, 0.0),) * (PER_FIBRE * fibres))
    return Law(name, lame, moduli, response, slopes, tangent)
