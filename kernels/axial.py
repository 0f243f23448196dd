"""Energies that are functions of a length: stress, tangent and derivatives by values, for any tension law.

The vector at a point, sum_a g_a x_a - o, has the length l and the unit vector u. With the point's weight w and its
values v, a law gives

    e(l, v),   tension t = de/dl,   slope dt/dl,   and dt/dv,

so that the stress is w t u and the tangent w (slope u u^T + t / l (1 - u u^T)), which has a negative eigenvalue only
for a negative tension. The origin o is zero, or for a string the first three values.
"""

from types import SimpleNamespace

import warp as wp

from .modules import generated, named_module
from .points import PartValues, VectorPoints, value_reader, vector_at

ZERO, HALF, ONE, TWO, THREE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0), wp.float64(2.0), wp.float64(3.0)
SIXTH, TWENTY_FOURTH = wp.float64(1.0 / 6.0), wp.float64(1.0 / 24.0)
QUARTER, TENTH, FORTIETH = wp.float64(0.25), wp.float64(0.1), wp.float64(0.025)

thread_values = wp.types.vector(1, wp.float64)  # k
string_values = wp.types.vector(5, wp.float64)  # position of the point that it is tied to [m], k [N/m], L [m]
muscle_values = wp.types.vector(3, wp.float64)  # sigma, c, k


@wp.func
def thread_pull(strain: wp.float64, toe: wp.float64):
    """Returns energy s, force and slope of a thread of stiffness one: zero in compression, linear beyond the toe."""
    energy = ZERO
    force = ZERO
    slope = ZERO
    if strain > toe:
        force = strain - HALF * toe
        energy = HALF * force * force + TWENTY_FOURTH * toe * toe
        slope = ONE
    elif strain > ZERO:
        slope = strain / toe
        force = HALF * strain * slope
        energy = SIXTH * strain * strain * slope
    return energy, force, slope


@wp.func
def muscle_pull(strain: wp.float64, toe: wp.float64):
    """Returns energy s, force and slope of a fibre of stiffness one; the slope rises as 3 t^2 - 2 t^3 over the toe.

    Smoother than `thread_pull`, with the same force beyond the toe: a solid has fibres at every strain, and derivatives
    are compared with differences over all of them.
    """
    energy = ZERO
    force = ZERO
    slope = ZERO
    t = strain / toe
    if t > ONE:
        force = strain - HALF * toe
        energy = HALF * force * force + FORTIETH * toe * toe
        slope = ONE
    elif t > ZERO:
        slope = t * t * (THREE - TWO * t)
        force = toe * t * t * t * (ONE - HALF * t)
        energy = toe * toe * t * t * t * t * (QUARTER - TENTH * t)
    return energy, force, slope


@wp.func
def thread_tension(length: wp.float64, toe: wp.float64, v: thread_values):
    """Tension-only thread, ``k s(l - 1)``, with s(e) = max(e, 0)^2 / 2 smoothed over a short toe."""
    energy, force, slope = thread_pull(length - ONE, toe)
    return v[0] * energy, v[0] * force, v[0] * slope, thread_values(force)


@wp.func
def string_tension(length: wp.float64, toe: wp.float64, v: string_values):
    """Tension-only spring from a given point, ``k s(l - L)``."""
    energy, force, slope = thread_pull(length - v[4], toe)
    by_values = string_values(ZERO, ZERO, ZERO, force, -v[3] * slope)
    return v[3] * energy, v[3] * force, v[3] * slope, by_values


@wp.func
def muscle_tension(length: wp.float64, toe: wp.float64, v: muscle_values):
    """Contractile fibre, ``sigma l + k s(l - 1 + c)``: active stress, and a spring shortened by a contraction."""
    energy, force, slope = muscle_pull(length - ONE + v[1], toe)
    by_values = muscle_values(ONE, v[2] * slope, force)
    return v[0] * length + v[2] * energy, v[0] + v[2] * force, v[2] * slope, by_values


LAWS = {"thread": thread_tension, "string": string_tension, "muscle": muscle_tension}  # e, t, dt/dl and dt/dv


@generated
def axial_kernels(law: str) -> SimpleNamespace:
    """Returns the kernels of one of `LAWS`."""
    module = named_module(f"axial.{law}")
    tension, tied = LAWS[law], law == "string"
    vector = tension.input_types["v"]
    read_values = value_reader(vector)

    @wp.func(module=module)
    def stretched(x: wp.vec3d, v: vector):
        """Returns the unit vector along the stretched line, and the length."""
        if wp.static(tied):
            x -= wp.vec3d(v[0], v[1], v[2])
        length = wp.length(x)
        if length > ZERO:
            x = x / length
        return x, length

    @wp.kernel(module=module)
    def local_step(
        active: wp.array[int],  # (B) zero: skip the environment
        points: VectorPoints,
        values: PartValues,
        toe: wp.float64,  # elongation at which the law reaches its full stiffness
        positions: wp.array2d[wp.vec3d],
        stress_out: wp.array2d[wp.vec3d],
        energy_out: wp.array2d[wp.float64],  # (B, P) [J]
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        v = read_values(values, b, p)
        u, length = stretched(vector_at(points, positions, b, p), v)
        energy, pull, _slope, _by_values = tension(length, toe, v)
        stress_out[b, p] = (values.weights[p] * pull) * u
        energy_out[b, p] = values.weights[p] * energy

    @wp.kernel(module=module)
    def tangent(
        active: wp.array[int],
        clamp: wp.array[int],  # (B) not zero where eigenvalues are clamped at zero
        points: VectorPoints,
        values: PartValues,
        toe: wp.float64,
        positions: wp.array2d[wp.vec3d],
        tangent_out: wp.array3d[wp.mat33d],  # (B, P, 1)
    ):
        b, p = wp.tid()
        if active[b] == 0:
            return
        v = read_values(values, b, p)
        u, length = stretched(vector_at(points, positions, b, p), v)
        _energy, pull, slope, _by_values = tension(length, toe, v)
        across, along = ZERO, values.weights[p] * slope
        if length > ZERO:
            across = values.weights[p] * pull / length
        if clamp[b] != 0:
            across = wp.max(across, ZERO)
        block = (along - across) * wp.outer(u, u)
        block[0, 0] += across
        block[1, 1] += across
        block[2, 2] += across
        tangent_out[b, p, 0] = block

    # The residual is w t u, so that -z . d residual/dv is -w dt/dv u . dz, with dz = sum_a g_a z_a. The origin moves
    # the vector the other way: its derivative is the tangent times dz.
    @wp.kernel(module=module)
    def adjoint(
        points: VectorPoints,
        values: PartValues,
        toe: wp.float64,
        positions: wp.array2d[wp.vec3d],
        direction: wp.array2d[wp.vec3d],  # (B, N) z = H^-1 dL/dx [m]
        values_out: wp.array2d[vector],  # (B, P) this point's part of dL/dv
    ):
        b, p = wp.tid()
        v = read_values(values, b, p)
        u, length = stretched(vector_at(points, positions, b, p), v)
        dz = vector_at(points, direction, b, p)
        _energy, pull, slope, by_values = tension(length, toe, v)
        axial = wp.dot(u, dz)
        result = (-values.weights[p] * axial) * by_values
        if wp.static(tied):
            moved = (slope * axial) * u
            if length > ZERO:
                moved += (pull / length) * (dz - axial * u)
            for i in range(3):
                result[i] = values.weights[p] * moved[i]
        values_out[b, p] = result

    return SimpleNamespace(local_step=local_step, tangent=tangent, adjoint=adjoint, values=vector)
