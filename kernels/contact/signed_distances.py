"""Signed distances of obstacles with their first two derivatives,
their pull-back, and queries of closed surfaces.

A point is at y = R^T (x - c) in the axes of an obstacle with place c and rotation R. The signed
distance phi(y) of a convex obstacle is convex, so that it is d + n . w or more after a way w from a
point with the distance d and the normal n = grad phi. Sizes s are in metres; the axis of an
obstacle is its z.

================  ==================================================
`HALF_SPACE`      z <= 0
`SPHERE`          radius s_0
`CAPSULE`         radius s_0 around a segment of half the length s_2
`BOX`             halves of the edges s
`CYLINDER`        radius s_0, half of the length s_2
`GRID`            any shape, by cubic B-splines on a grid of distances
================  ==================================================
"""

import warp as wp

from ..constants import FOUR, HALF, ONE, SIXTH, THREE, TWO, ZERO

wp.set_module_options({"enable_backward": False})

HALF_SPACE, SPHERE, CAPSULE, BOX, CYLINDER, GRID = (wp.constant(k) for k in range(6))
LEAST = wp.constant(wp.float64(1e-150))  # keeps a division by a length defined


@wp.struct
class Obstacles:
    """Obstacles of a batch, O of them."""

    kind: wp.array[int]  # (O)
    size: wp.array[wp.vec3d]  # (O) s [m]; grids: spacing, largest slope, least distance at the edge
    low: wp.array[wp.vec3d]  # (O) first node of a grid [m]
    nodes: wp.array[wp.vec4i]  # (O) of a grid: numbers of nodes, and index of its first coefficient
    coefficients: wp.array[wp.float64]  # of the B-splines of all grids, z fastest [m]
    reach: wp.float64  # distance D at which contact begins [m]
    place: wp.array2d[wp.vec3d]  # (B, O) c [m]
    turn: wp.array2d[wp.mat33d]  # (B, O) R
    growth: wp.array2d[wp.float64]  # (B, O) by which the surface lies further out [m]


@wp.struct
class Distance:
    """A signed distance [m], its gradient and its second derivative."""

    d: wp.float64
    n: wp.vec3d
    h: wp.mat33d


@wp.func
def from_line(y: wp.vec3d, half: wp.float64) -> Distance:
    """Returns the distance from a segment of the z axis; half its length may be zero."""
    out = Distance()
    q = y - wp.vec3d(ZERO, ZERO, wp.clamp(y[2], -half, half))
    out.d = wp.length(q)
    size = wp.max(out.d, LEAST)
    out.n = q / size
    h = wp.identity(n=3, dtype=wp.float64) - wp.outer(out.n, out.n)
    if wp.abs(y[2]) < half:
        h[2, 2] = ZERO
    out.h = h / size
    return out


@wp.func
def from_box(y: wp.vec3d, s: wp.vec3d) -> Distance:
    """Returns the signed distance from a box."""
    out = Distance()
    most = wp.int32(0)
    p = wp.vec3d()
    q = wp.vec3d()
    side = wp.vec3d()
    for i in range(3):
        side[i] = wp.where(y[i] < ZERO, -ONE, ONE)
        q[i] = wp.abs(y[i]) - s[i]
        p[i] = wp.max(q[i], ZERO)
    if q[1] > q[0]:
        most = 1
    if q[2] > q[most]:
        most = 2
    if q[most] <= ZERO:
        out.d = q[most]
        out.n[most] = side[most]
        return out
    out.d = wp.length(p)
    for i in range(3):
        out.n[i] = side[i] * p[i] / out.d
    h = -wp.outer(out.n, out.n)
    for i in range(3):
        if q[i] > ZERO:
            h[i, i] = h[i, i] + ONE
    out.h = h / out.d
    return out


@wp.func
def from_cylinder(y: wp.vec3d, s: wp.vec3d) -> Distance:
    """Returns the signed distance from a cylinder."""
    out = Distance()
    radius = wp.max(wp.sqrt(y[0] * y[0] + y[1] * y[1]), LEAST)
    outward = wp.vec3d(y[0] / radius, y[1] / radius, ZERO)
    around = wp.vec3d(-outward[1], outward[0], ZERO)
    axis = wp.vec3d(ZERO, ZERO, wp.where(y[2] < ZERO, -ONE, ONE))
    u = radius - s[0]
    v = wp.abs(y[2]) - s[2]
    if u > ZERO and v > ZERO:
        out.d = wp.sqrt(u * u + v * v)
        out.n = (u / out.d) * outward + (v / out.d) * axis
        across = (v / out.d) * outward - (u / out.d) * axis
        out.h = wp.outer(across, across) / out.d + (u / (out.d * radius)) * wp.outer(around, around)
    elif u > v:
        out.d = u
        out.n = outward
        out.h = wp.outer(around, around) / radius
    else:
        out.d = v
        out.n = axis
    return out


@wp.func
def spline(t: wp.float64, derivative: int) -> wp.vec4d:
    """Returns the weights of four coefficients at the share t of the interval
    between the second and the third.
    """
    s = ONE - t
    if derivative == 1:
        middle = wp.vec2d(t * (HALF * THREE * t - TWO), -s * (HALF * THREE * s - TWO))
        return wp.vec4d(-HALF * s * s, middle[0], middle[1], HALF * t * t)
    if derivative == 2:
        return wp.vec4d(s, THREE * t - TWO, THREE * s - TWO, t)
    middle = wp.vec2d(FOUR - THREE * t * t * (ONE + s), FOUR - THREE * s * s * (ONE + t))
    return wp.vec4d(SIXTH * s * s * s, SIXTH * middle[0], SIXTH * middle[1], SIXTH * t * t * t)


@wp.func
def from_grid(o: Obstacles, k: int, y: wp.vec3d) -> Distance:
    """Returns the interpolated distance.

    Outside of the grid, that from it and the least distance at its boundary.
    """
    out = Distance()
    spacing, shape = o.size[k][0], o.nodes[k]
    first = wp.vec3i()
    share = wp.vec3d()
    inside = wp.vec3d()
    for i in range(3):
        place = (y[i] - o.low[k][i]) / spacing
        inside[i] = wp.clamp(place, ONE, wp.float64(shape[i] - 2))
        first[i] = wp.min(int(inside[i]), shape[i] - 3)
        share[i] = inside[i] - wp.float64(first[i])
        out.n[i] = spacing * (place - inside[i])
    away = wp.length(out.n)
    if away > ZERO:
        out.d = o.size[k][2] + away
        out.n = out.n / away
        return out
    out.n = wp.vec3d()
    for a in range(4):
        for b in range(4):
            start = (
                shape[3]
                + ((first[0] - 1 + a) * shape[1] + first[1] - 1 + b) * shape[2]
                + first[2]
                - 1
            )
            line = wp.vec3d()
            for c in range(4):
                value = o.coefficients[start + c]
                for m in range(3):
                    line[m] = line[m] + value * spline(share[2], m)[c]
            u = wp.vec3d(spline(share[0], 0)[a], spline(share[0], 1)[a], spline(share[0], 2)[a])
            v = wp.vec3d(spline(share[1], 0)[b], spline(share[1], 1)[b], spline(share[1], 2)[b])
            out.d += u[0] * v[0] * line[0]
            out.n += wp.vec3d(u[1] * v[0] * line[0], u[0] * v[1] * line[0], u[0] * v[0] * line[1])
            xy, xz, yz = u[1] * v[1] * line[0], u[1] * v[0] * line[1], u[0] * v[1] * line[1]
            xx, yy, zz = u[2] * v[0] * line[0], u[0] * v[2] * line[0], u[0] * v[0] * line[2]
            out.h += wp.mat33d(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    out.n = out.n / spacing
    out.h = out.h / (spacing * spacing)
    return out


@wp.func
def distance(o: Obstacles, b: int, k: int, x: wp.vec3d) -> Distance:
    """Returns the signed distance of a position from obstacle k, in the axes of the world."""
    turn = o.turn[b, k]
    y = wp.transpose(turn) * (x - o.place[b, k])
    s = o.size[k]
    kind = o.kind[k]
    out = Distance()
    if kind == HALF_SPACE:
        out.d = y[2]
        out.n = wp.vec3d(ZERO, ZERO, ONE)
    elif kind <= CAPSULE:
        out = from_line(y, s[2])
        out.d = out.d - s[0]
    elif kind == BOX:
        out = from_box(y, s)
    elif kind == CYLINDER:
        out = from_cylinder(y, s)
    else:
        out = from_grid(o, k, y)
    out.d = out.d - o.growth[b, k]
    out.n = turn * out.n
    out.h = turn * out.h * wp.transpose(turn)
    return out


@wp.func
def turn_slope(
    o: Obstacles, b: int, k: int, x: wp.vec3d, at: Distance, a: wp.float64, w: wp.vec3d
) -> wp.mat33d:
    """Returns the derivative of a phi + w . n by the entries of R.

    That by x is a n + H w, and that by c its negative.

    With r = x - c, it is r (a n' + H' w')^T + w n'^T, where primes denote the axes of the obstacle.
    """
    back = wp.transpose(o.turn[b, k])
    return wp.outer(x - o.place[b, k], back * (a * at.n + at.h * w)) + wp.outer(w, back * at.n)


@wp.kernel
def measure(
    o: Obstacles,
    positions: wp.array2d[wp.vec3d],  # (B, P) [m]
    distance_out: wp.array3d[wp.float64],  # (B, P, O) [m]
    normal_out: wp.array3d[wp.vec3d],  # (B, P, O)
):
    """Computes distances and normals of positions."""
    b, p, k = wp.tid()
    at = distance(o, b, k, positions[b, p])
    distance_out[b, p, k] = at.d
    normal_out[b, p, k] = at.n


@wp.kernel
def measure_adjoint(
    o: Obstacles,
    positions: wp.array2d[wp.vec3d],
    by_distance: wp.array3d[wp.float64],
    by_normal: wp.array3d[wp.vec3d],
    position_out: wp.array3d[wp.vec3d],  # (B, P, O) parts of the derivative by the position
    turn_out: wp.array3d[wp.mat33d],  # (B, P, O)
):
    """Computes derivatives of a loss by positions and rotations,
    from those by distances and normals.
    """
    b, p, k = wp.tid()
    x = positions[b, p]
    at = distance(o, b, k, x)
    a, w = by_distance[b, p, k], by_normal[b, p, k]
    position_out[b, p, k] = a * at.n + at.h * w
    turn_out[b, p, k] = turn_slope(o, b, k, x, at, a, w)


@wp.kernel(module="unique")
def from_surface(surface: wp.uint64, places: wp.array[wp.vec3], distance_out: wp.array[float]):
    """Computes signed distances of places from a closed surface [m]."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(surface, places[i], 1.0e6)
    nearest = wp.mesh_eval_position(surface, query.face, query.u, query.v)
    distance_out[i] = query.sign * wp.length(places[i] - nearest)


@wp.kernel(module="unique")
def blocked(
    surface: wp.uint64,
    starts: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    blocked_out: wp.array[float],
):
    """Marks rays that hit a surface with one."""
    i = wp.tid()
    if wp.mesh_query_ray(surface, starts[i], directions[i], 1.0e6).result:
        blocked_out[i] = 1.0
