"""Follower pressure in chambers: stress, tangent and derivative by the pressure."""

import functools
from types import SimpleNamespace

import warp as wp

from .matrices import matrix_functions
from .modules import decorators
from .points import point_kernels


@functools.cache
def pressure_kernels(scalar: type) -> SimpleNamespace:
    """Kernels for one scalar type (``wp.float64`` or ``wp.float32``)."""
    kernel, _ = decorators(scalar, "pressure")
    functions = matrix_functions(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    cofactor, deformation_gradient = functions.cofactor, point_kernels(scalar).deformation_gradient
    zero = scalar(0.0)

    # The potential of a uniform gauge pressure p is -p V (Bonet and Wood 2008, section 8.5.2), and a chamber's faces
    # look into it: V = -sum_q w_q det F, F = [x, t1, t2].
    @kernel
    def local_step(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],  # (P) a third of the quadrature weight
        chamber: wp.array[int],  # (P)
        pressure: wp.array2d[scalar],  # (B, chambers) [Pa]
        points_per_cell: int,
        positions: wp.array2d[vec3],
        stress_out: wp.array2d[mat33],
        energy_out: wp.array2d[scalar],  # (B, P) [J]
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        scale = weights[p] * pressure[b, chamber[p]]
        stress_out[b, p] = scale * cofactor(f)
        energy_out[b, p] = scale * wp.determinant(f)

    @kernel
    def tangent(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        chamber: wp.array[int],
        pressure: wp.array2d[scalar],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        positive: wp.array[int],  # (B) 1: leave it out, as it has eigenvalues of both signs
        tangent_out: wp.array3d[mat33],
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        scale = weights[p] * pressure[b, chamber[p]]
        if positive[b] == 1:
            scale = zero
        columns = wp.transpose(f)
        out = tangent_out[b, p]
        nothing = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        # Blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2); column k of cof F is the product of the next two.
        out[0] = nothing
        out[1] = scale * wp.skew(columns[2])
        out[2] = nothing
        out[3] = -scale * wp.skew(columns[1])
        out[4] = scale * wp.skew(columns[0])
        out[5] = nothing

    @kernel
    def adjoint(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        direction: wp.array2d[vec3],  # (B, N) z = H^-1 dL/dx [m]
        pressure_out: wp.array2d[scalar],  # (B, P) this point's part of dL/dp of its chamber
    ):
        """dL/dp = -z . dg/dp = -w cof F : grad z."""
        b, p = wp.tid()
        cell = p / points_per_cell
        f = deformation_gradient(positions, nodes, gradients, b, p, cell)
        dz = deformation_gradient(direction, nodes, gradients, b, p, cell)
        pressure_out[b, p] = -weights[p] * wp.ddot(cofactor(f), dz)

    return SimpleNamespace(local_step=local_step, tangent=tangent, adjoint=adjoint)
