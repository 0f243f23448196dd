"""Warp device code: energies at points, gather, Hessian blocks and their adjoints.

All kernels use float64: in single precision the forces of a nearly incompressible solid have no
correct digit. Every file is a Warp module of its own, and so is every material law (`modules`), so
that a run compiles only what it needs. Warp does not differentiate these kernels, as ``wp.svd3``
has a wrong adjoint at the rest state; adjoints are written out. The exception are energies given as
one Warp function (`energy_functions`). An energy of a point by itself is a law (`laws`); arguments
of kernels are constants, inputs and outputs, in this order, and the outputs' names end in ``_out``.

The first argument of a local step, a tangent or an assembly is ``active`` (B), zero for
environments to skip; tangents also have ``clamp`` (B), non-zero where negative eigenvalues are
clamped.

Array names used in every kernel, with B environments, N vertices, C cells of K nodes with Q points
each, P = C Q:

==================  ===============  =========================================================
positions           (B, N) vec3      [m]
nodes               (C, K) int       vertex of each node of a cell
gradients           (P, K) vec3      operator of each node; in a solid, its shape function's
                                     gradient [1/m]
stress              (B, P) mat33     first Piola-Kirchhoff stress times the point's volume [J]
tangent             (B, P, 6) mat33  blocks (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2) of
                                     its derivative [J]
operators, weights  (P, K) float64   operators of energies that are functions of a vector;
                                     their stress is a vec3, their tangent (B, P, 1) one block
==================  ===============  =========================================================

Block (k, n) of a tangent is the derivative of column k of the stress by column n of the deformation
gradient; block (n, k) is its transpose. For every energy, the stiffness between two nodes with
operators g and g' is the sum of g_k g'_n (k, n).
"""

import sys
import warnings

import warp as wp


class QuietLogger:
    """A logger of Warp, for the whole process, that leaves out its greeting
    and the loading of modules of this package.

    Kernels that are compiled are named, as that takes seconds.
    ``wp.config.log_level = wp.LOG_DEBUG`` shows everything, and `wp.set_logger(None)` brings back
    Warp's own logger.
    """

    def debug(self, message: str) -> None:
        """Prints details of compilation."""
        sys.stdout.write(f"{message}\n")

    def info(self, message: str) -> None:
        """Prints a message, unless it is a greeting or says
        that a module of this package was in the cache.
        """
        known = message.startswith(f"Module {__package__}.") and "(cached)" in message
        if wp.config.log_level <= wp.LOG_DEBUG or not (known or message.startswith("Warp ")):
            sys.stdout.write(f"{message}\n")

    def warning(
        self, message: str, category: type[Warning] | None = None, stacklevel: int = 1
    ) -> None:
        """Issues a warning."""
        warnings.warn(message, category or UserWarning, stacklevel=stacklevel)

    def error(self, message: str) -> None:
        """Prints an error."""
        sys.stderr.write(f"Warp: {message}\n")


if type(wp.get_logger()).__module__.startswith("warp."):  # else the user's own
    wp.set_logger(QuietLogger())
