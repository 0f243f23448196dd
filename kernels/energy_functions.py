"""The law of an energy given as one Warp function of the kinematic variable
at a point and of its values.

The function e(f, v) returns the energy of a point of weight one; f is a vector or a matrix
(`points`), v the vector of values. From it follow

- the stress de/df, exact, by Warp's differentiation of the function;
- the tangent d2e/df2, by fourth-order differences of the exact stress with the step h = 3e-4 times
  the size of f that the energy declares. The error is about h^4/30 times a fifth derivative, plus
  1e-12 of the stress over the size of f from rounding: 1e-9 of the tangent or better, where e is
  smooth over h (tests/energies/test_pointwise.py);
- the derivatives by the values, d/ds de/dv(f + s df), by the same differences of the exact de/dv
  along df.

A clamped tangent is the nearest one without negative eigenvalues.
"""

from typing import Any

import warp as wp

from .constants import HALF, ONE, TWELVE, ZERO
from .laws import Law
from .modules import generated, named_module

STEP = 3e-4  # of differences, over the size of f
OFFSETS = wp.constant(wp.vec4d(1.0, -1.0, 2.0, -2.0))
SHARES = wp.constant(wp.vec4d(8.0, -8.0, -1.0, 1.0))
SWEEPS = wp.constant(30)
CONVERGED = wp.constant(wp.float64(1e-30))  # squared entries off the diagonal, over all

mat99 = wp.types.matrix((9, 9), wp.float64)


@wp.func
def without_negative_eigenvalues(h: mat99) -> mat99:
    """Returns the nearest positive semidefinite matrix to a symmetric one, by Jacobi rotations."""
    v = wp.identity(n=9, dtype=wp.float64)
    total = wp.ddot(h, h)
    for _sweep in range(SWEEPS):
        off = ZERO
        for i in range(9):
            for j in range(i):
                off += h[i, j] * h[i, j]
        if off <= CONVERGED * total:
            break
        for i in range(9):
            for j in range(i):
                if h[i, j] != ZERO:
                    angle = (h[j, j] - h[i, i]) / (h[i, j] + h[i, j])
                    t = ONE / (wp.abs(angle) + wp.sqrt(angle * angle + ONE))
                    if angle < ZERO:
                        t = -t
                    c = ONE / wp.sqrt(t * t + ONE)
                    s = t * c
                    for k in range(9):
                        x, y = h[i, k], h[j, k]
                        h[i, k] = c * x - s * y
                        h[j, k] = s * x + c * y
                    for k in range(9):
                        x, y = h[k, i], h[k, j]
                        h[k, i] = c * x - s * y
                        h[k, j] = s * x + c * y
                        x, y = v[k, i], v[k, j]
                        v[k, i] = c * x - s * y
                        v[k, j] = s * x + c * y
    result = mat99()
    for k in range(9):
        eigenvalue = wp.max(h[k, k], ZERO)
        for i in range(9):
            for j in range(9):
                result[i, j] = result[i, j] + eigenvalue * v[i, k] * v[j, k]
    return result


@wp.func
def write_blocks(hessian: mat99, columns: int, clamp: bool, out: wp.array[wp.mat33d]):
    """Writes the blocks of a second derivative by F,
    or by its first column, ordered by column and row of F.
    """
    hessian = HALF * (hessian + wp.transpose(hessian))
    if clamp:
        hessian = without_negative_eigenvalues(hessian)
    for m in range(columns):
        for n in range(m + 1):
            block = wp.mat33d()
            for i in range(3):
                for j in range(3):
                    block[i, j] = hessian[3 * m + i, 3 * n + j]
            out[(m * (m + 1)) / 2 + n] = block


@wp.func
def moved_vector(f: wp.vec3d, row: int, column: int, by: wp.float64) -> wp.vec3d:
    """Returns f with a change of the entry in a row; a vector has one column."""
    f[row] = f[row] + by
    return f


@wp.func
def moved_matrix(f: wp.mat33d, row: int, column: int, by: wp.float64) -> wp.mat33d:
    """Returns f with a change of the entry in a row and a column."""
    f[row, column] = f[row, column] + by
    return f


@wp.func
def vector_entry(f: wp.vec3d, row: int, column: int) -> wp.float64:
    """Returns the entry in a row."""
    return f[row]


@wp.func
def matrix_entry(f: wp.mat33d, row: int, column: int) -> wp.float64:
    """Returns the entry in a row and a column."""
    return f[row, column]


@generated
def derived_law(
    name: str, energy: Any, size: float = 1.0, lame: tuple[tuple[float, float], ...] = ()
) -> Law:
    """Returns the law of an energy function.

    Args:
        name: name of the law's Warp module.
        energy: e(f, v).
        size: typical size of f.
        lame: see `Law`.
    """
    shape, vector = energy.input_types.values()
    module = named_module(name)
    # Unrolled, the loops below would take minutes to compile.
    wp.set_module_options({"max_unroll": 1}, module)
    line, step = shape is wp.vec3d, wp.constant(wp.float64(size * STEP))
    columns, inner = wp.constant(1 if line else 3), wp.dot if line else wp.ddot
    moved, entry = (moved_vector, vector_entry) if line else (moved_matrix, matrix_entry)

    # Warp emits functions that use wp.grad after all others, so only kernels can call them.
    @wp.func(module=module)
    def response(f: shape, v: vector):
        stress, _by_values = wp.grad(energy)(f, v)
        return energy(f, v), stress

    @wp.func(module=module)
    def slopes(f: shape, df: shape, v: vector, carried: vector) -> vector:
        length = wp.sqrt(inner(df, df))
        result = vector()
        if length > ZERO:
            h = step / length
            for k in range(4):
                _stress, by_values = wp.grad(energy)(f + (OFFSETS[k] * h) * df, v)
                result += SHARES[k] * by_values
            result = result / (TWELVE * h)
        return result

    @wp.func(module=module)
    def tangent(f: shape, v: vector, clamp: bool, out: wp.array[wp.mat33d]):
        hessian = mat99()
        for n in range(columns):
            for j in range(3):
                slope = shape()
                for k in range(4):
                    stress, _by_values = wp.grad(energy)(moved(f, j, n, OFFSETS[k] * step), v)
                    slope += SHARES[k] * stress
                for m in range(columns):
                    for i in range(3):
                        hessian[3 * n + j, 3 * m + i] = entry(slope, i, m) / (TWELVE * step)
        write_blocks(hessian, columns, clamp, out)

    return Law(name, vector, response, slopes, tangent, lame)
