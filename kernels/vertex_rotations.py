"""Mean rotations of the cells around vertices, and rotations of rigid parts."""

import warp as wp

from .constants import ONE, THIRD
from .matrices import polar_rotation
from .points import MatrixPoints, matrix_at

wp.set_module_options({"enable_backward": False})

# Of determinants; gradients are scaled by the mean volume of cells.
SMALLEST = wp.constant(wp.float64(1.0e-30))


@wp.kernel
def cell_gradients(
    points: MatrixPoints,
    operators: wp.array2d[wp.vec3d],  # (C, K) mean gradients of the shape functions, times a weight
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    gradient_out: wp.array2d[wp.mat33d],  # (B, C)
):
    """Computes weighted mean deformation gradients of cells."""
    b, cell = wp.tid()
    f = wp.mat33d()
    for a in range(points.nodes.shape[1]):
        f += wp.outer(positions[b, points.nodes[cell, a]], operators[cell, a])
    gradient_out[b, cell] = f


@wp.kernel
def sum_at_vertices(
    start: wp.array[int],  # (N + 1) first entry of each vertex in `incident`
    incident: wp.array[int],  # cell K + local node
    nodes_per_cell: int,
    gradient: wp.array2d[wp.mat33d],  # (B, C)
    sum_out: wp.array2d[wp.mat33d],  # (B, N), added to
):
    """Adds the gradients of the cells around each vertex."""
    b, i = wp.tid()
    total = sum_out[b, i]
    for entry in range(start[i], start[i + 1]):
        total += gradient[b, incident[entry] / nodes_per_cell]
    sum_out[b, i] = total


@wp.kernel
def rotation(
    fixed: wp.array[int],  # (N) not zero: vertices without rotation
    gradient: wp.array2d[wp.mat33d],  # (B, N) up to a positive factor
    rotation_out: wp.array2d[wp.mat33d],
):
    """Computes the nearest rotations, the identity where a gradient is singular or inverted."""
    b, i = wp.tid()
    f = gradient[b, i]
    size = wp.determinant(f)
    rotation_out[b, i] = wp.identity(n=3, dtype=wp.float64)
    if fixed[i] == 0 and size > SMALLEST:
        rotation_out[b, i] = polar_rotation((ONE / wp.pow(size, THIRD)) * f)


@wp.kernel
def rotation_since(
    vertices: wp.array[int],  # (F)
    before: wp.array2d[wp.mat33d],  # (B, F)
    rotation: wp.array2d[wp.mat33d],  # (B, N)
    since_out: wp.array2d[wp.mat33d],  # (B, F)
):
    """Computes rotations of vertices from earlier ones to the present ones."""
    b, k = wp.tid()
    since_out[b, k] = rotation[b, vertices[k]] * wp.transpose(before[b, k])


@wp.kernel
def straighten(
    points: MatrixPoints,
    centre: wp.array2d[wp.float64],  # (P, 4) weights of the centre of mass
    arms: wp.array2d[wp.vec3d],  # (P, 4) from there to the control vertices at rest [m]
    positions_out: wp.array2d[wp.vec3d],
):
    """Replaces the deformation gradient of every part by its rotation,
    with the centre of mass in its place.
    """
    b, p = wp.tid()
    r = polar_rotation(matrix_at(points, positions_out, b, p))
    middle = wp.vec3d()
    for a in range(4):
        middle += centre[p, a] * positions_out[b, points.nodes[p, a]]
    for a in range(4):
        positions_out[b, points.nodes[p, a]] = middle + r * arms[p, a]
