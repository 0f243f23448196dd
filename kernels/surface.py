"""Energies on chamber surfaces, follower pressure and fibres: stress, tangent and derivatives by their constants.

A point's matrix F, stress P and tangent blocks are those of ``kernels.elasticity`` and ``kernels.tangent``, so that the
same kernels gather and assemble them.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .elasticity import elasticity_kernels
from .matrices import matrix_functions


@functools.cache
def surface_kernels(scalar: type) -> SimpleNamespace:
    """Kernels of pressure and fibres for one scalar type (``wp.float64`` or ``wp.float32``)."""
    module = f"warp_resphys.{scalar.__name__}"
    kernel = functools.partial(wp.kernel, module=module, enable_backward=False)
    function = functools.partial(wp.func, module=module)
    functions = matrix_functions(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    cofactor = functions.cofactor
    deformation_gradient = elasticity_kernels(scalar).deformation_gradient
    zero, half, one = scalar(0.0), scalar(0.5), scalar(1.0)
    sixth, twenty_fourth = scalar(1.0 / 6.0), scalar(1.0 / 24.0)

    # The potential of a uniform gauge pressure p is -p V (Bonet and Wood 2008, section 8.5.2), and a chamber's faces
    # look into it: V = -sum_q w_q det F, F = [x, t1, t2].
    @kernel
    def pressure_step(
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
    def pressure_tangent(
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
    def pressure_adjoint(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        adjoint: wp.array2d[vec3],
        pressure_out: wp.array2d[scalar],  # (B, P) this point's part of dL/dp of its chamber
    ):
        """dL/dp = -z . dg/dp = -w cof F : grad z."""
        b, p = wp.tid()
        cell = p / points_per_cell
        f = deformation_gradient(positions, nodes, gradients, b, p, cell)
        dz = deformation_gradient(adjoint, nodes, gradients, b, p, cell)
        pressure_out[b, p] = -weights[p] * wp.ddot(cofactor(f), dz)

    @kernel
    def volume(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        volume_out: wp.array2d[scalar],  # (B, P) [m^3]
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        volume_out[b, p] = -weights[p] * wp.determinant(f)

    @function
    def tension(strain: scalar, toe: scalar):
        """Energy, force and slope of a thread of stiffness one: none below zero, linear in the strain past the toe."""
        energy = zero
        force = zero
        slope = zero
        if strain > toe:
            force = strain - half * toe
            energy = half * force * force + twenty_fourth * toe * toe
            slope = one
        elif strain > zero:
            slope = strain / toe
            force = half * strain * slope
            energy = sixth * strain * strain * slope
        return energy, force, slope

    @kernel
    def fibre_step(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],  # (P) area [m^2]
        chamber: wp.array[int],
        stiffness: wp.array2d[scalar],  # (B, chambers) [N/m]
        toe: scalar,
        points_per_cell: int,
        positions: wp.array2d[vec3],
        stress_out: wp.array2d[mat33],
        energy_out: wp.array2d[scalar],
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        fibre = vec3(f[0, 0], f[1, 0], f[2, 0])
        stretch = wp.length(fibre)
        energy, force, _slope = tension(stretch - one, toe)
        scale = weights[p] * stiffness[b, chamber[p]]
        pull = vec3(zero, zero, zero)
        if stretch > one:
            pull = (scale * force / stretch) * fibre
        stress_out[b, p] = mat33(pull[0], zero, zero, pull[1], zero, zero, pull[2], zero, zero)
        energy_out[b, p] = scale * energy

    @kernel
    def fibre_tangent(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        chamber: wp.array[int],
        stiffness: wp.array2d[scalar],
        toe: scalar,
        points_per_cell: int,
        positions: wp.array2d[vec3],
        tangent_out: wp.array3d[mat33],
    ):
        """Block (0, 0) is k w (s / lambda (1 - u u^T) + s' u u^T), which is never indefinite: a thread only pulls."""
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        fibre = vec3(f[0, 0], f[1, 0], f[2, 0])
        stretch = wp.length(fibre)
        out = tangent_out[b, p]
        nothing = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        for k in range(6):
            out[k] = nothing
        if stretch > one:
            _energy, force, slope = tension(stretch - one, toe)
            scale = weights[p] * stiffness[b, chamber[p]]
            u = fibre / stretch
            across = scale * force / stretch
            block = (scale * slope - across) * wp.outer(u, u)
            block[0, 0] += across
            block[1, 1] += across
            block[2, 2] += across
            out[0] = block

    @kernel
    def fibre_adjoint(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        toe: scalar,
        points_per_cell: int,
        positions: wp.array2d[vec3],
        adjoint: wp.array2d[vec3],
        stiffness_out: wp.array2d[scalar],  # (B, P) this point's part of dL/dk of its chamber
    ):
        """dL/dk = -z . dg/dk = -w s (u . dz)."""
        b, p = wp.tid()
        cell = p / points_per_cell
        f = deformation_gradient(positions, nodes, gradients, b, p, cell)
        dz = deformation_gradient(adjoint, nodes, gradients, b, p, cell)
        fibre = vec3(f[0, 0], f[1, 0], f[2, 0])
        along = vec3(dz[0, 0], dz[1, 0], dz[2, 0])
        stretch = wp.length(fibre)
        _energy, force, _slope = tension(stretch - one, toe)
        result = zero
        if stretch > one:
            result = -weights[p] * force * wp.dot(fibre, along) / stretch
        stiffness_out[b, p] = result

    return SimpleNamespace(
        pressure_step=pressure_step,
        pressure_tangent=pressure_tangent,
        pressure_adjoint=pressure_adjoint,
        volume=volume,
        fibre_step=fibre_step,
        fibre_tangent=fibre_tangent,
        fibre_adjoint=fibre_adjoint,
    )
