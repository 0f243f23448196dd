"""Inertia of points that weighted sums of vertices move: k / 2 |x - y|^2 with x the first column of F."""

import warp as wp

from .modules import decorators
from .points import line_at

ZERO, HALF = wp.float64(0.0), wp.float64(0.5)

kernel, function = decorators("point_inertia")


@kernel
def local_step(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    inertia: wp.array2d[wp.float64],  # (B, P) k, mass over the square of the effective time step [N/m]
    target: wp.array2d[wp.vec3d],  # (B, P) y, where inertia alone would take the point [m]
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """Inertial force k (x - y), and its energy."""
    b, p = wp.tid()
    offset = line_at(positions, nodes, gradients, b, p, p / points_per_cell) - target[b, p]
    pull = inertia[b, p] * offset
    stress_out[b, p] = wp.mat33d(pull[0], ZERO, ZERO, pull[1], ZERO, ZERO, pull[2], ZERO, ZERO)
    energy_out[b, p] = HALF * wp.dot(pull, offset)


@kernel
def tangent(
    inertia: wp.array2d[wp.float64],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Block (0, 0) is k times the identity."""
    b, p = wp.tid()
    nothing = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    for block in range(6):
        tangent_out[b, p, block] = nothing
    k = inertia[b, p]
    tangent_out[b, p, 0] = wp.mat33d(k, ZERO, ZERO, ZERO, k, ZERO, ZERO, ZERO, k)


@kernel
def slopes(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    inertia: wp.array2d[wp.float64],
    target: wp.array2d[wp.vec3d],
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    inertia_out: wp.array2d[wp.float64],  # (B, P) dL/dk
    target_out: wp.array2d[wp.vec3d],  # (B, P) dL/dy
):
    """-z . d residual by the inertia and by the target."""
    b, p = wp.tid()
    cell = p / points_per_cell
    offset = line_at(positions, nodes, gradients, b, p, cell) - target[b, p]
    dz = line_at(direction, nodes, gradients, b, p, cell)
    inertia_out[b, p] = -wp.dot(offset, dz)
    target_out[b, p] = inertia[b, p] * dz
