"""Kernels at points against numpy: gather, product with a tangent, reading of values, inertia, reductions."""

import numpy as np
import pytest
import torch
import warp as wp

from warp_resphys.kernels.point_inertia import local_step, slopes
from warp_resphys.kernels.points import (
    gather_cells,
    gather_kernels,
    line_tangent_product,
    tangent_product,
)
from warp_resphys.kernels.reductions import masked_norm, totals
from warp_resphys.kernels.values import value_reader

wp.set_module_options({"enable_backward": False})
B, N, CELLS, NODES, POINTS = 2, 7, 3, 4, 2  # points of a cell
RANDOM = np.random.default_rng(0)
CELL_NODES = np.stack([RANDOM.choice(N, NODES, replace=False) for _ in range(CELLS)])
VEC, MAT, REAL = wp.vec3d, wp.mat33d, wp.float64


def array(values, dtype=REAL):
    return wp.array(values, dtype=dtype, device="cpu")


def launch(kernel, shape, *arguments):
    wp.launch(kernel, shape, list(arguments), device="cpu")


def seen(operators, field):
    """(B, P, 3, w) sum_a x_a g_a^T of (B, N, 3) vectors, for operators (P, K, w)."""
    cells = CELL_NODES.repeat(POINTS, axis=0)
    return np.einsum("bpai,paw->bpiw", field[:, cells], operators)


@pytest.mark.parametrize("width", [1, 3])
def test_forces_are_the_transpose_of_the_kinematics(width):
    points, operator, shape = CELLS * POINTS, (VEC if width == 3 else REAL), (MAT if width == 3 else VEC)
    operators, field = RANDOM.normal(size=(points, NODES, width)), RANDOM.normal(size=(B, N, 3))
    stress, before = RANDOM.normal(size=(B, points, 3, width)), RANDOM.normal(size=(B, N, 3))
    order = np.argsort(CELL_NODES.ravel(), kind="stable").astype(np.int32)
    start = np.searchsorted(np.sort(CELL_NODES.ravel()), np.arange(N + 1)).astype(np.int32)
    incident = [array(start, int), array(order, int)]
    kernels, nodes = gather_kernels(width), array(CELL_NODES.astype(np.int32), int)
    own, stresses = array(operators.squeeze(), operator), array(stress.squeeze(), shape)
    at_once, in_cells = array(before, VEC), array(before, VEC)
    launch(kernels.gather, (B, N), nodes, own, POINTS, *incident, stresses, at_once)
    cells = array(np.full((B, CELLS * NODES, 3), np.nan), VEC)
    launch(kernels.cell_forces, (B, CELLS * NODES), array([1] * B, int), own, POINTS, stresses, cells)
    launch(gather_cells, (B, N), *incident, cells, in_cells)
    work = np.einsum("bpiw,bpiw->b", stress, seen(operators, field))
    for forces in (at_once, in_cells):
        np.testing.assert_allclose(np.einsum("bni,bni->b", forces.numpy() - before, field), work, rtol=1e-12)


@pytest.mark.parametrize("width", [1, 3])
def test_the_product_with_a_tangent(width):
    """Block (k, n) is the derivative of column k of the stress by column n of F; block (n, k) its transpose."""
    points = CELLS * POINTS
    operators, field = RANDOM.normal(size=(points, NODES, width)), RANDOM.normal(size=(B, N, 3))
    whole = RANDOM.normal(size=(B, points, width, 3, width, 3))
    whole = whole + whole.transpose(0, 1, 4, 5, 2, 3)
    blocks = np.stack([whole[:, :, k, :, n] for k in range(width) for n in range(k + 1)], axis=2)
    kinds, kernel = ((VEC, MAT), tangent_product) if width == 3 else ((REAL, VEC), line_tangent_product)
    out = array(np.zeros((B, points, 3, width)).squeeze(), kinds[1])
    fields = [array(operators.squeeze(), kinds[0]), POINTS, array(blocks, MAT), array(field, VEC), out]
    launch(kernel, (B, points), array(CELL_NODES.astype(np.int32), int), *fields)
    expected = np.einsum("bpkinj,bpjn->bpik", whole, seen(operators, field))
    np.testing.assert_allclose(out.numpy(), expected.squeeze(), atol=1e-12)


def test_inertia_of_points():
    points = CELLS * POINTS
    weights, inertia = RANDOM.normal(size=(points, NODES)), RANDOM.uniform(1.0, 2.0, size=(B, points))
    target, x, z = (RANDOM.normal(size=(B, n, 3)) for n in (points, N, N))
    nodes, own = array(CELL_NODES.astype(np.int32), int), array(weights)

    def work(inertia, target, x, z):
        """Energy (B, P), and the work (B,) of its forces along z."""
        stress, energy = wp.zeros((B, points), dtype=VEC, device="cpu"), wp.zeros((B, points), dtype=REAL, device="cpu")
        fields = array(inertia), array(target, VEC), POINTS, array(x, VEC), stress, energy
        launch(local_step, (B, points), array([1] * B, int), nodes, own, *fields)
        return energy.numpy(), np.einsum("bpi,bpi->b", stress.numpy(), seen(weights[..., None], z)[..., 0])

    energy, along = work(inertia, target, x, z)
    offset = seen(weights[..., None], x)[..., 0] - target
    np.testing.assert_allclose(energy, 0.5 * inertia * np.square(offset).sum(-1), rtol=1e-12)
    step = 1e-5
    ahead, behind = (work(inertia, target, x + s * step * z, z)[0].sum(1) for s in (1, -1))
    np.testing.assert_allclose((ahead - behind) / (2 * step), along, rtol=1e-8)
    by_inertia, by_target = (wp.zeros((B, points), dtype=kind, device="cpu") for kind in (REAL, VEC))
    fields = array(inertia), array(target, VEC), POINTS, array(x, VEC), array(z, VEC), by_inertia, by_target
    launch(slopes, (B, points), nodes, own, *fields)
    change, moved = RANDOM.normal(size=inertia.shape), RANDOM.normal(size=target.shape)
    ahead, behind = (work(inertia + s * step * change, target + s * step * moved, x, z)[1] for s in (1, -1))
    expected = (by_inertia.numpy() * change).sum(1) + (by_target.numpy() * moved).sum((1, 2))
    np.testing.assert_allclose((ahead - behind) / (2 * step), -expected, rtol=1e-7)


def test_reductions_leave_fixed_vertices_out():
    free = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    vectors, energies, own = RANDOM.normal(size=(B, N, 3)), RANDOM.normal(size=(B, N)), RANDOM.normal(size=(B, 150))
    results = [wp.zeros(B, dtype=REAL, device="cpu") for _ in range(4)]
    options = {"block_dim": 64, "device": "cpu"}
    masked, residual = array(vectors, VEC), array(vectors, VEC)
    wp.launch_tiled(masked_norm, dim=[B], inputs=[array(free), masked, results[0]], **options)
    fields = [array(free), array(energies), array(own), residual, *results[1:]]
    wp.launch_tiled(totals, dim=[B], inputs=[array([1] * B, int), *fields], **options)
    norm, energy, size, other = (result.numpy() for result in results)
    np.testing.assert_allclose(norm, np.linalg.norm(vectors[:, free > 0.0], axis=(1, 2)), rtol=1e-13)
    np.testing.assert_allclose(other, norm, rtol=1e-15)
    np.testing.assert_allclose(energy, energies.sum(1) + own.sum(1), rtol=1e-12)
    np.testing.assert_allclose(size, np.abs(energies).sum(1) + np.abs(own).sum(1), rtol=1e-12)
    for field in (masked, residual):
        np.testing.assert_array_equal(field.numpy(), vectors * free[:, None])
    before = [result.numpy().copy() for result in results[1:]]
    fields[1:3] = array(2.0 * energies), array(2.0 * own)
    wp.launch_tiled(totals, dim=[B], inputs=[array([1] * (B - 1) + [0], int), *fields], **options)
    for one, other in zip(before[:2], results[1:3], strict=True):  # The last environment keeps its sums.
        np.testing.assert_allclose(other.numpy()[:-1], 2.0 * one[:-1], rtol=1e-12)
        np.testing.assert_array_equal(other.numpy()[-1], one[-1])


values3 = wp.types.vector(3, wp.float64)
read_values = value_reader(values3)


@wp.kernel
def read(
    addresses: wp.array[wp.uint64], sizes: wp.array[int], places: wp.array2d[int], values_out: wp.array2d[values3]
):
    b, p = wp.tid()
    values_out[b, p] = read_values(addresses, sizes, places, b, p)


def test_values_of_several_arrays():
    arrays = [torch.rand(B, size, dtype=torch.float64) for size in (5, 1, 4)]
    places = np.array([[4, 0, 2], [0, 0, 0], [1, 3, 3]], dtype=np.int32)  # by value and point
    out = wp.zeros((B, 3), dtype=values3, device="cpu")
    addresses = array(np.array([values.data_ptr() for values in arrays], dtype=np.uint64), wp.uint64)
    launch(read, (B, 3), addresses, array(np.array([5, 1, 4], dtype=np.int32), int), array(places, int), out)
    expected = np.stack([values[:, place] for values, place in zip(arrays, places, strict=True)], axis=-1)
    np.testing.assert_array_equal(out.numpy(), expected)
