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

from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.linearisation import Linearisation
from ..dynamics.simulator import Constants, Simulator
from ..io.errors import ConvergenceError, InputError
from ..linalg.threads import threads_for

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
        self._constants = simulator.prepare()

    def with_constants(self, constants: Constants) -> Self:
        """The same method for other constants than the simulator's."""
        other = copy.copy(self)
        other._constants = constants
        return other

    @abstractmethod
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        """Reconstructs the step from a state to observed positions.

        Args:
            state: where the step starts.
            observed: (B, N, 3) [m].
            inputs: what acts during the step; an external force adds to the one that is looked for.
            first_guess: (B, N, 3) force to start from, such as that of the step before [N].

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

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        del first_guess
        sim = self.simulator
        step = sim.linearise(state, inputs, self._constants)
        weight = self.regularisation * step.stage.end**2
        target = step.hold(sim.method.solution_for(state, observed))
        x, iterations = target.clone(), 0
        objective, force = _objective(step, x, target, weight)
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
            step.update(x)
            dx = _direction(step, x - target, force, weight)
            x, objective, force = _search(step, x, dx, target, objective, weight)
            change = dx.abs().max()
        x, force = x.to(sim.dtype), force.to(sim.dtype)
        return Reconstruction(step.finish(x), force, iterations)


def _objective(
    step: Linearisation, x: torch.Tensor, target: torch.Tensor, weight: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """|x - x*|^2 + w |g|^2 (B,) [m^2] and the residual force g (B, N, 3) [N] at x."""
    force = step.residual(x)
    return ((x - target) ** 2).sum((1, 2)) + weight * (force**2).sum((1, 2)), force


def _search(
    step: Linearisation,
    x: torch.Tensor,
    dx: torch.Tensor,
    target: torch.Tensor,
    objective: torch.Tensor,
    weight: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Halves the steps of environments whose objective would grow."""
    scale = torch.ones_like(objective)
    for _ in range(30):
        trial = x + scale[:, None, None] * dx
        value, force = _objective(step, trial, target, weight)
        worse = value > objective * (1.0 + 1e-9)
        if not bool(worse.any()):
            break
        scale = torch.where(worse, 0.5 * scale, scale)
    return trial, value, force


def _direction(step: Linearisation, offset: torch.Tensor, force: torch.Tensor, weight: float) -> torch.Tensor:
    """(B, N, 3) solution of the Gauss-Newton system by preconditioned conjugate gradients."""
    factor, free = step.shifted(float(np.sqrt(weight))), step.free

    def operator(d: torch.Tensor) -> torch.Tensor:
        return d + weight * step.product(step.product(d))

    def preconditioner(r: torch.Tensor) -> torch.Tensor:
        out = torch.zeros_like(r)
        right = r[:, free].reshape(len(r), -1, 1)
        out[:, free] = factor.solve(factor.solve(right)).reshape(len(r), -1, 3)
        return out

    right = -offset - weight * step.product(force)
    with threads_for(right.numel()):
        return conjugate_gradients(operator, preconditioner, right, tolerance=1e-6)


class LBFGSB(Reconstructor):
    """The published method: L-BFGS-B on the forces, with gradients through the simulator.

    ``tolerance`` is the relative change of the objective.
    """

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        free = self._free()
        return self._minimise(state, lambda q: ((q - observed) * free).square().sum(), inputs, first_guess)

    def _free(self) -> torch.Tensor:
        """(N, 1) zero at fixed vertices, else one."""
        free = self.simulator.rest_positions.new_ones(self.simulator.body.n_vertices, 1)
        free[self.simulator.fixed] = 0.0
        return free

    def _minimise(
        self,
        state: State,
        misfit_of: LinearMap,
        inputs: Inputs | None,
        first_guess: torch.Tensor | None,
    ) -> Reconstruction:
        """The force of least misfit, a scalar function of the next positions (B, N, 3), plus lambda |f|^2."""
        sim, free, like = self.simulator, self._free(), state.q
        acting = inputs or Inputs()

        def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
            force = torch.as_tensor(values, device=like.device, dtype=like.dtype).reshape(like.shape)
            force.requires_grad_(True)
            new, _ = sim.step(state, acting.plus(free * force), self._constants)
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
            new, _ = sim.step(state, acting.plus(force), self._constants)
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
