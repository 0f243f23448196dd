"""Threads that only pull: stress, tangent and derivative by the stiffness."""

import warp as wp

from .modules import decorators
from .points import line_at, write_axial

ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
SIXTH, TWENTY_FOURTH = wp.float64(1.0 / 6.0), wp.float64(1.0 / 24.0)

kernel, function = decorators("fibres")


@function
def tension(strain: wp.float64, toe: wp.float64):
    """Energy, force and slope of a thread of stiffness one: none below zero, linear in the strain past the toe."""
    energy = ZERO
    force = ZERO
    slope = ZERO
    if strain > toe:
        force = strain - HALF * toe
        energy = HALF * force * force + TWENTY_FOURTH * toe * toe
        slope = ONE
    elif strain > ZERO:
        slope = strain / toe
        force = HALF * strain * slope
        energy = SIXTH * strain * strain * slope
    return energy, force, slope


@kernel
def local_step(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    weights: wp.array[wp.float64],  # (P) area [m^2]
    chamber: wp.array[int],
    stiffness: wp.array2d[wp.float64],  # (B, chambers) [N/m]
    toe: wp.float64,
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """The pull along the fibre, and its energy."""
    b, p = wp.tid()
    fibre = line_at(positions, nodes, gradients, b, p, p / points_per_cell)
    stretch = wp.length(fibre)
    energy, force, _slope = tension(stretch - ONE, toe)
    scale = weights[p] * stiffness[b, chamber[p]]
    pull = wp.vec3d(ZERO, ZERO, ZERO)
    if stretch > ONE:
        pull = (scale * force / stretch) * fibre
    stress_out[b, p] = wp.mat33d(pull[0], ZERO, ZERO, pull[1], ZERO, ZERO, pull[2], ZERO, ZERO)
    energy_out[b, p] = scale * energy


@kernel
def tangent(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    weights: wp.array[wp.float64],
    chamber: wp.array[int],
    stiffness: wp.array2d[wp.float64],
    toe: wp.float64,
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Block (0, 0) is k w (s / lambda (1 - u u^T) + s' u u^T), which is never indefinite: a thread only pulls."""
    b, p = wp.tid()
    fibre = line_at(positions, nodes, gradients, b, p, p / points_per_cell)
    stretch = wp.length(fibre)
    across, along = ZERO, ZERO
    if stretch > ONE:
        _energy, force, slope = tension(stretch - ONE, toe)
        scale = weights[p] * stiffness[b, chamber[p]]
        across, along = scale * force / stretch, scale * slope
    write_axial(fibre, across, along, tangent_out[b, p])


@kernel
def adjoint(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    weights: wp.array[wp.float64],
    toe: wp.float64,
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    stiffness_out: wp.array2d[wp.float64],  # (B, P) this point's part of dL/dk of its chamber
):
    """dL/dk = -z . dg/dk = -w s (u . dz)."""
    b, p = wp.tid()
    cell = p / points_per_cell
    fibre = line_at(positions, nodes, gradients, b, p, cell)
    along = line_at(direction, nodes, gradients, b, p, cell)
    stretch = wp.length(fibre)
    _energy, force, _slope = tension(stretch - ONE, toe)
    result = ZERO
    if stretch > ONE:
        result = -weights[p] * force * wp.dot(fibre, along) / stretch
    stiffness_out[b, p] = result
