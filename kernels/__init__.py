"""Warp device code: energies at points, the gather, the Hessian blocks and their adjoints.

All in float64: single precision leaves a nearly incompressible solid no digit of its forces. Pressure, fibres and each
material are Warp modules of their own (`modules`), so that a run compiles what it needs. Nothing here is differentiated
by Warp itself: the adjoints are written out (``wp.svd3`` has a wrong adjoint at the rest state).

Array names used in every kernel, with B environments, N vertices, C cells of K nodes with Q points each, P = C Q:

==================  =====================  =============================================================
positions           (B, N) vec3            [m]
nodes               (C, K) int             vertex of each node of a cell
gradients           (P, K) vec3            operator of each node; in a solid, its shape function's gradient [1/m]
stress              (B, P) mat33           first Piola-Kirchhoff stress times the point's volume [J]
tangent             (B, P, 6) mat33        blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2) of its derivative [J]
==================  =====================  =============================================================

Block (k, n) of a tangent is the derivative of column k of the stress by column n of the deformation gradient, (n, k)
its transpose. The stiffness between two nodes with operators g and g' is the sum of g_k g'_n (k, n) for every energy.
"""
