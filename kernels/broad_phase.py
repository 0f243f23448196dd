"""Pairs of a surface of triangles that may come near one another, by a hierarchy of boxes.

Vertices move by at most a radius from the positions for which pairs are sought: pairs within one piece of the surface
by one around the mean motion of the piece, other pairs by another.
"""

import warp as wp

from .surfaces import EDGE_EDGE, VERTEX_TRIANGLE, Corners, apart, nearest

wp.set_module_options({"enable_backward": False})

FLAT = wp.constant(wp.float64(1e-9))  # sine of the angle below which an edge is parallel to a triangle
SAFE = wp.constant(wp.float32(1.0 + 1e-6))  # boxes are in float32


@wp.struct
class Motion:
    """Positions of a batch, and radii around them."""

    origin: wp.array2d[wp.vec3d]  # (B, N) [m]
    outer: wp.array2d[wp.float64]  # (B, N) radius [m]
    inner: wp.array2d[wp.float64]  # (B, N) radius around the mean motion of a piece [m]
    piece: wp.array[int]  # (N)
    reach: wp.float64  # distance within which pairs count [m]


@wp.struct
class Found:
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
    motion: Motion,
    nodes: wp.array2d[int],  # (M, K) vertices of triangles or edges
    lower_out: wp.array[wp.vec3],  # (B M)
    upper_out: wp.array[wp.vec3],
    group_out: wp.array[int],
):
    """Boxes of all places where a primitive may be."""
    b, k = wp.tid()
    i = b * nodes.shape[0] + k
    v = nodes[k, 0]
    low, high = lower(motion.origin[b, v], motion.outer[b, v]), upper(motion.origin[b, v], motion.outer[b, v])
    for a in range(1, nodes.shape[1]):
        v = nodes[k, a]
        low = wp.min(low, lower(motion.origin[b, v], motion.outer[b, v]))
        high = wp.max(high, upper(motion.origin[b, v], motion.outer[b, v]))
    lower_out[i] = low
    upper_out[i] = high
    group_out[i] = b


@wp.func
def may_touch(motion: Motion, b: int, kind: int, v: wp.vec4i) -> bool:
    """Whether a pair may come within reach."""
    x, r = Corners(), wp.vec4d()
    same = motion.piece[v[0]] == motion.piece[v[3]]
    for i in range(4):
        x[i] = motion.origin[b, v[i]]
        r[i] = wp.where(same, motion.inner[b, v[i]], motion.outer[b, v[i]])
    most = motion.reach + r[0] + wp.max(wp.max(r[1], r[2]), r[3])
    if kind == EDGE_EDGE:
        most = motion.reach + wp.max(r[0], r[1]) + wp.max(r[2], r[3])
    if apart(kind, x, most):
        return False
    return nearest(kind, 0, x).d < most


@wp.func
def keep(found: Found, key: wp.int64):
    """Stores the key of a pair."""
    slot = wp.atomic_add(found.count, 0, 1)
    if slot < found.keys.shape[0]:
        found.keys[slot] = key


@wp.kernel
def vertex_triangle_pairs(
    hierarchy: wp.uint64,
    motion: Motion,
    vertices: wp.array[int],  # (P)
    triangles: wp.array2d[int],  # (T, 3)
    per_environment: wp.int64,  # number of all conceivable pairs of an environment
    found: Found,
):
    """Pairs of a vertex and a triangle."""
    b, p = wp.tid()
    v = vertices[p]
    x, r = motion.origin[b, v], motion.outer[b, v] + motion.reach
    query = wp.bvh_query_aabb(hierarchy, lower(x, r), upper(x, r), wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    count = triangles.shape[0]
    while wp.bvh_query_next(query, hit):
        t = hit - b * count
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if v != i and v != j and v != k and may_touch(motion, b, VERTEX_TRIANGLE, wp.vec4i(v, i, j, k)):
            keep(found, wp.int64(b) * per_environment + wp.int64(p) * wp.int64(count) + wp.int64(t))


@wp.kernel
def edge_edge_pairs(
    hierarchy: wp.uint64,
    motion: Motion,
    edges: wp.array2d[int],  # (E, 2)
    first: wp.int64,  # number of pairs of a vertex and a triangle, which come before
    per_environment: wp.int64,
    found: Found,
):
    """Pairs of edges."""
    b, e = wp.tid()
    i, j = edges[e, 0], edges[e, 1]
    xi, xj = motion.origin[b, i], motion.origin[b, j]
    ri, rj = motion.outer[b, i] + motion.reach, motion.outer[b, j] + motion.reach
    low, high = wp.min(lower(xi, ri), lower(xj, rj)), wp.max(upper(xi, ri), upper(xj, rj))
    query = wp.bvh_query_aabb(hierarchy, low, high, wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    count = edges.shape[0]
    while wp.bvh_query_next(query, hit):
        f = hit - b * count
        if f > e:
            k, m = edges[f, 0], edges[f, 1]
            if i != k and i != m and j != k and j != m and may_touch(motion, b, EDGE_EDGE, wp.vec4i(i, j, k, m)):
                key = wp.int64(e) * wp.int64(count) + wp.int64(f)
                keep(found, wp.int64(b) * per_environment + first + key)


@wp.func
def side(x: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Six times the signed volume of a tetrahedron."""
    return wp.dot(x - a, wp.cross(b - a, c - a))


@wp.kernel
def crossings(
    hierarchy: wp.uint64,  # of triangles
    motion: Motion,
    edges: wp.array2d[int],
    triangles: wp.array2d[int],
    count_out: wp.array[int],  # (B) edges that cross a triangle
    edge_out: wp.array[int],  # (B) the first of them
):
    """Edges that pass through triangles without a vertex in common."""
    b, e = wp.tid()
    i, j = edges[e, 0], edges[e, 1]
    x, y = motion.origin[b, i], motion.origin[b, j]
    none = wp.float64(0.0)
    low, high = wp.min(lower(x, none), lower(y, none)), wp.max(upper(x, none), upper(y, none))
    query = wp.bvh_query_aabb(hierarchy, low, high, wp.bvh_get_group_root(hierarchy, b))
    hit = wp.int32(0)
    while wp.bvh_query_next(query, hit):
        t = hit - b * triangles.shape[0]
        k, m, n = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if i != k and i != m and i != n and j != k and j != m and j != n:
            p, q, r = motion.origin[b, k], motion.origin[b, m], motion.origin[b, n]
            from_x, from_y = side(x, p, q, r), side(y, p, q, r)
            flat = FLAT * wp.length(wp.cross(q - p, r - p)) * wp.length(y - x)
            if from_x * from_y <= none and wp.max(wp.abs(from_x), wp.abs(from_y)) > flat:
                u, v, w = side(p, x, y, q), side(q, x, y, r), side(r, x, y, p)
                if (u >= none and v >= none and w >= none) or (u <= none and v <= none and w <= none):
                    wp.atomic_add(count_out, b, 1)
                    wp.atomic_min(edge_out, b, e)
