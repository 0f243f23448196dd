"""Kernels of an energy given as one Warp function of the kinematic variable at a point and of its values.

The function e(f, v) returns the energy of a point of weight one; f is a vector or a matrix (`points`), v the vector of
values. From it follow

- the stress w de/df, exact, by Warp's differentiation of the function;
- the tangent w d2e/df2, by fourth-order differences of the exact stress with the step h = 3e-4 times the size of f that
  the energy declares. The error is about h^4/30 times a fifth derivative, plus 1e-12 of the stress over the size of f
  from rounding: 1e-9 of the tangent or better, where e is smooth over h (tests/energies/test_pointwise.py);
- the derivatives by the values, -z . d residual/dv = -w d/ds de/dv(f + s dz) with dz = sum_a g_a z_a, by the same
  differences of the exact de/dv along dz.

A clamped tangent is the nearest one without negative eigenvalues.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from .modules import generated, named_module
from .points import MatrixPoints, PartValues, VectorPoints, matrix_at, value_reader, vector_at

STEP = wp.constant(wp.float64(3e-4))  # of differences, over the size of f
OFFSETS, SHARES = wp.constant(wp.vec4d(1.0, -1.0, 2.0, -2.0)), wp.constant(wp.vec4d(8.0, -8.0, -1.0, 1.0))
TWELVE, ZERO, HALF, ONE = wp.float64(12.0), wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
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
    """Writes the blocks of a second derivative by F, or by its first column, ordered by column and row of F."""
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


@generated
def pointwise_kernels(density: Any) -> SimpleNamespace:
    """Returns the kernels of an energy function, and the vector type of its values."""
    shape, vector = density.input_types.values()
    module = named_module(f"pointwise.{density.module.name}.{density.key}")
    # Unrolled, the loops below would take minutes to compile.
    wp.set_module_options({"max_unroll": 1}, module)
    line = shape is wp.vec3d
    columns = wp.constant(1 if line else 3)
    see, points_type, inner = (vector_at, VectorPoints, wp.dot) if line else (matrix_at, MatrixPoints, wp.ddot)
    read_values = value_reader(vector)

    @wp.kernel(module=module)
    def local_step(
        active: wp.array[int],  # (B) zero: skip the environment
        points: points_type,
        values: PartValues,
        size: wp.float64,  # of f
        positions: wp.array2d[wp.vec3d],
        stress_out: wp.array2d[shape],
        energy_out: wp.array2d[wp.float64],  # (B, P) [J]
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        v = read_values(values, b, p)
        f = see(points, positions, b, p)
        stress, _by_values = wp.grad(density)(f, v)
        stress_out[b, p] = values.weights[p] * stress
        energy_out[b, p] = values.weights[p] * density(f, v)

    @wp.kernel(module=module)
    def adjoint(
        points: points_type,
        values: PartValues,
        size: wp.float64,
        positions: wp.array2d[wp.vec3d],
        direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
        values_out: wp.array2d[vector],  # (B, P) this point's part of dL/dv
    ):
        b, p = wp.tid()
        v = read_values(values, b, p)
        f = see(points, positions, b, p)
        dz = see(points, direction, b, p)
        length = wp.sqrt(inner(dz, dz))
        result = vector()
        if length > ZERO:
            h = STEP * size / length
            for k in range(4):
                _stress, by_values = wp.grad(density)(f + (OFFSETS[k] * h) * dz, v)
                result += SHARES[k] * by_values
            result = (-values.weights[p] / (TWELVE * h)) * result
        values_out[b, p] = result

    @wp.func(module=module)
    def moved(f: shape, j: int, n: int, by: wp.float64) -> shape:
        """Returns f with a change of the entry in row j and column n."""
        if wp.static(line):
            f[j] = f[j] + by
        else:
            f[j, n] = f[j, n] + by
        return f

    @wp.func(module=module)
    def entry(stress: shape, j: int, n: int) -> wp.float64:
        """Returns the entry in row j and column n."""
        if wp.static(line):  # noqa: SIM108  # Warp has no other branches that are left out.
            value = stress[j]
        else:
            value = stress[j, n]
        return value

    @wp.kernel(module=module)
    def tangent(
        active: wp.array[int],
        clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
        points: points_type,
        values: PartValues,
        size: wp.float64,
        positions: wp.array2d[wp.vec3d],
        tangent_out: wp.array3d[wp.mat33d],  # (B, P, 6), or (B, P, 1) for a vector
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        v = read_values(values, b, p)
        f = see(points, positions, b, p)
        scale = values.weights[p] / (TWELVE * STEP * size)
        hessian = mat99()
        for n in range(columns):
            for j in range(3):
                slope = shape()
                for k in range(4):
                    stress, _by_values = wp.grad(density)(moved(f, j, n, OFFSETS[k] * STEP * size), v)
                    slope += SHARES[k] * stress
                for m in range(columns):
                    for i in range(3):
                        hessian[3 * n + j, 3 * m + i] = scale * entry(slope, i, m)
        write_blocks(hessian, columns, clamp[b] != 0, tangent_out[b, p])

    return SimpleNamespace(local_step=local_step, tangent=tangent, adjoint=adjoint, values=vector)
