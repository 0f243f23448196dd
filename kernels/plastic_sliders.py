"""Sliders of a solid in parallel: stress and energy of a step, tangent and derivatives (``energies.hysteresis``)."""

import warp as wp

from .elasticity import add_square, add_strain_tangent
from .points import MatrixPoints, green_strain, matrix_at

wp.set_module_options({"enable_backward": False})

ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
TWO, FOUR = wp.float64(2.0), wp.float64(4.0)


@wp.func
def slider(square: wp.float64, limit: wp.float64) -> wp.vec3d:
    """Returns phi, phi' and phi'' of the squared trial strain: s if it sticks, 2 e sqrt(s) - e^2 if it slides."""
    if square <= limit * limit:
        return wp.vec3d(square, ONE, ZERO)
    size = wp.sqrt(square)
    slope = limit / size
    return wp.vec3d(limit * (TWO * size - limit), slope, -HALF * slope / square)


@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    modulus: wp.array2d[wp.float64],  # (B, P) mu times the point's volume [J]
    sliders: wp.array2d[wp.vec2d],  # (B, K) ratio g and yield strain e
    plastic: wp.array3d[wp.mat33d],  # (B, K, P) plastic strain at the start of the step
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],  # (B, P) [J]
):
    """Stress F S and energy of all sliders."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    f = matrix_at(points, positions, b, p)
    strain = green_strain(f)
    stress, energy = wp.mat33d(), wp.float64(0.0)
    for k in range(sliders.shape[1]):
        trial = strain - plastic[b, k, p]
        phi = slider(wp.ddot(trial, trial), sliders[b, k][1])
        m = modulus[b, p] * sliders[b, k][0]
        energy += m * phi[0]
        stress += (TWO * m * phi[1]) * trial
    stress_out[b, p] = f * stress
    energy_out[b, p] = energy


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
    points: MatrixPoints,
    modulus: wp.array2d[wp.float64],
    sliders: wp.array2d[wp.vec2d],
    plastic: wp.array3d[wp.mat33d],
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],  # (B, P, 6)
):
    """Computes the derivative of F S by F."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    f = matrix_at(points, positions, b, p)
    strain = green_strain(f)
    out = tangent_out[b, p]
    for i in range(6):
        out[i] = wp.mat33d()
    stress, shape = wp.mat33d(), wp.float64(0.0)
    for k in range(sliders.shape[1]):
        trial = strain - plastic[b, k, p]
        phi = slider(wp.ddot(trial, trial), sliders[b, k][1])
        m = modulus[b, p] * sliders[b, k][0]
        add_square(f * trial, FOUR * m * phi[2], out)
        shape += m * phi[1]
        if clamp[b] == 0:  # The stress part may be indefinite; the rest is not, as the potential is convex in E.
            stress += (TWO * m * phi[1]) * trial
    add_strain_tangent(f, stress, shape, ZERO, out)


@wp.kernel
def adjoint(
    points: MatrixPoints,
    modulus: wp.array2d[wp.float64],
    sliders: wp.array2d[wp.vec2d],
    plastic: wp.array3d[wp.mat33d],
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    modulus_out: wp.array2d[wp.float64],  # (B, P) dL/d modulus
    sliders_out: wp.array3d[wp.vec2d],  # (B, K, P) this point's part of dL/d sliders
    plastic_out: wp.array3d[wp.mat33d],  # (B, K, P) dL/d plastic
):
    """Computes dL/dtheta = -dP/dtheta : grad z = -dS/dtheta : R, R = sym(F^T grad z), S = 2 m phi'(A : A) A.

    With a = A : R: by g, -2 mu V phi' a; by e, -2 m a / |A| where the slider slides; by the plastic strain
    A = E - E_p has, 2 m (phi' R + 2 phi'' a A).
    """
    b, p = wp.tid()
    f = matrix_at(points, positions, b, p)
    rise = wp.transpose(f) * matrix_at(points, direction, b, p)
    rise = HALF * (rise + wp.transpose(rise))
    strain = green_strain(f)
    by_modulus = wp.float64(0.0)
    for k in range(sliders.shape[1]):
        trial = strain - plastic[b, k, p]
        ratio, limit = sliders[b, k][0], sliders[b, k][1]
        phi = slider(wp.ddot(trial, trial), limit)
        along = wp.ddot(trial, rise)
        m = modulus[b, p] * ratio
        by_ratio = -TWO * phi[1] * along
        by_limit = ZERO
        if phi[1] < ONE:
            by_limit = m * by_ratio / limit
        by_modulus += ratio * by_ratio
        sliders_out[b, k, p] = wp.vec2d(modulus[b, p] * by_ratio, by_limit)
        plastic_out[b, k, p] = (TWO * m) * (phi[1] * rise + (TWO * phi[2] * along) * trial)
    modulus_out[b, p] = by_modulus
