"""Hessian blocks of the cells, and their assembly into the value array of a linear solver."""

from typing import Any

import warp as wp

from .modules import generated, named_module
from .points import MatrixPoints, VectorPoints

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sum_blocks(
    start: wp.array[int],  # (R + 1) first entry of every row in `incident`
    incident: wp.array[int],  # 4 pair + its number in it, ascending: a fixed summation order
    rows: wp.array[wp.vec3i],  # (R) first value of a row's matrix, its size, the row's vertex
    columns: wp.array[wp.vec4i],  # (A) numbers of the vertices of a pair, -1: left out
    blocks: wp.array3d[wp.float64],  # (A, 12, 12) [N/m]
    matrices_out: wp.array[wp.float64],  # matrices, one after another, zero before
):
    """Sums matrices of pairs into those of environments."""
    r = wp.tid()
    row = rows[r]
    for entry in range(start[r], start[r + 1]):
        pair = incident[entry] / 4
        first = 3 * (incident[entry] - 4 * pair)
        for k in range(3):
            to = row[0] + (3 * row[2] + k) * row[1]
            for j in range(4):
                column = columns[pair][j]
                if column >= 0:
                    for m in range(3):
                        matrices_out[to + 3 * column + m] += blocks[pair, first + k, 3 * j + m]


@wp.kernel
def cell_blocks(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    tangent: wp.array3d[wp.mat33d],  # (B, P, 6)
    block_offset: int,
    blocks_out: wp.array2d[wp.mat33d],  # (B, C K (K + 1) / 2 from block_offset on) [N/m], a >= c
):
    """Computes the blocks (a, c) of a cell, d force_a / d x_c."""
    b, cell, a = wp.tid()
    if active[b] == 0:
        return
    k = points.nodes.shape[1]
    first = block_offset + cell * (k * (k + 1)) / 2 + (a * (a + 1)) / 2
    for q in range(points.per_cell):
        p = cell * points.per_cell + q
        g = points.operators[p, a]
        t = tangent[b, p]
        x = g[0] * t[0] + g[1] * t[1] + g[2] * t[3]
        y = g[0] * wp.transpose(t[1]) + g[1] * t[2] + g[2] * t[4]
        z = g[0] * wp.transpose(t[3]) + g[1] * wp.transpose(t[4]) + g[2] * t[5]
        for c in range(a + 1):
            h = points.operators[p, c]
            block = h[0] * x + h[1] * y + h[2] * z
            if q > 0:
                block += blocks_out[b, first + c]
            blocks_out[b, first + c] = block


@wp.func
def matrix_block(t: wp.array[wp.mat33d], g: wp.vec3d, h: wp.vec3d) -> wp.mat33d:
    """Returns the stiffness between nodes with operators g and h, from a tangent's six blocks."""
    total = (g[0] * h[0]) * t[0] + (g[1] * h[1]) * t[2] + (g[2] * h[2]) * t[5]
    total += (g[1] * h[0]) * t[1] + (g[0] * h[1]) * wp.transpose(t[1])
    total += (g[2] * h[0]) * t[3] + (g[0] * h[2]) * wp.transpose(t[3])
    return total + (g[2] * h[1]) * t[4] + (g[1] * h[2]) * wp.transpose(t[4])


@wp.func
def vector_block(t: wp.array[wp.mat33d], g: wp.float64, h: wp.float64) -> wp.mat33d:
    """Returns the same from a tangent's only block."""
    return (g * h) * t[0]


@generated
def pair_kernel(width: int) -> Any:
    """Returns `cell_blocks`, for operators of a width of 1 or 3, with one thread per block.

    That is more arithmetic, but every block is written once.
    """
    points_type, block = (
        (VectorPoints, vector_block) if width == 1 else (MatrixPoints, matrix_block)
    )

    @wp.kernel(module=named_module(f"hessian_blocks.{width}"))
    def pair_blocks(
        active: wp.array[int],  # (B) zero: skip the environment
        points: points_type,
        tangent: wp.array3d[wp.mat33d],  # (B, P, 6 or 1)
        pairs: wp.array2d[int],  # (K (K + 1) / 2, 2) rows a >= columns c
        block_offset: int,
        blocks_out: wp.array2d[wp.mat33d],
    ):
        b, cell, pair = wp.tid()
        if active[b] == 0:
            return
        total = wp.mat33d()
        for q in range(points.per_cell):
            p = cell * points.per_cell + q
            total += block(
                tangent[b, p],
                points.operators[p, pairs[pair, 0]],
                points.operators[p, pairs[pair, 1]],
            )
        blocks_out[b, block_offset + cell * pairs.shape[0] + pair] = total

    return pair_blocks


@generated
def scatter_kernel(scalar: Any) -> Any:
    """Returns `scatter_blocks` for values of type ``wp.float64`` or ``wp.float32``."""
    module = named_module(f"assembly.{scalar.__name__}")

    @wp.kernel(module=module)
    def scatter_blocks(
        active: wp.array[int],  # (B) zero: skip the environment
        block_start: wp.array[int],  # (blocks + 1) first contribution of each matrix block
        contribution: wp.array[int],  # index of a cell block, or -1 - index for its transpose
        diagonal_vertex: wp.array[int],  # (blocks) vertex of a diagonal block, else -1
        address: wp.array2d[int],  # (blocks, 9) index in the value array, or -1
        cell_block: wp.array2d[wp.mat33d],
        inertia: wp.array2d[wp.float64],  # (B, N) [N/m]
        values_out: wp.array2d[scalar],  # (B, layout size) [N/m]
    ):
        """Writes the matrix entries: sums of cell blocks, plus inertia on the diagonal."""
        b, block = wp.tid()
        if active[b] == 0:
            return
        total = wp.mat33d()
        for entry in range(block_start[block], block_start[block + 1]):
            source = contribution[entry]
            if source >= 0:
                total += cell_block[b, source]
            else:
                total += wp.transpose(cell_block[b, -1 - source])
        i = diagonal_vertex[block]
        if i >= 0:
            k = inertia[b, i]
            total[0, 0] += k
            total[1, 1] += k
            total[2, 2] += k
        for r in range(3):
            for c in range(3):
                at = address[block, 3 * r + c]
                if at >= 0:
                    values_out[b, at] = scalar(total[r, c])

    return scatter_blocks


@generated
def projection_kernel(scalar: Any) -> Any:
    """Returns `project_blocks` for values of type ``wp.float64`` or ``wp.float32``."""
    module = named_module(f"assembly.projection.{scalar.__name__}")

    @wp.kernel(module=module)
    def project_blocks(
        active: wp.array[int],  # (B) zero: skip the environment
        blocks: wp.array2d[int],  # (T, 3) block, projections of its row and column, or -1
        projections: wp.array[wp.mat33d],  # (R)
        address: wp.array2d[int],  # (blocks, 9) index in the value array, or -1
        values_out: wp.array2d[scalar],  # (B, layout size) [N/m]
    ):
        """Replaces H by P H P, plus the mean diagonal entry
        in the directions normal to symmetry planes.
        """
        b, t = wp.tid()
        if active[b] == 0:
            return
        block = blocks[t, 0]
        row, column = blocks[t, 1], blocks[t, 2]
        total = wp.mat33d()
        for r in range(3):
            for c in range(3):
                at = address[block, 3 * r + c]
                if at < 0:
                    at = address[block, 3 * c + r]
                total[r, c] = wp.float64(values_out[b, at])
        mean = wp.trace(total) / wp.float64(3.0)
        if row >= 0:
            total = projections[row] * total
        if column >= 0:
            total = total * projections[column]
        if row >= 0 and row == column:
            total += mean * (wp.identity(n=3, dtype=wp.float64) - projections[row])
        for r in range(3):
            for c in range(3):
                at = address[block, 3 * r + c]
                if at >= 0:
                    values_out[b, at] = scalar(total[r, c])

    return project_blocks
