"""Linear solvers of the Hessian's structure, conjugate gradients and least squares.

From outside: `choice.make_linear_solver`, `least_squares.minimise`.
"""
