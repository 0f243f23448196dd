"""Pairs of a surface of triangles that may come near one another, by a hierarchy of boxes.

Vertices move by at most a radius from the positions for which pairs are sought: pairs within one
piece of the surface by one around the mean motion of the piece, other pairs by another around the
mean motion of all.
"""

import warp as wp

from .nearest_points import EDGE_EDGE, Corners, apart, nearest

wp.set_module_options({"enable_backward": False})

# Sine of the angle below which an edge is parallel to a triangle.
FLAT = wp.constant(wp.float64(1e-9))
NOTHING = wp.constant(wp.float64(0.0))
SAFE = wp.constant(wp.float32(1.0 + 1e-6))  # boxes are in float32


@wp.struct
class Sweep:
    """Positions of a batch, and radii around them."""

    origin: wp.array2d[wp.vec3d]  # (B, N) [m]
    outer: wp.array2d[wp.float64]  # (B, N) radius around the mean motion of all [m]
    inner: wp.array2d[wp.float64]  # (B, N) radius around the mean motion of a piece [m]
    piece: wp.array[int]  # (N)
    reach: wp.float64  # distance within which pairs count [m]


@wp.struct
class PairKeys:
    """Keys of pairs, in any order; more than fit are only counted."""

    count: wp.array[int]  # (1)
    keys: wp.array[wp.int64]  # number of the environment, and of the pair among all of one


@wp.func
def lower(x: wp.vec3d, r: wp.float64) -> wp.vec3:
    """Returns the lower corner of a box in float32, rounded outwards.

    Minus that of -x is the upper one.
    """
    y, e = wp.vec3(x - wp.vec3d(r, r, r)), wp.vec3()
    for i in range(3):
        e[i] = wp.abs(y[i]) * (SAFE - wp.float32(1.0))
    return y - e


@wp.func
def box(sweep: Sweep, b: int, nodes: wp.array[int], more: wp.float64):
    """Returns both corners of the box of all places where a primitive may be, widened by more."""
    x, r = sweep.origin[b, nodes[0]], sweep.outer[b, nodes[0]] + more
    low, high = lower(x, r), -lower(-x, r)
    for a in range(1, nodes.shape[0]):
        y, s = sweep.origin[b, nodes[a]], sweep.outer[b, nodes[a]] + more
        low, high = wp.min(low, lower(y, s)), wp.max(high, -lower(-y, s))
    return low, high


@wp.kernel
def boxes(
    sweep: Sweep,
    nodes: wp.array2d[int],  # (M, K) vertices of triangles or edges
    lower_out: wp.array[wp.vec3],  # (B M)
    upper_out: wp.array[wp.vec3],
    group_out: wp.array[int],
):
    """Computes the boxes of all places where a primitive may be."""
    b, k = wp.tid()
    i = b * nodes.shape[0] + k
    low, high = box(sweep, b, nodes[k], NOTHING)
    lower_out[i] = low
    upper_out[i] = high
    group_out[i] = b


@wp.func
def may_touch(sweep: Sweep, b: int, kind: int, v: wp.vec4i) -> bool:
    """Returns whether a pair may come within reach."""
    x, r = Corners(), wp.vec4d()
    same = sweep.piece[v[0]] == sweep.piece[v[3]]
    for i in range(4):
        x[i] = sweep.origin[b, v[i]]
        r[i] = wp.where(same, sweep.inner[b, v[i]], sweep.outer[b, v[i]])
    most = sweep.reach + r[0] + wp.max(wp.max(r[1], r[2]), r[3])
    if kind == EDGE_EDGE:
        most = sweep.reach + wp.max(r[0], r[1]) + wp.max(r[2], r[3])
    if apart(kind, x, most):
        return False
    return nearest(kind, 0, x).d < most


@wp.kernel
def close_pairs(
    kind: int,
    hierarchy: wp.uint64,  # of the second primitives
    sweep: Sweep,
    first: wp.array2d[int],  # (P, 1) vertices, or (E, 2) edges
    second: wp.array2d[int],  # (T, 3) triangles, or (E, 2) edges
    offset: wp.int64,  # number of pairs of another kind, which come before
    per_environment: wp.int64,  # number of all conceivable pairs of an environment
    pairs_out: PairKeys,
):
    """Finds pairs of a vertex and a triangle, or of edges, without a vertex in common."""
    b, i = wp.tid()
    vertices = first[i]
    low, high = box(sweep, b, vertices, sweep.reach)
    query = wp.bvh_query_aabb(hierarchy, low, high, wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    count = second.shape[0]
    while wp.bvh_query_next(query, hit):
        j = hit - b * count
        other = second[j]
        v = wp.vec4i(vertices[0], other[0], other[1], other[other.shape[0] - 1])
        distinct = v[0] != v[1] and v[0] != v[2] and v[0] != v[3]
        if kind == EDGE_EDGE:
            v = wp.vec4i(vertices[0], vertices[1], other[0], other[1])
            distinct = j > i and v[0] != v[2] and v[0] != v[3] and v[1] != v[2] and v[1] != v[3]
        if distinct and may_touch(sweep, b, kind, v):
            slot = wp.atomic_add(pairs_out.count, 0, 1)
            if slot < pairs_out.keys.shape[0]:
                key = wp.int64(i) * wp.int64(count) + wp.int64(j)
                pairs_out.keys[slot] = wp.int64(b) * per_environment + offset + key


@wp.func
def side(x: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Returns six times the signed volume of a tetrahedron."""
    return wp.dot(x - a, wp.cross(b - a, c - a))


@wp.kernel
def crossings(
    hierarchy: wp.uint64,  # of triangles
    sweep: Sweep,
    edges: wp.array2d[int],
    triangles: wp.array2d[int],
    count_out: wp.array[int],  # (B) edges that cross a triangle
    edge_out: wp.array[int],  # (B) the first of them
):
    """Finds edges that pass through triangles without a vertex in common."""
    b, e = wp.tid()
    i, j = edges[e, 0], edges[e, 1]
    x, y = sweep.origin[b, i], sweep.origin[b, j]
    low, high = box(sweep, b, edges[e], NOTHING)
    query = wp.bvh_query_aabb(hierarchy, low, high, wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    while wp.bvh_query_next(query, hit):
        t = hit - b * triangles.shape[0]
        k, m, n = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if i != k and i != m and i != n and j != k and j != m and j != n:
            p, q, r = sweep.origin[b, k], sweep.origin[b, m], sweep.origin[b, n]
            from_x, from_y = side(x, p, q, r), side(y, p, q, r)
            flat = FLAT * wp.length(wp.cross(q - p, r - p)) * wp.length(y - x)
            if from_x * from_y <= NOTHING and wp.max(wp.abs(from_x), wp.abs(from_y)) > flat:
                u, v, w = side(p, x, y, q), side(q, x, y, r), side(r, x, y, p)
                if (u >= NOTHING and v >= NOTHING and w >= NOTHING) or (
                    u <= NOTHING and v <= NOTHING and w <= NOTHING
                ):
                    wp.atomic_add(count_out, b, 1)
                    wp.atomic_min(edge_out, b, e)
