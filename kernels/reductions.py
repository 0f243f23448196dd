"""Reductions over an environment by one block of threads:
one thread on a CPU, ``block_dim`` threads on a GPU.

Threads stride over the vertices or points. The summation order depends only on the device, never on
timing. Every thread of the block must reach a reduction, which is also a barrier.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def block_sum(value: wp.float64) -> wp.float64:
    """Returns the sum over a block, in every thread."""
    return wp.tile_sum(wp.tile(value))[0]


@wp.func
def block_max(value: wp.float64) -> wp.float64:
    """Returns the maximum over a block, in every thread."""
    return wp.tile_max(wp.tile(value))[0]


@wp.kernel
def masked_norm(
    free: wp.array[wp.float64],  # (N) one at free vertices, zero at fixed ones
    vectors: wp.array2d[wp.vec3d],  # (B, N)
    norm_out: wp.array[wp.float64],  # (B)
):
    """Computes the norm over all free vertices."""
    b, lane = wp.tid()
    total = wp.float64(0.0)
    for i in range(lane, free.shape[0], wp.block_dim()):
        value = free[i] * vectors[b, i]
        total += wp.dot(value, value)
    total = block_sum(total)
    if lane == 0:
        norm_out[b] = wp.sqrt(total)


@wp.kernel
def totals(
    active: wp.array[int],  # (B) zero: the environment keeps its sums
    free: wp.array[wp.float64],
    vertex_energy: wp.array2d[wp.float64],  # (B, N) [J]
    point_energy: wp.array2d[wp.float64],  # (B, P) [J]
    residual_out: wp.array2d[wp.vec3d],  # (B, N) set to zero at fixed vertices [N]
    fixed_out: wp.array2d[wp.vec3d],  # (B, N) the residual at fixed vertices before [N]
    energy_out: wp.array[wp.float64],  # (B) [J]
    size_out: wp.array[wp.float64],  # (B) sum of the energies' absolute values [J]
    norm_out: wp.array[wp.float64],  # (B) of the residual [N]
):
    """Sums the energy and the norm of the residual,
    for the line search and the convergence test.
    """
    b, lane = wp.tid()
    energy, size = wp.float64(0.0), wp.float64(0.0)
    square = wp.float64(0.0)
    for i in range(lane, free.shape[0], wp.block_dim()):
        if free[i] == wp.float64(0.0) and active[b] != 0:
            fixed_out[b, i] = residual_out[b, i]
        value = free[i] * residual_out[b, i]
        residual_out[b, i] = value
        square += wp.dot(value, value)
        energy += vertex_energy[b, i]
        size += wp.abs(vertex_energy[b, i])
    for p in range(lane, point_energy.shape[1], wp.block_dim()):
        energy += point_energy[b, p]
        size += wp.abs(point_energy[b, p])
    energy, size = block_sum(energy), block_sum(size)
    square = block_sum(square)
    if lane == 0 and active[b] != 0:
        energy_out[b] = energy
        size_out[b] = size
        norm_out[b] = wp.sqrt(square)
