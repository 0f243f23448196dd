"""Cholesky factorisation of banded matrices in square tiles, and both sweeps of a solve: one block a matrix.

A matrix of n unknowns is stored by rows: row i holds the W + 1 tiles of T columns that end with its diagonal tile, so
that entry (i, j) of the lower triangle is at column (j // T - i // T + W) T + j % T. Tiles left of the first column,
and what lies above the diagonal, are never read. In the last tiles, what is beyond n is a unit matrix.

The factorisation is the left-looking one by rows of tiles (Golub and Van Loan 2013, section 4.2.9).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .modules import decorators
from .reductions import block_max


@functools.cache
def tiled_kernels(tile: int, width: int, scalar: Any) -> SimpleNamespace:
    """Kernels for tiles of T x T numbers of a type, W of them left of the diagonal one."""
    kernel, _ = decorators(f"tiles.{tile}.{width}.{scalar.__name__}")
    T, W = wp.constant(tile), wp.constant(width)  # noqa: N806

    @kernel
    def clear(
        idle: wp.array[wp.bool],  # (B) those that stay as they are
        unit: wp.array[scalar],  # (n rounded up to tiles times (W + 1) T) zero, but for one beyond n on the diagonal
        matrices: wp.array2d[scalar],  # (B, as many)
    ):
        b, k = wp.tid()
        if not idle[b]:
            matrices[b, k] = unit[k]

    @kernel
    def check(
        clamped: wp.array[wp.bool],  # (B) matrices that are positive definite by force
        idle: wp.array[wp.bool],  # (B) becomes False for those alone that failed, and may be clamped yet
        factors: wp.array3d[scalar],  # (B, n rounded up to tiles, (W + 1) T) NaN where clamped ones have failed
    ):
        """Which matrices were not positive definite, one block a matrix."""
        b, lane = wp.tid()
        if idle[b]:
            return
        bad = wp.float64(0.0)
        for i in range(lane, factors.shape[1], wp.block_dim()):
            if not factors[b, i, W * T + i % T] > scalar(0.0):
                bad = wp.float64(1.0)
        failed = block_max(bad) > wp.float64(0.0)
        again = failed and not clamped[b]
        if failed and not again:
            for i in range(lane, factors.shape[1], wp.block_dim()):
                factors[b, i, W * T + i % T] = scalar(wp.nan)
        if lane == 0:
            idle[b] = not again

    @kernel
    def factor(
        idle: wp.array[wp.bool],  # (B) those that stay as they are
        matrices: wp.array3d[scalar],  # (B, n rounded up to tiles, (W + 1) T) overwritten by the factors
    ):
        b, _ = wp.tid()
        if idle[b]:
            return
        a = matrices[b]
        for i in range(a.shape[0] / T):
            for j in range(wp.max(0, i - W), i + 1):
                rest = wp.tile_load(a, shape=(T, T), offset=(i * T, (j - i + W) * T), storage="shared")
                for k in range(wp.max(0, i - W), j):
                    row = wp.tile_load(a, shape=(T, T), offset=(i * T, (k - i + W) * T), storage="shared")
                    column = wp.tile_load(a, shape=(T, T), offset=(j * T, (k - j + W) * T), storage="shared")
                    wp.tile_matmul(row, wp.tile_transpose(column), rest, alpha=-1.0)
                if j < i:
                    diagonal = wp.tile_load(a, shape=(T, T), offset=(j * T, W * T), storage="shared")
                    found = wp.tile_lower_solve(diagonal, wp.tile_transpose(rest))
                    wp.tile_store(a, wp.tile_transpose(found), offset=(i * T, (j - i + W) * T))
                else:
                    wp.tile_store(a, wp.tile_cholesky(rest), offset=(i * T, W * T))

    @kernel
    def solve(
        factors: wp.array3d[scalar],  # (B or 1, n rounded up to tiles, (W + 1) T)
        columns: wp.array3d[scalar],  # (B, m, n) right-hand sides, overwritten by the solutions
    ):
        """By forward and backward substitution, one block a right-hand side."""
        b, m, _ = wp.tid()
        a = factors[wp.min(b, factors.shape[0] - 1)]
        x = columns[b, m]
        tiles = a.shape[0] / T
        for i in range(tiles):
            rest = wp.tile_load(x, shape=T, offset=i * T, storage="shared")
            for k in range(wp.max(0, i - W), i):
                row = wp.tile_load(a, shape=(T, T), offset=(i * T, (k - i + W) * T), storage="shared")
                known = wp.tile_load(x, shape=T, offset=k * T, storage="shared")
                wp.tile_matmul(
                    row, wp.tile_reshape(known, shape=(T, 1)), wp.tile_reshape(rest, shape=(T, 1)), alpha=-1.0
                )
            diagonal = wp.tile_load(a, shape=(T, T), offset=(i * T, W * T), storage="shared")
            wp.tile_store(x, wp.tile_lower_solve(diagonal, rest), offset=i * T)
        for r in range(tiles):
            i = tiles - 1 - r
            rest = wp.tile_load(x, shape=T, offset=i * T, storage="shared")
            for k in range(i + 1, wp.min(tiles, i + W + 1)):
                column = wp.tile_load(a, shape=(T, T), offset=(k * T, (i - k + W) * T), storage="shared")
                known = wp.tile_load(x, shape=T, offset=k * T, storage="shared")
                wp.tile_matmul(
                    wp.tile_transpose(column),
                    wp.tile_reshape(known, shape=(T, 1)),
                    wp.tile_reshape(rest, shape=(T, 1)),
                    alpha=-1.0,
                )
            diagonal = wp.tile_load(a, shape=(T, T), offset=(i * T, W * T), storage="shared")
            wp.tile_store(x, wp.tile_upper_solve(wp.tile_transpose(diagonal), rest), offset=i * T)

    return SimpleNamespace(clear=clear, factor=factor, check=check, solve=solve)
