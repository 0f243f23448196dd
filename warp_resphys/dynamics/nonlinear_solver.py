"""Solver of an incremental potential: local steps on the points, global steps with a factorised matrix.

Three solvers differ in the matrix of the global step and share everything else:

=======================  ====================================================================================
``projective_dynamics``  constant projective-dynamics matrix, accelerated by L-BFGS (Liu et al. 2017)
``quasi_newton``         Hessian of a recent state, accelerated by L-BFGS; factorised anew when steps get slow, or
                         for every iterate where that costs little (multigrid)
``newton``               Hessian of every iterate, clamped to positive eigenvalues where it is not positive definite
=======================  ====================================================================================

An environment of the batch has converged when its residual is at most ``relative_tolerance`` times the norm of the
balancing forces, inertia and loads. Rounding may leave a larger residual: an environment whose residual has not halved
in three iterations has also converged if the residual is below its measured change when every coordinate moves by one
rounding unit. An environment without loads has also converged if its first step is within the rounding of its state.

Residuals and positions are float64. Factors and pairs may be float32: they change the number of iterations only.

Kernels make the decisions for every environment (`minimiser`); the host launches them and factorises, or launches one
graph that does both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, get_args

import torch

from ..energies.potential import IncrementalPotential
from ..io.errors import ConvergenceError, InputError
from ..linalg.choice import LINEAR_SOLVERS, make_linear_solver
from .assembly import BlockPattern
from .hessian import ExactHessian, HessianApproximation, ProjectiveHessian
from .minimiser import Minimiser

SolverName = Literal["projective_dynamics", "quasi_newton", "newton"]
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
FACTORS = ("double", "single")


@dataclass(frozen=True)
class SolverSettings:
    """Settings of the solver of a step."""

    name: str = "quasi_newton"  # one of `SOLVERS`
    # residual over balancing forces at which a solve has converged; below 1e-5, float32 states do not get better
    relative_tolerance: float = 1e-8
    absolute_tolerance: float = 1e-12  # residual below which a solve has converged in any case [N]
    max_iterations: int = 2000  # after which a solve has failed
    memory: int = 12  # pairs that L-BFGS keeps
    refactor_after: int = 4  # iterations of a step above which ``quasi_newton`` factorises anew
    linear_solver: str = "auto"  # ``auto``, ``banded``, ``tiled``, ``dense``, ``sparse`` or ``multigrid``
    factors: str = "double"  # or ``single``: factors and pairs in float32; residuals and states keep their types
    on_failure: str = "raise"  # ``raise`` a `ConvergenceError`, or ``count`` the failure in the report and go on

    def __post_init__(self) -> None:
        """Checks the settings; raises InputError for an unknown name, or a number out of range."""
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


@dataclass(frozen=True)
class SolveReport:
    """Outcome of a solve, by environment."""

    iterations: torch.Tensor  # (B,) global steps
    relative_residual: torch.Tensor  # (B,) last residual over balancing forces
    converged: torch.Tensor  # (B,) bool
    factorisations: torch.Tensor  # (B,) factorisations of the matrix

    @staticmethod
    def of(shards: "Sequence[SolveReport]") -> "SolveReport":
        """Returns the report of a batch from the reports of its shards."""
        if len(shards) == 1:
            return shards[0]
        names = [field.name for field in fields(SolveReport)]
        return SolveReport(*(torch.cat([getattr(report, name) for report in shards]) for name in names))


def check_converged(settings: SolverSettings, report: SolveReport, positions: torch.Tensor) -> None:
    """Raises an error for a failed solve, unless failures are only counted.

    Args:
        settings: of the solver.
        report: of the solve.
        positions: (B, N, 3) at the end of the solve [m].

    Raises:
        ConvergenceError: an environment did not converge.
    """
    if settings.on_failure != "raise" or bool(report.converged.all()):
        return
    worst = int((~report.converged).nonzero()[0])
    raise ConvergenceError(
        f"the {settings.name} solver stopped after {int(report.iterations[worst])} iterations with a relative residual "
        f"of {float(report.relative_residual[worst]):.2e} in environment {worst} of {len(report.converged)}: take a "
        "smaller time step or loads, raise solver.max_iterations, or choose solver.name=newton.",
        positions.detach(),
        report,
    )


class NonlinearSolver:
    """Minimises a potential repeatedly; keeps factor and buffers between solves.

    Args:
        potential: evaluated at its current terms.
        pattern: block structure of its Hessian.
        settings: see `SolverSettings`.
        dtype: of states.
    """

    def __init__(
        self, potential: IncrementalPotential, pattern: BlockPattern, settings: SolverSettings, dtype: torch.dtype
    ) -> None:
        self.potential, self.settings = potential, settings
        factors = torch.float32 if settings.factors == "single" else dtype
        self.hessian: HessianApproximation
        kind = settings.linear_solver
        where = (potential.device, factors, pattern.positions)
        if settings.name == "projective_dynamics":
            linear = make_linear_solver(kind, pattern.rows, pattern.cols, len(pattern.free), 1, *where)
            self.hessian = ProjectiveHessian(potential, pattern, linear)
        else:
            linear = make_linear_solver(kind, pattern.rows, pattern.cols, len(pattern.free), 3, *where)
            self.hessian = ExactHessian(potential, pattern, linear)
        # An iterative linear solver spends most of a solve on directions, so that a new Hessian costs little.
        quasi = 0 if linear.iterates else settings.refactor_after
        after = {"newton": 0, "quasi_newton": quasi, "projective_dynamics": None}
        self._minimiser = Minimiser(
            potential,
            self.hessian,
            factors,
            memory=0 if after[settings.name] == 0 else settings.memory,
            relative_tolerance=settings.relative_tolerance,
            absolute_tolerance=settings.absolute_tolerance,
            epsilon=torch.finfo(dtype).eps,
            max_iterations=settings.max_iterations,
            refactor_after=after[settings.name],
        )

    def solve(self, start: torch.Tensor, follows: torch.Tensor | None = None) -> SolveReport:
        """Minimises the potential; the solution is in ``potential.positions``.

        Args:
            start: (B, N, 3) positions to which inertia alone would lead, or any guess [m].
            follows: (B,) environments that continue the step solved last: they start from its extrapolation, with its
                factor. None for none. Results of the others do not depend on earlier solves.
        """
        self._minimiser.minimise(start, follows)
        return SolveReport(*self._minimiser.outcome())
