"""Local step and its adjoints: stress and energy at the points, gather to the vertices."""

import functools
from types import SimpleNamespace

import warp as wp

from .matrices import matrix_functions

COROTATED = 0
STABLE_NEO_HOOKEAN = 1


@functools.cache
def elasticity_kernels(scalar: type) -> SimpleNamespace:
    """Kernels of the elastic and viscous energies for one scalar type (``wp.float64`` or ``wp.float32``)."""
    module = f"warp_resphys.{scalar.__name__}"
    kernel = functools.partial(wp.kernel, module=module, enable_backward=False)
    function = functools.partial(wp.func, module=module)
    functions = matrix_functions(scalar)
    mat33, vec3 = functions.mat33, functions.vec3
    cofactor = functions.cofactor
    polar_rotation, nearest_unimodular = functions.polar_rotation, functions.nearest_unimodular
    zero, half, one, two = scalar(0.0), scalar(0.5), scalar(1.0), scalar(2.0)
    third = scalar(1.0 / 3.0)

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

    @function
    def isotropic(strain: mat33, shape: scalar, volume: scalar) -> mat33:
        """2 mu E + lambda tr(E) I."""
        t = volume * wp.trace(strain)
        return two * shape * strain + mat33(t, zero, zero, zero, t, zero, zero, zero, t)

    @function
    def shape_term(model: int, f: mat33):
        """Energy density and stress of the shape term for mu = 1."""
        energy = zero
        stress = f
        if model == COROTATED:
            stress = f - polar_rotation(f)
            energy = wp.ddot(stress, stress)
            stress = two * stress
        else:
            j = wp.determinant(f)
            energy = half * (wp.ddot(f, f) - scalar(3.0)) - (j - one) + half * (j - one) * (j - one)
            stress = f + (j - two) * cofactor(f)
        return energy, stress

    @function
    def volume_term(model: int, f: mat33):
        """Energy density and stress of the volume term for lambda = 1."""
        energy = zero
        stress = f
        if model == COROTATED:
            stress = f - nearest_unimodular(f)
            energy = half * wp.ddot(stress, stress)
        else:
            j = wp.determinant(f)
            energy = half * (j - one) * (j - one)
            stress = (j - one) * cofactor(f)
        return energy, stress

    @function
    def linear_volume_factor(model: int) -> scalar:
        """Small-strain lambda of the volume term over its nominal one (see ``material.py``)."""
        factor = one
        if model == COROTATED:
            factor = third
        return factor

    @kernel
    def local_step(
        model: int,
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        shape_stiffness: wp.array2d[scalar],
        volume_stiffness: wp.array2d[scalar],
        viscosity: wp.array[scalar],  # (B) stiffness damping over the effective time step, -
        reference_strain: wp.array2d[mat33],  # (B, P) Green strain that the viscous strain rate starts from
        points_per_cell: int,
        positions: wp.array2d[vec3],
        stress_out: wp.array2d[mat33],
        energy_out: wp.array2d[scalar],  # (B, P) [J]
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        shape = shape_stiffness[b, p]
        volume = volume_stiffness[b, p]
        stress = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        energy = zero
        if shape > zero:
            e, s = shape_term(model, f)
            energy += shape * e
            stress += shape * s
        if volume != zero:
            e, s = volume_term(model, f)
            energy += volume * e
            stress += volume * s
        c = viscosity[b]
        if c > zero:
            rate = green_strain(f) - reference_strain[b, p]
            viscous = c * isotropic(rate, shape, linear_volume_factor(model) * volume)
            energy += half * wp.ddot(viscous, rate)
            stress += f * viscous
        stress_out[b, p] = stress
        energy_out[b, p] = energy

    @kernel
    def strain(
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        strain_out: wp.array2d[mat33],  # (B, P)
    ):
        b, p = wp.tid()
        f = deformation_gradient(positions, nodes, gradients, b, p, p / points_per_cell)
        strain_out[b, p] = green_strain(f)

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
    def stiffness_adjoint(
        model: int,
        nodes: wp.array2d[int],
        gradients: wp.array2d[vec3],
        shape_stiffness: wp.array2d[scalar],
        volume_stiffness: wp.array2d[scalar],
        viscosity: wp.array[scalar],
        reference_strain: wp.array2d[mat33],
        points_per_cell: int,
        positions: wp.array2d[vec3],
        adjoint: wp.array2d[vec3],  # (B, N) z = H^-1 dL/dx [m]
        shape_out: wp.array2d[scalar],  # (B, P) dL/d shape_stiffness
        volume_out: wp.array2d[scalar],  # (B, P) dL/d volume_stiffness
        viscosity_out: wp.array2d[scalar],  # (B, P) this point's part of dL/d viscosity
        reference_out: wp.array2d[mat33],  # (B, P) dL/d reference_strain
    ):
        """dL/dtheta = -z . d(internal residual)/dtheta = -dP/dtheta : grad z, at fixed positions."""
        b, p = wp.tid()
        cell = p / points_per_cell
        f = deformation_gradient(positions, nodes, gradients, b, p, cell)
        dz = deformation_gradient(adjoint, nodes, gradients, b, p, cell)
        shape = shape_stiffness[b, p]
        volume = volume_stiffness[b, p]
        # A stiffness of zero has a derivative too (nu = 0), so nothing is skipped here.
        _e, s = shape_term(model, f)
        dshape = -wp.ddot(s, dz)
        _e2, s2 = volume_term(model, f)
        dvolume = -wp.ddot(s2, dz)
        c = viscosity[b]
        reference = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        bulk_factor = linear_volume_factor(model)
        m = wp.transpose(f) * dz
        m = half * (m + wp.transpose(m))
        rate = green_strain(f) - reference_strain[b, p]
        viscous = isotropic(rate, shape, bulk_factor * volume)
        dviscosity = -wp.ddot(viscous, m)
        if c > zero:
            dshape -= c * two * wp.ddot(rate, m)
            dvolume -= c * bulk_factor * wp.trace(rate) * wp.trace(m)
            reference = c * isotropic(m, shape, bulk_factor * volume)
        shape_out[b, p] = dshape
        volume_out[b, p] = dvolume
        viscosity_out[b, p] = dviscosity
        reference_out[b, p] = reference

    return SimpleNamespace(
        mat33=mat33,
        vec3=vec3,
        deformation_gradient=deformation_gradient,
        green_strain=green_strain,
        isotropic=isotropic,
        linear_volume_factor=linear_volume_factor,
        local_step=local_step,
        strain=strain,
        strain_adjoint=strain_adjoint,
        gather=gather,
        inertia_residual=inertia_residual,
        stiffness_adjoint=stiffness_adjoint,
    )
