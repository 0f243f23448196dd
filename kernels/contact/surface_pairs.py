"""Barrier and friction of pairs of surfaces of triangles (equations in
``energies.contact.surface_contact``).
"""

import warp as wp

from ..constants import ONE, TWO, ZERO
from ..points import VectorPoints, vector_at
from .barriers import INFINITE, UNDEFINED, barrier, slide_tangent, smoothed
from .nearest_points import EDGE_EDGE, Corners, Pairs, apart, corners, features, nearest, part

wp.set_module_options({"enable_backward": False})


@wp.func
def mollifier(c: wp.float64, width: wp.float64) -> wp.vec3d:
    """Returns m(c), m'(c) and m''(c) of a factor that is zero for parallel edges,
    c = 0, and one from `width` on.
    """
    if c >= width:
        return wp.vec3d(ONE, ZERO, ZERO)
    q = c / width
    return wp.vec3d((TWO - q) * q, TWO * (ONE - q) / width, -TWO / (width * width))


@wp.func
def parallelism(x: Corners) -> wp.float64:
    """Returns c = |a x b|^2 of the edges a and b of a pair."""
    return wp.length_sq(wp.cross(x[1] - x[0], x[3] - x[2]))


@wp.func
def parallelism_slope(x: Corners) -> Corners:
    """Returns dc / dx."""
    a, b = x[1] - x[0], x[3] - x[2]
    by_a = TWO * (wp.length_sq(b) * a - wp.dot(a, b) * b)
    by_b = TWO * (wp.length_sq(a) * b - wp.dot(a, b) * a)
    out = Corners()
    out[0] = -by_a
    out[1] = by_a
    out[2] = -by_b
    out[3] = by_b
    return out


@wp.struct
class Barrier:
    """Energy of a pair and its gradient."""

    energy: wp.float64
    slope: Corners


@wp.func
def pair_barrier(
    pairs: Pairs, c: int, x: Corners, stiffness: wp.float64, reach: wp.float64
) -> Barrier:
    """Returns the energy of a pair without the factor for almost parallel edges."""
    kind = pairs.kind[c]
    factor = stiffness * pairs.area[c]
    out = Barrier()
    for feature in range(features(kind)):
        at = nearest(kind, feature, x)
        if at.d < reach:
            e = barrier(at.d / reach)
            q = factor * part(kind, feature, pairs.degree[c])
            out.slope += (q * e[1]) * wp.outer(at.w, at.n)
            out.energy += q * reach * e[0]
    return out


@wp.kernel
def pair_forces(
    active: wp.array[int],  # (B) zero: skip the environment
    pairs: Pairs,
    stiffness: wp.array2d[wp.float64],  # (B, 1) kappa [Pa]
    reach: wp.float64,  # D [m]
    positions: wp.array2d[wp.vec3d],
    force_out: wp.array[Corners],  # (C)
    energy_out: wp.array[wp.float64],  # (C)
    near_out: wp.array[int],  # (C) whether a pair is nearer than D
):
    """Computes gradient and energy of pairs: not a number and infinite at no distance,
    finite for what has crossed.
    """
    c = wp.tid()
    b = pairs.environment[c]
    if active[b] == 0:
        return
    kind, x = pairs.kind[c], corners(positions, b, pairs.nodes[c])
    out = Barrier()
    near = 0
    if not apart(kind, x, reach):
        d = nearest(kind, 0, x).d
        if d <= ZERO:
            near = 1
            out.energy = INFINITE
            for i in range(4):
                out.slope[i] = wp.vec3d(UNDEFINED, UNDEFINED, UNDEFINED)
        elif d < reach:
            near = 1
            out = pair_barrier(pairs, c, x, stiffness[b, 0], reach)
            if kind == EDGE_EDGE:
                m = mollifier(parallelism(x), pairs.parallel[c])
                out.slope = m[0] * out.slope + (m[1] * out.energy) * parallelism_slope(x)
                out.energy = m[0] * out.energy
    force_out[c] = out.slope
    energy_out[c] = out.energy
    near_out[c] = near


@wp.func
def add_block(out: wp.array3d[wp.float64], a: int, i: int, j: int, block: wp.mat33d):
    """Adds a block of a pair's Hessian."""
    for r in range(3):
        for s in range(3):
            out[a, 3 * i + r, 3 * j + s] += block[r, s]


@wp.func
def add_parallelism(
    out: wp.array3d[wp.float64], a: int, x: Corners, factor: wp.float64, whole: wp.float64
):
    """Adds the second derivatives of c = |a x b|^2 (`parallelism`) times a factor.

    Those are 2 J^T J, with J of a x b, and the curvature of a x b; `whole` is zero without the
    latter.
    """
    e, f = x[1] - x[0], x[3] - x[2]
    ee = -wp.outer(f, f)
    ff = -wp.outer(e, e)
    ef = (ONE + whole) * wp.outer(e, f) - whole * wp.outer(f, e)
    for r in range(3):
        ee[r, r] = ee[r, r] + wp.length_sq(f)
        ff[r, r] = ff[r, r] + wp.length_sq(e)
        ef[r, r] = ef[r, r] - wp.dot(e, f)
    for i in range(4):
        for j in range(4):
            curved = wp.where(j < 2, ee, ef)
            if i >= 2:
                curved = wp.where(j < 2, wp.transpose(ef), ff)
            if (i + j) % 2 == 1:
                curved = -curved
            add_block(out, a, i, j, (TWO * factor) * curved)


@wp.kernel
def pair_tangents(
    chosen: wp.array[int],  # (A) pairs
    pairs: Pairs,
    stiffness: wp.array2d[wp.float64],
    reach: wp.float64,
    positions: wp.array2d[wp.vec3d],
    blocks_out: wp.array3d[wp.float64],  # (A, 12, 12), zero before
):
    """Computes the second derivatives of the energies of chosen pairs."""
    a = wp.tid()
    c = chosen[a]
    b, kind = pairs.environment[c], pairs.kind[c]
    x = corners(positions, b, pairs.nodes[c])
    factor = stiffness[b, 0] * pairs.area[c]
    m = wp.vec3d(ONE, ZERO, ZERO)
    if kind == EDGE_EDGE:
        m = mollifier(parallelism(x), pairs.parallel[c])
    for feature in range(features(kind)):
        at = nearest(kind, feature, x)
        if at.d < reach and at.d > ZERO:
            e = barrier(at.d / reach)
            q = m[0] * factor * part(kind, feature, pairs.degree[c])
            normal, bend = wp.outer(at.n, at.n), q * e[1] / at.d
            block = (q * e[2] / reach - bend) * normal
            for r in range(3):
                block[r, r] = block[r, r] + bend
            # The inverse of G, by the numbers of directions.
            et, es = at.t * x, at.s * x
            tt, ss = wp.dot(et, et), wp.dot(es, es)
            ts = wp.dot(et, es)
            g = wp.vec3d()  # G_11, G_22, G_12
            if at.free == 1:
                g[0] = ONE / tt
            elif at.free == 2:
                whole = tt * ss - ts * ts
                g = wp.vec3d(ss / whole, tt / whole, -ts / whole)
            for i in range(4):
                hi = at.t[i] * at.d * at.n + at.w[i] * et
                ki = at.s[i] * at.d * at.n + at.w[i] * es
                for j in range(4):
                    hj = at.t[j] * at.d * at.n + at.w[j] * et
                    kj = at.s[j] * at.d * at.n + at.w[j] * es
                    slid = g[0] * wp.outer(hi, hj) + g[1] * wp.outer(ki, kj)
                    slid += g[2] * (wp.outer(hi, kj) + wp.outer(ki, hj))
                    add_block(blocks_out, a, i, j, at.w[i] * at.w[j] * block - bend * slid)
    if m[0] < ONE:
        plain, slope = pair_barrier(pairs, c, x, stiffness[b, 0], reach), parallelism_slope(x)
        add_parallelism(blocks_out, a, x, plain.energy * m[1], ONE)
        for i in range(4):
            for j in range(4):
                outer = wp.outer(slope[i], plain.slope[j]) + wp.outer(plain.slope[i], slope[j])
                add_block(
                    blocks_out,
                    a,
                    i,
                    j,
                    m[1] * outer + plain.energy * m[2] * wp.outer(slope[i], slope[j]),
                )


@wp.kernel
def pair_springs(
    chosen: wp.array[int],  # (A) pairs
    pairs: Pairs,
    stiffness: wp.array2d[wp.float64],
    reach: wp.float64,
    positions: wp.array2d[wp.vec3d],
    blocks_out: wp.array3d[wp.float64],  # (A, 12, 12), zero before
):
    """Computes the positive part of `pair_tangents` along the distance,
    and by the angle of almost parallel edges.
    """
    a = wp.tid()
    c = chosen[a]
    b, kind = pairs.environment[c], pairs.kind[c]
    x = corners(positions, b, pairs.nodes[c])
    first = nearest(kind, 0, x)
    curvature = wp.float64(0.0)
    for feature in range(features(kind)):
        at = nearest(kind, feature, x)
        if at.d < reach and at.d > ZERO:
            by = wp.dot(first.w, at.w) * wp.dot(first.n, at.n)
            curvature += part(kind, feature, pairs.degree[c]) * barrier(at.d / reach)[2] * by * by
    if kind == EDGE_EDGE:
        m = mollifier(parallelism(x), pairs.parallel[c])
        curvature *= m[0]
        if m[0] < ONE:
            plain = pair_barrier(pairs, c, x, stiffness[b, 0], reach)
            add_parallelism(blocks_out, a, x, wp.max(plain.energy, ZERO) * m[1], ZERO)
    size = wp.dot(first.w, first.w)
    factor = wp.max(curvature, ZERO) * stiffness[b, 0] * pairs.area[c] / (reach * size * size)
    block = factor * wp.outer(first.n, first.n)
    for i in range(4):
        for j in range(4):
            add_block(blocks_out, a, i, j, first.w[i] * first.w[j] * block)


@wp.struct
class FrictionPairs:
    """Friction of pairs in a step, of all environments."""

    environment: wp.array[int]
    nodes: wp.array[wp.vec4i]
    weights: wp.array[wp.vec4d]  # at the start of the step, as the other two
    normal: wp.array[wp.vec3d]
    load: wp.array[wp.float64]  # normal force [N]
    regions: wp.array[int]  # number of their coefficient


@wp.func
def grip_slide(
    grips: FrictionPairs, g: int, positions: wp.array2d[wp.vec3d], reference: wp.array2d[wp.vec3d]
) -> wp.vec3d:
    """Returns u, the relative way of the two parts of a pair since the step began,
    in its tangential plane.
    """
    b, v = grips.environment[g], grips.nodes[g]
    w, n = grips.weights[g], grips.normal[g]
    way = w * (corners(positions, b, v) - corners(reference, b, v))
    return way - wp.dot(way, n) * n


@wp.kernel
def grip_forces(
    active: wp.array[int],
    grips: FrictionPairs,
    coefficient: wp.array2d[wp.float64],  # (B, F) mu, by regions
    slip: wp.array2d[wp.float64],  # (B, 1) slide at which friction is fully developed [m]
    reference: wp.array2d[wp.vec3d],  # (B, N) positions without slide [m]
    positions: wp.array2d[wp.vec3d],
    force_out: wp.array[Corners],
    energy_out: wp.array[wp.float64],
):
    """Computes gradient and energy of friction."""
    g = wp.tid()
    b = grips.environment[g]
    if active[b] == 0:
        return
    u = grip_slide(grips, g, positions, reference)
    v, most = smoothed(wp.length(u), slip[b, 0]), coefficient[b, grips.regions[g]] * grips.load[g]
    force_out[g] = (most * v[1]) * wp.outer(grips.weights[g], u)
    energy_out[g] = most * v[0]


@wp.kernel
def grip_tangents(
    grips: FrictionPairs,
    coefficient: wp.array2d[wp.float64],
    slip: wp.array2d[wp.float64],
    reference: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    blocks_out: wp.array3d[wp.float64],  # (G, 12, 12), zero before
):
    """Computes the second derivatives of the energies of friction."""
    g = wp.tid()
    b, w = grips.environment[g], grips.weights[g]
    u = grip_slide(grips, g, positions, reference)
    block = (coefficient[b, grips.regions[g]] * grips.load[g]) * slide_tangent(
        grips.normal[g], u, slip[b, 0]
    )
    for i in range(4):
        for j in range(4):
            add_block(blocks_out, g, i, j, w[i] * w[j] * block)


@wp.kernel
def interpolate(
    vertices: wp.array[int],  # (P) of the surface
    points: VectorPoints,
    field: wp.array2d[wp.vec3d],  # (B, N) at control vertices
    field_out: wp.array2d[wp.vec3d],  # (B, N)
):
    """Sets a field at the vertices of a surface from that at control vertices,
    and leaves it elsewhere.
    """
    b, p = wp.tid()
    field_out[b, vertices[p]] = vector_at(points, field, b, p)


@wp.kernel
def gather(
    start: wp.array[int],  # (B P + 1) first entry of every vertex
    incident: wp.array[int],  # 4 pair + its number in it, ascending: a fixed summation order
    force: wp.array[Corners],
    energy: wp.array[wp.float64],
    size: int,  # P
    adds: int,  # 1: to what is there
    force_out: wp.array2d[wp.vec3d],  # (B, P)
    energy_out: wp.array2d[wp.float64],
):
    """Sums the gradients of the pairs of every vertex,
    and the energies of those whose first vertex it is.
    """
    b, p = wp.tid()
    total, sum = wp.vec3d(), wp.float64(0.0)
    row = b * size + p
    for entry in range(start[row], start[row + 1]):
        pair = incident[entry] / 4
        i = incident[entry] - 4 * pair
        total += force[pair][i]
        if i == 0:
            sum += energy[pair]
    if adds == 1:
        total += force_out[b, p]
        sum += energy_out[b, p]
    force_out[b, p] = total
    energy_out[b, p] = sum


@wp.kernel
def local_step(
    active: wp.array[int],
    force: wp.array2d[wp.vec3d],  # (B, P) of `gather`
    energy: wp.array2d[wp.float64],
    stress_out: wp.array2d[wp.vec3d],
    energy_out: wp.array2d[wp.float64],
):
    """Copies force and energy of the vertices of a surface, as `gather` sums them."""
    b, p = wp.tid()
    if active[b] != 0:
        stress_out[b, p] = force[b, p]
        energy_out[b, p] = energy[b, p]


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],
    force: wp.array2d[wp.vec3d],
    energy: wp.array2d[wp.float64],
    tangent_out: wp.array3d[wp.mat33d],  # (B, P, 1)
):
    """Sets the second derivatives of single vertices to zero,
    as all are of pairs (`pair_tangents`).
    """
    b, p = wp.tid()
    tangent_out[b, p, 0] = wp.mat33d()
