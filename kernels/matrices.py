"""Functions of one 3x3 matrix: cofactor, polar rotation, nearest unimodular matrix, signed SVD."""

import functools
from types import SimpleNamespace

import warp as wp

from .modules import decorators


@functools.cache
def matrix_functions(scalar: type) -> SimpleNamespace:
    """The ``wp.func``s for one scalar type (``wp.float64`` or ``wp.float32``)."""
    _, function = decorators(scalar)
    mat33 = wp.types.matrix((3, 3), scalar)
    vec3 = wp.types.vector(3, scalar)
    # Squared size of the last update at which an iteration has converged to rounding: Newton's squares its error.
    update_tolerance = scalar(1.0e-30 if scalar is wp.float64 else 1.0e-13)
    newton_tolerance = scalar(1.0e-16 if scalar is wp.float64 else 1.0e-8)
    singular = scalar(1.0e-12 if scalar is wp.float64 else 1.0e-6)
    nearly_a_line = scalar(1.0e-3)
    zero = scalar(0.0)
    half = scalar(0.5)
    one = scalar(1.0)

    @function
    def cofactor(a: mat33) -> mat33:
        """Derivative of the determinant: det(A) A^-T, also where A is singular."""
        return mat33(
            a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1],
            a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2],
            a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0],
            a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2],
            a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0],
            a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1],
            a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1],
            a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2],
            a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0],
        )

    @function
    def signed_svd(f: mat33):
        """F = U diag(s) V^T with det U = det V = 1; the smallest s carries the sign of det F."""
        u, s, v = wp.svd3(f)
        if wp.determinant(u) < zero:
            u = mat33(u[0, 0], u[0, 1], -u[0, 2], u[1, 0], u[1, 1], -u[1, 2], u[2, 0], u[2, 1], -u[2, 2])
            s = vec3(s[0], s[1], -s[2])
        if wp.determinant(v) < zero:
            v = mat33(v[0, 0], v[0, 1], -v[0, 2], v[1, 0], v[1, 1], -v[1, 2], v[2, 0], v[2, 1], -v[2, 2])
            s = vec3(s[0], s[1], -s[2])
        return u, s, v

    @function
    def polar_rotation(f: mat33) -> mat33:
        """Rotation of the polar decomposition, det R = 1.

        Newton's iteration R <- (R + R^-T) / 2 (Higham 1986) from R = F; the signed SVD where F is inverted, and
        where it is so flat that the iteration would not settle.
        """
        r = f
        update = one
        if wp.determinant(f) > singular:
            for _ in range(20):
                c = cofactor(r)
                following = half * r + (scalar(1.5) / wp.ddot(c, r)) * c
                update = wp.ddot(following - r, following - r)
                r = following
                if update < newton_tolerance:
                    break
        if not (update < newton_tolerance):
            u, _s, v = signed_svd(f)
            r = u * wp.transpose(v)
        return r

    @function
    def nearest_unimodular(f: mat33) -> mat33:
        """The matrix D with det D = 1 that minimises ||F - D||.

        Successive projection of F on the tangent plane of {det D = 1} at the last D: at convergence F - D is normal
        to that surface, which is the stationarity condition (Bouaziz et al. 2014, section 5.2). It starts from F, or
        from F's rotation where F is so close to a line or a point that its own tangent plane is lost. From an F that
        is turned inside out as a whole it may end on another stationary point.
        """
        d = f
        c = cofactor(f)
        if wp.ddot(c, c) < nearly_a_line:
            d = polar_rotation(f)
        for _ in range(60):
            c = cofactor(d)
            offset = wp.ddot(c, d - f) - (wp.ddot(c, d) / scalar(3.0) - one)
            following = f + (offset / (wp.ddot(c, c) + singular)) * c
            update = wp.ddot(following - d, following - d)
            d = following
            if update < update_tolerance:
                break
        return d

    return SimpleNamespace(
        mat33=mat33,
        vec3=vec3,
        cofactor=cofactor,
        signed_svd=signed_svd,
        polar_rotation=polar_rotation,
        nearest_unimodular=nearest_unimodular,
    )
