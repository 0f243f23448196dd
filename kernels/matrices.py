"""Functions of one 3x3 matrix: cofactor, polar rotation, nearest unimodular matrix, signed SVD."""

import warp as wp

# Squared norm of the last update at which an iteration has converged to rounding; Newton's converges quadratically.
UPDATE_TOLERANCE, NEWTON_TOLERANCE = wp.float64(1.0e-30), wp.float64(1.0e-16)
SINGULAR, NEARLY_A_LINE = wp.float64(1.0e-12), wp.float64(1.0e-3)
ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)


@wp.func
def cofactor(a: wp.mat33d) -> wp.mat33d:
    """Derivative of the determinant: det(A) A^-T, also where A is singular."""
    return wp.mat33d(
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


@wp.func
def signed_svd(f: wp.mat33d):
    """F = U diag(s) V^T with det U = det V = 1; the smallest s carries the sign of det F."""
    u, s, v = wp.svd3(f)
    if wp.determinant(u) < ZERO:
        u = wp.mat33d(u[0, 0], u[0, 1], -u[0, 2], u[1, 0], u[1, 1], -u[1, 2], u[2, 0], u[2, 1], -u[2, 2])
        s = wp.vec3d(s[0], s[1], -s[2])
    if wp.determinant(v) < ZERO:
        v = wp.mat33d(v[0, 0], v[0, 1], -v[0, 2], v[1, 0], v[1, 1], -v[1, 2], v[2, 0], v[2, 1], -v[2, 2])
        s = wp.vec3d(s[0], s[1], -s[2])
    return u, s, v


@wp.func
def polar_rotation(f: wp.mat33d) -> wp.mat33d:
    """Rotation of the polar decomposition, det R = 1.

    Newton's iteration R <- (R + R^-T) / 2 (Higham 1986) from R = F; the signed SVD where F is inverted or so flat that
    the iteration does not converge.
    """
    r = f
    update = ONE
    if wp.determinant(f) > SINGULAR:
        for _ in range(20):
            c = cofactor(r)
            determinant = r[0, 0] * c[0, 0] + r[0, 1] * c[0, 1] + r[0, 2] * c[0, 2]
            step = (HALF / determinant) * c - HALF * r
            r += step
            update = wp.ddot(step, step)
            if update < NEWTON_TOLERANCE:
                break
    if not (update < NEWTON_TOLERANCE):
        u, _s, v = signed_svd(f)
        r = u * wp.transpose(v)
    return r


@wp.func
def nearest_unimodular(f: wp.mat33d) -> wp.mat33d:
    """The matrix D with det D = 1 that minimises ||F - D||.

    Successive projection of F on the tangent plane of {det D = 1} at the last D: at convergence F - D is normal to that
    surface, which is the stationarity condition (Bouaziz et al. 2014, section 5.2). The start is F, or the rotation of
    F if F is nearly a line or a point and its own tangent plane is undefined. For an inverted F the result may be
    another stationary point.
    """
    d = f
    c = cofactor(f)
    if wp.ddot(c, c) < NEARLY_A_LINE:
        d = polar_rotation(f)
    for _ in range(60):
        c = cofactor(d)
        offset = wp.ddot(c, d - f) - (wp.ddot(c, d) / wp.float64(3.0) - ONE)
        step = (f - d) + (offset / (wp.ddot(c, c) + SINGULAR)) * c
        d += step
        update = wp.ddot(step, step)
        if update < UPDATE_TOLERANCE:
            break
    return d
