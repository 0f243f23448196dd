"""Tiled Cholesky factors of banded matrices against numpy."""

import numpy as np
import pytest
import warp as wp

from warp_resphys.kernels.tiled_cholesky import BLOCK, TILE, tiled_kernels


def tiled(matrices, width):
    """Stores banded matrices (B, n, n) by rows of `width` + 1 tiles; what is never read is NaN."""
    n = matrices.shape[1]
    rows = -(-n // TILE) * TILE
    result = np.full((len(matrices), rows, (width + 1) * TILE), np.nan)
    padded = np.tile(np.eye(rows), (len(matrices), 1, 1))
    padded[:, :n, :n] = matrices
    for i in range(rows):
        first = max(i // TILE - width, 0) * TILE
        column = (first // TILE - i // TILE + width) * TILE
        result[:, i, column : column + i + 1 - first] = padded[:, i, first : i + 1]
    diagonal = result.reshape(len(matrices), rows // TILE, TILE, -1)[..., width * TILE :]
    diagonal[...] = np.nan_to_num(diagonal)
    return result


@pytest.mark.parametrize("scalar", [wp.float64, wp.float32], ids=["float64", "float32"])
@pytest.mark.parametrize(("n", "band"), [(10, 9), (48, 16), (75, 20), (100, 40)])
def test_solutions_of_banded_systems(n, band, scalar):
    random, width = np.random.default_rng(n), -(-band // TILE)
    lower = np.tril(np.triu(random.normal(size=(3, n, n)), -band), -1) / np.sqrt(band) + 2.0 * np.eye(n)
    matrices = lower @ lower.transpose(0, 2, 1)
    failing = matrices.copy()
    failing[2, n // 2, n // 2] = -1.0
    kind = np.float64 if scalar is wp.float64 else np.float32
    kernels, columns = tiled_kernels(scalar), random.normal(size=(3, 2, n))
    stored = tiled(failing, width).astype(kind)
    factors = wp.array(stored, dtype=scalar, device="cpu")
    active = wp.array([1, 0, 1], dtype=int, device="cpu")
    options = {"block_dim": BLOCK, "device": "cpu"}
    wp.launch_tiled(kernels.factor, dim=[3], inputs=[active, factors], **options)
    np.testing.assert_array_equal(factors.numpy()[1], stored[1])  # left alone
    clamped = wp.array([False] * 3, dtype=wp.bool, device="cpu")
    wp.launch_tiled(kernels.check, dim=[3], inputs=[active, clamped, factors], **options)
    np.testing.assert_array_equal(active.numpy(), [0, 0, 1])  # one failed
    x = wp.array(columns.astype(kind), dtype=scalar, device="cpu")
    wp.launch_tiled(kernels.solve, dim=[1, 2], inputs=[factors, x], **options)
    expected = np.linalg.solve(matrices[0], columns[0].T).T
    precision = 1e-11 if scalar is wp.float64 else 2e-3
    np.testing.assert_allclose(x.numpy()[0], expected, atol=precision * np.abs(expected).max())
