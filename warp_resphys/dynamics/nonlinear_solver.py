"""Nonlinear solvers for the incremental potential: local steps on the points, global steps with a factorised matrix.

The three solvers differ only in the matrix of the global step:

=======================  ====================================================================================
``projective_dynamics``  constant projective-dynamics matrix, accelerated by L-BFGS (Liu et al. 2017)
``quasi_newton``         Hessian of a recent state, accelerated by L-BFGS; refactorised when convergence is slow
``newton``               Hessian of every iterate, clamped to positive eigenvalues where it is not positive definite
=======================  ====================================================================================

An environment has converged when its residual is at most ``relative_tolerance`` times the norm of the balancing forces,
inertia and loads. Because of rounding, an environment whose residual has not halved in three iterations has also
converged if the residual is less than its measured change when every coordinate moves by one rounding unit; and an
environment without loads, if its first step is within the rounding of its state.

Residuals and positions are float64. Factors and L-BFGS pairs may be float32, which affects only the number of
iterations.

Kernels make all decisions for an environment (`minimiser`); the host launches them and factorises, or launches a graph
that does both.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import torch

from ..energies.launcher import struct_of
from ..energies.potential import IncrementalPotential
from ..io.errors import ConvergenceError, InputError
from ..kernels.minimisation import NEVER, Tolerances
from ..linalg.choice import LINEAR_SOLVERS, make_linear_solver
from ..stepping.state import SolveReport
from .assembly import BlockPattern
from .hessian import ExactHessian, ProjectiveHessian
from .minimiser import Minimiser

SolverName = Literal["projective_dynamics", "quasi_newton", "newton"]
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
FACTORS = ("double", "single")
_PATIENCE = 3  # by which `SolverSettings.refactor_after` is multiplied where factors are kept


@dataclass(frozen=True)
class SolverSettings:
    """Settings of the nonlinear solver."""

    name: str = "quasi_newton"  # one of `SOLVERS`
    # residual over balancing forces at which a solve has converged; below 1e-5 no gain for float32 states
    relative_tolerance: float = 1e-8
    absolute_tolerance: float = 1e-12  # residual at which a solve has converged in any case [N]
    max_iterations: int = 2000  # iterations after which a solve has failed
    memory: int = 12  # number of L-BFGS pairs
    refactor_after: int = 4  # iterations of a step above which ``quasi_newton`` refactorises
    linear_solver: str = "auto"  # ``auto``, ``banded``, ``tiled``, ``dense``, ``sparse`` or ``pardiso``
    factors: str = "double"  # or ``single``: factors and L-BFGS pairs in float32; see ``factors`` in docs/settings.md
    on_failure: str = "raise"  # ``raise`` a `ConvergenceError`, or ``count`` the failure in the report and continue

    def __post_init__(self) -> None:
        """Raises InputError for an unknown name or a number out of range."""
        if self.name not in SOLVERS:
            raise InputError(f"solver is {self.name!r}: choose one of {', '.join(SOLVERS)}.")
        if self.on_failure not in ("raise", "count"):
            raise InputError(f"solver.on_failure is {self.on_failure!r}: choose raise or count.")
        if self.factors not in FACTORS:
            raise InputError(f"solver.factors is {self.factors!r}: choose {' or '.join(FACTORS)}.")
        if self.linear_solver not in LINEAR_SOLVERS:
            raise InputError(
                f"solver.linear_solver is {self.linear_solver!r}: choose one of {', '.join(LINEAR_SOLVERS)}."
            )
        for key in ("relative_tolerance", "max_iterations", "memory", "refactor_after"):
            if not getattr(self, key) > 0:
                raise InputError(f"solver.{key} is {getattr(self, key)}: it must be positive.")
        if not self.absolute_tolerance >= 0:
            raise InputError(f"solver.absolute_tolerance is {self.absolute_tolerance}: it must be zero or more.")


def check_converged(settings: SolverSettings, report: SolveReport | None, positions: torch.Tensor) -> None:
    """Raises ConvergenceError with the last positions (B, N, 3) if a solve failed and failures are not counted."""
    if settings.on_failure != "raise" or report is None or bool(report.converged.all()):
        return
    worst = int((~report.converged).nonzero()[0])
    other = "or raise solver.max_iterations."
    if settings.name != "newton":
        other = "raise solver.max_iterations, or choose solver.name=newton."
    raise ConvergenceError(
        f"the {settings.name} solver stopped after {int(report.iterations[worst])} iterations with a relative residual "
        f"of {float(report.relative_residual[worst]):.2e} in environment {worst} of {len(report.converged)}: take a "
        f"smaller time step or loads, {other}",
        positions.detach(),
        report,
    )


def make_minimiser(
    potential: IncrementalPotential, pattern: BlockPattern, settings: SolverSettings, dtype: torch.dtype
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
    quasi = settings.refactor_after * (_PATIENCE if linear.keeps_factors else 1)
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
