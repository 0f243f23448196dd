"""A step's residual force as a problem of least squares, for full states and for sparse markers."""

import math
from abc import abstractmethod

import torch
from typing_extensions import override

from ..data.markers import Markers
from ..dynamics.inputs import Inputs
from ..dynamics.integrator import State
from ..dynamics.linearisation import Linearisation
from ..dynamics.simulator import Constants, Simulator
from ..io.errors import ConvergenceError
from ..linalg.conjugate_gradients import conjugate_gradients
from ..linalg.least_squares import Point, Problem, Step, ridge


class StepProblem(Problem):
    """A step whose force is looked for; points are as far apart as the positions of their stages [m]."""

    @abstractmethod
    def start(self, first_guess: torch.Tensor | None) -> Point:
        """Where to start, perhaps at a force (B, N, 3) [N]."""

    @abstractmethod
    def reached(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, N, 3) solution x of the stage [m], and the force [N]."""

    @override
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        return (self.reached(new)[0] - self.reached(old)[0]).abs().amax((1, 2))


class FullStateProblem(StepProblem):
    """|x - x*|^2 + w |g(x)|^2 over positions x, g(x) being the force that the step lacks to end there.

    With H = dg/dx, a step of Gauss-Newton solves

        (I + w H^2) dx = -(x - x*) - w H g(x)

    by conjugate gradients, preconditioned with (I + sqrt(w) H)^2: for every eigenvalue h of H the quotient
    (1 + w h^2) / (1 + sqrt(w) h)^2 lies between 1/2 and 1, so that a dozen iterations do for any w. Damping is in units
    of the matrix on the left: it shortens the step to dx / (1 + d).

    Args:
        step: the step without a force.
        target: (B, N, 3) x* [m].
        weight: w [m^2/N^2].
    """

    def __init__(self, step: Linearisation, target: torch.Tensor, weight: float) -> None:
        self._step, self._target, self._weight = step, target, weight

    @override
    def start(self, first_guess: torch.Tensor | None) -> Point:
        return self.evaluate(self._target)

    @override
    def reached(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        return point.x, point.kept[0]

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        force = self._step.residual(x)
        missed = (x - self._target).square().sum((1, 2))
        return Point(x, missed + self._weight * force.square().sum((1, 2)), (force,))

    @override
    def linearise(self, point: Point) -> Step:
        step, weight, x, (force,) = self._step, self._weight, point.x, point.kept
        step.update(x)
        factor = step.shifted(math.sqrt(weight))

        def preconditioner(r: torch.Tensor) -> torch.Tensor:
            right = r[:, step.free].reshape(len(r), -1, 1)
            solved = factor.solve(factor.solve(right)).reshape(len(r), -1, 3)
            return torch.zeros_like(r).index_copy(1, step.free, solved)

        change = conjugate_gradients(
            lambda d: d + weight * step.product(step.product(d)),
            preconditioner,
            self._target - x - weight * step.product(force),
            tolerance=1e-6,
        )
        return lambda damping: x + change / (1.0 + damping)[:, None, None]


class MarkerProblem(StepProblem):
    """What both problems of sparse markers see of a body.

    Args:
        markers: C, for as many environments as the states have.
        observed: (B, m, 3) y, NaN where a marker was not seen [m].
        weight: w [m^2/N^2].
    """

    def __init__(self, markers: Markers, observed: torch.Tensor, weight: float) -> None:
        self._markers, self._observed, self._weight = markers, observed, weight
        self._seen = torch.isfinite(observed)

    def _missing(self, end: torch.Tensor) -> torch.Tensor:
        """(B, 3 m, 1) y - C(q+), zero where not seen [m]."""
        return torch.where(self._seen, self._observed - self._markers(end), 0.0).flatten(1)[..., None]

    def _transposed_jacobian(self, end: torch.Tensor) -> torch.Tensor:
        """(B, 3 N, 3 m) C'^T of the markers that were seen."""
        return self._markers.transposed_jacobian(end) * self._seen.flatten(1)[:, None]


class MarkerPositionProblem(MarkerProblem):
    """Positions and forces at once, by full steps.

    The step with a force f ends where the residual g of the step without it equals f. Linearised at an iterate x, with
    the exact Hessian H = dg/dx, that is

        x+ = x - H^-1 g + H^-1 f

    so that f solves a ridge regression with J = C' H^-1 and r = y - C(x) + C' H^-1 g, C' being the derivative of C:
    f = J^T (J J^T + w I)^-1 r. One factorisation and 3 m + 2 back-substitutions an iteration, no inner solve, and at
    convergence f = g(x) holds as it does for a step of the simulator. Restricted to forces B a with orthonormal columns
    B (see `vibration_modes`), J is C' H^-1 B, which takes a back-substitution a column where these are fewer.

    Where x stands at a fraction e of the time step, q+ moves 1/e times as far as x, so that e (y - C(q+)) takes the
    place of y - C(x), and w e^2 that of w. The objective is zero everywhere: every step is taken.

    Args:
        step: the step without a force.
        markers: see `MarkerProblem`, as the others.
        observed: the same.
        weight: w.
        basis: (3 N, modes) B; None for every force on the free vertices.
    """

    def __init__(
        self,
        step: Linearisation,
        markers: Markers,
        observed: torch.Tensor,
        weight: float,
        basis: torch.Tensor | None = None,
    ) -> None:
        super().__init__(markers, observed, weight)
        self._step, self._basis = step, basis

    @override
    def start(self, first_guess: torch.Tensor | None) -> Point:
        return self.evaluate(torch.stack([self._step.start, torch.zeros_like(self._step.start)], 1))

    @override
    def reached(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        return point.x[:, 0], point.x[:, 1]

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        return Point(x, x.new_zeros(len(x)))

    @override
    def linearise(self, point: Point) -> Step:
        x, step, basis = point.x[:, 0], self._step, self._basis
        end = step.finish(x).q
        residual = step.residual(x).reshape(len(x), -1, 1).to(x.dtype)
        step.factorise(x)
        transposed = self._transposed_jacobian(end)
        columns = transposed
        if basis is not None and basis.shape[1] < transposed.shape[2]:
            columns = basis.expand(len(x), -1, -1)
        response, settling = step.solve(torch.cat([columns, residual], dim=2)).tensor_split([-1], dim=2)
        jacobian = response.mT if columns is transposed else transposed.mT @ response
        if basis is not None and columns is transposed:
            jacobian = jacobian @ basis
        right = step.stage.end * self._missing(end) + transposed.mT @ settling
        force = ridge(jacobian, right, self._weight * step.stage.end**2)
        force = force if basis is None else basis @ force
        new = x + (step.solve(force) - settling).view_as(x)
        return lambda _: torch.stack([new, force.view_as(x)], 1)


class MarkerForceProblem(MarkerProblem):
    """Forces, each followed by a whole step of the simulator, so that an iterate is always a state that it reaches.

    With J = C' H^-1 there, the next force minimises |r - J (f - f0)|^2 + w |f|^2 + d w |f - f0|^2.

    Args:
        simulator: makes the steps.
        constants: of the simulator.
        state: where the step starts.
        inputs: what acts during it.
        markers: see `MarkerProblem`, as the others.
        observed: the same.
        weight: w.
    """

    def __init__(
        self,
        simulator: Simulator,
        constants: Constants,
        state: State,
        inputs: Inputs,
        markers: Markers,
        observed: torch.Tensor,
        weight: float,
    ) -> None:
        super().__init__(markers, observed, weight)
        self._simulator, self._constants, self._state, self._inputs = simulator, constants, state, inputs

    @override
    def start(self, first_guess: torch.Tensor | None) -> Point:
        """A first guess that the simulator does not follow is left."""
        if first_guess is not None and bool(torch.isfinite((found := self.evaluate(first_guess)).value).all()):
            return found
        return self.evaluate(torch.zeros_like(self._state.q))

    @override
    def reached(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        return self._simulator.method.solution_for(self._state, point.kept[0]), point.x

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        try:
            end = self._simulator.step(self._state, self._inputs.plus(x), self._constants)[0].q
        except ConvergenceError:
            return Point(x, x.new_full((len(x),), torch.inf), (self._state.q,))
        value = self._missing(end).square().sum((1, 2)) + self._weight * x.square().sum((1, 2))
        return Point(x, value, (end,))

    @override
    def linearise(self, point: Point) -> Step:
        force, (end,) = point.x.flatten(1)[..., None], point.kept
        step = self._simulator.linearise(self._state, self._inputs, self._constants)
        step.factorise(self.reached(point)[0])
        # q+ moves 1 / end times as far as the solution.
        jacobian = step.solve(self._transposed_jacobian(end)).mT / step.stage.end
        missing = self._missing(end)

        def damped_step(damping: torch.Tensor) -> torch.Tensor:
            own = (1.0 + damping)[:, None, None]
            centre = force - force / own
            change = ridge(jacobian, missing + jacobian @ (force / own), self._weight * own)
            return (centre + change).view_as(point.x)

        return damped_step
