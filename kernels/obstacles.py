"""Signed distances of convex obstacles, with their first two derivatives, and the pull-back of derivatives by them.

A point is at y = R^T (x - c) in the axes of an obstacle with place c and rotation R. The signed distance phi(y) of a
convex obstacle is convex, so that from a point with the distance d and the normal n = grad phi no way w is shorter than
d + n . w. Sizes s are in metres; the axis of an obstacle is its z.

================  ==================================================
`HALF_SPACE`      z <= 0
`SPHERE`          radius s_0
`CAPSULE`         radius s_0 around a segment of half the length s_2
`BOX`             halves of the edges s
`CYLINDER`        radius s_0, half of the length s_2
================  ==================================================
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

HALF_SPACE, SPHERE, CAPSULE, BOX, CYLINDER = (wp.constant(k) for k in range(5))
ZERO, ONE = wp.float64(0.0), wp.float64(1.0)
LEAST = wp.constant(wp.float64(1e-150))  # keeps a division by a length defined


@wp.struct
class Obstacles:
    """Obstacles of a batch, O of them."""

    kind: wp.array[int]  # (O)
    size: wp.array[wp.vec3d]  # (O) s [m]
    reach: wp.float64  # distance D at which contact begins [m]
    place: wp.array2d[wp.vec3d]  # (B, O) c [m]
    turn: wp.array2d[wp.mat33d]  # (B, O) R
    growth: wp.array2d[wp.float64]  # (B, O) by which the surface lies further out [m]


@wp.struct
class Distance:
    """A signed distance [m], its gradient and its second derivative, which has no negative eigenvalues."""

    d: wp.float64
    n: wp.vec3d
    h: wp.mat33d


@wp.func
def identity() -> wp.mat33d:
    """Returns the identity."""
    return wp.mat33d(ONE, ZERO, ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ONE)


@wp.func
def from_line(y: wp.vec3d, half: wp.float64) -> Distance:
    """Returns the distance from a segment of the z axis; half its length may be zero."""
    out = Distance()
    q = y - wp.vec3d(ZERO, ZERO, wp.clamp(y[2], -half, half))
    out.d = wp.length(q)
    size = wp.max(out.d, LEAST)
    out.n = q / size
    h = identity() - wp.outer(out.n, out.n)
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
    else:
        out = from_cylinder(y, s)
    out.d = out.d - o.growth[b, k]
    out.n = turn * out.n
    out.h = turn * out.h * wp.transpose(turn)
    return out


@wp.func
def turn_slope(o: Obstacles, b: int, k: int, x: wp.vec3d, at: Distance, a: wp.float64, w: wp.vec3d) -> wp.mat33d:
    """Returns the derivative of a phi + w . n by the entries of R; that by x is a n + H w, and that by c its negative.

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
    """Distances and normals of positions."""
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
    """Derivatives of a loss by positions and rotations, from those by distances and normals."""
    b, p, k = wp.tid()
    x = positions[b, p]
    at = distance(o, b, k, x)
    a, w = by_distance[b, p, k], by_normal[b, p, k]
    position_out[b, p, k] = a * at.n + at.h * w
    turn_out[b, p, k] = turn_slope(o, b, k, x, at, a, w)
