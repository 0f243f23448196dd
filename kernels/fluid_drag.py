"""Drag and added mass of a medium on a surface over an implicit stage: stress and tangent.

A point of the surface is at x = sum_a g_a x_a. With its area a and normal n at the start of the
step, its displacement d since then, its offset e from the inertial target, and the coefficients
c = (linear, normal, tangential, inertial) of the step, its energy is

    a (c_l / 2 |d|^2 + c_n / 3 |d . n|^3 + c_t / 3 |d_t|^3 + c_i / 2 (e . n)^2),
    d_t = d - (d . n) n .
"""

import warp as wp

from .constants import HALF, THIRD, ZERO
from .points import VectorPoints, vector_at

wp.set_module_options({"enable_backward": False})


@wp.func
def split(displacement: wp.vec3d, area: wp.vec3d):
    """Returns size and normal of an area, and the normal (scalar)
    and tangential (vector) parts of a displacement.
    """
    n = wp.normalize(area)
    across = wp.dot(displacement, n)
    return wp.length(area), n, across, displacement - across * n


@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: VectorPoints,
    reference: wp.array2d[wp.vec3d],  # (B, P) position at the start of the step [m]
    target: wp.array2d[wp.vec3d],  # (B, P) inertial target [m]
    area: wp.array2d[wp.vec3d],  # (B, P) a n [m^2]
    coefficients: wp.array2d[wp.vec4d],  # (B, 1)
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.vec3d],
    energy_out: wp.array2d[wp.float64],
):
    """Computes force and energy of each point."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    x = vector_at(points, positions, b, p)
    d = x - reference[b, p]
    e = x - target[b, p]
    c = coefficients[b, 0]
    a, n, across, along = split(d, area[b, p])
    slip = wp.length(along)
    inertial = wp.dot(e, n)
    force = a * (
        c[0] * d + (c[1] * wp.abs(across) * across + c[3] * inertial) * n + c[2] * slip * along
    )
    stress_out[b, p] = force
    cubes = c[1] * wp.abs(across) * across * across + c[2] * slip * slip * slip
    energy_out[b, p] = a * (
        HALF * (c[0] * wp.dot(d, d) + c[3] * inertial * inertial) + THIRD * cubes
    )


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) without effect: the energy is convex
    points: VectorPoints,
    reference: wp.array2d[wp.vec3d],
    target: wp.array2d[wp.vec3d],
    area: wp.array2d[wp.vec3d],
    coefficients: wp.array2d[wp.vec4d],
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],  # (B, P, 1)
):
    """Computes the second derivative, without negative eigenvalues as the energy is convex."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    d = vector_at(points, positions, b, p) - reference[b, p]
    c = coefficients[b, 0]
    a, n, across, along = split(d, area[b, p])
    slip = wp.length(along)
    # The tangential part is c_t (|d_t| (1 - n n^T) + d_t d_t^T / |d_t|).
    even = a * (c[0] + c[2] * slip)
    block = a * (wp.float64(2.0) * c[1] * wp.abs(across) + c[3] - c[2] * slip) * wp.outer(n, n)
    if slip > ZERO:
        block += (a * c[2] / slip) * wp.outer(along, along)
    block[0, 0] += even
    block[1, 1] += even
    block[2, 2] += even
    tangent_out[b, p, 0] = block
