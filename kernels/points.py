"""What the points of every energy share: the matrix F, the gather, the product with a tangent; and inertia."""

import warp as wp

from .modules import decorators

ZERO, HALF = wp.float64(0.0), wp.float64(0.5)

kernel, function = decorators()


@function
def deformation_gradient(
    positions: wp.array2d[wp.vec3d], nodes: wp.array2d[int], gradients: wp.array2d[wp.vec3d], b: int, p: int, cell: int
) -> wp.mat33d:
    """F = sum_a x_a (grad N_a)^T."""
    f = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    for a in range(nodes.shape[1]):
        f += wp.outer(positions[b, nodes[cell, a]], gradients[p, a])
    return f


@function
def line_at(
    positions: wp.array2d[wp.vec3d], nodes: wp.array2d[int], gradients: wp.array2d[wp.vec3d], b: int, p: int, cell: int
) -> wp.vec3d:
    """The first column of F: what becomes of the line that the first components of the operators tell."""
    f = deformation_gradient(positions, nodes, gradients, b, p, cell)
    return wp.vec3d(f[0, 0], f[1, 0], f[2, 0])


@function
def write_axial(line: wp.vec3d, across: wp.float64, along: wp.float64, out: wp.array[wp.mat33d]):
    """The six blocks of a tangent along a line alone: (0, 0) is across (1 - u u^T) + along u u^T, all else zero."""
    nothing = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    for k in range(6):
        out[k] = nothing
    length = wp.length(line)
    if length > ZERO:
        u = line / length
        block = (along - across) * wp.outer(u, u)
        block[0, 0] += across
        block[1, 1] += across
        block[2, 2] += across
        out[0] = block


@function
def green_strain(f: wp.mat33d) -> wp.mat33d:
    """E = (F^T F - I) / 2."""
    e = HALF * (wp.transpose(f) * f)
    return e - wp.mat33d(HALF, ZERO, ZERO, ZERO, HALF, ZERO, ZERO, ZERO, HALF)


@kernel
def gather(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    points_per_cell: int,
    incident_start: wp.array[int],  # (N + 1) where a vertex's entries begin
    incident: wp.array[int],  # cell * K + local node, cells in ascending order: a fixed summation order
    stress: wp.array2d[wp.mat33d],
    force_out: wp.array2d[wp.vec3d],  # (B, N) [N] has the transposed deformation gradient of the stress added
):
    """Adds the transposed operator of the stress to the force of every vertex."""
    b, i = wp.tid()
    total = force_out[b, i]
    k = nodes.shape[1]
    for entry in range(incident_start[i], incident_start[i + 1]):
        cell = incident[entry] / k
        a = incident[entry] - cell * k
        for q in range(points_per_cell):
            p = cell * points_per_cell + q
            total += stress[b, p] * gradients[p, a]
    force_out[b, i] = total


@kernel
def cell_forces(
    asleep: wp.array[int],  # (B) not zero where nothing is to be done
    gradients: wp.array2d[wp.vec3d],  # (P, K)
    points_per_cell: int,
    stress: wp.array2d[wp.mat33d],
    force_out: wp.array2d[wp.vec3d],  # (B, C K) [N]
):
    """The transposed operator of the stress, by cell and local node: what `gather_cells` sums."""
    b, entry = wp.tid()
    if asleep[b] != 0:
        return
    k = gradients.shape[1]
    cell = entry / k
    a = entry - cell * k
    total = wp.vec3d(ZERO, ZERO, ZERO)
    for q in range(points_per_cell):
        p = cell * points_per_cell + q
        total += stress[b, p] * gradients[p, a]
    force_out[b, entry] = total


@kernel
def gather_cells(
    incident_start: wp.array[int],
    incident: wp.array[int],
    cell_force: wp.array2d[wp.vec3d],  # (B, C K) [N]
    force_out: wp.array2d[wp.vec3d],  # (B, N) [N] has them added
):
    """Adds what `cell_forces` has found to the force of every vertex."""
    b, i = wp.tid()
    total = force_out[b, i]
    for entry in range(incident_start[i], incident_start[i + 1]):
        total += cell_force[b, incident[entry]]
    force_out[b, i] = total


@kernel
def inertia_residual(
    inertia: wp.array2d[wp.float64],  # (B, N) [N/m] mass over the square of the effective time step
    target: wp.array2d[wp.vec3d],  # (B, N) [m] where inertia alone would take the vertex
    force: wp.array2d[wp.vec3d],  # (B, N) [N]
    positions: wp.array2d[wp.vec3d],
    residual_out: wp.array2d[wp.vec3d],  # (B, N) [N]
    energy_out: wp.array2d[wp.float64],  # (B, N) [J]
):
    """Inertia less the loads, k (x - y) - f, and its energy."""
    b, i = wp.tid()
    offset = positions[b, i] - target[b, i]
    pull = inertia[b, i] * offset
    residual_out[b, i] = pull - force[b, i]
    energy_out[b, i] = wp.dot(HALF * pull - force[b, i], offset)


@kernel
def tangent_product(
    nodes: wp.array2d[int],
    gradients: wp.array2d[wp.vec3d],
    points_per_cell: int,
    tangent_point: wp.array3d[wp.mat33d],
    direction: wp.array2d[wp.vec3d],  # (B, N) [m]
    stress_out: wp.array2d[wp.mat33d],  # (B, P) dP in that direction [J]
):
    """The change of stress in a direction."""
    b, p = wp.tid()
    df = deformation_gradient(direction, nodes, gradients, b, p, p / points_per_cell)
    t = tangent_point[b, p]
    columns = wp.transpose(df)
    x = columns[0]
    y = columns[1]
    z = columns[2]
    stress_out[b, p] = wp.matrix_from_cols(
        t[0] * x + wp.transpose(t[1]) * y + wp.transpose(t[3]) * z,
        t[1] * x + t[2] * y + wp.transpose(t[4]) * z,
        t[3] * x + t[4] * y + t[5] * z,
    )
