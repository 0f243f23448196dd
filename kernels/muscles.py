"""Fibres through a solid: stress, tangent and derivatives by what contracts them.

The first column of F = sum_a x_a g_a^T is the deformed fibre, of the length lambda of one that was one long. It pulls
with t = sigma + k s'(lambda - 1 + c): a commanded stress, and a spring that tightens where the fibre is longer than the
contraction c leaves it.
"""

import warp as wp

from .modules import decorators
from .points import line_at, write_axial

ZERO, HALF, ONE, TWO, THREE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0), wp.float64(3.0)
QUARTER, TENTH, FORTIETH = wp.float64(0.25), wp.float64(0.1), wp.float64(0.025)

kernel, function = decorators("muscles")


@function
def tension(strain: wp.float64, toe: wp.float64):
    """Energy, force and slope of a fibre of stiffness one, whose slope rises as 3 t^2 - 2 t^3 over the toe.

    Smoother than a thread's (`fibres.tension`), with the same force past the toe: there are fibres at every strain in a
    solid, and derivatives are compared with differences over all of them.
    """
    energy = ZERO
    force = ZERO
    slope = ZERO
    t = strain / toe
    if t > ONE:
        force = strain - HALF * toe
        energy = HALF * force * force + FORTIETH * toe * toe
        slope = ONE
    elif t > ZERO:
        slope = t * t * (THREE - TWO * t)
        force = toe * t * t * t * (ONE - HALF * t)
        energy = toe * toe * t * t * t * t * (QUARTER - TENTH * t)
    return energy, force, slope


@kernel
def local_step(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    volumes: wp.array[wp.float64],  # (P) [m^3]
    muscle: wp.array[int],  # (P)
    stress: wp.array2d[wp.float64],  # (B, muscles) sigma [Pa]
    contraction: wp.array2d[wp.float64],  # (B, muscles) c
    stiffness: wp.array2d[wp.float64],  # (B, muscles) k [Pa]
    toe: wp.float64,
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """The pull along the fibre, and its energy sigma lambda + k s."""
    b, p = wp.tid()
    m = muscle[p]
    fibre = line_at(positions, nodes, gradients, b, p, p / points_per_cell)
    stretch = wp.length(fibre)
    energy, force, _slope = tension(stretch - ONE + contraction[b, m], toe)
    pull = wp.vec3d(ZERO, ZERO, ZERO)
    if stretch > ZERO:
        pull = (volumes[p] * (stress[b, m] + stiffness[b, m] * force) / stretch) * fibre
    stress_out[b, p] = wp.mat33d(pull[0], ZERO, ZERO, pull[1], ZERO, ZERO, pull[2], ZERO, ZERO)
    energy_out[b, p] = volumes[p] * (stress[b, m] * stretch + stiffness[b, m] * energy)


@kernel
def tangent(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    volumes: wp.array[wp.float64],
    muscle: wp.array[int],
    stress: wp.array2d[wp.float64],
    contraction: wp.array2d[wp.float64],
    stiffness: wp.array2d[wp.float64],
    toe: wp.float64,
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    positive: wp.array[int],  # (B) 1: clamp the eigenvalues at zero
    tangent_out: wp.array3d[wp.mat33d],
):
    """Block (0, 0) is V (t / lambda (1 - u u^T) + k s'' u u^T), which is indefinite only where a fibre pushes."""
    b, p = wp.tid()
    m = muscle[p]
    fibre = line_at(positions, nodes, gradients, b, p, p / points_per_cell)
    stretch = wp.length(fibre)
    across, along = ZERO, ZERO
    if stretch > ZERO:
        _energy, force, slope = tension(stretch - ONE + contraction[b, m], toe)
        across = volumes[p] * (stress[b, m] + stiffness[b, m] * force) / stretch
        along = volumes[p] * stiffness[b, m] * slope
        if positive[b] == 1:
            across = wp.max(across, ZERO)
    write_axial(fibre, across, along, tangent_out[b, p])


@kernel
def adjoint(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    volumes: wp.array[wp.float64],
    muscle: wp.array[int],
    contraction: wp.array2d[wp.float64],
    stiffness: wp.array2d[wp.float64],
    toe: wp.float64,
    points_per_cell: int,
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    by_tension_out: wp.array2d[wp.vec3d],  # (B, P) this point's parts of dL/dsigma, dL/dc and dL/dk
):
    """dL/dt = -V u . dz, as the gradient is V t u; and t = sigma + k s'(lambda - 1 + c)."""
    b, p = wp.tid()
    m = muscle[p]
    fibre = line_at(positions, nodes, gradients, b, p, p / points_per_cell)
    along = line_at(direction, nodes, gradients, b, p, p / points_per_cell)
    stretch = wp.length(fibre)
    result = wp.vec3d(ZERO, ZERO, ZERO)
    if stretch > ZERO:
        _energy, force, slope = tension(stretch - ONE + contraction[b, m], toe)
        by_tension = -volumes[p] * wp.dot(fibre, along) / stretch
        result = by_tension * wp.vec3d(ONE, stiffness[b, m] * slope, force)
    by_tension_out[b, p] = result
