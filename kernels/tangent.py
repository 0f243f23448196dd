"""The tangent dP/dF of every point, as six 3x3 blocks, and its product with a displacement.

Block (k, n) is the derivative of column k of the stress by column n of the deformation gradient, (n, k) its transpose.
The stiffness between two nodes with gradients g and g' is the sum of g_k g'_n (k, n), without regard to the material.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .elasticity import COROTATED, elasticity_kernels
from .matrices import matrix_functions


@functools.cache
def tangent_kernels(scalar: type) -> SimpleNamespace:
    """Kernels of second derivatives for one scalar type (``wp.float64`` or ``wp.float32``)."""
    module = f"warp_resphys.{scalar.__name__}"
    kernel = functools.partial(wp.kernel, module=module, enable_backward=False)
    function = functools.partial(wp.func, module=module)
    functions, elastic = matrix_functions(scalar), elasticity_kernels(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    cofactor, signed_svd = functions.cofactor, functions.signed_svd
    polar_rotation, nearest_unimodular = functions.polar_rotation, functions.nearest_unimodular
    deformation_gradient, green_strain = elastic.deformation_gradient, elastic.green_strain
    isotropic, linear_volume_factor = elastic.isotropic, elastic.linear_volume_factor
    zero, half, one, two = scalar(0.0), scalar(0.5), scalar(1.0), scalar(2.0)
    smallest_stretch_sum = scalar(1.0e-3)

    # In the frame of the SVD F = U diag(s) V^T, with dF' = U^T dF V, the tangent of an isotropic energy is
    #   dP'_ij = direct_ij dF'_ij + cross_ij dF'_ji            (i != j)
    #   dP'_ii = direct_ii dF'_ii + sum_{k != i} normal_ik dF'_kk
    # with direct = (flip + twist) / 2 and cross = (flip - twist) / 2 off the diagonal, where flip and twist are the
    # eigenvalues (sigma_i - sigma_j) / (s_i - s_j) and (sigma_i + sigma_j) / (s_i + s_j) of the symmetric and skew
    # pairs (Smith, de Goes, Kim 2019), written so that equal singular values do not divide by zero.
    @function
    def corotated_hessian(s: vec3, d: vec3, shape: scalar, volume: scalar):
        """Normal (3, 3), flip and twist by the index of the axis left out; d are the singular values of D."""
        # D shares F's singular frame: s = d + m cof(d), prod d = 1. Differentiating both gives the 3x3 block of
        # dD as the projection on the surface's tangent plane in the metric I + m (d off the diagonal).
        cof = vec3(d[1] * d[2], d[0] * d[2], d[0] * d[1])
        m = wp.dot(s - d, cof) / wp.dot(cof, cof)
        inverse = wp.inverse(mat33(one, m * d[2], m * d[1], m * d[2], one, m * d[0], m * d[1], m * d[0], one))
        icof = inverse * cof
        normal = volume * (wp.outer(icof, icof) / wp.dot(cof, icof) - inverse)
        flip = vec3(zero, zero, zero)
        twist = vec3(zero, zero, zero)
        for k in range(3):
            normal[k, k] += volume + two * shape
            stretch_sum = wp.max(s[(k + 1) % 3] + s[(k + 2) % 3], smallest_stretch_sum)
            flip[k] = two * shape + volume * (one - one / (one - m * d[k]))
            d_sum = d[(k + 1) % 3] + d[(k + 2) % 3]
            twist[k] = two * shape * (one - two / stretch_sum) + volume * (one - d_sum / stretch_sum)
        return normal, flip, twist

    @function
    def neo_hookean_hessian(s: vec3, shape: scalar, volume: scalar):
        """Normal (3, 3), flip and twist by the index of the axis left out."""
        jac = s[0] * s[1] * s[2]
        cof = vec3(s[1] * s[2], s[0] * s[2], s[0] * s[1])
        slope = shape * (jac - two) + volume * (jac - one)
        normal = (shape + volume) * wp.outer(cof, cof)
        flip = vec3(zero, zero, zero)
        twist = vec3(zero, zero, zero)
        for k in range(3):
            i = (k + 1) % 3
            j = (k + 2) % 3
            normal[k, k] += shape
            normal[i, j] += slope * s[k]
            normal[j, i] += slope * s[k]
            flip[k] = shape - slope * s[k]
            twist[k] = shape + slope * s[k]
        return normal, flip, twist

    @function
    def spectral_tangent(model: int, f: mat33, shape: scalar, volume: scalar, positive: int, out: wp.array[mat33]):
        """The blocks from the SVD; with `positive`, of the nearest tangent without negative eigenvalues."""
        u, s, v = signed_svd(f)
        normal, flip, twist = neo_hookean_hessian(s, shape, volume)
        if model == COROTATED:
            d = s
            if volume != zero:
                d = wp.get_diag(wp.transpose(u) * nearest_unimodular(f) * v)
            normal, flip, twist = corotated_hessian(s, d, shape, volume)
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

    # The rotation R of F = R S turns by dR = [w]_x R, w = A^-1 a, where A = tr(S) I - R S R^T and a is the axial vector
    # of dF R^T - R dF^T. A change x of column n of F has a = (R e_n) x x, so that block (k, n) of dR is
    # -[R e_k]_x A^-1 [R e_n]_x.
    @function
    def rotation_tangent(f: mat33, shape: scalar, out: wp.array[mat33]):
        """The blocks of the corotated shape term: 2 mu (dF - dR), for det F > 0."""
        r = polar_rotation(f)
        stretch = f * wp.transpose(r)
        t = wp.trace(stretch)
        a = mat33(t, zero, zero, zero, t, zero, zero, zero, t) - half * (stretch + wp.transpose(stretch))
        scaled = two * shape * wp.inverse(a)
        columns = wp.transpose(r)
        for k in range(3):
            turned = wp.skew(columns[k]) * scaled
            for n in range(k + 1):
                block = turned * wp.skew(columns[n])
                if k == n:
                    block[0, 0] += two * shape
                    block[1, 1] += two * shape
                    block[2, 2] += two * shape
                out[(k * (k + 1)) / 2 + n] = block

    @function
    def neo_hookean_tangent(f: mat33, shape: scalar, volume: scalar, out: wp.array[mat33]):
        """The blocks of mu F + (mu (J - 2) + lambda (J - 1)) cof F."""
        jac = wp.determinant(f)
        cof = cofactor(f)
        slope = shape * (jac - two) + volume * (jac - one)
        bulk = shape + volume
        columns = wp.transpose(f)
        normals = wp.transpose(cof)
        for k in range(3):
            for n in range(k + 1):
                block = bulk * wp.outer(normals[k], normals[n])
                if k == n:
                    block[0, 0] += shape
                    block[1, 1] += shape
                    block[2, 2] += shape
                elif k - n == 1:
                    block += slope * wp.skew(columns[3 - k - n])
                else:
                    block -= slope * wp.skew(columns[1])
                out[(k * (k + 1)) / 2 + n] = block

    @function
    def add_viscous_tangent(f: mat33, stress: mat33, shape: scalar, volume: scalar, out: wp.array[mat33]):
        """Adds the blocks of F S(E), with S = 2 mu E + lambda tr(E) I and its value `stress`."""
        columns = wp.transpose(f)
        left = shape * (f * columns)
        for k in range(3):
            for n in range(k + 1):
                block = shape * wp.outer(columns[n], columns[k]) + volume * wp.outer(columns[k], columns[n])
                if k == n:
                    block += left
                block[0, 0] += stress[k, n]
                block[1, 1] += stress[k, n]
                block[2, 2] += stress[k, n]
                out[(k * (k + 1)) / 2 + n] += block

    @kernel
    def tangent(
        model: int,
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        shape_stiffness: wp.array2d[scalar],
        volume_stiffness: wp.array2d[scalar],
        viscosity: wp.array[scalar],
        reference_strain: wp.array2d[mat33],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        positive: wp.array[int],  # (B) 1: clamp the eigenvalues at zero
        tangent_out: wp.array3d[mat33],  # (B, P, 6) blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2) [J]
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        shape = shape_stiffness[b, p]
        volume = volume_stiffness[b, p]
        out = tangent_out[b, p]
        if positive[b] == 1 or (model == COROTATED and (volume != zero or wp.determinant(f) < smallest_stretch_sum)):
            spectral_tangent(model, f, shape, volume, positive[b], out)
        elif model == COROTATED:
            rotation_tangent(f, shape, out)
        else:
            neo_hookean_tangent(f, shape, volume, out)
        c = viscosity[b]
        if c > zero:
            bulk = linear_volume_factor(model) * volume
            stress = c * isotropic(green_strain(f) - reference_strain[b, p], shape, bulk)
            if positive[b] == 1:
                # The stress part of the viscous Hessian may be indefinite: a clamped Hessian leaves it out.
                stress = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
            add_viscous_tangent(f, stress, c * shape, c * bulk, out)

    @kernel
    def tangent_product(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        points_per_cell: int,
        tangent_point: wp.array3d[mat33],
        direction: wp.array2d[vec3],  # (B, N) [m]
        stress_out: wp.array2d[mat33],  # (B, P) dP in that direction [J]
    ):
        b, p = wp.tid()
        df = deformation_gradient(direction, nodes, gradients, b, p, p / points_per_cell)
        t = tangent_point[b, p]
        columns = wp.transpose(df)
        x = columns[0]
        y = columns[1]
        z = columns[2]
        stress_out[b, p] = wp.matrix_from_cols(
            t[0] * x + wp.transpose(t[1]) * y + wp.transpose(t[3]) * z,
            t[1] * x + t[2] * y + wp.transpose(t[4]) * z,
            t[3] * x + t[4] * y + t[5] * z,
        )

    return SimpleNamespace(tangent=tangent, tangent_product=tangent_product)
