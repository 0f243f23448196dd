"""Local step and tangent of whole cells by a CPU's vector instructions: eight points at a time.

A quantity of eight points is a vector of C++, on which operations become vector instructions; those
of Warp, entry by entry, only do by chance. Launches on a CPU run one thread after another, so that
threads may add to the same forces.

The shape term of the corotated material needs no rotation here (Hoger and Carlson 1984).
With F = R U, J = det F and U^2 = F^T F = I + e, the invariants 3 + x, 3 + y and J = 1 + z of U
follow from those of e:

    p (12 + p) = 8 (x + e_1) + 4 e_2 + 8 z (3 + x),        p = 6 x + x^2 - e_1 = 2 y

of which x is the largest root. With s = x - y + z and g = (3 + x) (3 + y) - J, the theorem of
Cayley and Hamilton gives

    g (U - I)      = s (4 + x) I + ((3 + x)^2 - y - 5) e - e^2
    J (I - U^-1)   = s I + (3 + x) (U - I) - e

and F - R = F (I - U^-1). All terms are small with the strain, so that they add no error to those of
e and z. By the same theorem, the matrix of `kernels.materials.corotated.turning` is
(F F^T + (3 + y) I) / g.
"""

from typing import Any, Final

import warp as wp

from .constants import ZERO
from .elasticity import viscosity_of
from .laws import Law
from .matrices import HALLEY_ITERATIONS, HALLEY_TOLERANCE, LARGEST_TRACE
from .modules import generated, named_module
from .points import MatrixPoints, matrix_at

WIDTH = 8  # points: as many doubles as the widest vector instructions take
# Smallest J of points that are taken together; the others' errors would grow with 1 / J
FLATTEST = 0.2

lanes = wp.types.vector(WIDTH, wp.float64)

# F, e, I - U^-1 = offset, U - I = longer and the invariants above, of the points of a group.
_STRETCH: Final = f"""
    typedef double V __attribute__((vector_size(8 * {WIDTH}), aligned(8), may_alias));
    V f[3][3] = {{}}, e[3][3], square[3][3], longer[3][3], offset[3][3];
    for (int a = 0; a < nodes.shape[0]; ++a)
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                f[i][k] += positions.data[nodes.data[a]][i] * ((const V*)together.data)[3 * a + k];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            e[i][k] = f[0][i] * f[0][k] + f[1][i] * f[1][k] + f[2][i] * f[2][k] - (i == k);
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            square[i][k] = e[i][0] * e[0][k] + e[i][1] * e[1][k] + e[i][2] * e[2][k];
    const V j = f[0][0] * (f[1][1] * f[2][2] - f[1][2] * f[2][1])
        + f[0][1] * (f[1][2] * f[2][0] - f[1][0] * f[2][2])
        + f[0][2] * (f[1][0] * f[2][1] - f[1][1] * f[2][0]);
    const V z = j - 1.0, e1 = e[0][0] + e[1][1] + e[2][2];
    const V e2 = e[0][0] * e[1][1] - e[0][1] * e[0][1] + e[0][0] * e[2][2] - e[0][2] * e[0][2]
        + e[1][1] * e[2][2] - e[1][2] * e[1][2];
    V x = 0.5 * e1;  // not below the root, to which Halley's iteration falls
    double change = 1.0;
    for (int k = 0; k < {HALLEY_ITERATIONS} && !(change < {float(HALLEY_TOLERANCE)}); ++k) {{
        const V p = x * (6.0 + x) - e1, q = 6.0 + p, trace = 3.0 + x;
        const V value = 12.0 * p + p * p - 8.0 * (x + e1 + z * trace) - 4.0 * e2;
        const V slope = 4.0 * trace * q - 8.0 * j, bend = 4.0 * q + 8.0 * trace * trace;
        const V step = 2.0 * value * slope / (2.0 * slope * slope - value * bend);
        x -= step;
        change = 0.0;
        for (int n = 0; n < {WIDTH}; ++n) change += step[n] * step[n];
    }}
    if (!(change < {float(HALLEY_TOLERANCE)})) return false;
    for (int n = 0; n < {WIDTH}; ++n)
        if (!(j[n] > {FLATTEST} && e1[n] < {float(LARGEST_TRACE) - 3.0})) return false;
    const V y = 0.5 * (x * (6.0 + x) - e1), s = x - y + z, first_invariant = 3.0 + x;
    const V g = 1.0 / (first_invariant * (3.0 + y) - j), over = 1.0 / j;
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {{
            longer[i][k] =
                g * ((first_invariant * first_invariant - y - 5.0) * e[i][k] - square[i][k]);
            if (i == k) longer[i][k] += g * s * (1.0 + first_invariant);
            offset[i][k] = over * (first_invariant * longer[i][k] - e[i][k]);
            if (i == k) offset[i][k] += over * s;
        }}
    V mu = {{}};
    for (int n = 0; n < count; ++n) mu[n] = stiffness.data[first + n][0];
"""

_STEP: Final = (
    _STRETCH
    + f"""
    V energy = {{}}, stress[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) energy += longer[i][k] * longer[i][k];
    if (damping > 0.0)  // `elasticity.viscous_response`
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) {{
                V w = {{}};
                for (int n = 0; n < count; ++n) w[n] = strain_offset.data[first + n].data[i][k];
                energy += 0.5 * e[i][k] * (0.5 * damping * e[i][k] - 2.0 * w);
                offset[i][k] += 0.5 * damping * e[i][k] - w;
            }}
    energy *= mu;
    for (int n = 0; n < count; ++n) energy_out.data[first + n] = energy[n];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            stress[i][k] = 2.0 * mu
                * (f[i][0] * offset[0][k] + f[i][1] * offset[1][k] + f[i][2] * offset[2][k]);
    for (int part = 0; part < by_nodes.shape[1]; ++part) {{
        V force[3] = {{}};
        for (int n = 0; n < count; ++n) {{
            const V* row = (const V*)by_nodes.data + 3 * ((first + n) * by_nodes.shape[1] + part);
            for (int i = 0; i < 3; ++i)
                force[i] += stress[i][0][n] * row[0] + stress[i][1][n] * row[1]
                    + stress[i][2][n] * row[2];
        }}
        const int* node = nodes.data + {WIDTH} * part;
        for (int n = 0; n < {WIDTH} && {WIDTH} * part + n < nodes.shape[0]; ++n)
            for (int i = 0; i < 3; ++i) force_out.data[node[n]][i] += force[i][n];
    }}
    return true;
"""
)

# Block (k, m) is 2 mu ([k = m] I - dR_k / dF_m), with -dR_k / dF_m = [R e_k]_x A^-1 [R e_m]_x
# (`kernels.materials.corotated.turning`).
_TANGENT: Final = (
    _STRETCH
    + """
    V r[3][3], turning[3][3], left[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
            r[k][i] = f[i][k]
                - (f[i][0] * offset[0][k] + f[i][1] * offset[1][k] + f[i][2] * offset[2][k]);
            turning[i][k] = 2.0 * mu * g
                * (f[i][0] * f[k][0] + f[i][1] * f[k][1] + f[i][2] * f[k][2]);
            if (i == k) turning[i][k] += 2.0 * mu * g * (3.0 + y);
        }
    for (int k = 0; k < 3; ++k) {
        for (int i = 0; i < 3; ++i)
            for (int l = 0; l < 3; ++l)
                left[i][l] = r[k][(i + 1) % 3] * turning[(i + 2) % 3][l]
                    - r[k][(i + 2) % 3] * turning[(i + 1) % 3][l];
        for (int m = 0; m <= k; ++m)
            for (int i = 0; i < 3; ++i)
                for (int l = 0; l < 3; ++l) {
                    V block = left[i][(l + 1) % 3] * r[m][(l + 2) % 3]
                        - left[i][(l + 2) % 3] * r[m][(l + 1) % 3];
                    if (k == m && i == l) block += 2.0 * mu;
                    for (int n = 0; n < count; ++n)
                        tangent_out.data[6 * (first + n) + k * (k + 1) / 2 + m].data[i][l] =
                            block[n];
                }
    }
    return true;
"""
)


@wp.struct
class LaneCells:
    """Gradients of cells for the vector instructions."""

    together: wp.array4d[lanes]  # (C, G, K, 3) of a cell's first S points, filled up with the last
    by_nodes: wp.array3d[lanes]  # (P, K / 8, 3) of eight nodes at a time, filled up with zeros
    shape_points: int  # S, the number of points without a volume term, which come first


@wp.func
def along(row: wp.vec3d, gradients: wp.array[lanes]) -> lanes:
    """Returns the product of a row of a stress with the gradients of eight nodes."""
    return row[0] * gradients[0] + row[1] * gradients[1] + row[2] * gradients[2]


@generated
def cell_step(law: Law) -> Any:
    """Returns the kernel for forces and energies of a material
    whose shape term is that of `materials.corotated`.
    """
    viscosity = viscosity_of(law)
    response, vector = law.response, law.values
    values_type, respond = viscosity.Values, viscosity.respond

    @wp.func_native(_STEP)
    def step_together(
        first: int, count: int, nodes: wp.array[int],
        together: wp.array2d[lanes], by_nodes: wp.array3d[lanes],
        stiffness: wp.array[vector], damping: wp.float64, strain_offset: wp.array[wp.mat33d],
        positions: wp.array[wp.vec3d],
        force_out: wp.array[wp.vec3d], energy_out: wp.array[wp.float64],
    ) -> bool: ...  # fmt: skip

    @wp.kernel(module=named_module(f"lanes.{law.name}"))
    def step(
        active: wp.array[int],  # (B) zero: skip the environment
        points: MatrixPoints,
        values: values_type,
        positions: wp.array2d[wp.vec3d],
        cells: LaneCells,
        force_out: wp.array2d[wp.vec3d],  # (B, N) [N], added to
        energy_out: wp.array2d[wp.float64],  # (B, P) [J]
    ):
        b, cell = wp.tid()
        if active[b] == 0:
            return
        begin, nodes = cell * points.per_cell, points.nodes[cell]
        alone = wp.int32(0)  # first of the points that are taken one by one
        for group in range(cells.together.shape[1]):
            first, count = begin + group * WIDTH, wp.min(cells.shape_points - group * WIDTH, WIDTH)
            if not step_together(
                first, count, nodes,
                cells.together[cell, group], cells.by_nodes,
                values.stiffness[b], values.viscosity[b][0], values.strain_offset[b],
                positions[b],
                force_out[b], energy_out[b],
            ):  # fmt: skip
                break
            alone += count
        for p in range(begin + alone, begin + points.per_cell):
            f = matrix_at(points, positions, b, p)
            energy, stress = response(f, values.stiffness[b, p])
            added, viscous = respond(f, values, b, p)
            energy_out[b, p] = energy + added
            stress += viscous
            for part in range(cells.by_nodes.shape[1]):
                gradients = cells.by_nodes[p, part]
                x = along(stress[0], gradients)
                y = along(stress[1], gradients)
                z = along(stress[2], gradients)
                for n in range(wp.min(nodes.shape[0] - part * WIDTH, WIDTH)):
                    force_out[b, nodes[part * WIDTH + n]] += wp.vec3d(x[n], y[n], z[n])

    return step


@generated
def cell_tangent(law: Law) -> Any:
    """Returns the kernel for the tangents of the same materials."""
    viscosity = viscosity_of(law)
    elastic_tangent, vector = law.tangent, law.values
    values_type, add_viscosity = viscosity.Values, viscosity.add_tangent

    @wp.func_native(_TANGENT)
    def tangents_together(
        first: int, count: int, nodes: wp.array[int],
        together: wp.array2d[lanes], stiffness: wp.array[vector], positions: wp.array[wp.vec3d],
        tangent_out: wp.array2d[wp.mat33d],
    ) -> bool: ...  # fmt: skip

    @wp.kernel(module=named_module(f"lanes.{law.name}"))
    def tangent(
        active: wp.array[int],
        clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
        points: MatrixPoints,
        values: values_type,
        positions: wp.array2d[wp.vec3d],
        cells: LaneCells,
        tangent_out: wp.array3d[wp.mat33d],  # (B, P, 6)
    ):
        b, cell = wp.tid()
        if active[b] == 0:
            return
        begin, clamped = cell * points.per_cell, clamp[b] != 0
        alone = wp.int32(0)
        for group in range(cells.together.shape[1]):
            first, count = begin + group * WIDTH, wp.min(cells.shape_points - group * WIDTH, WIDTH)
            if clamped or not tangents_together(
                first, count, points.nodes[cell],
                cells.together[cell, group], values.stiffness[b], positions[b],
                tangent_out[b],
            ):  # fmt: skip
                break
            alone += count
        start = begin + alone
        if values.viscosity[b][0] > ZERO:
            start = begin
        for p in range(start, begin + points.per_cell):
            f = matrix_at(points, positions, b, p)
            if p >= begin + alone:
                elastic_tangent(f, values.stiffness[b, p], clamped, tangent_out[b, p])
            add_viscosity(f, values, b, p, clamped, tangent_out[b, p])

    return tangent
