"""Local step and tangent of whole cells by the vector instructions of a CPU: eight points at a time.

A quantity of eight points is one vector, on which Warp's elementwise operations become vector instructions. Launches on
a CPU run one thread after another, so that threads may add to the same forces.

The shape term of the corotated material needs no rotation here (Hoger and Carlson 1984). With F = R U, J = det F and
U^2 = F^T F = I + e, the invariants 3 + x, 3 + y and J = 1 + z of U follow from those of e:

    p (12 + p) = 8 (x + e_1) + 4 e_2 + 8 z (3 + x),        p = 6 x + x^2 - e_1 = 2 y

of which x is the largest root. With s = x - y + z and g = (3 + x) (3 + y) - J, the theorem of Cayley and Hamilton gives

    g (U - I)      = s (4 + x) I + ((3 + x)^2 - y - 5) e - e^2
    J (I - U^-1)   = s I + (3 + x) (U - I) - e

and F - R = F (I - U^-1). All terms are small with the strain, so that they add no error to those of e and z. By the
same theorem, the matrix of `kernels.materials.corotated.turning` is (F F^T + (3 + y) I) / g.
"""

from types import ModuleType, SimpleNamespace

import warp as wp

from .elasticity import add_viscous_tangent, solid_kernels, viscous_response
from .materials.corotated import rotation_blocks
from .matrices import HALLEY_ITERATIONS, HALLEY_TOLERANCE, LARGEST_TRACE
from .modules import generated, named_module
from .points import MatrixPoints, matrix_at

WIDTH = 8  # points: as many doubles as the widest vector instructions take
FLATTEST = wp.float64(0.2)  # smallest J of points that are taken together; the others' errors would grow with 1 / J
ZERO, HALF, ONE, TWO = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0)
THREE, FOUR, FIVE, SIX = wp.float64(3.0), wp.float64(4.0), wp.float64(5.0), wp.float64(6.0)
EIGHT, TWELVE = wp.float64(8.0), wp.float64(12.0)

lanes = wp.types.vector(WIDTH, wp.float64)  # A tensor has its components one by one; matrices of lanes would be slower.


@wp.func
def dot(x: lanes, y: lanes, z: lanes, u: lanes, v: lanes, w: lanes) -> lanes:
    """Returns x u + y v + z w."""
    return wp.cw_mul(x, u) + wp.cw_mul(y, v) + wp.cw_mul(z, w)


@wp.func
def minor(x: lanes, y: lanes, u: lanes, v: lanes) -> lanes:
    """Returns x y - u v."""
    return wp.cw_mul(x, y) - wp.cw_mul(u, v)


@wp.func
def deformation(nodes: wp.array[int], together: wp.array2d[lanes], positions: wp.array[wp.vec3d]):
    """F = sum_a x_a (grad N_a)^T, row by row."""
    f00, f01, f02 = lanes(), lanes(), lanes()
    f10, f11, f12 = lanes(), lanes(), lanes()
    f20, f21, f22 = lanes(), lanes(), lanes()
    for a in range(nodes.shape[0]):
        x = positions[nodes[a]]
        g0, g1, g2 = together[a, 0], together[a, 1], together[a, 2]
        f00 += x[0] * g0
        f01 += x[0] * g1
        f02 += x[0] * g2
        f10 += x[1] * g0
        f11 += x[1] * g1
        f12 += x[1] * g2
        f20 += x[2] * g0
        f21 += x[2] * g1
        f22 += x[2] * g2
    return f00, f01, f02, f10, f11, f12, f20, f21, f22


@wp.func
def strain(f00: lanes, f01: lanes, f02: lanes, f10: lanes, f11: lanes, f12: lanes, f20: lanes, f21: lanes, f22: lanes):
    """Returns J, and e = F^T F - I: components 00, 11, 22, 12, 02 and 01."""
    one = lanes(ONE)
    return (
        dot(f00, f01, f02, minor(f11, f22, f12, f21), minor(f12, f20, f10, f22), minor(f10, f21, f11, f20)),
        dot(f00, f10, f20, f00, f10, f20) - one,
        dot(f01, f11, f21, f01, f11, f21) - one,
        dot(f02, f12, f22, f02, f12, f22) - one,
        dot(f01, f11, f21, f02, f12, f22),
        dot(f00, f10, f20, f02, f12, f22),
        dot(f00, f10, f20, f01, f11, f21),
    )


@wp.func
def stretch(j: lanes, e00: lanes, e11: lanes, e22: lanes, e12: lanes, e02: lanes, e01: lanes):
    """Returns 1 / g, 3 + y, |U - I|^2, the components of I - U^-1, and whether all are as exact as of single points."""
    one = lanes(ONE)
    e1, z = e00 + e11 + e22, j - one
    e2 = minor(e00, e11, e01, e01) + minor(e00, e22, e02, e02) + minor(e11, e22, e12, e12)
    x = HALF * e1  # not below the root, to which Halley's iteration falls
    change = ONE
    for _ in range(HALLEY_ITERATIONS):
        p = wp.cw_mul(x, lanes(SIX) + x) - e1
        q, trace = lanes(SIX) + p, lanes(THREE) + x
        value = TWELVE * p + wp.cw_mul(p, p) - EIGHT * (x + e1 + wp.cw_mul(z, trace)) - FOUR * e2
        slope = FOUR * wp.cw_mul(trace, q) - EIGHT * j
        bend = FOUR * q + EIGHT * wp.cw_mul(trace, trace)
        step = wp.cw_div(TWO * wp.cw_mul(value, slope), TWO * wp.cw_mul(slope, slope) - wp.cw_mul(value, bend))
        x -= step
        change = wp.dot(step, step)
        if change < HALLEY_TOLERANCE:
            break
    y = HALF * (wp.cw_mul(x, lanes(SIX) + x) - e1)
    s, i = x - y + z, lanes(THREE) + x
    g = wp.cw_div(one, wp.cw_mul(i, lanes(THREE) + y) - j)
    # h = U - I
    gs, ge = wp.cw_mul(wp.cw_mul(g, s), one + i), wp.cw_mul(g, wp.cw_mul(i, i) - y - lanes(FIVE))
    h00 = gs + wp.cw_mul(ge, e00) - wp.cw_mul(g, dot(e00, e01, e02, e00, e01, e02))
    h11 = gs + wp.cw_mul(ge, e11) - wp.cw_mul(g, dot(e01, e11, e12, e01, e11, e12))
    h22 = gs + wp.cw_mul(ge, e22) - wp.cw_mul(g, dot(e02, e12, e22, e02, e12, e22))
    h12 = wp.cw_mul(ge, e12) - wp.cw_mul(g, dot(e01, e11, e12, e02, e12, e22))
    h02 = wp.cw_mul(ge, e02) - wp.cw_mul(g, dot(e00, e01, e02, e02, e12, e22))
    h01 = wp.cw_mul(ge, e01) - wp.cw_mul(g, dot(e00, e01, e02, e01, e11, e12))
    k = wp.cw_div(one, j)
    return (
        g,
        lanes(THREE) + y,
        dot(h00, h11, h22, h00, h11, h22) + TWO * dot(h12, h02, h01, h12, h02, h01),
        wp.cw_mul(k, s + wp.cw_mul(i, h00) - e00),
        wp.cw_mul(k, s + wp.cw_mul(i, h11) - e11),
        wp.cw_mul(k, s + wp.cw_mul(i, h22) - e22),
        wp.cw_mul(k, wp.cw_mul(i, h12) - e12),
        wp.cw_mul(k, wp.cw_mul(i, h02) - e02),
        wp.cw_mul(k, wp.cw_mul(i, h01) - e01),
        change < HALLEY_TOLERANCE and wp.min(j) > FLATTEST and wp.max(e1) < LARGEST_TRACE - THREE,
    )


@wp.func
def along(x: wp.float64, y: wp.float64, z: wp.float64, gradients: wp.array[lanes]) -> lanes:
    """Product of a row of the stress with the gradients of some nodes."""
    return x * gradients[0] + y * gradients[1] + z * gradients[2]


@wp.func
def scatter(x: lanes, y: lanes, z: lanes, nodes: wp.array[int], part: int, force_out: wp.array[wp.vec3d]):
    """Adds the forces of some nodes of a cell."""
    first = part * WIDTH
    for n in range(wp.min(nodes.shape[0] - first, WIDTH)):
        force_out[nodes[first + n]] += wp.vec3d(x[n], y[n], z[n])


@wp.struct
class LaneCells:
    """Gradients of cells for the vector instructions."""

    together: wp.array4d[lanes]  # (C, G, K, 3) of a cell's first S points, filled up with the last
    by_nodes: wp.array3d[lanes]  # (P, K / 8, 3) of eight nodes at a time, filled up with zeros
    shape_points: int  # S, the number of points without a volume term, which come first


@generated
def cell_kernels(law: ModuleType) -> SimpleNamespace:
    """Returns the kernels of a material whose shape term is that of ``kernels.materials.corotated``."""
    module = named_module(f"lanes.{law.NAME}")
    respond, elastic_tangent, moduli = law.response, law.tangent, law.moduli
    values_type = solid_kernels(law).Values
    mu_of, lambda_of = (moduli(*(wp.float64(pair[i]) for pair in law.LAME)) for i in (0, 1))

    @wp.kernel(module=module)
    def cell_step(
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
        damping, begin = values.viscosity[b], cell * points.per_cell
        first_alone = wp.int32(0)  # of the points that are taken one by one
        for group in range(cells.together.shape[1]):
            f00, f01, f02, f10, f11, f12, f20, f21, f22 = deformation(
                points.nodes[cell], cells.together[cell, group], positions[b]
            )
            j, e00, e11, e22, e12, e02, e01 = strain(f00, f01, f02, f10, f11, f12, f20, f21, f22)
            _g, _i2, energy, t00, t11, t22, t12, t02, t01, exact = stretch(j, e00, e11, e22, e12, e02, e01)
            if not exact:
                break
            first, count = begin + group * WIDTH, wp.min(cells.shape_points - group * WIDTH, WIDTH)
            mu = lanes()
            for n in range(count):
                mu[n] = wp.dot(mu_of, values.stiffness[b, first + n])
            if damping[0] > ZERO:
                w00, w11, w22, w12, w02, w01 = lanes(), lanes(), lanes(), lanes(), lanes(), lanes()
                for n in range(count):
                    w = values.strain_offset[b, first + n]
                    w00[n] = w[0, 0]
                    w11[n] = w[1, 1]
                    w22[n] = w[2, 2]
                    w12[n] = w[1, 2]
                    w02[n] = w[0, 2]
                    w01[n] = w[0, 1]
                half = HALF * damping[0]
                c00, c11, c22, c12, c02, c01 = half * e00, half * e11, half * e22, half * e12, half * e02, half * e01
                normal = dot(c00 - TWO * w00, c11 - TWO * w11, c22 - TWO * w22, c00, c11, c22)
                shear = dot(c12 - TWO * w12, c02 - TWO * w02, c01 - TWO * w01, c12, c02, c01)
                energy += (ONE / damping[0]) * (normal + TWO * shear)
                t00 += c00 - w00
                t11 += c11 - w11
                t22 += c22 - w22
                t12 += c12 - w12
                t02 += c02 - w02
                t01 += c01 - w01
            energy = wp.cw_mul(mu, energy)
            for n in range(count):
                energy_out[b, first + n] = energy[n]
            mu = TWO * mu
            p00 = wp.cw_mul(mu, dot(f00, f01, f02, t00, t01, t02))
            p01 = wp.cw_mul(mu, dot(f00, f01, f02, t01, t11, t12))
            p02 = wp.cw_mul(mu, dot(f00, f01, f02, t02, t12, t22))
            p10 = wp.cw_mul(mu, dot(f10, f11, f12, t00, t01, t02))
            p11 = wp.cw_mul(mu, dot(f10, f11, f12, t01, t11, t12))
            p12 = wp.cw_mul(mu, dot(f10, f11, f12, t02, t12, t22))
            p20 = wp.cw_mul(mu, dot(f20, f21, f22, t00, t01, t02))
            p21 = wp.cw_mul(mu, dot(f20, f21, f22, t01, t11, t12))
            p22 = wp.cw_mul(mu, dot(f20, f21, f22, t02, t12, t22))
            for part in range(cells.by_nodes.shape[1]):
                x, y, z = lanes(), lanes(), lanes()
                for n in range(count):
                    x += along(p00[n], p01[n], p02[n], cells.by_nodes[first + n, part])
                    y += along(p10[n], p11[n], p12[n], cells.by_nodes[first + n, part])
                    z += along(p20[n], p21[n], p22[n], cells.by_nodes[first + n, part])
                scatter(x, y, z, points.nodes[cell], part, force_out[b])
            first_alone = wp.min((group + 1) * WIDTH, cells.shape_points)
        for p in range(begin + first_alone, begin + points.per_cell):
            f_one = matrix_at(points, positions, b, p)
            m = values.stiffness[b, p]
            energy_one, stress_one = respond(f_one, m)
            if damping[0] + damping[1] > ZERO:
                lame = wp.vec2d(wp.dot(mu_of, m), wp.dot(lambda_of, m))
                added = viscous_response(f_one, lame, damping, values.strain_offset[b, p], values.dilation_offset[b, p])
                energy_one += added[0]
                stress_one += added[1]
            energy_out[b, p] = energy_one
            for part in range(cells.by_nodes.shape[1]):
                x_one = along(stress_one[0, 0], stress_one[0, 1], stress_one[0, 2], cells.by_nodes[p, part])
                y_one = along(stress_one[1, 0], stress_one[1, 1], stress_one[1, 2], cells.by_nodes[p, part])
                z_one = along(stress_one[2, 0], stress_one[2, 1], stress_one[2, 2], cells.by_nodes[p, part])
                scatter(x_one, y_one, z_one, points.nodes[cell], part, force_out[b])

    @wp.kernel(module=module)
    def cell_tangent(
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
        c, begin, clamped = values.viscosity[b], cell * points.per_cell, clamp[b] != 0
        groups = cells.together.shape[1]
        if clamped:
            groups = 0
        first_alone = wp.int32(0)
        for group in range(groups):
            f00, f01, f02, f10, f11, f12, f20, f21, f22 = deformation(
                points.nodes[cell], cells.together[cell, group], positions[b]
            )
            j, e00, e11, e22, e12, e02, e01 = strain(f00, f01, f02, f10, f11, f12, f20, f21, f22)
            g, i2, _energy, t00, t11, t22, t12, t02, t01, exact = stretch(j, e00, e11, e22, e12, e02, e01)
            if not exact:
                break
            r00 = f00 - dot(f00, f01, f02, t00, t01, t02)
            r01 = f01 - dot(f00, f01, f02, t01, t11, t12)
            r02 = f02 - dot(f00, f01, f02, t02, t12, t22)
            r10 = f10 - dot(f10, f11, f12, t00, t01, t02)
            r11 = f11 - dot(f10, f11, f12, t01, t11, t12)
            r12 = f12 - dot(f10, f11, f12, t02, t12, t22)
            r20 = f20 - dot(f20, f21, f22, t00, t01, t02)
            r21 = f21 - dot(f20, f21, f22, t01, t11, t12)
            r22 = f22 - dot(f20, f21, f22, t02, t12, t22)
            a00 = wp.cw_mul(g, i2 + dot(f00, f01, f02, f00, f01, f02))
            a11 = wp.cw_mul(g, i2 + dot(f10, f11, f12, f10, f11, f12))
            a22 = wp.cw_mul(g, i2 + dot(f20, f21, f22, f20, f21, f22))
            a12 = wp.cw_mul(g, dot(f10, f11, f12, f20, f21, f22))
            a02 = wp.cw_mul(g, dot(f00, f01, f02, f20, f21, f22))
            a01 = wp.cw_mul(g, dot(f00, f01, f02, f10, f11, f12))
            first, count = begin + group * WIDTH, wp.min(cells.shape_points - group * WIDTH, WIDTH)
            for n in range(count):
                p = first + n
                mu = wp.dot(mu_of, values.stiffness[b, p])
                r = wp.mat33d(r00[n], r01[n], r02[n], r10[n], r11[n], r12[n], r20[n], r21[n], r22[n])
                a = wp.mat33d(a00[n], a01[n], a02[n], a01[n], a11[n], a12[n], a02[n], a12[n], a22[n])
                rotation_blocks(r, (TWO * mu) * a, mu, tangent_out[b, p])
                if c[0] > ZERO:
                    f = wp.mat33d(f00[n], f01[n], f02[n], f10[n], f11[n], f12[n], f20[n], f21[n], f22[n])
                    add_viscous_tangent(
                        f, wp.vec2d(mu, ZERO), c, values.strain_offset[b, p], ZERO, False, tangent_out[b, p]
                    )
            first_alone = wp.min((group + 1) * WIDTH, cells.shape_points)
        for p_one in range(begin + first_alone, begin + points.per_cell):
            f_one = matrix_at(points, positions, b, p_one)
            m = values.stiffness[b, p_one]
            out = tangent_out[b, p_one]
            elastic_tangent(f_one, m, clamped, out)
            if c[0] + c[1] > ZERO:
                lame = wp.vec2d(wp.dot(mu_of, m), wp.dot(lambda_of, m))
                offset, dilation = values.strain_offset[b, p_one], values.dilation_offset[b, p_one]
                add_viscous_tangent(f_one, lame, c, offset, dilation, clamped, out)

    return SimpleNamespace(step=cell_step, tangent=cell_tangent)
