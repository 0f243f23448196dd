r"""Reconstruction of residual forces from observed states or sparse markers.

For each step of an observed trajectory, find the force f that minimises

    |C q+(f) - y|^2 + lambda |f|^2

with q+ the simulator's next positions, y the observation, and C the map from positions to markers, linear or not; the
identity for full states. The next step starts from the reconstructed state, not from the observed one, so that the
forces reproduce the trajectory in closed loop. With sparse markers, the second term sets the components of f that the
markers do not determine to zero.
"""

import copy
import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Self

import numpy as np
import scipy.optimize
import torch
from typing_extensions import override

from ..data.markers import WHOLE_STATE, Markers, Observation, WholeState
from ..dynamics.modes import vibration_modes
from ..dynamics.simulator import Constants, Simulator
from ..io.errors import ConvergenceError, InputError
from ..linalg.least_squares import minimise
from ..linalg.threads import threads_for
from ..stepping.inputs import Inputs
from ..stepping.rollout import states
from ..stepping.state import State
from .reconstruction_problems import FullStateProblem, MarkerForceProblem, MarkerPositionProblem, StepProblem

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reconstruction:
    """One reconstructed step."""

    state: State  # after the step with the force
    force: torch.Tensor  # (B, N, 3) [N]; zero at fixed vertices
    iterations: int  # of the optimisation


class Reconstructor(ABC):
    """Finds residual forces for a simulator; see `make_reconstructor`."""

    def __init__(
        self,
        simulator: Simulator,
        observation: Observation,
        regularisation: float,
        tolerance: float,
        max_iterations: int,
    ) -> None:
        if not regularisation >= 0.0:
            raise InputError(f"reconstruction.regularisation is {regularisation:g}: it must be zero or more.")
        if not tolerance > 0.0:
            raise InputError(f"reconstruction.tolerance is {tolerance:g}: it must be positive.")
        if not max_iterations > 0:
            raise InputError(f"reconstruction.max_iterations is {max_iterations}: it must be positive.")
        self.simulator, self.regularisation = simulator, regularisation
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self.observation = observation.to(simulator.rest_positions)
        if not isinstance(observation, WholeState):
            self._check_sparse(observation)
        self._constants = simulator.prepare()

    def _check_sparse(self, observation: Observation) -> None:
        if not self.regularisation > 0.0:
            raise InputError(
                f"reconstruction.regularisation is {self.regularisation:g}: it must be positive, as markers do not "
                "determine the whole force."
            )
        last = self.simulator.body.n_vertices - 1
        markers = getattr(observation, "markers", observation)
        if isinstance(markers, Markers) and not 0 <= int(markers.vertices.min()) <= int(markers.vertices.max()) <= last:
            raise InputError(f"a marker is on a vertex that the body does not have: its vertices are 0 to {last}.")

    def with_constants(self, constants: Constants) -> Self:
        """Returns the method with constants in place of the simulator's own."""
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
        """Reconstructs the force of a step from a state to an observation.

        Args:
            state: at the start of the step.
            observed: (B, M, D) measured points, NaN where a point was not seen [unit].
            inputs: during the step; an external force is added to the reconstructed one.
            first_guess: (B, N, 3) initial guess of the force, such as that of the last step [N]; not all methods use
                it.

        Raises:
            ConvergenceError: the method did not converge.
        """


class LeastSquares(Reconstructor):
    """Gauss-Newton or Levenberg-Marquardt; ``tolerance`` is the last change of any position [m].

    Where one formulation does not converge, such as full steps far from the state without the force, the next is used.

    Args:
        problems: formulations of the same minimum, the fastest first.
        modes: number of columns of B; any force on the free vertices if None.
        settings: see `Reconstructor`.
    """

    def __init__(self, problems: Sequence[type[StepProblem]], modes: int | None, *settings: Any) -> None:
        super().__init__(*settings)
        self._problems = tuple(problems)
        self._basis = None if modes is None else vibration_modes(self.simulator, modes)

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
    ) -> Reconstruction:
        acting, constants = inputs or Inputs(), self._constants
        step = (self.simulator, constants, state, acting, observed, self.regularisation, self.observation)
        with threads_for(state.q[0].numel()), torch.no_grad():
            for number, kind in enumerate(self._problems, 1):
                problem = kind(*step, self._basis, self.tolerance)
                result = minimise(problem, problem.start(first_guess), self.tolerance, self.max_iterations)
                if result.converged or number == len(self._problems):
                    break
                log.info("full steps moved by %.1e m after %d: damped ones follow", result.last_step, result.iterations)
            x, force = (values.to(self.simulator.dtype) for values in problem.solution(result.point))
            if not result.converged:
                raise ConvergenceError(
                    f"{problem.method} reconstruction moved by {result.last_step:.1e} m in its last iteration, the "
                    f"{result.iterations}th: raise {problem.remedies}.",
                    x,
                    None,
                )
            return Reconstruction(problem.without_force().finish(x), force, result.iterations)


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
        sim, like, acting = self.simulator, state.q, inputs or Inputs()
        free = sim.rest_positions.new_ones(sim.body.n_vertices, 1)
        free[sim.fixed] = 0.0
        whole = isinstance(self.observation, WholeState)

        def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
            force = torch.as_tensor(values, device=like.device, dtype=like.dtype).reshape(like.shape)
            force.requires_grad_(True)
            end = sim.step(state, acting.plus(free * force), self._constants).q
            residual = self.observation.residual(self.observation(end), observed)
            misfit = (free * residual if whole else residual).square().sum()
            value = misfit + self.regularisation * force.square().sum()
            (gradient,) = torch.autograd.grad(value, force)
            # Divided by lambda, the objective and its change have the magnitude of f^2.
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
        if result.status == 1:  # An early end of the line search is no failure: the change is down to rounding.
            raise ConvergenceError(
                f"L-BFGS-B found no minimum in {result.nit} iterations: raise reconstruction.max_iterations, "
                "reconstruction.tolerance or reconstruction.regularisation.",
                like,
                None,
            )
        force = free * sim.tensor(result.x.reshape(like.shape))
        with torch.no_grad():
            new = sim.step(state, acting.plus(force), self._constants)
        return Reconstruction(new, force, int(result.nit))


def follow(
    method: Reconstructor, state: State, targets: Iterable[torch.Tensor], inputs: Inputs | None = None
) -> Iterator[Reconstruction]:
    """Yields the steps that bring bodies to observed points; each starts from the force of the last one.

    Args:
        method: reconstruction method.
        state: at the start.
        targets: (B, M, D) measured points at the end of each step [unit].
        inputs: of the steps.
    """

    def step(last: Reconstruction, now: tuple[int, torch.Tensor]) -> Reconstruction:
        number, observed = now
        with torch.enable_grad():
            result = method.step(last.state, observed, None if inputs is None else inputs.at(number), last.force)
        return Reconstruction(result.state.detach(), result.force.detach(), result.iterations)

    start = Reconstruction(state, torch.zeros_like(state.q), 0)
    return islice(states(step, start, enumerate(targets)), 1, None)


def without_ringing(simulator: Simulator, observation: Observation) -> Simulator:
    """Returns the simulator, with BDF2 in place of the midpoint rule where markers are observed.

    Velocities of the midpoint rule ring: v+ = 2 (q+ - q) / h - v keeps every deviation.
    """
    rings = simulator.integrator == "midpoint" and not isinstance(observation, WholeState)
    return replace(simulator, integrator="bdf2") if rings else simulator


def make_reconstructor(
    simulator: Simulator,
    method: str,
    regularisation: float,
    tolerance: float,
    max_iterations: int,
    modes: int | None = None,
    observation: Observation = WHOLE_STATE,
) -> Reconstructor:
    """Returns the reconstruction method of a name.

    Args:
        simulator: to correct.
        method: ``gauss_newton``, ``lbfgsb``, or for markers ``levenberg_marquardt``.
        regularisation: lambda, positive for sparse observations [unit^2/N^2].
        tolerance: see the methods.
        max_iterations: of a step, after which it has failed.
        modes: number of vibration modes that span the forces; any force on the free vertices if None.
        observation: C, for as many environments as the states have.

    Raises:
        InputError: an unknown method, modes for a method without them, a number out of range, or a marker on a vertex
            that the body does not have.
    """
    problems: dict[str, tuple[type[StepProblem], ...]] = {"gauss_newton": (FullStateProblem,)}
    if not isinstance(observation, WholeState):
        damped = (MarkerForceProblem,)
        problems = {"gauss_newton": (MarkerPositionProblem, *damped), "levenberg_marquardt": damped}
    if method not in (*problems, "lbfgsb"):
        raise InputError(f"reconstruction.method is {method!r}: choose one of {', '.join(problems)}, lbfgsb.")
    if modes is not None and isinstance(observation, WholeState):
        raise InputError("reconstruction.modes is for bodies that are seen through markers: leave it out.")
    if modes is not None and method == "lbfgsb":
        raise InputError(f"{modes} modes are asked for, but reconstruction.method=lbfgsb has none: take gauss_newton.")
    settings = (simulator, observation, regularisation, tolerance, max_iterations)
    return LBFGSB(*settings) if method == "lbfgsb" else LeastSquares(problems[method], modes, *settings)
