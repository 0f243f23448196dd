"""Nearest points of a vertex and a triangle, and of two edges:
four vertices x_i, the rows of a matrix.

The vector from the nearest point of the second to that of the first is sum_i w_i x_i = d n, with
the distance d, a unit vector n and weights w_i. Where the nearest points can slide along directions
t_k of the weights, with e_k = sum_i t_ki x_i, the distance has the second derivatives

    d H_ij = w_i w_j (1 - n n^T) - sum_kl (t_ki d n + w_i e_k) G_kl (t_lj d n + w_j e_l)^T,
    G^-1 = [e_k . e_l].
"""

import warp as wp

from ..constants import HALF, ONE, QUARTER, ZERO
from .barriers import KEPT

wp.set_module_options({"enable_backward": False})

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
    parallel: wp.array[wp.float64]  # |a x b|^2 of edges below which they are almost parallel [m^4]


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
    """Returns the share of the way from a to b at which it is nearest to p."""
    e = b - a
    return wp.clamp(wp.dot(p - a, e) / wp.dot(e, e), ZERO, ONE)


@wp.func
def on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Returns the weights of the corners at the place nearest to p (Ericson 2005).

    Zero on the opposite side.
    """
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
    """Returns the shares of the ways from a to b and from c to d
    at which the two are nearest (Ericson 2005).
    """
    e, f = b - a, d - c
    r = a - c
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
def triangle_weights(feature: int, x: Corners):
    """Returns w, the number of directions t_k, and these,
    of a vertex and a feature of a triangle (`nearest`).
    """
    x0, x1, x2, x3 = x[0], x[1], x[2], x[3]
    t, s = wp.vec4d(), wp.vec4d()
    free = 0
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
    if u[0] > ZERO:
        if u[1] > ZERO:
            t, free = wp.vec4d(ZERO, ONE, -ONE, ZERO), 1
            if u[2] > ZERO:
                s, free = wp.vec4d(ZERO, ONE, ZERO, -ONE), 2
        elif u[2] > ZERO:
            t, free = wp.vec4d(ZERO, ONE, ZERO, -ONE), 1
    elif u[1] > ZERO and u[2] > ZERO:
        t, free = wp.vec4d(ZERO, ZERO, ONE, -ONE), 1
    return wp.vec4d(ONE, -u[0], -u[1], -u[2]), free, t, s


@wp.func
def edge_weights(feature: int, x: Corners):
    """Returns the same for a feature of two edges."""
    x0, x1, x2, x3 = x[0], x[1], x[2], x[3]
    t, s = wp.vec4d(), wp.vec4d()
    free = 0
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
    slides, other = at[0] > ZERO and at[0] < ONE, at[1] > ZERO and at[1] < ONE
    if slides:
        t, free = wp.vec4d(-ONE, ONE, ZERO, ZERO), 1
    if other:
        if slides:
            s, free = wp.vec4d(ZERO, ZERO, ONE, -ONE), 2
        else:
            t, free = wp.vec4d(ZERO, ZERO, ONE, -ONE), 1
    return wp.vec4d(ONE - at[0], at[0], at[1] - ONE, -at[1]), free, t, s


@wp.func
def nearest(kind: int, feature: int, x: Corners) -> Nearest:
    """Returns the nearest points of a feature of a pair.

    Features of a vertex x0 and a triangle: 0 the triangle, 1 to 3 its sides opposite to x1 to x3, 4
    to 6 its corners. Features of two edges: 3 i + j, where i and j are 0 for an edge, 1 and 2 for
    its ends.
    """
    w = wp.vec4d()
    t, s = wp.vec4d(), wp.vec4d()
    free = 0
    if kind == VERTEX_TRIANGLE:
        w, free, t, s = triangle_weights(feature, x)
    else:
        w, free, t, s = edge_weights(feature, x)
    r = w * x
    out = Nearest()
    out.d = wp.length(r)
    if out.d > ZERO:
        out.n = r / out.d
    if free == 2:
        e, f = x[1] - x[0], x[3] - x[2]
        across = x[0] - x[2]
        if kind == VERTEX_TRIANGLE:
            e, f = x[2] - x[1], x[3] - x[1]
            across = x[0] - x[1]
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
    """Returns the coefficient of a feature's barrier in that of its pair.

    The sum over all pairs counts what several triangles or edges share once (inclusion and
    exclusion).
    """
    if kind == VERTEX_TRIANGLE:
        if feature == 0:
            return ONE
        if feature < 4:
            return -HALF
        return ONE / degree[feature - 3]
    first, second = feature / 3, feature % 3
    out = ONE
    if first > 0:
        out = -out * (ONE - ONE / degree[first - 1])
    if second > 0:
        out = -out * (ONE - ONE / degree[second + 1])
    return out


@wp.func
def corners(positions: wp.array2d[wp.vec3d], b: int, v: wp.vec4i) -> Corners:
    """Returns the positions of the vertices of a pair."""
    x = Corners()
    for i in range(4):
        x[i] = positions[b, v[i]]
    return x


@wp.func
def apart(kind: int, x: Corners, most: wp.float64) -> bool:
    """Returns whether the boxes of the two parts of a pair are further apart than a distance."""
    low, high = x[0], x[0]
    one = x[1]
    if kind == EDGE_EDGE:
        low, high = wp.min(x[0], x[1]), wp.max(x[0], x[1])
        one = x[2]
    a = wp.min(wp.min(one, x[2]), x[3]) - high
    b = low - wp.max(wp.max(one, x[2]), x[3])
    return wp.max(wp.max(wp.max(a[0], a[1]), a[2]), wp.max(wp.max(b[0], b[1]), b[2])) > most


@wp.func
def features(kind: int) -> int:
    """Returns the number of features of a pair."""
    return wp.where(kind == VERTEX_TRIANGLE, TRIANGLE_FEATURES, EDGE_FEATURES)


@wp.kernel
def bound(
    active: wp.array[int],
    pairs: Pairs,
    origin: wp.array2d[wp.vec3d],  # (B, N) without penetration [m]
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    share_out: wp.array[wp.float64],  # (B) lowered to what of the way leaves `KEPT` of each gap
):
    """Bounds a step by additive advances (Li, Kaufman and Jiang 2021).

    No point of one part of a pair comes nearer to the other by more than the sum of the largest
    ways of the two.
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
    whole = share_out[b]
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
    wp.atomic_min(share_out, b, t)


@wp.kernel
def distances(pairs: Pairs, positions: wp.array2d[wp.vec3d], distance_out: wp.array[wp.float64]):
    """Computes the distances of all pairs [m]."""
    c = wp.tid()
    distance_out[c] = nearest(
        pairs.kind[c], 0, corners(positions, pairs.environment[c], pairs.nodes[c])
    ).d


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
    features_out: Features,
):
    """Computes weights of nearest points, directions in which these can slide,
    and parts of all features of pairs.
    """
    a, feature = wp.tid()
    c = chosen[a]
    kind = pairs.kind[c]
    at = nearest(
        kind,
        wp.where(feature < features(kind), feature, 0),
        corners(positions, pairs.environment[c], pairs.nodes[c]),
    )
    features_out.w[a, feature] = at.w
    features_out.t[a, feature] = at.t
    features_out.s[a, feature] = at.s
    if feature < features(kind) and at.d < reach:
        features_out.coefficient[a, feature] = part(kind, feature, pairs.degree[c])
