"""Minimises an incremental potential: local steps on the points, global steps with a factorised matrix.

Three solvers differ in the matrix of the global step and share everything else:

=======================  ====================================================================================
``projective_dynamics``  constant projective-dynamics matrix, accelerated by L-BFGS (Liu et al. 2017)
``quasi_newton``         Hessian of a recent state, accelerated by L-BFGS; factorised anew when steps get slow
``newton``               Hessian of every iterate, clamped to positive eigenvalues where it is not positive definite
=======================  ====================================================================================

An environment of the batch has converged when its residual is at most ``relative_tolerance`` times the norm of the
forces that balance: inertia and loads. Rounding may leave more than that. An environment whose residual has not halved
in three iterations has converged too if it is less than what moving every coordinate by one unit of rounding makes of
it, which is measured; and one on which nothing acts, if its first step is within the rounding of its state.

Residuals and positions are float64. Factors and directions may be float32: they decide how many iterations it takes.
"""

from dataclasses import dataclass

import torch

from ..energies.potential import IncrementalPotential
from ..io.errors import ConvergenceError, InputError
from ..linalg.lbfgs import InverseHessianUpdate
from ..linalg.linear_solver import LINEAR_SOLVERS, make_linear_solver
from .assembly import BlockPattern
from .hessian import ExactHessian, HessianApproximation, ProjectiveHessian

SOLVERS = ("projective_dynamics", "quasi_newton", "newton")
_ARMIJO = 1e-4
_MAX_HALVINGS = 25
_STALLS = 3


@dataclass(frozen=True)
class SolverSettings:
    """How to solve a step."""

    name: str = "quasi_newton"  # one of `SOLVERS`
    # residual over balancing forces at which a solve has converged; where states are float32, less than 1e-5
    # gains nothing
    relative_tolerance: float = 1e-8
    absolute_tolerance: float = 1e-12  # residual below which it has converged in any case [N]
    max_iterations: int = 2000  # after which it has failed
    memory: int = 12  # pairs that L-BFGS keeps
    refactor_after: int = 4  # mean iterations a step above which ``quasi_newton`` factorises anew
    linear_solver: str = "auto"  # ``auto``, ``banded``, ``dense`` or ``sparse``
    on_failure: str = "raise"  # ``raise`` a `ConvergenceError`, or ``count`` the failure in the report and go on

    def __post_init__(self) -> None:
        """Checks the settings; raises InputError for an unknown name, or a number out of range."""
        if self.name not in SOLVERS:
            raise InputError(f"solver is {self.name!r}: choose one of {', '.join(SOLVERS)}.")
        if self.on_failure not in ("raise", "count"):
            raise InputError(f"solver.on_failure is {self.on_failure!r}: choose raise or count.")
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
    """Outcome of a solve."""

    iterations: torch.Tensor  # (B,) global steps of each environment
    relative_residual: torch.Tensor  # (B,) last residual over balancing forces
    converged: torch.Tensor  # (B,) bool
    factorisations: int  # of the whole batch


class NonlinearSolver:
    """Minimises a potential again and again; keeps factor and buffers between solves.

    Args:
        potential: evaluated at its current terms.
        pattern: block structure of its Hessian.
        settings: see `SolverSettings`.
        dtype: of factors and directions.
    """

    def __init__(
        self, potential: IncrementalPotential, pattern: BlockPattern, settings: SolverSettings, dtype: torch.dtype
    ) -> None:
        self.potential, self.settings, self.dtype = potential, settings, dtype
        self.hessian: HessianApproximation
        kind = settings.linear_solver
        where = (potential.device, dtype)
        if settings.name == "projective_dynamics":
            linear = make_linear_solver(kind, pattern.rows, pattern.cols, len(pattern.free), 1, *where)
            self.hessian = ProjectiveHessian(potential, pattern, linear)
        else:
            linear = make_linear_solver(kind, pattern.rows, pattern.cols, len(pattern.free), 3, *where)
            self.hessian = ExactHessian(potential, pattern, linear)
        memory = 0 if settings.name == "newton" else settings.memory
        self._update = InverseHessianUpdate(memory, potential.positions.to(dtype))
        self._mean_iterations = float("inf")

    def solve(self, start: torch.Tensor) -> SolveReport:
        """Minimises from (B, N, 3); the minimiser is left in ``potential.positions``.

        Raises:
            ConvergenceError: an environment did not converge and failures are not merely counted.
        """
        run = _Run(self, start)
        while run.advance():
            pass
        self._mean_iterations = float(run.iterations.double().mean())
        report = SolveReport(run.iterations, run.relative_residual, run.converged, run.factorisations)
        if self.settings.on_failure == "raise" and not bool(run.converged.all()):
            worst = int((~run.converged).nonzero()[0])
            raise ConvergenceError(
                f"the {self.settings.name} solver stopped after {int(run.iterations[worst])} iterations with a "
                f"relative residual of {float(run.relative_residual[worst]):.2e} in environment {worst} of "
                f"{len(run.converged)}: take a smaller time step or loads, raise solver.max_iterations, or choose "
                "solver.name=newton.",
                self.potential.positions.to(self.dtype, copy=True),
                report,
            )
        return report

    def stale(self, iteration: int) -> bool:
        """Whether the global step's matrix should be factorised before this iteration."""
        name, limit = self.settings.name, self.settings.refactor_after
        if name == "newton":
            return True
        if iteration == 0:
            return not self.hessian.ready() or (name == "quasi_newton" and self._mean_iterations > limit)
        return name == "quasi_newton" and iteration % (3 * limit) == 0


class _Run:
    """One solve: the iterate, its residual, and which environments are done."""

    def __init__(self, solver: NonlinearSolver, start: torch.Tensor) -> None:
        self.solver, self.potential = solver, solver.potential
        p = self.potential
        p.positions.copy_(start)
        self.batch = p.batch
        self.force_norm = torch.linalg.vector_norm(p.force.view(self.batch, -1), dim=1)
        self.iterations = torch.zeros(self.batch, dtype=torch.int64, device=p.device)
        self.converged = torch.zeros(self.batch, dtype=torch.bool, device=p.device)
        self.energy = self.rounding = self.smallest = torch.full_like(self.force_norm, torch.inf)
        self.stalls = torch.zeros_like(self.iterations)
        self.factorisations = 0
        self.iteration = 0
        self.clamp: bool | None = None  # How to factorise before the next iteration, if that must be.
        solver._update.reset()
        self._accept(*p.evaluate())
        self.stuck = ~torch.isfinite(self.relative_residual)

    def _accept(self, energy: torch.Tensor, balance: torch.Tensor) -> None:
        s = self.solver.settings
        self.residual = self.potential.residual.view(self.batch, -1).clone()
        norm = torch.linalg.vector_norm(self.residual, dim=1)
        scale = balance + self.force_norm
        self.scale, self.relative_residual = scale, norm / scale.clamp_min(s.absolute_tolerance)
        self.stalls = torch.where(norm < 0.5 * self.smallest, 0, self.stalls + 1)
        self.smallest = torch.minimum(self.smallest, norm)
        small = (norm <= s.relative_tolerance * scale) | (norm <= s.absolute_tolerance)
        self.converged |= small & (norm + scale < torch.inf)
        if self.iteration >= _STALLS and int(self.stalls.max()) >= _STALLS:
            flat = self.energy - energy <= self.potential.energy_rounding()
            stalled = flat & (self.stalls >= _STALLS) & (norm <= self.rounding) & ~self.converged
            if bool(stalled.any()):
                self.rounding = self.potential.residual_rounding()
                self.converged |= stalled & (norm <= self.rounding)
        self.energy = energy

    def advance(self) -> bool:
        """One global step and line search; False when every environment is done."""
        resting = self.converged | self.stuck
        if bool(resting.all()) or self.iteration >= self.solver.settings.max_iterations:
            return False
        if self.clamp is not None or self.solver.stale(self.iteration):
            self._refactor(resting if self.solver.settings.name == "newton" else None)
        direction, slope = self._direction(resting)
        active = ~resting
        self.iterations += active
        self.iteration += 1
        self._line_search(direction, slope, active)
        if self.iteration == 1 and bool((self.force_norm == 0.0).any()):
            self.converged |= active & ~self.stuck & self._within_rounding(direction)
        return True

    def _within_rounding(self, direction: torch.Tensor) -> torch.Tensor:
        """(B,) whether a step of (B, 3 N) and the forces that balance after it are those of rounding the state."""
        p = self.potential
        rounding = torch.finfo(self.solver.dtype).eps * p.positions.abs().amax((1, 2))
        forces = 2.0 * rounding * torch.linalg.vector_norm(p.inertia, dim=1)
        return (direction.abs().amax(1) <= rounding) & (self.scale <= forces)

    def _direction(self, resting: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, 3 N) where to go, and (B,) the slope of the energy there; zero for environments that rest or are stuck.

        A factor that an overflow left behind is made again. What has no finite direction then is stuck.
        """
        solver = self.solver
        residual = self.residual.to(solver.dtype)

        def along(product: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            direction = (-product.to(self.residual.dtype)).masked_fill_(resting[:, None], 0.0)
            return direction, torch.linalg.vecdot(self.residual, direction).masked_fill_(resting, 0.0)

        direction, slope = along(solver._update.apply(residual, solver.hessian))
        if not bool((slope <= 0).all()):
            solver._update.reset()
            direction, slope = along(solver.hessian.apply(residual))
            if not self.factorisations and not bool(torch.isfinite(slope).all()):
                self._refactor()
                direction, slope = along(solver.hessian.apply(residual))
            lost = ~torch.isfinite(slope)
            self.stuck |= lost
            direction, slope = direction.masked_fill_(lost[:, None], 0.0), slope.masked_fill_(lost, 0.0)
        return direction, slope

    def _refactor(self, idle: torch.Tensor | None = None) -> None:
        self.solver.hessian.refactor(bool(self.clamp), idle)
        self.solver._update.reset()
        self.factorisations += 1
        self.clamp = None

    def _line_search(self, direction: torch.Tensor, slope: torch.Tensor, active: torch.Tensor) -> None:
        """Backtracks to a decrease of the energy, or of the slope where the energy is down to rounding.

        The second test is the approximate Wolfe condition of Hager and Zhang (2005).
        """
        p = self.potential
        start = p.positions.clone()
        step = torch.ones_like(slope)
        before = self.residual
        for _ in range(_MAX_HALVINGS):
            p.positions.copy_(start).add_((step[:, None] * direction).view_as(start))
            energy, balance = p.evaluate()
            failed = active & ~(energy <= self.energy + _ARMIJO * step * slope)
            if bool(failed.any()):
                after = torch.linalg.vecdot(p.residual.view(self.batch, -1), direction)
                flat = (energy <= self.energy + p.energy_rounding()) & (after <= (2 * _ARMIJO - 1) * slope)
                failed &= ~flat
            if not bool(failed.any()):
                break
            step = torch.where(failed, 0.5 * step, step)
        else:
            self._give_up(failed, start, direction, step)
            energy, balance = p.evaluate()
        self._accept(energy, balance)
        self.solver._update.add(step[:, None] * direction, self.residual - before)

    def _give_up(self, failed: torch.Tensor, start: torch.Tensor, direction: torch.Tensor, step: torch.Tensor) -> None:
        """Stays where it was; a new factor, and a clamped one, get a try before the environment counts as stuck."""
        step.masked_fill_(failed, 0.0)
        self.potential.positions.copy_(start).add_((step[:, None] * direction).view_as(start))
        self.clamp = self.factorisations > 0
        if self.clamp:
            self.stuck |= failed & self.solver.hessian.clamped
