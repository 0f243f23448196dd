"""Tendons that slide without friction through guides: stress, tangent and derivatives by what pulls.

A point is the piece of a tendon between two guides. The first column of F = sum_a x_a g_a^T is the vector from one to
the other. A tendon's tension is that commanded, and that of a spring that only pulls, stretched by what the tendon is
longer than its winch leaves it.
"""

import warp as wp

from .fibres import tension
from .modules import decorators
from .points import deformation_gradient

ZERO, ONE = wp.float64(0.0), wp.float64(1.0)

kernel, function = decorators("tendons")


@function
def piece(
    positions: wp.array2d[wp.vec3d], nodes: wp.array2d[int], gradients: wp.array2d[wp.vec3d], b: int, p: int
) -> wp.vec3d:
    """From a guide to the next one."""
    f = deformation_gradient(positions, nodes, gradients, b, p, p)
    return wp.vec3d(f[0, 0], f[1, 0], f[2, 0])


@kernel
def pull(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    first: wp.array[int],  # (T + 1) pieces of each tendon, those at rest
    rest_length: wp.array[wp.float64],  # (T) of a tendon that nothing contracts [m]
    commanded: wp.array2d[wp.float64],  # (B, T) tension [N]
    contraction: wp.array2d[wp.float64],  # (B, T) [m]
    stiffness: wp.array2d[wp.float64],  # (B, T) of the spring [N/m]
    toe: wp.float64,  # over which the spring tightens [m]
    positions: wp.array2d[wp.vec3d],
    tension_out: wp.array2d[wp.float64],  # (B, T) [N]
    spring_out: wp.array2d[wp.vec3d],  # (B, T) energy, force and slope of a spring of stiffness one [m^2, m, -]
):
    """The tension of each tendon."""
    b, t = wp.tid()
    length = ZERO
    for p in range(first[t], first[t + 1]):
        length += wp.length(piece(positions, nodes, gradients, b, p))
    energy, force, slope = tension(length - rest_length[t] + contraction[b, t], toe)
    spring_out[b, t] = wp.vec3d(energy, force, slope)
    tension_out[b, t] = commanded[b, t] + stiffness[b, t] * force


@kernel
def local_step(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    first: wp.array[int],
    tendon: wp.array[int],  # (P)
    commanded: wp.array2d[wp.float64],
    stiffness: wp.array2d[wp.float64],
    total: wp.array2d[wp.float64],  # (B, T) what `pull` wrote
    spring: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """T L of the commanded tension, and the spring's energy with the first piece."""
    b, p = wp.tid()
    t = tendon[p]
    along = piece(positions, nodes, gradients, b, p)
    length = wp.length(along)
    energy = commanded[b, t] * length
    if p == first[t]:
        energy += stiffness[b, t] * spring[b, t][0]
    force = wp.vec3d(ZERO, ZERO, ZERO)
    if length > ZERO:
        force = (total[b, t] / length) * along
    stress_out[b, p] = wp.mat33d(force[0], ZERO, ZERO, force[1], ZERO, ZERO, force[2], ZERO, ZERO)
    energy_out[b, p] = energy


@kernel
def tangent(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    tendon: wp.array[int],
    total: wp.array2d[wp.float64],
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Block (0, 0) is T / l (1 - u u^T), at a given tension; that of its change couples all pieces of a tendon."""
    b, p = wp.tid()
    along = piece(positions, nodes, gradients, b, p)
    length = wp.length(along)
    out = tangent_out[b, p]
    nothing = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    for k in range(6):
        out[k] = nothing
    if length > ZERO:
        u = along / length
        block = -wp.outer(u, u)
        block[0, 0] += ONE
        block[1, 1] += ONE
        block[2, 2] += ONE
        out[0] = (total[b, tendon[p]] / length) * block


@kernel
def directions(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    direction_out: wp.array2d[wp.vec3d],  # (B, P)
):
    """Unit vectors along the pieces."""
    b, p = wp.tid()
    along = piece(positions, nodes, gradients, b, p)
    length = wp.length(along)
    result = wp.vec3d(ZERO, ZERO, ZERO)
    if length > ZERO:
        result = along / length
    direction_out[b, p] = result


@kernel
def shortening(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    shortening_out: wp.array2d[wp.float64],  # (B, P) -u . dz, dL/dT of this piece
):
    """How much shorter a displacement makes each piece."""
    b, p = wp.tid()
    along = piece(positions, nodes, gradients, b, p)
    dz = piece(direction, nodes, gradients, b, p)
    length = wp.length(along)
    result = ZERO
    if length > ZERO:
        result = -wp.dot(along, dz) / length
    shortening_out[b, p] = result
