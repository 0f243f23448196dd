"""Contact between surfaces of triangles: barrier, friction, step bounds (equations in ``energies.surfaces``).

A pair is a vertex and a triangle, or two edges: four vertices x_i, the rows of a matrix. The vector from the nearest
point of the second to that of the first is sum_i w_i x_i = d n, with the distance d, a unit vector n and weights w_i.
Where the nearest points can slide along directions t_k of the weights, with e_k = sum_i t_ki x_i, the distance has the
second derivatives

    d H_ij = w_i w_j (1 - n n^T) - sum_kl (t_ki d n + w_i e_k) G_kl (t_lj d n + w_j e_l)^T,    G^-1 = [e_k . e_l].
"""

import warp as wp

from .contact import INFINITE, KEPT, ONE, TWO, UNDEFINED, ZERO, barrier, slide_tangent, smoothed
from .points import VectorPoints, vector_at

wp.set_module_options({"enable_backward": False})

HALF, QUARTER = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(0.25))
VERTEX_TRIANGLE, EDGE_EDGE = wp.constant(0), wp.constant(1)
SLENDER = wp.constant(wp.float64(1e-2))  # square of the sine below which edges give no exact normal
TRIANGLE_FEATURES, EDGE_FEATURES = wp.constant(7), wp.constant(9)  # of a pair of a kind (`nearest`)
Corners = wp.types.matrix(shape=(4, 3), dtype=wp.float64)  # a vector for every vertex of a pair
ADVANCES = wp.constant(1000)  # along the way of a pair


@wp.struct
class Pairs:
    """Pairs of all environments, sorted."""

    environment: wp.array[int]
    kind: wp.array[int]
    nodes: wp.array[wp.vec4i]
    area: wp.array[wp.float64]  # that a pair stands for [m^2]
    degree: wp.array[wp.vec4d]  # triangles at each of the vertices
    parallel: wp.array[wp.float64]  # |a x b|^2 of edges below which they count as almost parallel [m^4]


@wp.struct
class Nearest:
    """Nearest points of a pair (equations in the module's docstring)."""

    d: wp.float64
    n: wp.vec3d
    w: wp.vec4d
    free: int  # number of directions t_k
    t: wp.vec4d
    s: wp.vec4d


@wp.func
def along(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """Share of the way from a to b at which it is nearest to p."""
    e = b - a
    return wp.clamp(wp.dot(p - a, e) / wp.dot(e, e), ZERO, ONE)


@wp.func
def on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Weights of the corners at the place nearest to p (Ericson 2005); a weight is zero on the side opposite to it."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = wp.dot(ab, ap), wp.dot(ac, ap)
    if d1 <= ZERO and d2 <= ZERO:
        return wp.vec3d(ONE, ZERO, ZERO)
    bp = p - b
    d3, d4 = wp.dot(ab, bp), wp.dot(ac, bp)
    if d3 >= ZERO and d4 <= d3:
        return wp.vec3d(ZERO, ONE, ZERO)
    vc = d1 * d4 - d3 * d2
    if vc <= ZERO and d1 >= ZERO and d3 <= ZERO:
        u = d1 / (d1 - d3)
        return wp.vec3d(ONE - u, u, ZERO)
    cp = p - c
    d5, d6 = wp.dot(ab, cp), wp.dot(ac, cp)
    if d6 >= ZERO and d5 <= d6:
        return wp.vec3d(ZERO, ZERO, ONE)
    vb = d5 * d2 - d1 * d6
    if vb <= ZERO and d2 >= ZERO and d6 <= ZERO:
        u = d2 / (d2 - d6)
        return wp.vec3d(ONE - u, ZERO, u)
    va = d3 * d6 - d5 * d4
    if va <= ZERO and d4 >= d3 and d5 >= d6:
        u = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3d(ZERO, ONE - u, u)
    whole = va + vb + vc
    return wp.vec3d(va / whole, vb / whole, vc / whole)


@wp.func
def on_edges(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec2d:
    """Shares of the ways from a to b and from c to d at which the two are nearest to each other (Ericson 2005)."""
    e, f, r = b - a, d - c, a - c
    ee, ff, ef = wp.dot(e, e), wp.dot(f, f), wp.dot(e, f)
    er, fr = wp.dot(e, r), wp.dot(f, r)
    whole = ee * ff - ef * ef
    s = ZERO
    if whole > ZERO:
        s = wp.clamp((ef * fr - er * ff) / whole, ZERO, ONE)
    t = (ef * s + fr) / ff
    if t < ZERO:
        return wp.vec2d(wp.clamp(-er / ee, ZERO, ONE), ZERO)
    if t > ONE:
        return wp.vec2d(wp.clamp((ef - er) / ee, ZERO, ONE), ONE)
    return wp.vec2d(s, t)


@wp.func
def nearest(kind: int, feature: int, x: Corners) -> Nearest:
    """Nearest points of a feature of a pair.

    Features of a vertex x0 and a triangle: 0 the triangle, 1 to 3 its sides opposite to x1 to x3, 4 to 6 its corners.
    Features of two edges: 3 i + j, where i and j are 0 for an edge, 1 and 2 for its ends.
    """
    x0, x1, x2, x3 = x[0], x[1], x[2], x[3]
    w, t, s = wp.vec4d(), wp.vec4d(), wp.vec4d()
    free = 0
    if kind == VERTEX_TRIANGLE:
        u = wp.vec3d(ONE, ZERO, ZERO)
        if feature == 0:
            u = on_triangle(x0, x1, x2, x3)
        elif feature == 1:
            q = along(x0, x2, x3)
            u = wp.vec3d(ZERO, ONE - q, q)
        elif feature == 2:
            q = along(x0, x1, x3)
            u = wp.vec3d(ONE - q, ZERO, q)
        elif feature == 3:
            q = along(x0, x1, x2)
            u = wp.vec3d(ONE - q, q, ZERO)
        elif feature == 5:
            u = wp.vec3d(ZERO, ONE, ZERO)
        elif feature == 6:
            u = wp.vec3d(ZERO, ZERO, ONE)
        w = wp.vec4d(ONE, -u[0], -u[1], -u[2])
        if u[0] > ZERO:
            if u[1] > ZERO:
                t, free = wp.vec4d(ZERO, ONE, -ONE, ZERO), 1
                if u[2] > ZERO:
                    s, free = wp.vec4d(ZERO, ONE, ZERO, -ONE), 2
            elif u[2] > ZERO:
                t, free = wp.vec4d(ZERO, ONE, ZERO, -ONE), 1
        elif u[1] > ZERO and u[2] > ZERO:
            t, free = wp.vec4d(ZERO, ZERO, ONE, -ONE), 1
    else:
        first, second = feature / 3, feature % 3
        at = wp.vec2d(ZERO, ZERO)
        if first == 0 and second == 0:
            at = on_edges(x0, x1, x2, x3)
        elif first == 0:
            at[0] = along(wp.where(second == 1, x2, x3), x0, x1)
        elif second == 0:
            at[1] = along(wp.where(first == 1, x0, x1), x2, x3)
        if first == 2:
            at[0] = ONE
        if second == 2:
            at[1] = ONE
        w = wp.vec4d(ONE - at[0], at[0], at[1] - ONE, -at[1])
        slides, other = at[0] > ZERO and at[0] < ONE, at[1] > ZERO and at[1] < ONE
        if slides:
            t, free = wp.vec4d(-ONE, ONE, ZERO, ZERO), 1
        if other:
            if slides:
                s, free = wp.vec4d(ZERO, ZERO, ONE, -ONE), 2
            else:
                t, free = wp.vec4d(ZERO, ZERO, ONE, -ONE), 1
    r = w * x
    out = Nearest()
    out.d = wp.length(r)
    if out.d > ZERO:
        out.n = r / out.d
    if free == 2:
        e, f, across = x1 - x0, x3 - x2, x0 - x2
        if kind == VERTEX_TRIANGLE:
            e, f, across = x2 - x1, x3 - x1, x0 - x1
        normal = wp.cross(e, f)
        square = wp.dot(normal, normal)
        if square > SLENDER * wp.dot(e, e) * wp.dot(f, f):  # more digits than by the weights
            normal /= wp.sqrt(square)
            gap = wp.dot(normal, across)
            out.d = wp.abs(gap)
            out.n = wp.where(gap < ZERO, -normal, normal)
    out.w = w
    out.free = free
    out.t = t
    out.s = s
    return out


@wp.func
def part(kind: int, feature: int, degree: wp.vec4d) -> wp.float64:
    """Coefficient of a feature's barrier in that of its pair.

    The sum over all pairs counts what several triangles or edges share once (inclusion and exclusion).
    """
    if kind == VERTEX_TRIANGLE:
        if feature == 0:
            return ONE
        if feature < 4:
            return -HALF
        return ONE / degree[feature - 3]
    first, second, out = feature / 3, feature % 3, ONE
    if first > 0:
        out = -out * (ONE - ONE / degree[first - 1])
    if second > 0:
        out = -out * (ONE - ONE / degree[second + 1])
    return out


@wp.func
def mollifier(c: wp.float64, width: wp.float64) -> wp.vec3d:
    """m(c), m'(c) and m''(c) of a factor that is zero for parallel edges, c = 0, and one from `width` on."""
    if c >= width:
        return wp.vec3d(ONE, ZERO, ZERO)
    q = c / width
    return wp.vec3d((TWO - q) * q, TWO * (ONE - q) / width, -TWO / (width * width))


@wp.func
def corners(positions: wp.array2d[wp.vec3d], b: int, v: wp.vec4i) -> Corners:
    """Positions of the vertices of a pair."""
    x = Corners()
    for i in range(4):
        x[i] = positions[b, v[i]]
    return x


@wp.func
def apart(kind: int, x: Corners, most: wp.float64) -> bool:
    """Whether the boxes of the two parts of a pair are further apart than a distance."""
    low, high, one = x[0], x[0], x[1]
    if kind == EDGE_EDGE:
        low, high, one = wp.min(x[0], x[1]), wp.max(x[0], x[1]), x[2]
    a = wp.min(wp.min(one, x[2]), x[3]) - high
    b = low - wp.max(wp.max(one, x[2]), x[3])
    return wp.max(wp.max(wp.max(a[0], a[1]), a[2]), wp.max(wp.max(b[0], b[1]), b[2])) > most


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


@wp.func
def features(kind: int) -> int:
    """Number of features of a pair."""
    return wp.where(kind == VERTEX_TRIANGLE, TRIANGLE_FEATURES, EDGE_FEATURES)


@wp.struct
class Barrier:
    """Energy of a pair and its gradient."""

    energy: wp.float64
    slope: Corners


@wp.func
def pair_barrier(pairs: Pairs, c: int, x: Corners, stiffness: wp.float64, reach: wp.float64) -> Barrier:
    """Energy of a pair without the factor for almost parallel edges."""
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
    """Gradient and energy of every pair; not a number and infinite at no distance, but finite for what has crossed."""
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
def add_parallelism(out: wp.array3d[wp.float64], a: int, x: Corners, factor: wp.float64, whole: wp.float64):
    """Adds the second derivatives of c = |a x b|^2 (`parallelism`) times a factor.

    Those are 2 J^T J, with J of a x b, and the curvature of a x b; `whole` is zero without the latter.
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
    out: wp.array3d[wp.float64],  # (A, 12, 12), zero before
):
    """Second derivatives of the energies of chosen pairs."""
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
            tt, ss, ts = wp.dot(et, et), wp.dot(es, es), wp.dot(et, es)
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
                    add_block(out, a, i, j, at.w[i] * at.w[j] * block - bend * slid)
    if m[0] < ONE:
        plain, slope = pair_barrier(pairs, c, x, stiffness[b, 0], reach), parallelism_slope(x)
        add_parallelism(out, a, x, plain.energy * m[1], ONE)
        for i in range(4):
            for j in range(4):
                outer = wp.outer(slope[i], plain.slope[j]) + wp.outer(plain.slope[i], slope[j])
                add_block(out, a, i, j, m[1] * outer + plain.energy * m[2] * wp.outer(slope[i], slope[j]))


@wp.kernel
def pair_springs(
    chosen: wp.array[int],  # (A) pairs
    pairs: Pairs,
    stiffness: wp.array2d[wp.float64],
    reach: wp.float64,
    positions: wp.array2d[wp.vec3d],
    out: wp.array3d[wp.float64],  # (A, 12, 12), zero before
):
    """The positive part of `pair_tangents` along the shortest distance, and by the angle of almost parallel edges."""
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
            add_parallelism(out, a, x, wp.max(plain.energy, ZERO) * m[1], ZERO)
    size = wp.dot(first.w, first.w)
    factor = wp.max(curvature, ZERO) * stiffness[b, 0] * pairs.area[c] / (reach * size * size)
    block = factor * wp.outer(first.n, first.n)
    for i in range(4):
        for j in range(4):
            add_block(out, a, i, j, first.w[i] * first.w[j] * block)


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
    """u, the relative way of the two parts of a pair since the start of the step, in its tangential plane."""
    b, v, w, n = grips.environment[g], grips.nodes[g], grips.weights[g], grips.normal[g]
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
    """Gradient and energy of friction."""
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
    out: wp.array3d[wp.float64],  # (G, 12, 12), zero before
):
    """Second derivatives of the energies of friction."""
    g = wp.tid()
    b, w = grips.environment[g], grips.weights[g]
    u = grip_slide(grips, g, positions, reference)
    block = (coefficient[b, grips.regions[g]] * grips.load[g]) * slide_tangent(grips.normal[g], u, slip[b, 0])
    for i in range(4):
        for j in range(4):
            add_block(out, g, i, j, w[i] * w[j] * block)


@wp.kernel
def interpolate(
    vertices: wp.array[int],  # (P) of the surface
    points: VectorPoints,
    field: wp.array2d[wp.vec3d],  # (B, N) at control vertices
    field_out: wp.array2d[wp.vec3d],  # (B, N)
):
    """Sets a field at the vertices of a surface from that at control vertices, and leaves it elsewhere."""
    b, p = wp.tid()
    field_out[b, vertices[p]] = vector_at(points, field, b, p)


@wp.kernel
def gather(
    start: wp.array[int],  # (B P + 1) first entry of every vertex
    incident: wp.array[int],  # pair 4 + number of the vertex in it, in ascending order: a fixed summation order
    force: wp.array[Corners],
    energy: wp.array[wp.float64],
    size: int,  # P
    adds: int,  # 1: to what is there
    force_out: wp.array2d[wp.vec3d],  # (B, P)
    energy_out: wp.array2d[wp.float64],
):
    """Sums the gradients of the pairs of every vertex, and the energies of those whose first vertex it is."""
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
def bound(
    active: wp.array[int],
    pairs: Pairs,
    origin: wp.array2d[wp.vec3d],  # (B, N) without penetration [m]
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    share: wp.array[wp.float64],  # (B) is lowered to the share of the way from origin that leaves `KEPT` of every gap
):
    """Bounds a step by additive advances (Li, Kaufman and Jiang 2021).

    No point of one part of a pair comes nearer to the other by more than the sum of the largest ways of the two.
    """
    c = wp.tid()
    b = pairs.environment[c]
    if active[b] == 0:
        return
    kind, v = pairs.kind[c], pairs.nodes[c]
    x = corners(origin, b, v)
    way = corners(positions, b, v) - x
    mean = QUARTER * (way[0] + way[1] + way[2] + way[3])
    w0, w1 = wp.length(way[0] - mean), wp.length(way[1] - mean)
    last = wp.max(wp.length(way[2] - mean), wp.length(way[3] - mean))
    most = w0 + wp.max(w1, last)
    if kind == EDGE_EDGE:
        most = wp.max(w0, w1) + last
    whole = share[b]
    if apart(kind, x, most * whole / (ONE - KEPT)):
        return
    d = nearest(kind, 0, x).d
    kept = KEPT * d
    t = wp.float64(0.0)
    for _ in range(ADVANCES):
        gap = d - kept
        if most * (whole - t) <= gap:
            return
        t += gap / most
        if gap < kept:
            break
        d = nearest(kind, 0, x + t * way).d
    wp.atomic_min(share, b, t)


@wp.kernel
def distances(pairs: Pairs, positions: wp.array2d[wp.vec3d], distance_out: wp.array[wp.float64]):
    """Distances of all pairs [m]."""
    c = wp.tid()
    distance_out[c] = nearest(pairs.kind[c], 0, corners(positions, pairs.environment[c], pairs.nodes[c])).d


@wp.struct
class Features:
    """Features of chosen pairs (A, 9), for derivatives by torch."""

    coefficient: wp.array2d[wp.float64]  # zero where there is no barrier
    w: wp.array2d[wp.vec4d]
    t: wp.array2d[wp.vec4d]
    s: wp.array2d[wp.vec4d]


@wp.kernel
def pair_features(
    chosen: wp.array[int],  # (A)
    pairs: Pairs,
    reach: wp.float64,
    positions: wp.array2d[wp.vec3d],
    out: Features,
):
    """Weights of the nearest points of all features of pairs, the directions in which they can slide, and parts."""
    a, feature = wp.tid()
    c = chosen[a]
    kind = pairs.kind[c]
    at = nearest(
        kind, wp.where(feature < features(kind), feature, 0), corners(positions, pairs.environment[c], pairs.nodes[c])
    )
    out.w[a, feature] = at.w
    out.t[a, feature] = at.t
    out.s[a, feature] = at.s
    if feature < features(kind) and at.d < reach:
        out.coefficient[a, feature] = part(kind, feature, pairs.degree[c])


@wp.kernel
def local_step(
    active: wp.array[int],
    force: wp.array2d[wp.vec3d],  # (B, P) of `gather`
    energy: wp.array2d[wp.float64],
    stress_out: wp.array2d[wp.vec3d],
    energy_out: wp.array2d[wp.float64],
):
    """Force and energy of the vertices of a surface."""
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
    """Second derivatives of single vertices: none, as all are of pairs (`pair_tangents`)."""
    b, p = wp.tid()
    tangent_out[b, p, 0] = wp.mat33d()
