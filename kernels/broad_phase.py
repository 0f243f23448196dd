"""Pairs of a surface of triangles that may come near one another, by a hierarchy of boxes.

Vertices move by at most a radius from the positions for which pairs are sought: pairs within one piece of the surface
by one around the mean motion of the piece, other pairs by another around the mean motion of all.
"""

import warp as wp

from .surfaces import EDGE_EDGE, VERTEX_TRIANGLE, Corners, apart, nearest

wp.set_module_options({"enable_backward": False})

FLAT = wp.constant(wp.float64(1e-9))  # sine of the angle below which an edge is parallel to a triangle
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
    keys: wp.array[wp.int64]  # number of the environment, and of the pair among all of an environment


@wp.func
def lower(x: wp.vec3d, r: wp.float64) -> wp.vec3:
    """Corner of a box in float32, rounded outwards."""
    y, e = wp.vec3(x - wp.vec3d(r, r, r)), wp.vec3()
    for i in range(3):
        e[i] = wp.abs(y[i]) * (SAFE - wp.float32(1.0))
    return y - e


@wp.func
def upper(x: wp.vec3d, r: wp.float64) -> wp.vec3:
    """The opposite corner."""
    return -lower(-x, r)


@wp.kernel
def boxes(
    sweep: Sweep,
    nodes: wp.array2d[int],  # (M, K) vertices of triangles or edges
    lower_out: wp.array[wp.vec3],  # (B M)
    upper_out: wp.array[wp.vec3],
    group_out: wp.array[int],
):
    """Boxes of all places where a primitive may be."""
    b, k = wp.tid()
    i = b * nodes.shape[0] + k
    v = nodes[k, 0]
    low, high = lower(sweep.origin[b, v], sweep.outer[b, v]), upper(sweep.origin[b, v], sweep.outer[b, v])
    for a in range(1, nodes.shape[1]):
        v = nodes[k, a]
        low = wp.min(low, lower(sweep.origin[b, v], sweep.outer[b, v]))
        high = wp.max(high, upper(sweep.origin[b, v], sweep.outer[b, v]))
    lower_out[i] = low
    upper_out[i] = high
    group_out[i] = b


@wp.func
def may_touch(sweep: Sweep, b: int, kind: int, v: wp.vec4i) -> bool:
    """Whether a pair may come within reach."""
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


@wp.func
def keep(pair_keys: PairKeys, key: wp.int64):
    """Stores the key of a pair."""
    slot = wp.atomic_add(pair_keys.count, 0, 1)
    if slot < pair_keys.keys.shape[0]:
        pair_keys.keys[slot] = key


@wp.kernel
def vertex_triangle_pairs(
    hierarchy: wp.uint64,
    sweep: Sweep,
    vertices: wp.array[int],  # (P)
    triangles: wp.array2d[int],  # (T, 3)
    per_environment: wp.int64,  # number of all conceivable pairs of an environment
    pair_keys: PairKeys,
):
    """Pairs of a vertex and a triangle."""
    b, p = wp.tid()
    v = vertices[p]
    x, r = sweep.origin[b, v], sweep.outer[b, v] + sweep.reach
    query = wp.bvh_query_aabb(hierarchy, lower(x, r), upper(x, r), wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    count = triangles.shape[0]
    while wp.bvh_query_next(query, hit):
        t = hit - b * count
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if v != i and v != j and v != k and may_touch(sweep, b, VERTEX_TRIANGLE, wp.vec4i(v, i, j, k)):
            keep(pair_keys, wp.int64(b) * per_environment + wp.int64(p) * wp.int64(count) + wp.int64(t))


@wp.kernel
def edge_edge_pairs(
    hierarchy: wp.uint64,
    sweep: Sweep,
    edges: wp.array2d[int],  # (E, 2)
    first: wp.int64,  # number of pairs of a vertex and a triangle, which come before
    per_environment: wp.int64,
    pair_keys: PairKeys,
):
    """Pairs of edges."""
    b, e = wp.tid()
    i, j = edges[e, 0], edges[e, 1]
    xi, xj = sweep.origin[b, i], sweep.origin[b, j]
    ri, rj = sweep.outer[b, i] + sweep.reach, sweep.outer[b, j] + sweep.reach
    low, high = wp.min(lower(xi, ri), lower(xj, rj)), wp.max(upper(xi, ri), upper(xj, rj))
    query = wp.bvh_query_aabb(hierarchy, low, high, wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    count = edges.shape[0]
    while wp.bvh_query_next(query, hit):
        f = hit - b * count
        if f > e:
            k, m = edges[f, 0], edges[f, 1]
            if i != k and i != m and j != k and j != m and may_touch(sweep, b, EDGE_EDGE, wp.vec4i(i, j, k, m)):
                key = wp.int64(e) * wp.int64(count) + wp.int64(f)
                keep(pair_keys, wp.int64(b) * per_environment + first + key)


@wp.func
def side(x: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Six times the signed volume of a tetrahedron."""
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
    """Edges that pass through triangles without a vertex in common."""
    b, e = wp.tid()
    i, j = edges[e, 0], edges[e, 1]
    x, y = sweep.origin[b, i], sweep.origin[b, j]
    none = wp.float64(0.0)
    low, high = wp.min(lower(x, none), lower(y, none)), wp.max(upper(x, none), upper(y, none))
    query = wp.bvh_query_aabb(hierarchy, low, high, wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    while wp.bvh_query_next(query, hit):
        t = hit - b * triangles.shape[0]
        k, m, n = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if i != k and i != m and i != n and j != k and j != m and j != n:
            p, q, r = sweep.origin[b, k], sweep.origin[b, m], sweep.origin[b, n]
            from_x, from_y = side(x, p, q, r), side(y, p, q, r)
            flat = FLAT * wp.length(wp.cross(q - p, r - p)) * wp.length(y - x)
            if from_x * from_y <= none and wp.max(wp.abs(from_x), wp.abs(from_y)) > flat:
                u, v, w = side(p, x, y, q), side(q, x, y, r), side(r, x, y, p)
                if (u >= none and v >= none and w >= none) or (u <= none and v <= none and w <= none):
                    wp.atomic_add(count_out, b, 1)
                    wp.atomic_min(edge_out, b, e)
