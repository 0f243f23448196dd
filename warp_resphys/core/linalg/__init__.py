"""Linear solvers for Hessians, conjugate gradients and nonlinear least squares.

Public: `choice.make_linear_solver`, `least_squares.minimise`.
"""
