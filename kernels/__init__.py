"""Warp device code: the local step, the gather, the Hessian blocks and their adjoints.

Each factory takes a Warp scalar type and returns the kernels compiled for it, in one Warp module a
scalar type, so that a float64 run never compiles float32 code. Nothing here is differentiated by Warp itself: the
adjoints are written out (``wp.svd3`` has a wrong adjoint at the rest state), so ``enable_backward`` is off throughout.

Array names used in every kernel, with B environments, N vertices, C cells of K nodes with Q points each, P = C Q:

==================  =====================  =============================================================
positions           (B, N) vec3            [m]
nodes               (C, K) int             vertex of each node of a cell
gradients           (P, K) vec3            rest-space gradient of each shape function [1/m]
shape_stiffness     (B, P)                 mu times the point's volume [J]
volume_stiffness    (B, P)                 lambda times the point's volume [J]
stress              (B, P) mat33           first Piola-Kirchhoff stress times the point's volume [J]
==================  =====================  =============================================================
"""
