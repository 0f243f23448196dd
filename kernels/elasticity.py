"""Elastic and viscous energy of a solid: local step,
tangent and derivatives by the constants, for any material.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from .constants import HALF, TWO, ZERO
from .laws import Law
from .modules import generated, named_module
from .points import MatrixPoints, green_strain, matrix_at

wp.set_module_options({"enable_backward": False})

# Of threads a block and blocks a multiprocessor: at most 128 registers a thread, of a GPU's 65,536.
BOUNDS = (128, 4)


@wp.kernel
def strain(
    points: MatrixPoints,
    positions: wp.array2d[wp.vec3d],
    strain_out: wp.array2d[wp.mat33d],  # (B, P)
):
    """Computes the Green strain."""
    b, p = wp.tid()
    strain_out[b, p] = green_strain(matrix_at(points, positions, b, p))


@wp.kernel
def strain_adjoint(
    points: MatrixPoints,
    positions: wp.array2d[wp.vec3d],
    adjoint_strain: wp.array2d[wp.mat33d],  # (B, P)
    stress_out: wp.array2d[wp.mat33d],  # (B, P) adjoint of F
):
    """Computes the adjoint F sym(adjoint E) of F, as dE = sym(F^T dF)."""
    b, p = wp.tid()
    f = matrix_at(points, positions, b, p)
    w = adjoint_strain[b, p]
    stress_out[b, p] = f * (HALF * (w + wp.transpose(w)))


@wp.func
def isotropic(
    strain: wp.mat33d, dilation: wp.float64, shape: wp.float64, volume: wp.float64
) -> wp.mat33d:
    """Returns 2 mu E + lambda e I."""
    t = volume * dilation
    return TWO * shape * strain + wp.mat33d(t, ZERO, ZERO, ZERO, t, ZERO, ZERO, ZERO, t)


@wp.func
def viscous_response(
    f: wp.mat33d, lame: wp.vec2d, c: wp.vec2d, offset: wp.mat33d, dilation_offset: wp.float64
):
    """Returns energy and stress by viscosity (`energies.viscosity`),
    with mu and lambda times the point's volume.
    """
    strain = green_strain(f)
    dilation = wp.trace(strain)
    left, rest = c[0] * strain - offset, c[1] * dilation - dilation_offset
    energy = (
        lame[0] * wp.ddot(left - offset, strain)
        + HALF * lame[1] * (rest - dilation_offset) * dilation
    )
    return energy, f * isotropic(left, rest, lame[0], lame[1])


@wp.func
def add_viscous_tangent(
    f: wp.mat33d,
    lame: wp.vec2d,
    c: wp.vec2d,
    offset: wp.mat33d,
    dilation_offset: wp.float64,
    clamp: bool,
    out: wp.array[wp.mat33d],
):
    """Adds the blocks of `viscous_response`.

    Clamped ones without the part by stress, which may be indefinite.
    """
    stress = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    if not clamp:
        strain = green_strain(f)
        stress = isotropic(
            c[0] * strain - offset, c[1] * wp.trace(strain) - dilation_offset, lame[0], lame[1]
        )
    shape = c[0] * lame[0]
    volume = c[1] * lame[1]
    columns = wp.transpose(f)
    left = shape * (f * columns)
    for k in range(3):
        for n in range(k + 1):
            block = shape * wp.outer(columns[n], columns[k]) + volume * wp.outer(
                columns[k], columns[n]
            )
            if k == n:
                block += left
            block[0, 0] += stress[k, n]
            block[1, 1] += stress[k, n]
            block[2, 2] += stress[k, n]
            out[(k * (k + 1)) / 2 + n] += block


@wp.func
def viscous_slopes(
    f: wp.mat33d,
    dz: wp.mat33d,
    lame: wp.vec2d,
    c: wp.vec2d,
    offset: wp.mat33d,
    dilation_offset: wp.float64,
):
    """Returns the derivatives of `viscous_response`'s stress :
    dz by lame, c, offset and dilation_offset.
    """
    rise = wp.transpose(f) * dz
    rise = HALF * (rise + wp.transpose(rise))
    swelling = wp.trace(rise)
    strain = green_strain(f)
    dilation = wp.trace(strain)
    by_lame = wp.vec2d()
    if c[0] + c[1] > ZERO:  # Without viscosity the offsets are not set.
        left = c[0] * strain - offset
        by_lame = wp.vec2d(
            TWO * wp.ddot(left, rise), (c[1] * dilation - dilation_offset) * swelling
        )
    by_c = wp.vec2d(TWO * lame[0] * wp.ddot(strain, rise), lame[1] * dilation * swelling)
    return by_lame, by_c, (-TWO * lame[0]) * rise, -lame[1] * swelling


@generated
def viscosity_of(law: Law) -> SimpleNamespace:
    """Returns the struct of a material's values, and the viscosity at its points."""
    module, vector = named_module(law.name), law.values
    mu_of = vector(*(wp.float64(mu) for mu, _ in law.lame))
    lambda_of = vector(*(wp.float64(lame_lambda) for _, lame_lambda in law.lame))

    @wp.struct
    class Values:
        """Values of a step."""

        stiffness: wp.array2d[vector]  # (B, P) moduli times the point's volumes [J]
        viscosity: wp.array[wp.vec2d]  # (B) c and d of `energies.viscosity`, -
        strain_offset: wp.array2d[wp.mat33d]  # (B, P) W there
        dilation_offset: wp.array2d[wp.float64]  # (B, P) w there

    @wp.func(module=module)
    def lame_of(m: vector) -> wp.vec2d:
        """Returns the Lame constants times the point's volume [J]."""
        return wp.vec2d(wp.dot(mu_of, m), wp.dot(lambda_of, m))

    @wp.func(module=module)
    def respond(f: wp.mat33d, values: Values, b: int, p: int):
        """Returns energy and stress by viscosity."""
        c = values.viscosity[b]
        energy, stress = wp.float64(0.0), wp.mat33d()
        if c[0] + c[1] > ZERO:
            lame = lame_of(values.stiffness[b, p])
            energy, stress = viscous_response(
                f, lame, c, values.strain_offset[b, p], values.dilation_offset[b, p]
            )
        return energy, stress

    @wp.func(module=module)
    def add_tangent(
        f: wp.mat33d, values: Values, b: int, p: int, clamp: bool, out: wp.array[wp.mat33d]
    ):
        """Adds the blocks of `respond`."""
        c = values.viscosity[b]
        if c[0] + c[1] > ZERO:
            lame = lame_of(values.stiffness[b, p])
            offset, dilation = values.strain_offset[b, p], values.dilation_offset[b, p]
            add_viscous_tangent(f, lame, c, offset, dilation, clamp, out)

    parts = {"Values": Values, "lame_of": lame_of, "respond": respond, "add_tangent": add_tangent}
    return SimpleNamespace(**parts, mu_of=mu_of, lambda_of=lambda_of)


@generated
def adjoint_kernel(law: Law) -> Any:
    """Returns the kernel of a material for derivatives by the values of a step."""
    viscosity = viscosity_of(law)
    slopes, vector = law.slopes, law.values
    values_type = viscosity.Values
    lame_of = viscosity.lame_of
    mu_of = viscosity.mu_of
    lambda_of = viscosity.lambda_of

    @wp.kernel(module=named_module(law.name))
    def adjoint(
        points: MatrixPoints,
        values: values_type,
        positions: wp.array2d[wp.vec3d],
        carried: wp.array[vector],  # (P) volumes that the points carry for each modulus [m^3]
        direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
        stiffness_out: wp.array2d[vector],  # (B, P) dL/d stiffness
        viscosity_out: wp.array2d[wp.vec2d],  # (B, P) this point's part of dL/d viscosity
        strain_out: wp.array2d[wp.mat33d],  # (B, P) dL/d strain_offset
        dilation_out: wp.array2d[wp.float64],  # (B, P) dL/d dilation_offset
    ):
        """Computes dL/dtheta = -z . d(internal residual)/dtheta = -dP/dtheta :
        grad z, at fixed positions.
        """
        b, p = wp.tid()
        f = matrix_at(points, positions, b, p)
        dz = matrix_at(points, direction, b, p)
        m = values.stiffness[b, p]
        # A stiffness of zero (nu = 0) has a derivative too, so only the volumes decide what is
        # skipped.
        elastic = slopes(f, dz, m, carried[p])
        by_lame, by_c, by_strain, by_dilation = viscous_slopes(
            f,
            dz,
            lame_of(m),
            values.viscosity[b],
            values.strain_offset[b, p],
            values.dilation_offset[b, p],
        )
        stiffness_out[b, p] = -elastic - by_lame[0] * mu_of - by_lame[1] * lambda_of
        viscosity_out[b, p] = -by_c
        strain_out[b, p] = -by_strain
        dilation_out[b, p] = -by_dilation

    return adjoint


@generated
def solid_kernels(law: Law) -> SimpleNamespace:
    """Returns the kernels of a material, and the struct of its values."""
    module, viscosity = named_module(law.name), viscosity_of(law)
    response, elastic_tangent = law.response, law.tangent
    values_type = viscosity.Values
    respond, add_tangent = viscosity.respond, viscosity.add_tangent

    @wp.kernel(module=module, launch_bounds=BOUNDS)
    def local_step(
        active: wp.array[int],  # (B) zero: skip the environment
        points: MatrixPoints,
        values: values_type,
        positions: wp.array2d[wp.vec3d],
        stress_out: wp.array2d[wp.mat33d],
        energy_out: wp.array2d[wp.float64],  # (B, P) [J]
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        f = matrix_at(points, positions, b, p)
        energy, stress = response(f, values.stiffness[b, p])
        added, viscous = respond(f, values, b, p)
        stress_out[b, p] = stress + viscous
        energy_out[b, p] = energy + added

    @wp.kernel(module=module, launch_bounds=BOUNDS)
    def tangent(
        active: wp.array[int],
        clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
        points: MatrixPoints,
        values: values_type,
        positions: wp.array2d[wp.vec3d],
        tangent_out: wp.array3d[wp.mat33d],
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        f = matrix_at(points, positions, b, p)
        out = tangent_out[b, p]
        elastic_tangent(f, values.stiffness[b, p], clamp[b] != 0, out)
        add_tangent(f, values, b, p, clamp[b] != 0, out)

    return SimpleNamespace(
        local_step=local_step, tangent=tangent, adjoint=adjoint_kernel(law), Values=values_type
    )
