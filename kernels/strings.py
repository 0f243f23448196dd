"""Weights on strings: stress, tangent and derivatives of a spring that only pulls, from a vertex to a given place.

The first column of F = sum_a x_a g_a^T is where the string is tied to.
"""

import warp as wp

from .fibres import tension
from .modules import decorators
from .points import line_at, write_axial

ZERO = wp.float64(0.0)

kernel, function = decorators("strings")


@function
def from_target(
    positions: wp.array2d[wp.vec3d],
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    target: wp.array2d[wp.vec3d],
    b: int,
    p: int,
):
    """The unit vector from the place that a string pulls to, to where it is tied, and the distance [m]."""
    along = line_at(positions, nodes, gradients, b, p, p) - target[b, p]
    length = wp.length(along)
    if length > ZERO:
        along = along / length
    return along, length


@kernel
def local_step(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    target: wp.array2d[wp.vec3d],  # (B, S) [m]
    stiffness: wp.array2d[wp.float64],  # (B, S) [N/m]
    rest_length: wp.array2d[wp.float64],  # (B, S) [m]
    toe: wp.float64,  # over which it tightens [m]
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """Pull and energy of each string."""
    b, p = wp.tid()
    along, length = from_target(positions, nodes, gradients, target, b, p)
    energy, force, _slope = tension(length - rest_length[b, p], toe)
    pull = (stiffness[b, p] * force) * along
    stress_out[b, p] = wp.mat33d(pull[0], ZERO, ZERO, pull[1], ZERO, ZERO, pull[2], ZERO, ZERO)
    energy_out[b, p] = stiffness[b, p] * energy


@kernel
def tangent(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    target: wp.array2d[wp.vec3d],
    stiffness: wp.array2d[wp.float64],
    rest_length: wp.array2d[wp.float64],
    toe: wp.float64,
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Block (0, 0) is k (s'' u u^T + s' / l (1 - u u^T)); it has no negative eigenvalues."""
    b, p = wp.tid()
    along, length = from_target(positions, nodes, gradients, target, b, p)
    _energy, force, slope = tension(length - rest_length[b, p], toe)
    across = ZERO
    if length > ZERO:
        across = stiffness[b, p] * force / length
    write_axial(along, across, stiffness[b, p] * slope, tangent_out[b, p])


@kernel
def slopes(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    target: wp.array2d[wp.vec3d],
    stiffness: wp.array2d[wp.float64],
    rest_length: wp.array2d[wp.float64],
    toe: wp.float64,
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    by_target: wp.array2d[wp.vec3d],  # (B, S) dL/d(target)
    by_others: wp.array2d[wp.vec3d],  # (B, S) dL/d(stiffness), dL/d(length), nothing
):
    """-z . d residual by what a string depends on."""
    b, p = wp.tid()
    along, length = from_target(positions, nodes, gradients, target, b, p)
    _energy, force, slope = tension(length - rest_length[b, p], toe)
    dz = line_at(direction, nodes, gradients, b, p, p)
    axial = wp.dot(along, dz)
    across = ZERO
    if length > ZERO:
        across = force / length
    by_target[b, p] = stiffness[b, p] * (slope * axial * along + across * (dz - axial * along))
    by_others[b, p] = wp.vec3d(-force * axial, stiffness[b, p] * slope * axial, ZERO)
