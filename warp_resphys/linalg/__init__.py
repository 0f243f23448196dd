"""Linear solvers of the Hessian's structure, L-BFGS, and least squares within bounds.

From outside: `linear_solver.make_linear_solver`, `lbfgs.InverseHessianUpdate`, `least_squares.minimise`.
"""
