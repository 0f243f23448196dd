r"""Residual forces from observed states.

For each step of an observed trajectory, find the force f that minimises

    |q+(f) - q*|^2 + lambda |f|^2

with q+ the simulator's next positions and q* the observed ones. The step goes on from the reconstructed state, not from
the observed one, so that the forces reproduce the trajectory in closed loop.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.optimize
import torch
from typing_extensions import override

from ..assembly import HessianAssembly
from ..equilibrium import Workspace
from ..errors import ConvergenceError, InputError
from ..integrator import ImplicitStage, State
from ..linear_solver import Factor, make_linear_solver
from ..point_terms import StepTerms
from ..potential import IncrementalPotential
from ..simulator import MaterialTensors, Simulator
from ..threads import threads_for

LinearMap = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Reconstruction:
    """One reconstructed step.

    Attributes:
        state: where the simulator gets with the force.
        force: (B, N, 3) [N]; zero at fixed vertices.
        iterations: of the optimisation.
    """

    state: State
    force: torch.Tensor
    iterations: int


class Reconstructor(ABC):
    """Finds residual forces for a simulator.

    Args:
        simulator: the one to correct.
        regularisation: lambda [m^2/N^2].
        tolerance: see the methods.
        max_iterations: after which a step has failed.

    Raises:
        InputError: a regularisation that is negative, or a tolerance or number of iterations that is not positive.
    """

    def __init__(self, simulator: Simulator, regularisation: float, tolerance: float, max_iterations: int) -> None:
        if not regularisation >= 0.0:
            raise InputError(f"reconstruction.regularisation is {regularisation:g}: it must be zero or more.")
        if not tolerance > 0.0:
            raise InputError(f"reconstruction.tolerance is {tolerance:g}: it must be positive.")
        if not max_iterations > 0:
            raise InputError(f"reconstruction.max_iterations is {max_iterations}: it must be positive.")
        self.simulator = simulator
        self.regularisation, self.tolerance, self.max_iterations = regularisation, tolerance, max_iterations
        self._tensors = simulator.prepare()

    def with_tensors(self, tensors: MaterialTensors) -> Self:
        """The same method for other constants than the simulator's, such as other weights in every environment."""
        other = copy.copy(self)
        other._tensors = tensors
        return other

    def _terms(
        self, stage: ImplicitStage, state: State, workspace: Workspace, pressure: torch.Tensor | None
    ) -> StepTerms:
        """The potential of the step without a residual force."""
        sim = self.simulator
        force, inside = sim.coupled(state, None, pressure)
        return sim.step_terms(stage, state.batch, force, self._tensors, workspace, inside)

    @abstractmethod
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        first_guess: torch.Tensor | None = None,
        pressure: torch.Tensor | None = None,
    ) -> Reconstruction:
        """Reconstructs the step from a state to observed positions.

        Args:
            state: where the step starts.
            observed: (B, N, 3) [m].
            first_guess: (B, N, 3) force to start from, such as that of the step before [N].
            pressure: (B, C) gauge pressure in each chamber during the step [Pa].

        Raises:
            ConvergenceError: no minimum was found.
        """


class GaussNewton(Reconstructor):
    """Gauss-Newton in the positions.

    With the full state observed, f is a function of x = q+: the residual g(x) of the step without it, with Jacobian H.
    A Gauss-Newton step of |x - x*|^2 + lambda |g(x)|^2 solves

        (I + lambda H^2) dx = -(x - x*) - lambda H g(x)

    by conjugate gradients, preconditioned with (I + sqrt(lambda) H)^2: for every eigenvalue h of H the quotient
    (1 + lambda h^2) / (1 + sqrt(lambda) h)^2 lies between 1/2 and 1, so that a dozen iterations do for any lambda.
    ``tolerance`` is the last change of any position [m]. Where x stands at a fraction e of the time step, |q+ - q*| is
    |x - x*| / e, and lambda e^2 takes the place of lambda. The first guess is x*, and no force is needed.
    """

    _assembled: IncrementalPotential | None = None

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        first_guess: torch.Tensor | None = None,
        pressure: torch.Tensor | None = None,
    ) -> Reconstruction:
        del first_guess
        sim, batch = self.simulator, state.batch
        workspace = sim.workspace(batch)
        p = workspace.potential
        stage = sim.method.stage(state, sim.time_step)
        p.set_terms(self._terms(stage, state, workspace, pressure))
        self._weight = self.regularisation * stage.end**2
        target = sim.method.solution_for(state, observed).clone()
        target[:, sim.fixed] = state.q[:, sim.fixed]
        x = target.clone()
        objective, force = self._evaluate(p, x, target)
        iterations = 0
        change = torch.full((), torch.inf) if self.regularisation > 0.0 else torch.zeros(())
        while float(change) > self.tolerance:
            if iterations == self.max_iterations:
                raise ConvergenceError(
                    f"Gauss-Newton reconstruction moved by {float(change):.1e} m in its last iteration, the "
                    f"{iterations}th: raise reconstruction.max_iterations or reconstruction.tolerance.",
                    x,
                    None,
                )
            iterations += 1
            p.positions.copy_(x)
            p.update_tangent()
            dx = self._direction(p, x - target, force)
            x, objective, force = self._search(p, x, dx, target, objective)
            change = dx.abs().max()
        x, force = x.to(sim.dtype), force.to(sim.dtype)
        return Reconstruction(sim.method.finish(state, x, sim.time_step), force, iterations)

    def _evaluate(
        self, p: IncrementalPotential, x: torch.Tensor, target: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Objective (B,) [m^2] and residual force (B, N, 3) [N] at x."""
        p.positions.copy_(x)
        p.evaluate()
        force = p.residual.clone()
        return ((x - target) ** 2).sum((1, 2)) + self._weight * (force**2).sum((1, 2)), force

    def _search(
        self,
        p: IncrementalPotential,
        x: torch.Tensor,
        dx: torch.Tensor,
        target: torch.Tensor,
        objective: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Halves the steps of environments whose objective would grow."""
        scale = torch.ones_like(objective)
        for _ in range(30):
            trial = x + scale[:, None, None] * dx
            value, force = self._evaluate(p, trial, target)
            worse = value > objective * (1.0 + 1e-9)
            if not bool(worse.any()):
                break
            scale = torch.where(worse, 0.5 * scale, scale)
        return trial, value, force

    def _direction(self, p: IncrementalPotential, offset: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) solution of the Gauss-Newton system by preconditioned conjugate gradients."""
        inertia = p.inertia[..., None]
        mask = p.free_mask[:, None]

        def hessian(d: torch.Tensor) -> torch.Tensor:
            return (p.stiffness_product(d) + inertia * d) * mask

        def operator(d: torch.Tensor) -> torch.Tensor:
            return d + self._weight * hessian(hessian(d))

        factor, dofs = self._precondition(p)

        def preconditioner(r: torch.Tensor) -> torch.Tensor:
            out = torch.zeros_like(r)
            right = r[:, dofs].reshape(len(r), -1, 1)
            out[:, dofs] = factor.solve(factor.solve(right)).reshape(len(r), -1, 3)
            return out

        right = -offset - self._weight * hessian(force)
        with threads_for(right.numel()):
            return conjugate_gradients(operator, preconditioner, right, tolerance=1e-6)

    def _precondition(self, p: IncrementalPotential) -> tuple[Factor, torch.Tensor]:
        """Factor of I + sqrt(lambda) H on the free vertices; H clamped where that is not positive definite."""
        if self._assembled is not p:
            pattern = self.simulator.workspace(p.batch).pattern
            name = self.simulator.settings.linear_solver
            where = (p.device, p.dtype)
            linear = make_linear_solver(name, pattern.rows, pattern.cols, len(pattern.free), 3, *where)
            diagonal = linear.address[pattern.rows == pattern.cols][:, [0, 4, 8]].ravel()
            self._diagonal = torch.as_tensor(diagonal.astype(np.int64), device=p.device)
            self._free = torch.as_tensor(pattern.free, device=p.device)
            self._assemble = HessianAssembly(p, linear, pattern)
            self._linear = linear
            self._assembled = p

        def factorise() -> Factor:
            values = np.sqrt(self._weight) * self._assemble()
            values[:, self._diagonal] += 1.0
            return self._linear.factor(values)

        factor = factorise()
        if factor.failed.any():
            p.update_tangent(torch.as_tensor(factor.failed, device=p.device))
            factor = factorise()
            p.update_tangent()
        return factor, self._free


class LBFGSB(Reconstructor):
    """The published method: L-BFGS-B on the forces, with gradients through the simulator.

    ``tolerance`` is the relative change of the objective.
    """

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        first_guess: torch.Tensor | None = None,
        pressure: torch.Tensor | None = None,
    ) -> Reconstruction:
        free = self._free()
        return self._minimise(state, lambda q: ((q - observed) * free).square().sum(), first_guess, pressure)

    def _free(self) -> torch.Tensor:
        """(N, 1) zero at fixed vertices, else one."""
        free = self.simulator.rest_positions.new_ones(self.simulator.body.n_vertices, 1)
        free[self.simulator.fixed] = 0.0
        return free

    def _minimise(
        self,
        state: State,
        misfit_of: LinearMap,
        first_guess: torch.Tensor | None,
        pressure: torch.Tensor | None,
    ) -> Reconstruction:
        """The force of least misfit, a scalar function of the next positions (B, N, 3), plus lambda |f|^2."""
        sim, free, like = self.simulator, self._free(), state.q

        def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
            force = torch.as_tensor(values, device=like.device, dtype=like.dtype).reshape(like.shape)
            force.requires_grad_(True)
            new, _ = sim.step(state, free * force, material=self._tensors, pressure=pressure)
            value = misfit_of(new.q) + self.regularisation * force.square().sum()
            (gradient,) = torch.autograd.grad(value, force)
            # In units of lambda both the objective and its change are of the size of f^2.
            scale = 1.0 / max(self.regularisation, 1e-12)
            return scale * float(value.detach()), scale * gradient.cpu().double().numpy().ravel()

        start = torch.zeros_like(like) if first_guess is None else first_guess
        result = scipy.optimize.minimize(
            objective,
            start.cpu().double().numpy().ravel(),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": self.max_iterations, "maxcor": 30, "ftol": self.tolerance, "gtol": 0.0},
        )
        if result.status == 1:  # A line search that ends early is another matter: the objective is down to rounding.
            raise ConvergenceError(
                f"L-BFGS-B found no minimum in {result.nit} iterations: raise reconstruction.max_iterations, "
                "reconstruction.tolerance or reconstruction.regularisation.",
                like,
                None,
            )
        force = free * sim.tensor(result.x.reshape(like.shape))
        with torch.no_grad():
            new, _ = sim.step(state, force, material=self._tensors, pressure=pressure)
        return Reconstruction(new, force, int(result.nit))


def conjugate_gradients(
    operator: LinearMap,
    preconditioner: LinearMap,
    right: torch.Tensor,
    tolerance: float,
    max_iterations: int = 500,
) -> torch.Tensor:
    """Preconditioned conjugate gradients for a batch of symmetric positive definite systems.

    Args:
        operator: (B, N, 3) to (B, N, 3).
        preconditioner: approximate inverse of it.
        right: (B, N, 3) right-hand sides.
        tolerance: relative, in the preconditioner's norm.
        max_iterations: the last iterate is returned after that many.
    """
    x = torch.zeros_like(right)
    r = right.clone()
    z = preconditioner(r)
    d = z.clone()
    rz = (r * z).sum((1, 2))
    goal = tolerance**2 * rz
    for _ in range(max_iterations):
        if bool((rz <= goal).all()):
            break
        hd = operator(d)
        curvature = (d * hd).sum((1, 2))
        step = torch.where(rz > goal, rz / curvature.clamp_min(torch.finfo(r.dtype).tiny), 0.0)
        x += step[:, None, None] * d
        r -= step[:, None, None] * hd
        z = preconditioner(r)
        following = (r * z).sum((1, 2))
        d = z + (following / rz.clamp_min(torch.finfo(r.dtype).tiny))[:, None, None] * d
        rz = following
    return x


def make_reconstructor(
    simulator: Simulator,
    method: str,
    regularisation: float,
    tolerance: float,
    max_iterations: int,
) -> Reconstructor:
    """The named method.

    Raises:
        InputError: an unknown method.
    """
    methods: dict[str, type[Reconstructor]] = {"gauss_newton": GaussNewton, "lbfgsb": LBFGSB}
    if method not in methods:
        raise InputError(f"reconstruction.method is {method!r}: choose one of {', '.join(methods)}.")
    return methods[method](simulator, regularisation, tolerance, max_iterations)
