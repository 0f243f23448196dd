"""Threads that only pull: stress, tangent and derivative by the stiffness."""

import functools
from types import SimpleNamespace

import warp as wp

from .matrices import matrix_functions
from .modules import decorators
from .points import point_kernels


@functools.cache
def fibre_kernels(scalar: type) -> SimpleNamespace:
    """Kernels for one scalar type (``wp.float64`` or ``wp.float32``)."""
    kernel, function = decorators(scalar, "fibres")
    functions = matrix_functions(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    deformation_gradient = point_kernels(scalar).deformation_gradient
    zero, half, one = scalar(0.0), scalar(0.5), scalar(1.0)
    sixth, twenty_fourth = scalar(1.0 / 6.0), scalar(1.0 / 24.0)

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
    def local_step(
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
    def tangent(
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
    def adjoint(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        weights: wp.array[scalar],
        toe: scalar,
        points_per_cell: int,
        positions: wp.array2d[vec3],
        direction: wp.array2d[vec3],  # (B, N) z = H^-1 dL/dx [m]
        stiffness_out: wp.array2d[scalar],  # (B, P) this point's part of dL/dk of its chamber
    ):
        """dL/dk = -z . dg/dk = -w s (u . dz)."""
        b, p = wp.tid()
        cell = p / points_per_cell
        f = deformation_gradient(positions, nodes, gradients, b, p, cell)
        dz = deformation_gradient(direction, nodes, gradients, b, p, cell)
        fibre = vec3(f[0, 0], f[1, 0], f[2, 0])
        along = vec3(dz[0, 0], dz[1, 0], dz[2, 0])
        stretch = wp.length(fibre)
        _energy, force, _slope = tension(stretch - one, toe)
        result = zero
        if stretch > one:
            result = -weights[p] * force * wp.dot(fibre, along) / stretch
        stiffness_out[b, p] = result

    return SimpleNamespace(local_step=local_step, tangent=tangent, adjoint=adjoint)
