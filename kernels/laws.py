"""Laws, which give the energy of a point and its derivatives, and their kernels.

The energy e(f, v) of a point of weight one is a function of the vector or the matrix f at the point
(`points`) and of values v. With the point's weight w, the stress is w de/df, the tangent w d2e/df2,
and the derivatives by the values -z . d residual/dv = -w d2e/dfdv . dz, with dz = sum_a g_a z_a.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from .modules import generated, named_module
from .points import MatrixPoints, PartValues, VectorPoints, matrix_at, value_reader, vector_at


@dataclass(frozen=True, eq=False)
class Law:
    """An energy and its derivatives, as Warp functions.

    Attributes:
        name: name of its Warp module.
        values: vector type of v; of a material, moduli times the point's volumes.
        response: (f, v) -> e and de/df.
        slopes: (f, df, v, carried) -> derivatives by v of de/df : df; undefined where ``carried``
            is zero.
        tangent: (f, v, clamp, out), writes the blocks of d2e/df2; with ``clamp``, without negative
            eigenvalues.
        lame: of a material, the contribution of each value to the Lame constants (mu, lambda) of
            small strains.
        has_lanes: whether the first value has the shape term of `kernels.lanes`, and no other one a
            shape term.
    """

    name: str
    values: Any
    response: Any
    slopes: Any
    tangent: Any
    lame: tuple[tuple[float, float], ...] = ()
    has_lanes: bool = False


@generated
def point_kernels(law: Law) -> SimpleNamespace:
    """Returns the kernels of a law whose values at a point are read from any number of arrays."""
    module = named_module(law.name)
    response, slopes = law.response, law.slopes
    write_tangent, vector = law.tangent, law.values
    shape = response.input_types["f"]
    see, points_type = (vector_at, VectorPoints) if shape is wp.vec3d else (matrix_at, MatrixPoints)
    read_values = value_reader(vector)

    @wp.kernel(module=module)
    def local_step(
        active: wp.array[int],  # (B) zero: skip the environment
        points: points_type,
        values: PartValues,
        positions: wp.array2d[wp.vec3d],
        stress_out: wp.array2d[shape],
        energy_out: wp.array2d[wp.float64],  # (B, P) [J]
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        energy, stress = response(see(points, positions, b, p), read_values(values, b, p))
        stress_out[b, p] = values.weights[p] * stress
        energy_out[b, p] = values.weights[p] * energy

    @wp.kernel(module=module)
    def tangent(
        active: wp.array[int],
        clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
        points: points_type,
        values: PartValues,
        positions: wp.array2d[wp.vec3d],
        tangent_out: wp.array3d[wp.mat33d],  # (B, P, 6), or (B, P, 1) for a vector
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        out = tangent_out[b, p]
        write_tangent(see(points, positions, b, p), read_values(values, b, p), clamp[b] != 0, out)
        for k in range(out.shape[0]):
            out[k] = values.weights[p] * out[k]

    @wp.kernel(module=module)
    def adjoint(
        points: points_type,
        values: PartValues,
        positions: wp.array2d[wp.vec3d],
        direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
        values_out: wp.array2d[vector],  # (B, P) this point's part of dL/dv
    ):
        b, p = wp.tid()
        v = read_values(values, b, p)
        result = slopes(see(points, positions, b, p), see(points, direction, b, p), v, v)
        values_out[b, p] = -values.weights[p] * result

    return SimpleNamespace(local_step=local_step, tangent=tangent, adjoint=adjoint, values=vector)
