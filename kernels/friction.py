"""Bristle friction along a line: incremental potential of a step (``energies.friction``)."""

import warp as wp


@wp.func
def bristle_energy(line: wp.vec3d, v: wp.vec4d) -> wp.float64:
    """F_c / z_c times the integral of z over the slide; values: F_c, z_c, deflection and length at the step's start."""
    slide = wp.length(line) - v[3]
    start = v[2]
    if slide < wp.float64(0.0):
        slide = -slide
        start = -start
    return v[0] * (slide + (start - v[1]) * (wp.float64(1.0) - wp.exp(-slide / v[1])))
