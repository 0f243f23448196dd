"""The tangent of an isotropic energy from its second derivatives by the singular values of F."""

import functools
from types import SimpleNamespace

import warp as wp

from .matrices import matrix_functions
from .modules import decorators

SMALLEST_STRETCH_SUM = 1.0e-3  # below it, a tangent divides by this


@functools.cache
def spectral_functions(scalar: type) -> SimpleNamespace:
    """The ``wp.func`` for one scalar type (``wp.float64`` or ``wp.float32``)."""
    _, function = decorators(scalar)
    functions = matrix_functions(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    zero, half = scalar(0.0), scalar(0.5)

    # In the frame of the SVD F = U diag(s) V^T, with dF' = U^T dF V, the tangent of an isotropic energy is
    #   dP'_ij = direct_ij dF'_ij + cross_ij dF'_ji            (i != j)
    #   dP'_ii = direct_ii dF'_ii + sum_{k != i} normal_ik dF'_kk
    # with direct = (flip + twist) / 2 and cross = (flip - twist) / 2 off the diagonal, where flip and twist are the
    # eigenvalues (sigma_i - sigma_j) / (s_i - s_j) and (sigma_i + sigma_j) / (s_i + s_j) of the symmetric and skew
    # pairs (Smith, de Goes, Kim 2019), written so that equal singular values do not divide by zero.
    @function
    def spectral_blocks(
        u: mat33, v: mat33, normal: mat33, flip: vec3, twist: vec3, positive: int, out: wp.array[mat33]
    ):
        """The six blocks; with `positive`, of the nearest tangent without negative eigenvalues.

        `flip` and `twist` are numbered by the axis that their pair leaves out.
        """
        if positive == 1:
            q, e = wp.eig3(normal)
            clamped = wp.diag(vec3(wp.max(e[0], zero), wp.max(e[1], zero), wp.max(e[2], zero)))
            normal = q * clamped * wp.transpose(q)
            for k in range(3):
                flip[k] = wp.max(flip[k], zero)
                twist[k] = wp.max(twist[k], zero)
        direct = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        cross = direct
        for i in range(3):
            direct[i, i] = normal[i, i]
            for j in range(3):
                if i != j:
                    axis = 3 - i - j
                    direct[i, j] = half * (flip[axis] + twist[axis])
                    cross[i, j] = half * (flip[axis] - twist[axis])
        for k in range(3):
            for n in range(k + 1):
                # A unit change of column n of F along u_j is e_j v_n^T in the frame, v_n being row n of V.
                diagonal = direct * wp.cw_mul(v[k], v[n])
                block = wp.cw_mul(normal, wp.outer(v[k], v[n])) + wp.cw_mul(cross, wp.outer(v[n], v[k]))
                block[0, 0] = diagonal[0]
                block[1, 1] = diagonal[1]
                block[2, 2] = diagonal[2]
                out[(k * (k + 1)) / 2 + n] = u * block * wp.transpose(u)

    return SimpleNamespace(spectral_blocks=spectral_blocks)
