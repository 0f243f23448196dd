"""Elastic and viscous energy of a solid: local step, tangent and derivatives by its constants, for any material."""

import functools
from collections.abc import Callable
from types import SimpleNamespace

import warp as wp

from .modules import decorators
from .points import point_kernels


@functools.cache
def strain_kernels(scalar: type) -> SimpleNamespace:
    """Green strain of every point and its transposed derivative, for one scalar type."""
    kernel, _ = decorators(scalar)
    points = point_kernels(scalar)
    mat33, vec3 = points.mat33, points.vec3
    deformation_gradient, green_strain = points.deformation_gradient, points.green_strain
    half = scalar(0.5)

    @kernel
    def strain(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        strain_out: wp.array2d[mat33],  # (B, P)
    ):
        b, p = wp.tid()
        strain_out[b, p] = green_strain(deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell))

    @kernel
    def strain_adjoint(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        adjoint_strain: wp.array2d[mat33],  # (B, P)
        stress_out: wp.array2d[mat33],  # (B, P) adjoint of F: dE = sym(F^T dF), so F sym(adjoint E)
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        w = adjoint_strain[b, p]
        stress_out[b, p] = f * (half * (w + wp.transpose(w)))

    return SimpleNamespace(strain=strain, strain_adjoint=strain_adjoint)


@functools.cache
def solid_kernels(scalar: type, material: Callable[[type], SimpleNamespace]) -> SimpleNamespace:
    """Kernels for one scalar type (``wp.float64`` or ``wp.float32``) and one of ``kernels.materials``."""
    law = material(scalar)
    kernel, function = decorators(scalar, law.name)
    points = point_kernels(scalar)
    mat33, vec3 = points.mat33, points.vec3
    deformation_gradient, green_strain = points.deformation_gradient, points.green_strain
    response, slopes, elastic_tangent = law.response, law.slopes, law.tangent
    moduli = wp.types.vector(len(law.lame), scalar)
    mu_of, lambda_of = (moduli(*(scalar(pair[i]) for pair in law.lame)) for i in (0, 1))
    zero, half, two = scalar(0.0), scalar(0.5), scalar(2.0)

    @function
    def isotropic(strain: mat33, shape: scalar, volume: scalar) -> mat33:
        """2 mu E + lambda tr(E) I."""
        t = volume * wp.trace(strain)
        return two * shape * strain + mat33(t, zero, zero, zero, t, zero, zero, zero, t)

    @kernel
    def local_step(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        stiffness: wp.array2d[moduli],  # (B, P) moduli times the point's volumes [J]
        viscosity: wp.array[scalar],  # (B) stiffness damping over the effective time step, -
        reference_strain: wp.array2d[mat33],  # (B, P) Green strain that the viscous strain rate starts from
        points_per_cell: int,
        positions: wp.array2d[vec3],
        stress_out: wp.array2d[mat33],
        energy_out: wp.array2d[scalar],  # (B, P) [J]
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        m = stiffness[b, p]
        energy, stress = response(f, m)
        c = viscosity[b]
        if c > zero:
            rate = green_strain(f) - reference_strain[b, p]
            viscous = c * isotropic(rate, wp.dot(mu_of, m), wp.dot(lambda_of, m))
            energy += half * wp.ddot(viscous, rate)
            stress += f * viscous
        stress_out[b, p] = stress
        energy_out[b, p] = energy

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
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        stiffness: wp.array2d[moduli],
        viscosity: wp.array[scalar],
        reference_strain: wp.array2d[mat33],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        positive: wp.array[int],  # (B) 1: clamp the eigenvalues at zero
        tangent_out: wp.array3d[mat33],
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        m = stiffness[b, p]
        out = tangent_out[b, p]
        elastic_tangent(f, m, positive[b], out)
        c = viscosity[b]
        if c > zero:
            shape = c * wp.dot(mu_of, m)
            bulk = c * wp.dot(lambda_of, m)
            stress = isotropic(green_strain(f) - reference_strain[b, p], shape, bulk)
            if positive[b] == 1:
                # The stress part of the viscous Hessian may be indefinite: a clamped Hessian leaves it out.
                stress = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
            add_viscous_tangent(f, stress, shape, bulk, out)

    @kernel
    def adjoint(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        stiffness: wp.array2d[moduli],
        viscosity: wp.array[scalar],
        reference_strain: wp.array2d[mat33],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        direction: wp.array2d[vec3],  # (B, N) z = H^-1 dL/dx [m]
        stiffness_out: wp.array2d[moduli],  # (B, P) dL/d stiffness
        viscosity_out: wp.array2d[scalar],  # (B, P) this point's part of dL/d viscosity
        reference_out: wp.array2d[mat33],  # (B, P) dL/d reference_strain
    ):
        """dL/dtheta = -z . d(internal residual)/dtheta = -dP/dtheta : grad z, at fixed positions."""
        b, p = wp.tid()
        cell = p / points_per_cell
        f = deformation_gradient(positions, nodes, gradients, b, p, cell)
        dz = deformation_gradient(direction, nodes, gradients, b, p, cell)
        m = stiffness[b, p]
        shape = wp.dot(mu_of, m)
        bulk = wp.dot(lambda_of, m)
        c = viscosity[b]
        # A stiffness of zero has a derivative too (nu = 0), so nothing is skipped here.
        result = -slopes(f, dz)
        reference = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        rise = wp.transpose(f) * dz
        rise = half * (rise + wp.transpose(rise))
        rate = green_strain(f) - reference_strain[b, p]
        viscosity_out[b, p] = -wp.ddot(isotropic(rate, shape, bulk), rise)
        if c > zero:
            result -= (c * two * wp.ddot(rate, rise)) * mu_of + (c * wp.trace(rate) * wp.trace(rise)) * lambda_of
            reference = c * isotropic(rise, shape, bulk)
        stiffness_out[b, p] = result
        reference_out[b, p] = reference

    return SimpleNamespace(local_step=local_step, tangent=tangent, adjoint=adjoint)
