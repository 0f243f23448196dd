"""Follower pressure in chambers: stress, tangent and derivative by the pressure."""

import warp as wp

from .matrices import cofactor
from .points import MatrixPoints, matrix_at

wp.set_module_options({"enable_backward": False})

ZERO = wp.float64(0.0)


# The potential of a uniform gauge pressure p is -p V (Bonet and Wood 2008, section 8.5.2). The faces are oriented into
# the chamber: V = -sum_q w_q det F, F = [x, t1, t2].
@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    weights: wp.array[wp.float64],  # (P) a third of the quadrature weight
    chamber: wp.array[int],  # (P)
    pressure: wp.array2d[wp.float64],  # (B, chambers) [Pa]
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],  # (B, P) [J]
):
    """-p V and its derivative."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    f = matrix_at(points, positions, b, p)
    scale = weights[p] * pressure[b, chamber[p]]
    stress_out[b, p] = scale * cofactor(f)
    energy_out[b, p] = scale * wp.determinant(f)


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) non-zero: set to zero, as the eigenvalues have both signs
    points: MatrixPoints,
    weights: wp.array[wp.float64],
    chamber: wp.array[int],
    pressure: wp.array2d[wp.float64],
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Derivative of cof F, whose column k is the cross product of the next two columns of F."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    f = matrix_at(points, positions, b, p)
    scale = weights[p] * pressure[b, chamber[p]]
    if clamp[b] != 0:
        scale = ZERO
    columns = wp.transpose(f)
    out = tangent_out[b, p]
    nothing = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    # Blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2).
    out[0] = nothing
    out[1] = scale * wp.skew(columns[2])
    out[2] = nothing
    out[3] = -scale * wp.skew(columns[1])
    out[4] = scale * wp.skew(columns[0])
    out[5] = nothing


@wp.kernel
def adjoint(
    points: MatrixPoints,
    weights: wp.array[wp.float64],
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    pressure_out: wp.array2d[wp.float64],  # (B, P) this point's part of dL/dp of its chamber
):
    """dL/dp = -z . dg/dp = -w cof F : grad z."""
    b, p = wp.tid()
    f = matrix_at(points, positions, b, p)
    dz = matrix_at(points, direction, b, p)
    pressure_out[b, p] = -weights[p] * wp.ddot(cofactor(f), dz)
