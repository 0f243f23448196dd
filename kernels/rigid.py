"""Inertia of points at weighted sums of vertices, k / 2 |x - y|^2, and rotations of rigid parts."""

import warp as wp

from .matrices import polar_rotation
from .points import MatrixPoints, VectorPoints, matrix_at, vector_at

wp.set_module_options({"enable_backward": False})

ZERO, HALF = wp.float64(0.0), wp.float64(0.5)


@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: VectorPoints,
    inertia: wp.array2d[wp.float64],  # (B, P) k, mass over the square of the effective time step [N/m]
    target: wp.array2d[wp.vec3d],  # (B, P) y, inertial target [m]
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.vec3d],
    energy_out: wp.array2d[wp.float64],
):
    """Inertial force k (x - y), and its energy."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    offset = vector_at(points, positions, b, p) - target[b, p]
    pull = inertia[b, p] * offset
    stress_out[b, p] = pull
    energy_out[b, p] = HALF * wp.dot(pull, offset)


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) without effect: the energy is convex
    inertia: wp.array2d[wp.float64],
    tangent_out: wp.array3d[wp.mat33d],  # (B, P, 1)
):
    """K times the identity."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    k = inertia[b, p]
    tangent_out[b, p, 0] = wp.mat33d(k, ZERO, ZERO, ZERO, k, ZERO, ZERO, ZERO, k)


@wp.kernel
def slopes(
    points: VectorPoints,
    inertia: wp.array2d[wp.float64],
    target: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    inertia_out: wp.array2d[wp.float64],  # (B, P) dL/dk
    target_out: wp.array2d[wp.vec3d],  # (B, P) dL/dy
):
    """-z . d residual by the inertia and by the target."""
    b, p = wp.tid()
    offset = vector_at(points, positions, b, p) - target[b, p]
    dz = vector_at(points, direction, b, p)
    inertia_out[b, p] = -wp.dot(offset, dz)
    target_out[b, p] = inertia[b, p] * dz


@wp.kernel
def straighten(
    points: MatrixPoints,
    centre: wp.array2d[wp.float64],  # (P, 4) weights of the centre of mass
    arms: wp.array2d[wp.vec3d],  # (P, 4) from there to the control vertices at rest [m]
    positions: wp.array2d[wp.vec3d],
):
    """Replaces the deformation gradient of every part by its rotation, with the centre of mass in its place."""
    b, p = wp.tid()
    r = polar_rotation(matrix_at(points, positions, b, p))
    middle = wp.vec3d()
    for a in range(4):
        middle += centre[p, a] * positions[b, points.nodes[p, a]]
    for a in range(4):
        positions[b, points.nodes[p, a]] = middle + r * arms[p, a]
