"""What the points of every energy share: the matrix F, the gather, the product with a tangent; and inertia."""

import functools
from types import SimpleNamespace

import warp as wp

from .matrices import matrix_functions
from .modules import decorators


@functools.cache
def point_kernels(scalar: type) -> SimpleNamespace:
    """Functions and kernels for one scalar type (``wp.float64`` or ``wp.float32``)."""
    kernel, function = decorators(scalar)
    functions = matrix_functions(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    zero, half = scalar(0.0), scalar(0.5)

    @function
    def deformation_gradient(
        positions: wp.array2d[vec3], nodes: wp.array2d[int], gradients: wp.array2d[vec3], b: int, p: int, cell: int
    ) -> mat33:
        """F = sum_a x_a (grad N_a)^T."""
        f = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        for a in range(nodes.shape[1]):
            f += wp.outer(positions[b, nodes[cell, a]], gradients[p, a])
        return f

    @function
    def green_strain(f: mat33) -> mat33:
        e = half * (wp.transpose(f) * f)
        return e - mat33(half, zero, zero, zero, half, zero, zero, zero, half)

    @kernel
    def gather(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        points_per_cell: int,
        incident_start: wp.array[int],  # (N + 1) where a vertex's entries begin
        incident: wp.array[int],  # cell * K + local node, cells in ascending order: a fixed summation order
        stress: wp.array2d[mat33],
        force_out: wp.array2d[vec3],  # (B, N) [N] has the transposed deformation gradient of the stress added
    ):
        b, i = wp.tid()
        total = force_out[b, i]
        k = nodes.shape[1]
        for entry in range(incident_start[i], incident_start[i + 1]):
            cell = incident[entry] / k
            a = incident[entry] - cell * k
            for q in range(points_per_cell):
                p = cell * points_per_cell + q
                total += stress[b, p] * gradients[p, a]
        force_out[b, i] = total

    @kernel
    def inertia_residual(
        inertia: wp.array2d[scalar],  # (B, N) [N/m] mass over the square of the effective time step
        target: wp.array2d[vec3],  # (B, N) [m] where inertia alone would take the vertex
        force: wp.array2d[vec3],  # (B, N) [N]
        positions: wp.array2d[vec3],
        residual_out: wp.array2d[vec3],  # (B, N) [N]
        energy_out: wp.array2d[scalar],  # (B, N) [J]
    ):
        b, i = wp.tid()
        offset = positions[b, i] - target[b, i]
        pull = inertia[b, i] * offset
        residual_out[b, i] = pull - force[b, i]
        energy_out[b, i] = wp.dot(half * pull - force[b, i], offset)

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

    return SimpleNamespace(
        mat33=mat33,
        vec3=vec3,
        deformation_gradient=deformation_gradient,
        green_strain=green_strain,
        gather=gather,
        inertia_residual=inertia_residual,
        tangent_product=tangent_product,
    )
