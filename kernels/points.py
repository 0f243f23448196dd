"""Kernels shared by the points of all energies: kinematics, gather, product with a tangent.

A point has an operator g_a for each of its nodes. Either g_a is a vector, and the energy is a
function of the matrix F = sum_a x_a g_a^T, such as a deformation gradient; or g_a is a number, and
the energy is a function of the vector sum_a g_a x_a, such as a fibre or a position. The stress has
the shape of the argument of the energy.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from .constants import HALF, ZERO
from .modules import generated, named_module

wp.set_module_options({"enable_backward": False})


@wp.struct
class MatrixPoints:
    """Points with operators for a matrix."""

    nodes: wp.array2d[int]  # (C, K)
    operators: wp.array2d[wp.vec3d]  # (P, K) g_a
    per_cell: int  # Q


@wp.struct
class VectorPoints:
    """Points with operators for a vector."""

    nodes: wp.array2d[int]
    operators: wp.array2d[wp.float64]
    per_cell: int


@wp.func
def matrix_at(points: MatrixPoints, positions: wp.array2d[wp.vec3d], b: int, p: int) -> wp.mat33d:
    """Returns F = sum_a x_a g_a^T."""
    nodes = points.nodes[p / points.per_cell]
    operators = points.operators[p]
    f = wp.mat33d(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO)
    for a in range(nodes.shape[0]):
        f += wp.outer(positions[b, nodes[a]], operators[a])
    return f


@wp.func
def vector_at(points: VectorPoints, positions: wp.array2d[wp.vec3d], b: int, p: int) -> wp.vec3d:
    """Returns sum_a g_a x_a, a deformed line, or a position."""
    nodes = points.nodes[p / points.per_cell]
    operators = points.operators[p]
    x = wp.vec3d(ZERO, ZERO, ZERO)
    for a in range(nodes.shape[0]):
        x += operators[a] * positions[b, nodes[a]]
    return x


@wp.func
def green_strain(f: wp.mat33d) -> wp.mat33d:
    """Returns E = (F^T F - I) / 2."""
    e = HALF * (wp.transpose(f) * f)
    return e - wp.mat33d(HALF, ZERO, ZERO, ZERO, HALF, ZERO, ZERO, ZERO, HALF)


@wp.struct
class PartValues:
    """Weights of points, and values at each of them, which are parts of any number of arrays."""

    weights: wp.array[wp.float64]  # (P)
    addresses: wp.array[wp.uint64]  # of float64 arrays (B, size)
    sizes: wp.array[int]
    places: wp.array2d[int]  # (n, P) column of each value at each point


@generated
def value_reader(vector: Any) -> Any:
    """Returns the function that reads the values at point p of environment b into a vector type."""

    @wp.func(module=named_module(f"values.{vector._length_}"))
    def read_values(from_parts: PartValues, b: int, p: int) -> vector:
        values = vector()
        for k in range(from_parts.places.shape[0]):
            size = from_parts.sizes[k]
            row = wp.array(ptr=from_parts.addresses[k], shape=((b + 1) * size,), dtype=wp.float64)
            values[k] = row[b * size + from_parts.places[k, p]]
        return values

    return read_values


@wp.func
def matrix_product(t: wp.array[wp.mat33d], df: wp.mat33d) -> wp.mat33d:
    """Returns the product of a tangent's six blocks with a change of F."""
    columns = wp.transpose(df)
    x = columns[0]
    y = columns[1]
    z = columns[2]
    return wp.matrix_from_cols(
        t[0] * x + wp.transpose(t[1]) * y + wp.transpose(t[3]) * z,
        t[1] * x + t[2] * y + wp.transpose(t[4]) * z,
        t[3] * x + t[4] * y + t[5] * z,
    )


@wp.func
def vector_product(t: wp.array[wp.mat33d], dx: wp.vec3d) -> wp.vec3d:
    """Returns the product of a tangent's only block with a change of a vector."""
    return t[0] * dx


@generated
def set_kernels(width: int) -> SimpleNamespace:
    """Returns kernels from stresses to forces and from tangents to stresses,
    for operators of a width of 1 or 3.
    """
    module = named_module(f"points.{width}")
    points_type, shape = (VectorPoints, wp.vec3d) if width == 1 else (MatrixPoints, wp.mat33d)
    see, product = (vector_at, vector_product) if width == 1 else (matrix_at, matrix_product)

    @wp.kernel(module=module)
    def gather(
        points: points_type,
        incident_start: wp.array[int],  # (N + 1) first entry of each vertex
        incident: wp.array[int],  # cell * K + node, cells ascending: a fixed summation order
        stress: wp.array2d[shape],
        force_out: wp.array2d[wp.vec3d],  # (B, N) [N], added to
    ):
        """Adds the transposed operator applied to the stress to the force of every vertex."""
        b, i = wp.tid()
        total = force_out[b, i]
        k = points.nodes.shape[1]
        for entry in range(incident_start[i], incident_start[i + 1]):
            cell = incident[entry] / k
            a = incident[entry] - cell * k
            for q in range(points.per_cell):
                p = cell * points.per_cell + q
                total += stress[b, p] * points.operators[p, a]
        force_out[b, i] = total

    @wp.kernel(module=module)
    def cell_forces(
        active: wp.array[int],  # (B) zero: skip the environment
        points: points_type,
        stress: wp.array2d[shape],
        force_out: wp.array2d[wp.vec3d],  # (B, C K) [N]
    ):
        """Applies the transposed operator to the stress, per cell and local node.

        `gather_cells` sums the results.
        """
        b, entry = wp.tid()
        if active[b] == 0:
            return
        k = points.nodes.shape[1]
        cell = entry / k
        a = entry - cell * k
        total = wp.vec3d(ZERO, ZERO, ZERO)
        for q in range(points.per_cell):
            p = cell * points.per_cell + q
            total += stress[b, p] * points.operators[p, a]
        force_out[b, entry] = total

    @wp.kernel(module=module)
    def tangent_product(
        points: points_type,
        tangent: wp.array3d[wp.mat33d],  # (B, P, 6 or 1)
        direction: wp.array2d[wp.vec3d],  # (B, N) [m]
        stress_out: wp.array2d[shape],  # (B, P) its derivative in that direction
    ):
        b, p = wp.tid()
        stress_out[b, p] = product(tangent[b, p], see(points, direction, b, p))

    return SimpleNamespace(gather=gather, cell_forces=cell_forces, tangent_product=tangent_product)


@wp.kernel
def gather_cells(
    incident_start: wp.array[int],
    incident: wp.array[int],
    cell_force: wp.array2d[wp.vec3d],  # (B, C K) [N]
    force_out: wp.array2d[wp.vec3d],  # (B, N) [N], added to
):
    """Adds the results of `cell_forces` to the force of every vertex."""
    b, i = wp.tid()
    total = force_out[b, i]
    for entry in range(incident_start[i], incident_start[i + 1]):
        total += cell_force[b, incident[entry]]
    force_out[b, i] = total


@wp.kernel
def inertia_residual(
    inertia: wp.array2d[wp.float64],  # (B, N) [N/m] mass over the square of the effective time step
    target: wp.array2d[wp.vec3d],  # (B, N) [m] inertial target
    force: wp.array2d[wp.vec3d],  # (B, N) [N]
    positions: wp.array2d[wp.vec3d],
    residual_out: wp.array2d[wp.vec3d],  # (B, N) [N]
    energy_out: wp.array2d[wp.float64],  # (B, N) [J]
):
    """Computes inertia less the loads, k (x - y) - f, and its energy."""
    b, i = wp.tid()
    offset = positions[b, i] - target[b, i]
    pull = inertia[b, i] * offset
    residual_out[b, i] = pull - force[b, i]
    energy_out[b, i] = wp.dot(HALF * pull - force[b, i], offset)


@wp.kernel
def project(
    active: wp.array[int],  # (B) zero: the environment keeps what was removed
    vertices: wp.array[int],  # (R)
    projections: wp.array[wp.mat33d],  # (R)
    first: int,  # zero: what is removed is added to what was removed before
    vectors_out: wp.array2d[wp.vec3d],  # (B, N)
    removed_out: wp.array2d[wp.vec3d],  # (B, N)
):
    """Removes the components of vectors that are normal to symmetry planes."""
    b, r = wp.tid()
    i = vertices[r]
    vector = vectors_out[b, i]
    kept = projections[r] * vector
    vectors_out[b, i] = kept
    if active[b] != 0:
        removed = vector - kept
        if first == 0:
            removed += removed_out[b, i]
        removed_out[b, i] = removed
