"""Contact of points with obstacles: barrier and lagged, smoothed Coulomb friction.

Equations are in ``energies.contact.obstacle_contact``.
Here s = d / D, and y = |u| is the slide u of a point in the tangential plane of its normal at the
start of the step.
"""

import warp as wp

from ..constants import FOUR, ONE, THIRD, TWO, ZERO
from ..points import VectorPoints, vector_at
from .signed_distances import GRID, Obstacles, distance, turn_slope

wp.set_module_options({"enable_backward": False})

INFINITE, UNDEFINED = wp.constant(wp.float64(float("inf"))), wp.constant(wp.float64(float("nan")))
ADVANCES = wp.constant(100)  # along a way beside an obstacle that is not convex
KEPT = wp.constant(wp.float64(0.1))  # share of a gap that one iterate leaves at least


@wp.struct
class Friction:
    """Friction of every point with every obstacle in a step; all but the first two (B, P, O)."""

    coefficient: wp.array2d[wp.float64]  # (B, O) mu
    slip: wp.array2d[wp.float64]  # (B, 1) slide at which friction is fully developed [m]
    load: wp.array3d[wp.float64]  # normal force at the start [N], times its region's factor
    normal: wp.array3d[wp.vec3d]  # normal at the start
    reference: wp.array3d[wp.vec3d]  # position without slide [m]


@wp.func
def barrier(s: wp.float64) -> wp.vec3d:
    """Returns B = -(s - 1)^2 ln s, B' and B''; zero from s = 1 on."""
    if s >= ONE:
        return wp.vec3d(ZERO, ZERO, ZERO)
    t, log = s - ONE, wp.log(s)
    return wp.vec3d(
        -t * t * log, -TWO * t * log - t * t / s, -TWO * log - FOUR * t / s + t * t / (s * s)
    )


@wp.func
def smoothed(y: wp.float64, slip: wp.float64) -> wp.vec3d:
    """Returns f(y), f'(y) / y and (f'(y) / y)' / y of the smoothed absolute value (Li et al. 2020),
    zero at zero.
    """
    if y >= slip:
        return wp.vec3d(y - THIRD * slip, ONE / y, -ONE / (y * y * y))
    q = y / slip
    last = ZERO
    if y > ZERO:
        last = -ONE / (slip * slip * y)
    return wp.vec3d(slip * q * q * (ONE - THIRD * q), (TWO - q) / slip, last)


@wp.func
def slide(f: Friction, b: int, p: int, k: int, x: wp.vec3d) -> wp.vec3d:
    """Returns u, the way of a point since the start of the step
    in the tangential plane of an obstacle.
    """
    m, way = f.normal[b, p, k], x - f.reference[b, p, k]
    return way - wp.dot(way, m) * m


@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: VectorPoints,
    area: wp.array[wp.float64],  # (P) [m^2]
    o: Obstacles,
    stiffness: wp.array2d[wp.float64],  # (B, O) kappa [Pa]
    f: Friction,
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.vec3d],
    energy_out: wp.array2d[wp.float64],
):
    """Computes force and energy of each point; not a number and infinite within an obstacle."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    x = vector_at(points, positions, b, p)
    force, energy = wp.vec3d(), wp.float64(0.0)
    for k in range(o.kind.shape[0]):
        at = distance(o, b, k, x)
        if at.d <= ZERO:
            force, energy = wp.vec3d(UNDEFINED, UNDEFINED, UNDEFINED), wp.float64(INFINITE)
        else:
            e = barrier(at.d / o.reach)
            factor = stiffness[b, k] * area[p]
            force += (factor * e[1]) * at.n
            energy += factor * o.reach * e[0]
            most = f.coefficient[b, k] * f.load[b, p, k]
            if most > ZERO:
                u = slide(f, b, p, k, x)
                v = smoothed(wp.length(u), f.slip[b, 0])
                force += (most * v[1]) * u
                energy += most * v[0]
    stress_out[b, p] = force
    energy_out[b, p] = energy


@wp.func
def slide_tangent(m: wp.vec3d, u: wp.vec3d, slip: wp.float64) -> wp.mat33d:
    """Returns the second derivative of f(|u|) by the position, with the normal m."""
    v = smoothed(wp.length(u), slip)
    flat = -wp.outer(m, m)
    for i in range(3):
        flat[i, i] = flat[i, i] + ONE
    return v[1] * flat + v[2] * wp.outer(u, u)


@wp.func
def friction_tangent(f: Friction, b: int, p: int, k: int, x: wp.vec3d) -> wp.mat33d:
    """Returns the second derivative of the friction's energy,
    for mu = 1 and a normal force of one newton.
    """
    return slide_tangent(f.normal[b, p, k], slide(f, b, p, k, x), f.slip[b, 0])


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
    points: VectorPoints,
    area: wp.array[wp.float64],
    o: Obstacles,
    stiffness: wp.array2d[wp.float64],
    f: Friction,
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],  # (B, P, 1)
):
    """Computes the second derivative.

    A clamped one leaves out that by the curvature of obstacles.
    """
    b, p = wp.tid()
    if active[b] == 0:
        return
    x = vector_at(points, positions, b, p)
    block = wp.mat33d()
    for k in range(o.kind.shape[0]):
        at = distance(o, b, k, x)
        e = barrier(at.d / o.reach)
        factor = stiffness[b, k] * area[p]
        block += (factor * e[2] / o.reach) * wp.outer(at.n, at.n)
        if clamp[b] == 0:
            block += (factor * e[1]) * at.h
        most = f.coefficient[b, k] * f.load[b, p, k]
        if most > ZERO:
            block += most * friction_tangent(f, b, p, k, x)
    tangent_out[b, p, 0] = block


@wp.struct
class Slopes:
    """Derivatives of a loss by the values of an obstacle and of its friction:
    parts of the points, (B, P, O).
    """

    place: wp.array3d[wp.vec3d]
    turn: wp.array3d[wp.mat33d]
    growth: wp.array3d[wp.float64]
    stiffness: wp.array3d[wp.float64]
    coefficient: wp.array3d[wp.float64]
    load: wp.array3d[wp.float64]
    normal: wp.array3d[wp.vec3d]
    reference: wp.array3d[wp.vec3d]


@wp.kernel
def adjoint(
    points: VectorPoints,
    area: wp.array[wp.float64],
    o: Obstacles,
    stiffness: wp.array2d[wp.float64],
    f: Friction,
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    slopes_out: Slopes,
):
    """Computes -z . d force / d value, at fixed positions."""
    b, p, k = wp.tid()
    x = vector_at(points, positions, b, p)
    z = vector_at(points, direction, b, p)
    at = distance(o, b, k, x)
    e = barrier(at.d / o.reach)
    factor = stiffness[b, k] * area[p]
    # The loss is a phi + w . n, linearised in the distance phi and the normal n.
    a, w = -(factor * e[2] / o.reach) * wp.dot(at.n, z), -(factor * e[1]) * z
    slopes_out.stiffness[b, p, k] = -area[p] * e[1] * wp.dot(at.n, z)
    slopes_out.growth[b, p, k] = -a
    slopes_out.place[b, p, k] = -(a * at.n + at.h * w)
    slopes_out.turn[b, p, k] = turn_slope(o, b, k, x, at, a, w)
    mu = f.coefficient[b, k]
    load, m = f.load[b, p, k], f.normal[b, p, k]
    u, way = slide(f, b, p, k, x), x - f.reference[b, p, k]
    v = smoothed(wp.length(u), f.slip[b, 0])
    work = -v[1] * wp.dot(u, z)
    slopes_out.coefficient[b, p, k] = load * work
    slopes_out.load[b, p, k] = mu * work
    q = -(mu * load) * (v[1] * z + (v[2] * wp.dot(u, z)) * u)
    slopes_out.normal[b, p, k] = -wp.dot(m, way) * q - wp.dot(q, m) * way
    slopes_out.reference[b, p, k] = (mu * load) * (friction_tangent(f, b, p, k, x) * z)


@wp.kernel
def bound(
    active: wp.array[int],  # (B) zero: skip the environment
    points: VectorPoints,
    o: Obstacles,
    origin: wp.array2d[wp.vec3d],  # (B, N) without penetration [m]
    positions: wp.array2d[wp.vec3d],  # (B, N) [m]
    share_out: wp.array[wp.float64],  # (B) lowered to what of the way leaves `KEPT` of each gap
):
    """Bounds a step.

    A convex obstacle lies behind the tangential plane of its place nearest to a point. Along
    another one the step goes on as far as the largest slope of its distance allows, several times.
    """
    b, p, k = wp.tid()
    if active[b] == 0:
        return
    x = vector_at(points, origin, b, p)
    way = vector_at(points, positions, b, p) - x
    at = distance(o, b, k, x)
    kept = KEPT * at.d
    if o.kind[k] != GRID:
        fall = -wp.dot(at.n, way)
        if fall > at.d - kept:
            wp.atomic_min(share_out, b, (at.d - kept) / fall)
        return
    most = o.size[k][1] * wp.length(way)
    t = wp.float64(0.0)
    for _ in range(ADVANCES):
        gap = at.d - kept
        if most * (ONE - t) <= gap:
            return
        t += gap / most
        if gap < kept:
            break
        at = distance(o, b, k, x + t * way)
    wp.atomic_min(share_out, b, t)
