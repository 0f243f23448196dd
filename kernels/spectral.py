"""Tangent of an isotropic energy from its second derivatives by the singular values of F."""

import warp as wp

from .matrices import symmetric_eigen

SMALLEST_STRETCH_SUM = wp.float64(1.0e-3)  # lower bound of sums of stretches in denominators
ZERO, HALF = wp.float64(0.0), wp.float64(0.5)


# In the frame of the SVD F = U diag(s) V^T, with dF' = U^T dF V, the tangent of an isotropic energy is
#   dP'_ij = direct_ij dF'_ij + cross_ij dF'_ji            (i != j)
#   dP'_ii = direct_ii dF'_ii + sum_{k != i} normal_ik dF'_kk
# with direct = (flip + twist) / 2 and cross = (flip - twist) / 2 off the diagonal, where flip and twist are the
# eigenvalues (sigma_i - sigma_j) / (s_i - s_j) and (sigma_i + sigma_j) / (s_i + s_j) of the symmetric and skew
# pairs (Smith, de Goes, Kim 2019), written so that equal singular values do not divide by zero.
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
    """Writes the six blocks, with `clamp` those of the nearest tangent without negative eigenvalues.

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
            # A unit change of column n of F along u_j is e_j v_n^T in the frame, v_n being row n of V.
            diagonal = direct * wp.cw_mul(v[k], v[n])
            block = wp.cw_mul(normal, wp.outer(v[k], v[n])) + wp.cw_mul(cross, wp.outer(v[n], v[k]))
            block[0, 0] = diagonal[0]
            block[1, 1] = diagonal[1]
            block[2, 2] = diagonal[2]
            out[(k * (k + 1)) / 2 + n] = u * block * wp.transpose(u)
