"""Rotations that are nearest to the deformation of rigid parts."""

import warp as wp

from .matrices import polar_rotation
from .points import deformation_gradient

wp.set_module_options({"enable_backward": False})


@wp.kernel
def straighten(
    nodes: wp.array2d[int],  # (P, 4) control vertices
    gradients: wp.array2d[wp.vec3d],
    centre: wp.array2d[wp.float64],  # (P, 4) weights of the centre of mass
    arms: wp.array2d[wp.vec3d],  # (P, 4) from there to the control vertices at rest [m]
    positions: wp.array2d[wp.vec3d],
):
    """Replaces the deformation gradient of every part by its rotation, with the centre of mass in its place."""
    b, p = wp.tid()
    r = polar_rotation(deformation_gradient(positions, nodes, gradients, b, p, p))
    middle = wp.vec3d()
    for a in range(4):
        middle += centre[p, a] * positions[b, nodes[p, a]]
    for a in range(4):
        positions[b, nodes[p, a]] = middle + r * arms[p, a]
