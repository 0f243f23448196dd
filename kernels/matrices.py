"""Functions of one 3x3 matrix: cofactor, polar rotation,
signed SVD, and the tangent of an isotropic energy.
"""

import warp as wp

from .constants import HALF, ONE, ZERO

# Squared norms of the last update at which an iteration has converged to rounding: Newton's is of
# second order, Halley's of third.
NEWTON_TOLERANCE, HALLEY_TOLERANCE = wp.float64(1.0e-16), wp.float64(1.0e-11)
HALLEY_ITERATIONS = 12
# Of F^T F, up to which invariants give rotations as exact as iterations of matrices do.
LARGEST_TRACE = wp.float64(12.0)
SMALLEST_STRETCH_SUM = wp.float64(1.0e-3)  # lower bound of sums of stretches in denominators
SINGULAR, ROUNDING = wp.float64(1.0e-12), wp.float64(1.0e-32)


@wp.func
def cofactor(a: wp.mat33d) -> wp.mat33d:
    """Returns the derivative of the determinant, det(A) A^-T, also where A is singular."""
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
def annul(
    p: wp.float64,
    q: wp.float64,
    pq: wp.float64,
    rp: wp.float64,
    rq: wp.float64,
    vp: wp.vec3d,
    vq: wp.vec3d,
):
    """Applies Jacobi's rotation of axes p and q that makes the entry pq of a symmetric matrix zero.

    Returns the entries pp, qq, rp and rq, with r the third axis, and the vectors of the two axes.
    """
    t = ZERO
    if pq * pq > ZERO:
        half = HALF * (q - p)
        t = pq / (half + wp.where(half < ZERO, -ONE, ONE) * wp.sqrt(half * half + pq * pq))
    c = ONE / wp.sqrt(ONE + t * t)
    s = t * c
    return (
        p - t * pq,
        q + t * pq,
        c * rp - s * rq,
        s * rp + c * rq,
        c * vp - s * vq,
        s * vp + c * vq,
    )


@wp.func
def symmetric_eigen(a: wp.mat33d):
    """Returns V, det V = 1, and e of A = V diag(e) V^T,
    in no order (Golub and Van Loan 2013, section 8.5).
    """
    x, y, z, xy, xz, yz = a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2]
    i, j, k = wp.vec3d(ONE, ZERO, ZERO), wp.vec3d(ZERO, ONE, ZERO), wp.vec3d(ZERO, ZERO, ONE)
    small = ROUNDING * wp.ddot(a, a)
    for _ in range(10):
        if xy * xy + xz * xz + yz * yz <= small:
            break
        x, y, xz, yz, i, j = annul(x, y, xy, xz, yz, i, j)
        x, z, xy, yz, i, k = annul(x, z, xz, ZERO, yz, i, k)
        y, z, xy, xz, j, k = annul(y, z, yz, xy, ZERO, j, k)
        yz = ZERO
    return wp.matrix_from_cols(i, j, k), wp.vec3d(x, y, z)


@wp.func
def general_svd(f: wp.mat33d):
    """Returns U, s and V of F = U diag(s) V^T, det U = det V = 1.

    The smallest s carries the sign of det F.
    """
    u, s, v = wp.svd3(f)
    if wp.determinant(u) < ZERO:
        u = wp.mat33d(
            u[0, 0], u[0, 1], -u[0, 2], u[1, 0], u[1, 1], -u[1, 2], u[2, 0], u[2, 1], -u[2, 2]
        )
        s = wp.vec3d(s[0], s[1], -s[2])
    if wp.determinant(v) < ZERO:
        v = wp.mat33d(
            v[0, 0], v[0, 1], -v[0, 2], v[1, 0], v[1, 1], -v[1, 2], v[2, 0], v[2, 1], -v[2, 2]
        )
        s = wp.vec3d(s[0], s[1], -s[2])
    return u, s, v


@wp.func
def newton_rotation(f: wp.mat33d):
    """Returns R by Newton's iteration R <- (R + R^-T) / 2 from R = F (Higham 1986),
    and whether it converged.

    It does not where F is inverted or too flat.
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
    return r, update < NEWTON_TOLERANCE


@wp.func
def polar_rotation(f: wp.mat33d) -> wp.mat33d:
    """Returns the rotation of the polar decomposition, det R = 1."""
    r, converged = newton_rotation(f)
    if not converged:
        u, _s, v = general_svd(f)
        r = u * wp.transpose(v)
    return r


@wp.func
def signed_svd(f: wp.mat33d):
    """Returns U, s and V of F = U diag(s) V^T, det U = det V = 1.

    If det F < 0, the last and smallest s is negative.

    By the eigenvectors of the symmetric factor of F = R S, in half the time of a general one.
    """
    r, converged = newton_rotation(f)
    if not converged:
        u, s, v = general_svd(f)
        return u, s, v
    stretch = wp.transpose(r) * f
    v, s = symmetric_eigen(HALF * (stretch + wp.transpose(stretch)))
    return r * v, s, v


# In the frame of the SVD F = U diag(s) V^T, with dF' = U^T dF V, the tangent of an isotropic energy
# is
#   dP'_ij = direct_ij dF'_ij + cross_ij dF'_ji            (i != j)
#   dP'_ii = direct_ii dF'_ii + sum_{k != i} normal_ik dF'_kk
# with direct = (flip + twist) / 2 and cross = (flip - twist) / 2 off the diagonal, where flip and
# twist are the eigenvalues (sigma_i - sigma_j) / (s_i - s_j) and (sigma_i + sigma_j) / (s_i + s_j)
# of the symmetric and skew pairs (Smith, de Goes, Kim 2019), written so that equal singular values
# do not divide by zero.
@wp.func
def spectral_blocks(
    u: wp.mat33d,
    v: wp.mat33d,
    normal: wp.mat33d,
    flip: wp.vec3d,
    twist: wp.vec3d,
    clamp: bool,
    out: wp.array[wp.mat33d],
):
    """Writes the six blocks, with `clamp` those of the nearest tangent
    without negative eigenvalues.

    The index of `flip` and `twist` is the axis that is not in their pair.
    """
    if clamp:
        q, e = symmetric_eigen(normal)
        clamped = wp.diag(wp.vec3d(wp.max(e[0], ZERO), wp.max(e[1], ZERO), wp.max(e[2], ZERO)))
        normal = q * clamped * wp.transpose(q)
        for k in range(3):
            flip[k] = wp.max(flip[k], ZERO)
            twist[k] = wp.max(twist[k], ZERO)
    direct = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    cross = direct
    for i in range(3):
        direct[i, i] = normal[i, i]
        for j in range(3):
            if i != j:
                axis = 3 - i - j
                direct[i, j] = HALF * (flip[axis] + twist[axis])
                cross[i, j] = HALF * (flip[axis] - twist[axis])
    for k in range(3):
        for n in range(k + 1):
            # A unit change of column n of F along u_j is e_j v_n^T in the frame, v_n being row n of
            # V.
            diagonal = direct * wp.cw_mul(v[k], v[n])
            block = wp.cw_mul(normal, wp.outer(v[k], v[n])) + wp.cw_mul(cross, wp.outer(v[n], v[k]))
            block[0, 0] = diagonal[0]
            block[1, 1] = diagonal[1]
            block[2, 2] = diagonal[2]
            out[(k * (k + 1)) / 2 + n] = u * block * wp.transpose(u)
