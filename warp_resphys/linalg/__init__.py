"""Linear solvers of the Hessian's structure, L-BFGS, conjugate gradients and least squares.

From outside: `linear_solver.make_linear_solver`, `lbfgs.InverseHessianUpdate`, `least_squares.minimise`.
"""
