"""Tendons through guides: stress, tangent, and which guides slide.

A point is the segment of a tendon between two guides. The first column of F = sum_a x_a g_a^T is
the vector from one guide to the next; the other two are its changes as the guides move in the body
along the tendon's two offset directions, per `OFFSET_UNIT`. So a segment is F c, with
c = (1, offsets in that unit). The tension at the first guide is the commanded one plus that of a
tension-only spring, stretched by the tendon's length in excess of its free length. The guide before
each segment adds the friction of `bristle`, which depends on the length of the tendon beyond it.
"""

import warp as wp

from .axial import thread_pull
from .constants import ONE, ZERO
from .points import MatrixPoints, matrix_at

wp.set_module_options({"enable_backward": False})

# Unit of the offsets [m], about a cell size, so that the columns of F have similar norms
OFFSET_UNIT = 5e-3


@wp.struct
class Segments:
    """Constants of the segments of tendons, which follow one another from the first guide."""

    anchors: wp.array[wp.mat33d]  # (P) ends that are fixed in the world [m]
    rest: wp.array[wp.mat33d]  # (P) F of the undeformed body
    tendon: wp.array[int]  # (P)
    first: wp.array[int]  # (T + 1) first segment of each tendon


@wp.struct
class TendonValues:
    """Values of each tendon in a step."""

    route: wp.array2d[wp.vec3d]  # (B, T) c
    commanded: wp.array2d[wp.float64]  # (B, T) tension [N]
    contraction: wp.array2d[wp.float64]  # (B, T) [m]
    stiffness: wp.array2d[wp.float64]  # (B, T) of the spring [N/m]


@wp.struct
class GuideFriction:
    """Friction of the guide before each segment, at the start of a step."""

    hold: wp.array2d[wp.float64]  # (B, P) friction [N]
    drop: wp.array2d[wp.float64]  # (B, P) its bounds, downwards and upwards [N]
    rise: wp.array2d[wp.float64]
    beyond: wp.array2d[wp.float64]  # (B, P) tendon beyond that guide [m]
    bristles: wp.array2d[wp.float64]  # (B, T) bristle length [m]


@wp.struct
class Pulls:
    """Results of `pull`."""

    tension: wp.array2d[wp.float64]  # (B, P) of each segment [N]
    spring: wp.array2d[wp.vec3d]  # (B, T) energy, force, slope at stiffness one [m^2, m, -]
    friction: wp.array2d[wp.vec3d]  # (B, P) energy [J], slide [m], slope [N/m] before it


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
    points: MatrixPoints,
    positions: wp.array2d[wp.vec3d],
    anchors: wp.array[wp.mat33d],
    b: int,
    p: int,
) -> wp.mat33d:
    """Returns F of a segment; ends that are fixed in the world are in ``anchors`` (P)."""
    return matrix_at(points, positions, b, p) + anchors[p]


@wp.func
def bristle(
    slide: wp.float64, hold: wp.float64, drop: wp.float64, rise: wp.float64, length: wp.float64
):
    """Returns energy, force and slope of a guide's friction after a slide
    (``energies.tendon_forces``).
    """
    size, start = slide, hold
    most, sign = rise, ONE
    if slide < ZERO:
        size, start = -slide, -hold
        most, sign = drop, -ONE
    left = (start - most) * wp.exp(-size / length)
    return (
        most * size + length * (start - most - left),
        sign * (most + left),
        wp.max(-left / length, ZERO),
    )


@wp.kernel
def pull(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    segments: Segments,
    toe: wp.float64,  # elongation at which the spring reaches its full stiffness [m]
    values: TendonValues,
    friction: GuideFriction,
    positions: wp.array2d[wp.vec3d],
    pulls_out: Pulls,
):
    """Computes spring, friction and tensions of each tendon."""
    b, t = wp.tid()
    if active[b] == 0:
        return
    c = values.route[b, t]
    begin = segments.first[t]
    end = segments.first[t + 1]
    longer = wp.float64(0.0)
    length = wp.float64(0.0)
    for k in range(end - begin):
        p = end - 1 - k  # from the end, as friction depends on the length beyond a guide
        span = wp.length(segment(points, positions, segments.anchors, b, p) * c)
        length += span
        longer += span - wp.length(segments.rest[p] * c)
        slide = length - friction.beyond[b, p]
        energy, force, slope = bristle(
            slide,
            friction.hold[b, p],
            friction.drop[b, p],
            friction.rise[b, p],
            friction.bristles[b, t],
        )
        pulls_out.friction[b, p] = wp.vec3d(energy, slide, slope)
        pulls_out.tension[b, p] = force
    energy, force, slope = thread_pull(longer + values.contraction[b, t], toe)
    pulls_out.spring[b, t] = wp.vec3d(energy, force, slope)
    tension = values.commanded[b, t] + values.stiffness[b, t] * force
    for p in range(begin, end):
        tension += pulls_out.tension[b, p]
        pulls_out.tension[b, p] = tension


@wp.kernel
def local_step(
    active: wp.array[int],  # (B) zero: skip the environment
    points: MatrixPoints,
    segments: Segments,
    values: TendonValues,
    pulls: Pulls,
    positions: wp.array2d[wp.vec3d],
    stress_out: wp.array2d[wp.mat33d],
    energy_out: wp.array2d[wp.float64],
):
    """Computes T L of the commanded tension and friction.

    The first segment also has the spring's energy.
    """
    b, p = wp.tid()
    if active[b] == 0:
        return
    t = segments.tendon[p]
    c = values.route[b, t]
    line = segment(points, positions, segments.anchors, b, p) * c
    energy = values.commanded[b, t] * wp.length(line) + pulls.friction[b, p][0]
    if p == segments.first[t]:
        energy += values.stiffness[b, t] * pulls.spring[b, t][0]
    stress_out[b, p] = pulls.tension[b, p] * wp.outer(direction_of(line), c)
    energy_out[b, p] = energy


@wp.kernel
def tangent(
    active: wp.array[int],
    clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
    points: MatrixPoints,
    segments: Segments,
    route: wp.array2d[wp.vec3d],
    total: wp.array2d[wp.float64],  # (B, P) tension, from `pull`
    positions: wp.array2d[wp.vec3d],
    tangent_out: wp.array3d[wp.mat33d],
):
    """Computes blocks (i, j), c_i c_j T / l (1 - u u^T), at constant tension.

    Its change couples segments at low rank.

    Friction makes a tension negative only where that at the first guide fell by more than itself
    within the step.
    """
    b, p = wp.tid()
    if active[b] == 0:
        return
    c = route[b, segments.tendon[p]]
    line = segment(points, positions, segments.anchors, b, p) * c
    length = wp.length(line)
    stiffness = ZERO
    if length > ZERO:
        stiffness = total[b, p] / length
    if clamp[b] != 0:
        stiffness = wp.max(stiffness, ZERO)
    u = direction_of(line)
    block = stiffness * (wp.identity(n=3, dtype=wp.float64) - wp.outer(u, u))
    for i in range(3):
        for j in range(i + 1):
            tangent_out[b, p, (i * (i + 1)) / 2 + j] = (c[i] * c[j]) * block


@wp.kernel
def stick(
    first: wp.array[int],
    begin: wp.array2d[wp.float64],  # (B, T) tension before the first guide [N]
    segments: wp.array2d[wp.float64],  # (B, P) tension of each segment so far [N]
    growth: wp.array2d[wp.float64],  # (B, P) exp(mu theta) of the guide before it
    slides_out: wp.array2d[int],  # (B, P) -1, 1 where it slides: the tension falls or rises
):
    """Lets every guide stick, or slide as far as its bounds ask for.

    Guides without contact slide.
    """
    b, t = wp.tid()
    before = wp.float64(begin[b, t])
    for p in range(first[t], first[t + 1]):
        if segments[b, p] <= before / growth[b, p]:
            slides_out[b, p] = -1
            before = before / growth[b, p]
        elif segments[b, p] >= before * growth[b, p]:
            slides_out[b, p] = 1
            before = before * growth[b, p]
        else:
            slides_out[b, p] = 0
            before = segments[b, p]
