"""Warp device code: energies at points, the gather, the Hessian blocks and their adjoints.

All in float64: single precision leaves a nearly incompressible solid no digit of its forces. Every file is a Warp
module of its own, and so is every law that kernels are made for (`modules`): a run compiles what it needs. Kernels are
not differentiated by Warp, as ``wp.svd3`` has a wrong adjoint at the rest state: their adjoints are written out.
Energies that are one Warp function are (`pointwise`).

The first argument of a local step, a tangent or an assembly is ``active`` (B), zero for environments that are to be
left alone; tangents have ``clamp`` (B) beside it, not zero where negative eigenvalues are clamped.

Array names used in every kernel, with B environments, N vertices, C cells of K nodes with Q points each, P = C Q:

==================  =====================  =============================================================
positions           (B, N) vec3            [m]
nodes               (C, K) int             vertex of each node of a cell
gradients           (P, K) vec3            operator of each node; in a solid, its shape function's gradient [1/m]
stress              (B, P) mat33           first Piola-Kirchhoff stress times the point's volume [J]
tangent             (B, P, 6) mat33        blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2) of its derivative [J]
operators, weights  (P, K) float64         the same for energies that are functions of a vector; then a stress is
                                           a vec3, and a tangent (B, P, 1) one block
==================  =====================  =============================================================

Block (k, n) of a tangent is the derivative of column k of the stress by column n of the deformation gradient, (n, k)
its transpose. The stiffness between two nodes with operators g and g' is the sum of g_k g'_n (k, n) for every energy.
"""
