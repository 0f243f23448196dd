"""Nonlinear solvers for the incremental potential: local steps on the points,
global steps with a factorised matrix.

The three solvers differ only in the matrix of the global step:

=======================  =======================================================================
``projective_dynamics``  constant projective-dynamics matrix, accelerated by L-BFGS (Liu et al.
                         2017)
``quasi_newton``         Hessian of a recent state, accelerated by L-BFGS; refactorised when
                         convergence is slow
``newton``               Hessian of every iterate, clamped to positive eigenvalues where it is
                         not positive definite
=======================  =======================================================================

An environment has converged when its residual is at most ``relative_tolerance`` times the norm of
the balancing forces, inertia and loads. Because of rounding, an environment whose residual has not
halved in three iterations has also converged if the residual is less than its measured change when
every coordinate moves by one rounding unit; and an environment without loads, if its first step is
within the rounding of its state.

Residuals and positions are float64. Factors and L-BFGS pairs may be float32, which affects only the
number of iterations.

Kernels make all decisions for an environment (`minimiser`); the host launches them and factorises,
or launches a graph that does both.
"""

from typing import get_args

import torch

from ...io.errors import ConvergenceError
from ...kernels.minimisation import NEVER, Tolerances
from ..energies.launcher import struct_of
from ..energies.potential import IncrementalPotential
from ..linalg.choice import make_linear_solver
from ..stepping.state import SolveReport, State
from .assembly import BlockPattern
from .hessian import ExactHessian, ProjectiveHessian
from .minimiser import Minimiser
from .solver_settings import SolverName, SolverSettings

SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
_STEPS_TO_CHECK = 32  # of a roll-out on a GPU, after which their convergence is checked
_REFACTOR_AFTER = 4  # iterations of a step above which ``quasi_newton`` refactorises
_PATIENCE = 3  # by which it is multiplied where factors are kept


def check_converged(
    settings: SolverSettings, report: SolveReport | None, positions: torch.Tensor
) -> None:
    """Raises ConvergenceError with the last positions (B, N, 3)
    if a solve failed and failures are not counted.
    """
    if settings.on_failure != "raise" or report is None or bool(report.converged.all()):
        return
    worst = int((~report.converged).nonzero()[0])
    other = "or raise solver.max_iterations."
    if settings.name != "newton":
        other = "raise solver.max_iterations, or choose solver.name=newton."
    raise ConvergenceError(
        f"the {settings.name} solver stopped after {int(report.iterations[worst])} iterations "
        f"with a relative residual of {float(report.relative_residual[worst]):.2e} in "
        f"environment {worst} of {len(report.converged)}: "
        f"take a smaller time step or loads, {other}",
        positions.detach(),
        report,
    )


class ConvergenceCheck:
    """Checks the states of a roll-out, on a GPU those of many steps at once:
    the host waits for it only then.

    Args:
        settings: settings of the solver.
    """

    def __init__(self, settings: SolverSettings) -> None:
        self._settings, self._states = settings, list[State]()

    def add(self, state: State) -> State:
        """Returns a new state, and raises ConvergenceError if a step that is checked failed."""
        self._states.append(state)
        if state.q.device.type == "cpu" or len(self._states) == _STEPS_TO_CHECK:
            self.finish()
        return state

    def finish(self) -> None:
        """Raises ConvergenceError if a step since the last check failed."""
        states, self._states = self._states, []
        for state in states:
            check_converged(self._settings, state.report, state.q)


def make_minimiser(
    potential: IncrementalPotential,
    pattern: BlockPattern,
    settings: SolverSettings,
    dtype: torch.dtype,
) -> Minimiser:
    """Returns the minimiser of a potential.

    Args:
        potential: the potential.
        pattern: block structure of its Hessian.
        settings: settings of the solver.
        dtype: dtype of states.
    """
    factors = torch.float32 if settings.factors == "single" else dtype
    projective = settings.name == "projective_dynamics"
    blocks = (pattern.rows, pattern.cols, len(pattern.free), 1 if projective else 3)
    linear = make_linear_solver(settings.linear_solver, *blocks, potential.device, factors)
    hessian = (ProjectiveHessian if projective else ExactHessian)(potential, pattern, linear)
    quasi = _REFACTOR_AFTER * (_PATIENCE if linear.keeps_factors else 1)
    after = {"newton": 0, "quasi_newton": quasi, "projective_dynamics": NEVER}[settings.name]
    tolerances = struct_of(
        Tolerances,
        relative=settings.relative_tolerance,
        absolute=settings.absolute_tolerance,
        epsilon=torch.finfo(dtype).eps,
        max_iterations=settings.max_iterations,
        refactor_after=after,
    )
    pairs = torch.float32 if linear.keeps_factors and not potential.couples_cells else factors
    return Minimiser(potential, hessian, pairs, settings.memory if after else 0, tolerances)
