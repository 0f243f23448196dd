"""Warp device code: energies at points, gather, Hessian blocks and their adjoints.

All kernels use float64: in single precision the forces of a nearly incompressible solid have no correct digit. Every
file is a Warp module of its own, and so is every material law (`modules`), so that a run compiles only what it needs.
Warp does not differentiate these kernels, as ``wp.svd3`` has a wrong adjoint at the rest state; adjoints are written
out. The exception are energies given as one Warp function (`pointwise`).

The first argument of a local step, a tangent or an assembly is ``active`` (B), zero for environments to skip; tangents
also have ``clamp`` (B), non-zero where negative eigenvalues are clamped.

Array names used in every kernel, with B environments, N vertices, C cells of K nodes with Q points each, P = C Q:

==================  =====================  =============================================================
positions           (B, N) vec3            [m]
nodes               (C, K) int             vertex of each node of a cell
gradients           (P, K) vec3            operator of each node; in a solid, its shape function's gradient [1/m]
stress              (B, P) mat33           first Piola-Kirchhoff stress times the point's volume [J]
tangent             (B, P, 6) mat33        blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2) of its derivative [J]
operators, weights  (P, K) float64         operators of energies that are functions of a vector; their stress is a
                                           vec3, their tangent (B, P, 1) one block
==================  =====================  =============================================================

Block (k, n) of a tangent is the derivative of column k of the stress by column n of the deformation gradient; block
(n, k) is its transpose. For every energy, the stiffness between two nodes with operators g and g' is the sum of
g_k g'_n (k, n).
"""

import warp as wp

from .messages import QuietLogger

if type(wp.get_logger()).__module__.startswith("warp."):  # else the user's own
    wp.set_logger(QuietLogger())
