"""Cholesky factorisation of banded matrices in square tiles,
and both sweeps of a solve: one block per matrix.

A matrix of n unknowns is stored by rows: row i holds the W + 1 tiles of T columns that end with its
diagonal tile, so that entry (i, j) of the lower triangle is at column (j // T - i // T + W) T + j %
T. Tiles left of the first column and entries above the diagonal are never read. Rows beyond n in
the last tile are those of a unit matrix.

The factorisation is left-looking by columns of tiles (Golub and Van Loan 2013, section 4.2.9). The
inverse of each diagonal tile of the factor is stored instead of the tile: a sweep multiplies by it
instead of a sequential substitution.

Threads of a block share tiles and synchronise. Warp's own tiles do so through libraries that take
two minutes to compile for every type; these few lines of C++ also compile for a CPU, where a block
is one thread.
"""

from types import SimpleNamespace
from typing import Any, Final

import warp as wp

from .modules import generated, named_module
from .reductions import block_max

TILE: Final = 16  # rows and columns of a tile
BLOCK: Final = 128  # threads that share a matrix, on a GPU

T = wp.constant(TILE)

_SHARED: Final = f"""
    constexpr int T = {TILE};
#if defined(__CUDA_ARCH__)
    #define RESPHYS_SHARED __shared__
    #define RESPHYS_SYNC __syncthreads();
    constexpr int LANES = {BLOCK};  // The block's; Q of them work on a row of a tile.
    constexpr int Q = LANES / T;
    const int lane = threadIdx.x;
    #define RESPHYS_SUM(v) \\
        for (int o = Q / 2; o > 0; o /= 2) v += __shfl_xor_sync(0xffffffffu, v, o);
    #define RESPHYS_ANY(v) __syncthreads_or(v)
#else
    #define RESPHYS_SHARED
    #define RESPHYS_SYNC
    constexpr int LANES = 1;
    constexpr int Q = 1;
    const int lane = 0;
    #define RESPHYS_SUM(v)
    #define RESPHYS_ANY(v) (v)
#endif
"""

_FACTOR: Final = (
    _SHARED
    + """
    using S = SCALAR;
    constexpr int V = 16 / sizeof(S);
    struct alignas(16) Some { S v[V]; };
    RESPHYS_SHARED alignas(16) S pivot[T][T + V];
    RESPHYS_SHARED alignas(16) S inverse[T][T + V];
    S* const all = matrix_out.data;
    const int stride = matrix_out.shape[1], tiles = matrix_out.shape[0] / T, width = stride / T - 1;
    for (int j = 0; j < tiles; ++j) {
        // Tiles of this column under the diagonal.
        const int below = (tiles - j - 1 < width ? tiles - j - 1 : width);
        // What the columns before leave of this one, in pieces of 4 x 4 entries.
        for (int piece = lane; piece < (below + 1) * 16; piece += LANES) {
            const int i = j + piece / 16, r = piece % 16 / 4 * 4, c = piece % 4 * 4;
            if (i == j && c > r) continue;
            const int first = (i > width ? i - width : 0);
            const S* a = all + (i * T + r) * stride + (first - i + width) * T;
            const S* b = all + (j * T + c) * stride + (first - j + width) * T;
            S sum[4][4] = {};
            for (const S* end = a + (j - first) * T; a < end; a += T, b += T) {
                #pragma unroll 2
                for (int k = 0; k < T; k += V) {
                    Some x[4], y[4];
                    for (int m = 0; m < 4; ++m) {
                        x[m] = *reinterpret_cast<const Some*>(a + m * stride + k);
                        y[m] = *reinterpret_cast<const Some*>(b + m * stride + k);
                    }
                    for (int v = 0; v < V; ++v)
                        for (int m = 0; m < 4; ++m)
                            for (int n = 0; n < 4; ++n) sum[m][n] += x[m].v[v] * y[n].v[v];
                }
            }
            S* out = all + (i * T + r) * stride + (j - i + width) * T + c;
            for (int m = 0; m < 4; ++m)
                for (int n = 0; n < 4; ++n) out[m * stride + n] -= sum[m][n];
        }
        RESPHYS_SYNC
        // The diagonal tile as L D L^T, and the inverse of L with it.
        S* const diagonal = all + j * T * stride + width * T;
        for (int e = lane; e < T * T; e += LANES) {
            const int r = e / T, c = e % T;
            pivot[r][c] = diagonal[r * stride + c];
            inverse[r][c] = S(r == c);
        }
        RESPHYS_SYNC
        for (int p = 0; p < T - 1; ++p) {
            const S over = S(1) / pivot[p][p];
            for (int e = lane; e < T * T; e += LANES) {
                const int r = e / T, c = e % T;
                if (r <= p) continue;
                const S factor = pivot[r][p] * over;
                if (c > p && c <= r) pivot[r][c] -= factor * pivot[c][p];
                if (c <= p) inverse[r][c] -= factor * inverse[p][c];
            }
            RESPHYS_SYNC
        }
        for (int e = lane; e < T * T; e += LANES) {
            const int r = e / T, c = e % T;
            const S d = pivot[r][r];
            inverse[r][c] *= (d > S(0) ? S(1) / sqrt(d) : S(0) / S(0));
            diagonal[r * stride + c] = inverse[r][c];
        }
        RESPHYS_SYNC
        // The rows under it.
        for (int e = lane; e < below * T; e += LANES) {
            const int i = j + 1 + e / T;
            S* row = all + (i * T + e % T) * stride + (j - i + width) * T;
            S x[T];
            for (int c = 0; c < T; ++c) x[c] = row[c];
            for (int c = 0; c < T; ++c) {
                S sum = S(0);
                for (int m = 0; m <= c; ++m) sum += x[m] * inverse[c][m];
                row[c] = sum;
            }
        }
        RESPHYS_SYNC
    }
"""
)

_SOLVE: Final = (
    _SHARED
    + """
    using S = SCALAR;
    RESPHYS_SHARED S rest[T];
    const S* const all = factor.data;
    S* const x = column_out.data;
    const int n = column_out.shape[0];
    const int stride = factor.shape[1], tiles = factor.shape[0] / T, width = stride / T - 1;
    const int h = lane % Q;
    int some = 0;
    for (int c = lane; c < n; c += LANES) some |= (x[c] != S(0));
    if (!RESPHYS_ANY(some)) return;  // A zero right-hand side: the environment needs no direction.
    int early = 0;
    for (int c = lane; c < T && c < n; c += LANES) early |= (x[c] != S(0));
    // Such as a column of a unit matrix: tiles of zeros are skipped.
    const bool sparse = !RESPHYS_ANY(early);
    for (int i = 0; i < tiles; ++i) {
        const int first = (i > width ? i - width : 0) * T;
        if (sparse) {
            some = 0;
            for (int c = first + lane; c < i * T + T && c < n; c += LANES) some |= (x[c] != S(0));
            if (!RESPHYS_ANY(some)) continue;
        }
        for (int r = lane / Q; r < T; r += LANES / Q) {
            const S* row = all + (i * T + r) * stride + (width - i) * T;
            S sum = S(0);
            for (int c = first + h; c < i * T; c += Q) sum += row[c] * x[c];
            RESPHYS_SUM(sum)
            if (h == 0) rest[r] = (i * T + r < n ? x[i * T + r] - sum : S(0));
        }
        RESPHYS_SYNC
        for (int r = lane / Q; r < T; r += LANES / Q) {
            const S* inverse = all + (i * T + r) * stride + width * T;
            S sum = S(0);
            for (int c = h; c <= r; c += Q) sum += inverse[c] * rest[c];
            RESPHYS_SUM(sum)
            if (h == 0 && i * T + r < n) x[i * T + r] = sum;
        }
        RESPHYS_SYNC
    }
    for (int i = tiles - 1; i >= 0; --i) {
        const int first = (i > width ? i - width : 0) * T;
        if (sparse) {
            some = 0;
            for (int c = i * T + lane; c < i * T + T && c < n; c += LANES) some |= (x[c] != S(0));
            if (!RESPHYS_ANY(some)) continue;
        }
        for (int c = lane / Q; c < T; c += LANES / Q) {
            const S* inverse = all + i * T * stride + width * T + c;
            S sum = S(0);
            for (int r = h; r < T; r += Q)
                if (r >= c && i * T + r < n) sum += inverse[r * stride] * x[i * T + r];
            RESPHYS_SUM(sum)
            if (h == 0) rest[c] = sum;
        }
        RESPHYS_SYNC
        for (int c = lane; c < T; c += LANES)
            if (i * T + c < n) x[i * T + c] = rest[c];
        for (int c = first + lane; c < i * T; c += LANES) {
            const S* over = all + i * T * stride + (width - i) * T + c;
            S sum = S(0);
            for (int r = 0; r < T; ++r) sum += over[r * stride] * rest[r];
            x[c] -= sum;
        }
        RESPHYS_SYNC
    }
"""
)


def _of_one_matrix(scalar: Any) -> tuple[Any, Any]:
    """Returns the factorisation of a matrix, and the sweeps over a right-hand side."""
    name = "double" if scalar is wp.float64 else "float"

    @wp.func_native(_FACTOR.replace("SCALAR", name))
    def factorise(matrix_out: wp.array2d[scalar]): ...

    @wp.func_native(_SOLVE.replace("SCALAR", name))
    def substitute(factor: wp.array2d[scalar], column_out: wp.array[scalar]): ...

    return factorise, substitute


@generated
def tiled_kernels(scalar: Any) -> SimpleNamespace:
    """Returns kernels for a scalar type, in blocks of ``BLOCK`` threads."""
    module = named_module(f"tiles.{scalar.__name__}")
    factorise, substitute = _of_one_matrix(scalar)

    @wp.kernel(module=module)
    def clear(
        active: wp.array[int],  # (B) zero: skip the environment
        unit: wp.array[scalar],  # (whole tiles times (W + 1) T) zero, one on the diagonal beyond n
        matrices_out: wp.array2d[scalar],  # (B, length of unit)
    ):
        """Resets active matrices.

        One block per matrix, as one thread per entry would be slow for inactive ones.
        """
        b, lane = wp.tid()
        if active[b] != 0:
            for k in range(lane, unit.shape[0], wp.block_dim()):
                matrices_out[b, k] = unit[k]

    @wp.kernel(module=module)
    def check(
        clamped: wp.array[wp.bool],  # (B) matrices with clamped eigenvalues
        active_out: wp.array[int],  # (B) becomes zero, except for unclamped matrices that failed
        factors_out: wp.array3d[scalar],  # (B, whole tiles, (W + 1) T) NaN where clamped failed
    ):
        """Finds matrices that were not positive definite, one block per matrix."""
        b, lane = wp.tid()
        if active_out[b] == 0:
            return
        last = factors_out.shape[2] - T  # where the diagonal tiles begin
        bad = wp.float64(0.0)
        for i in range(lane, factors_out.shape[1], wp.block_dim()):
            if not factors_out[b, i, last + i % T] > scalar(0.0):
                bad = wp.float64(1.0)
        failed = block_max(bad) > wp.float64(0.0)
        again = failed and not clamped[b]
        if failed and not again:
            for i in range(lane, factors_out.shape[1], wp.block_dim()):
                factors_out[b, i, last + i % T] = scalar(wp.nan)
        if lane == 0:
            active_out[b] = int(again)

    @wp.kernel(module=module)
    def factor(
        active: wp.array[int],  # (B) zero: skip the environment
        matrices_out: wp.array3d[scalar],  # (B, n to whole tiles, (W + 1) T) overwritten by factors
    ):
        b, _ = wp.tid()
        if active[b] != 0:
            factorise(matrices_out[b])

    @wp.kernel(module=module)
    def solve(
        factors: wp.array3d[scalar],  # (B or 1, n rounded up to tiles, (W + 1) T)
        columns_out: wp.array3d[scalar],  # (B, m, n) right-hand sides, overwritten by the solutions
    ):
        """Substitutes forwards and backwards, one block per right-hand side."""
        b, m, _ = wp.tid()
        substitute(factors[wp.min(b, factors.shape[0] - 1)], columns_out[b, m])

    return SimpleNamespace(clear=clear, factor=factor, check=check, solve=solve)
