"""Tendons that slide without friction through guides: stress, tangent and derivatives by what pulls.

A point is the piece of a tendon between two guides. The first column of F = sum_a x_a g_a^T is the vector from one to
the other. A tendon's tension is that commanded, and that of a spring that only pulls, stretched by what the tendon is
longer than its winch leaves it.
"""

import warp as wp

from .fibres import tension
from .modules import decorators
from .points import line_at, write_axial

ZERO = wp.float64(0.0)

kernel, function = decorators("tendons")


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
        length += wp.length(line_at(positions, nodes, gradients, b, p, p))
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
    along = line_at(positions, nodes, gradients, b, p, p)
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
    along = line_at(positions, nodes, gradients, b, p, p)
    length = wp.length(along)
    across = ZERO
    if length > ZERO:
        across = total[b, tendon[p]] / length
    write_axial(along, across, ZERO, tangent_out[b, p])


@kernel
def directions(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    direction_out: wp.array2d[wp.vec3d],  # (B, P)
):
    """Unit vectors along the pieces."""
    b, p = wp.tid()
    along = line_at(positions, nodes, gradients, b, p, p)
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
    along = line_at(positions, nodes, gradients, b, p, p)
    dz = line_at(direction, nodes, gradients, b, p, p)
    length = wp.length(along)
    result = ZERO
    if length > ZERO:
        result = -wp.dot(along, dz) / length
    shortening_out[b, p] = result
