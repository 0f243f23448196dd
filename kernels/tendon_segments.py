"""Tendons through guides: stress, tangent and derivatives by actuation, friction and routing.

A point is the segment of a tendon between two guides. The first column of F = sum_a x_a g_a^T is the vector from one
guide to the next; the other two are its changes as the guides move in the body along the tendon's two offset
directions, per `OFFSET_UNIT`. So a segment is F c, with c = (1, offsets in that unit). The tension at the first guide
is the commanded one plus that of a tension-only spring, stretched by the tendon's length in excess of its free length.
The guide before each segment adds the friction of `bristle`, which depends on the length of the tendon beyond it.
"""

import warp as wp

from .axial import thread_pull
from .points import MatrixPoints, matrix_at

wp.set_module_options({"enable_backward": False})

ZERO, ONE = wp.float64(0.0), wp.float64(1.0)
OFFSET_UNIT = 5e-3  # unit of the offsets [m], about a cell size, so that the columns of F have similar norms
PER_UNIT_OFFSET = wp.float64(1.0 / OFFSET_UNIT)


@wp.func
def direction_of(line: wp.vec3d) -> wp.vec3d:
    """Returns the unit vector along a segment, or zero for a segment without length."""
    length = wp.length(line)
    result = wp.vec3d(ZERO, ZERO, ZERO)
    if length > ZERO:
        result = line / length
    return result


@wp.func
def segment(
    points: MatrixPoints, positions: wp.array2d[wp.vec3d], anchors: wp.array[wp.mat33d], b: int, p: int
) -> wp.mat33d:
    """Returns F of a segment; ends that are fixed in the world are in ``anchors`` (P)."""
    return matrix_at(points, positions, b, p) + anchors[p]


@wp.func
def bristle(slide: wp.float64, hold: wp.float64, drop: wp.float64, rise: wp.float64, length: wp.float64):
    """Returns energy, force and slope of a guide's friction after a slide (``energies.tendon_friction``)."""
    size, start, most, sign = slide, hold, rise, ONE
    if slide < ZERO:
        size, start, most, sign = -slide, -hold, drop, -ONE
    left = (start - most) * wp.exp(-size / length)
    return most * size + length * (start - most - left), sign * (most + left), wp.max(-left / length, ZERO)


@wp.kernel
def pull(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    anchors: wp.array[wp.mat33d],
    first: wp.array[int],  # (T + 1) first segment of each tendon
    rest: wp.array[wp.mat33d],  # (P) F of the undeformed body
    first_offset: wp.array2d[wp.float64],  # (B, T) [m]
    second_offset: wp.array2d[wp.float64],
    commanded: wp.array2d[wp.float64],  # (B, T) tension [N]
    contraction: wp.array2d[wp.float64],  # (B, T) [m]
    stiffness: wp.array2d[wp.float64],  # (B, T) of the spring [N/m]
    toe: wp.float64,  # elongation at which the spring reaches its full stiffness [m]
    hold: wp.array2d[wp.float64],  # (B, P) friction of the guide before each segment at the step's start [N]
    drop: wp.array2d[wp.float64],  # (B, P) its bounds, downwards and upwards [N]
    rise: wp.array2d[wp.float64],
    beyond: wp.array2d[wp.float64],  # (B, P) length of the tendon beyond that guide at the step's start [m]
    bristles: wp.array2d[wp.float64],  # (B, T) bristle length [m]
    positions: wp.array2d[wp.vec3d],
    along_out: wp.array2d[wp.vec3d],  # (B, T) c
    tension_out: wp.array2d[wp.float64],  # (B, P) of each segment [N]
    spring_out: wp.array2d[wp.vec3d],  # (B, T) energy, force and slope of a spring of stiffness one [m^2, m, -]
    friction_out: wp.array2d[wp.vec3d],  # (B, P) energy [J], slide [m] and slope [N/m] of the friction before it
):
    """Computes the vector c, spring, friction and tensions of each tendon."""
    b, t = wp.tid()
    if active[b] == 0:
        return
    c = wp.vec3d(ONE, PER_UNIT_OFFSET * first_offset[b, t], PER_UNIT_OFFSET * second_offset[b, t])
    along_out[b, t] = c
    longer = wp.float64(0.0)
    length = wp.float64(0.0)
    for k in range(first[t + 1] - first[t]):
        p = first[t + 1] - 1 - k  # from the end, as friction depends on the length beyond a guide
        own = wp.length(segment(points, positions, anchors, b, p) * c)
        length += own
        longer += own - wp.length(rest[p] * c)
        slide = length - beyond[b, p]
        energy, force, slope = bristle(slide, hold[b, p], drop[b, p], rise[b, p], bristles[b, t])
        friction_out[b, p] = wp.vec3d(energy, slide, slope)
        tension_out[b, p] = force
    energy, force, slope = thread_pull(longer + contraction[b, t], toe)
    spring_out[b, t] = wp.vec3d(energy, force, slope)
    tension = commanded[b, t] + stiffness[b, t] * force
    for p in range(first[t], first[t + 1]):
        tension += tension_out[b, p]
        tension_out[b, p] = tension


@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    anchors: wp.array[wp.mat33d],
    first: wp.array[int],
    tendon: wp.array[int],  # (P)
    commanded: wp.array2d[wp.float64],
    stiffness: wp.array2d[wp.float64],
    along: wp.array2d[wp.vec3d],  # (B, T) c, from `pull` like the next three
    total: wp.array2d[wp.float64],
    spring: wp.array2d[wp.vec3d],
    friction: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """T L of the commanded tension and friction; the spring's energy is added to the first segment."""
    b, p = wp.tid()
    if active[b] == 0:
        return
    t = tendon[p]
    c = along[b, t]
    line = segment(points, positions, anchors, b, p) * c
    energy = commanded[b, t] * wp.length(line) + friction[b, p][0]
    if p == first[t]:
        energy += stiffness[b, t] * spring[b, t][0]
    stress_out[b, p] = total[b, p] * wp.outer(direction_of(line), c)
    energy_out[b, p] = energy


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
    points: MatrixPoints,
    anchors: wp.array[wp.mat33d],
    tendon: wp.array[int],
    along: wp.array2d[wp.vec3d],
    total: wp.array2d[wp.float64],
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Block (i, j) is c_i c_j T / l (1 - u u^T) at constant tension; its change, coupling segments, is low rank.

    Friction makes a tension negative only where that at the first guide fell by more than itself within the step.
    """
    b, p = wp.tid()
    if active[b] == 0:
        return
    c = along[b, tendon[p]]
    line = segment(points, positions, anchors, b, p) * c
    length = wp.length(line)
    stiffness = ZERO
    if length > ZERO:
        stiffness = total[b, p] / length
    if clamp[b] != 0:
        stiffness = wp.max(stiffness, ZERO)
    u = direction_of(line)
    block = stiffness * (wp.identity(n=3, dtype=wp.float64) - wp.outer(u, u))
    tangent_out[b, p, 0] = (c[0] * c[0]) * block
    tangent_out[b, p, 1] = (c[1] * c[0]) * block
    tangent_out[b, p, 2] = (c[1] * c[1]) * block
    tangent_out[b, p, 3] = (c[2] * c[0]) * block
    tangent_out[b, p, 4] = (c[2] * c[1]) * block
    tangent_out[b, p, 5] = (c[2] * c[2]) * block


@wp.kernel
def directions(
    points: MatrixPoints,
    anchors: wp.array[wp.mat33d],
    tendon: wp.array[int],
    along: wp.array2d[wp.vec3d],
    positions: wp.array2d[wp.vec3d],
    direction_out: wp.array2d[wp.mat33d],  # (B, P)
):
    """Derivative u c^T of the length of each segment by F, with the unit vector u along the segment."""
    b, p = wp.tid()
    c = along[b, tendon[p]]
    line = segment(points, positions, anchors, b, p) * c
    direction_out[b, p] = wp.outer(direction_of(line), c)


@wp.kernel
def adjoint(
    points: MatrixPoints,
    anchors: wp.array[wp.mat33d],
    tendon: wp.array[int],
    rest: wp.array[wp.mat33d],
    along: wp.array2d[wp.vec3d],
    total: wp.array2d[wp.float64],
    positions: wp.array2d[wp.vec3d],
    direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
    by_tension_out: wp.array2d[wp.float64],  # (B, P) -u . dZ c, this segment's part of dL/dT [m]
    by_offset_out: wp.array2d[wp.vec2d],  # (B, P) dL/d offset at constant tension [N]
    longer_out: wp.array2d[wp.vec2d],  # (B, P) derivative of the segment's length by the offsets
    rest_out: wp.array2d[wp.vec2d],  # (B, P) derivative of its length at rest
):
    """Derivatives of each segment by tension and offsets, with dZ = F of the displacement z."""
    b, p = wp.tid()
    t = tendon[p]
    c = along[b, t]
    f = segment(points, positions, anchors, b, p)
    dz = matrix_at(points, direction, b, p)
    line, moved = f * c, dz * c
    u, u_rest = direction_of(line), direction_of(rest[p] * c)
    shorter = -wp.dot(u, moved)
    turned = wp.vec3d(ZERO, ZERO, ZERO)
    if wp.length(line) > ZERO:
        turned = (moved + shorter * u) / wp.length(line)
    by_offset = -total[b, p] * (wp.transpose(dz) * u + wp.transpose(f) * turned)
    longer, at_rest = wp.transpose(f) * u, wp.transpose(rest[p]) * u_rest
    by_tension_out[b, p] = shorter
    by_offset_out[b, p] = PER_UNIT_OFFSET * wp.vec2d(by_offset[1], by_offset[2])
    longer_out[b, p] = PER_UNIT_OFFSET * wp.vec2d(longer[1], longer[2])
    rest_out[b, p] = PER_UNIT_OFFSET * wp.vec2d(at_rest[1], at_rest[2])


@wp.kernel
def stick(
    first: wp.array[int],
    begin: wp.array2d[wp.float64],  # (B, T) tension before the first guide [N]
    held: wp.array2d[wp.float64],  # (B, P) tension of each segment so far [N]
    growth: wp.array2d[wp.float64],  # (B, P) exp(mu theta) of the guide before it
    tension_out: wp.array2d[wp.float64],  # (B, P) its tension, within the bounds of that guide [N]
):
    """Lets every guide stick, or slide as far as its bounds ask for."""
    b, t = wp.tid()
    before = wp.float64(begin[b, t])
    for p in range(first[t], first[t + 1]):
        before = wp.clamp(held[b, p], before / growth[b, p], before * growth[b, p])
        tension_out[b, p] = before


@wp.kernel
def stick_adjoint(
    first: wp.array[int],
    begin: wp.array2d[wp.float64],
    held: wp.array2d[wp.float64],
    growth: wp.array2d[wp.float64],
    tension: wp.array2d[wp.float64],
    adjoint: wp.array2d[wp.float64],  # (B, P) of the tension
    begin_out: wp.array2d[wp.float64],
    held_out: wp.array2d[wp.float64],
    growth_out: wp.array2d[wp.float64],
):
    """Adjoint of `stick`; guides without contact slide."""
    b, t = wp.tid()
    carried = wp.float64(0.0)
    for k in range(first[t + 1] - first[t]):
        p = first[t + 1] - 1 - k
        before = begin[b, t]
        if p > first[t]:
            before = tension[b, p - 1]
        total = adjoint[b, p] + carried
        by_held, by_growth, factor = ZERO, ZERO, ZERO
        if held[b, p] <= before / growth[b, p]:
            factor = ONE / growth[b, p]
            by_growth = -total * before * factor * factor
        elif held[b, p] >= before * growth[b, p]:
            factor = growth[b, p]
            by_growth = total * before
        else:
            by_held = total
        held_out[b, p] = by_held
        growth_out[b, p] = by_growth
        carried = total * factor
    begin_out[b, t] = carried
