"""Laws that are functions of a length: fibres, muscles, and inertia.

The vector x at a point less an origin o has the length l and the unit vector u. With the values v,
a tension gives

    e(l, v),   t = de/dl,   slope dt/dl,   and dt/dv,

so that the stress is t u and the tangent slope u u^T + t / l (1 - u u^T), which has a negative
eigenvalue only for a negative tension. The origin is zero, or for inertia the first three values.
The last value of fibres, the elongation over which they become taut, is a constant.
"""

from typing import Any

import warp as wp

from .constants import HALF, ONE, QUARTER, SIXTH, THREE, TWO, ZERO
from .laws import Law
from .modules import named_module

TWENTY_FOURTH = wp.float64(1.0 / 24.0)
TENTH = wp.float64(0.1)
FORTIETH = wp.float64(0.025)


@wp.func
def thread_pull(strain: wp.float64, toe: wp.float64):
    """Returns energy s, force and slope of a thread of stiffness one:
    zero in compression, linear beyond the toe.
    """
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
    """Returns energy s, force and slope of a fibre of stiffness one.

    The slope rises as 3 t^2 - 2 t^3 over the toe.

    Smoother than `thread_pull`, with the same force beyond the toe: a solid has fibres at every
    strain, and derivatives are compared with differences over all of them.
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
def thread_tension(length: wp.float64, v: wp.vec2d):
    """Describes a thread, ``k s(l - 1)``, with s(e) = max(e, 0)^2 / 2 smoothed over a toe.

    V = (k, toe).
    """
    energy, force, slope = thread_pull(length - ONE, v[1])
    return v[0] * energy, v[0] * force, v[0] * slope, wp.vec2d(force, ZERO)


@wp.func
def muscle_tension(length: wp.float64, v: wp.vec4d):
    """Describes active stress and a contracted spring, ``sigma l + k s(l - 1 + c)``.

    V = (sigma, c, k, toe).
    """
    energy, force, slope = muscle_pull(length - ONE + v[1], v[3])
    by_values = wp.vec4d(ONE, v[2] * slope, force, ZERO)
    return v[0] * length + v[2] * energy, v[0] + v[2] * force, v[2] * slope, by_values


@wp.func
def stiffness_across(length: wp.float64, pull: wp.float64, slope: wp.float64) -> wp.float64:
    """Returns t / l, its limit without length."""
    if length > ZERO:
        return pull / length
    return slope


@wp.func
def inertia_tension(length: wp.float64, v: wp.vec4d):
    """Describes the inertia of a point in a step, ``k / 2 l^2`` from its target.

    V = (target, k) [m, N/m].
    """
    pull = v[3] * length
    return HALF * pull * length, pull, v[3], wp.vec4d(ZERO, ZERO, ZERO, length)


def _axial_law(name: str, tension: Any, tied: bool = False) -> Law:
    vector, module = tension.input_types["v"], named_module(name)

    @wp.func(module=module)
    def stretched(x: wp.vec3d, v: vector):
        """Returns the unit vector along the stretched line, and the length."""
        if wp.static(tied):
            x -= wp.vec3d(v[0], v[1], v[2])
        length = wp.length(x)
        if length > ZERO:
            x = x / length
        return x, length

    @wp.func(module=module)
    def response(f: wp.vec3d, v: vector):
        u, length = stretched(f, v)
        energy, pull, _slope, _by_values = tension(length, v)
        return energy, pull * u

    # The origin moves the vector the other way: its derivative is minus the tangent times df.
    @wp.func(module=module)
    def slopes(f: wp.vec3d, df: wp.vec3d, v: vector, carried: vector) -> vector:
        u, length = stretched(f, v)
        _energy, pull, slope, by_values = tension(length, v)
        along = wp.dot(u, df)
        result = along * by_values
        if wp.static(tied):
            moved = (slope * along) * u + stiffness_across(length, pull, slope) * (df - along * u)
            for i in range(3):
                result[i] = -moved[i]
        return result

    @wp.func(module=module)
    def tangent(f: wp.vec3d, v: vector, clamp: bool, out: wp.array[wp.mat33d]):
        u, length = stretched(f, v)
        _energy, pull, slope, _by_values = tension(length, v)
        across = stiffness_across(length, pull, slope)
        if clamp:
            across = wp.max(across, ZERO)
        block = (slope - across) * wp.outer(u, u)
        block[0, 0] += across
        block[1, 1] += across
        block[2, 2] += across
        out[0] = block

    return Law(name, vector, response, slopes, tangent)


THREAD = _axial_law("axial.thread", thread_tension)
MUSCLE = _axial_law("axial.muscle", muscle_tension)
INERTIA = _axial_law("axial.inertia", inertia_tension, tied=True)
