"""Least-squares problems for the residual force of a step, from full states or sparse markers."""

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar

import torch
from typing_extensions import override

from ...core.dynamics.linearisation import Linearisation
from ...core.dynamics.simulator import Constants, Simulator
from ...core.linalg.conjugate_gradients import LinearMap, conjugate_gradients
from ...core.linalg.least_squares import Move, Point, Problem, ridge
from ...core.stepping.inputs import Acts, Inputs
from ...core.stepping.state import State
from ...data.markers import WHOLE_STATE, Observation, WholeState
from ...io.errors import ConvergenceError, InputError
from ..replay import Prepared, Replay
from ..sensing import loads_at_steps
from ..start import Start

# Errors of readings in the state after a step, (B, C) as lengths [m].
Read = Callable[[State], torch.Tensor]

_SHORT = 0.1  # of the tolerance: length of a step of Gauss-Newton that needs no check


@dataclass(eq=False)
class StepProblem(Problem):
    """A step whose force is unknown.

    The distance of two iterates is that of their stage positions [m].
    """

    method: ClassVar[str]
    remedies: ClassVar[str] = "reconstruction.regularisation or reconstruction.max_iterations"

    simulator: Simulator
    constants: Constants  # of the simulator
    state: State  # at the start of the step
    inputs: Inputs  # during the step
    observed: torch.Tensor  # (B, M, D) points at its end, NaN where not seen [unit]
    weight: float  # lambda [unit^2/N^2]
    observation: Observation = WHOLE_STATE  # C, for as many environments as the state has
    tolerance: float = 0.0  # of the distance of two iterates at the minimum [m]
    read: Read | None = None  # of force sensors, differentiable; C' below then has C more rows
    acts: Acts = "internal"  # where the force acts: sensors feel an external one

    def __post_init__(self) -> None:
        """Linearises the step."""
        self._step = self.without_force()

    def without_force(self) -> Linearisation:
        """Returns the linearisation of the step without a residual force."""
        return self.simulator.linearise(self.state, self.inputs, self.constants)

    def missing(self, end: State) -> torch.Tensor:
        """Returns y - C(q+), and the same of readings, (B, M D + C, 1) [unit], zero where not
        seen.
        """
        seen = -self.observation.residual(self.observation(end.q), self.observed).flatten(1)
        return (seen if self.read is None else torch.cat([seen, -self.read(end)], 1))[..., None]

    def transposed_jacobian(self, step: Linearisation, x: torch.Tensor) -> torch.Tensor:
        """Returns C'^T, (B, 3 N, M D + C), zero for points that were not seen,
        at positions x of the stage [m].

        Derivatives of readings by x are those by q+, which moves 1 / e times as far
        (`MarkerPositionProblem`).
        """
        seen = torch.isfinite(self.observed).all(-1, keepdim=True).expand_as(self.observed)
        points = torch.where(
            seen.flatten(1)[:, None], self.observation.transposed_jacobian(step.finish(x).q), 0.0
        )
        if self.read is None:
            return points
        with torch.enable_grad():
            at = x.detach().requires_grad_(True)
            errors = self.read(step.reached(at, self.acts)).unbind(1)
            columns = [
                torch.autograd.grad(one.sum(), at, retain_graph=True)[0].flatten(1)
                for one in errors
            ]
        return torch.cat([points, step.stage.end * torch.stack(columns, 2)], 2)

    def _reached(self, step: Linearisation, x: torch.Tensor) -> State:
        """Returns the state after the step with positions x of the stage [m]."""
        return step.finish(x) if self.read is None else step.reached(x, self.acts)

    @abstractmethod
    def start(self, first_guess: torch.Tensor | None) -> Point:
        """Initial iterate, from a first guess of the force (B, N, 3) [N]."""

    @abstractmethod
    def solution(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions x of the stage (B, N, 3) [m], and the force (B, N, 3) [N]."""

    @override
    def distance(self, old: Point, new: Point) -> torch.Tensor:
        return (self.solution(new)[0] - self.solution(old)[0]).abs().amax((1, 2))


class FullStateProblem(StepProblem):
    """|x - x*|^2 + w |g(x)|^2 over positions x, with g(x) the residual force
    with which the step ends there.

    With H = dg/dx, a step of Gauss-Newton solves

        (I + w H^2) dx = -(x - x*) - w H g(x)

    by conjugate gradients, preconditioned with (I + sqrt(w) H)^2: for every eigenvalue h of H the
    quotient (1 + w h^2) / (1 + sqrt(w) h)^2 lies between 1/2 and 1, so that a dozen iterations
    suffice for any w. The preconditioned gradient is thus between a half of the step and the step:
    where it is far below the tolerance, with the factor of the iterate before, it is the last step,
    without a new factor. Damping d is relative to the matrix on the left: it shortens the step to
    dx / (1 + d). The search starts at x*.

    Where x stands at a fraction e of the time step, |q+ - q*| is |x - x*| / e: w is lambda e^2.
    """

    method = "Gauss-Newton"
    remedies = "reconstruction.max_iterations or reconstruction.tolerance"

    @override
    def __post_init__(self) -> None:
        if not bool(torch.isfinite(self.observed).all()):
            raise InputError(
                "Gauss-Newton needs the positions of all vertices, but some were not seen: "
                "observe those that were as markers (MarkerMap.at_vertices), "
                "or take method=lbfgsb."
            )
        super().__post_init__()
        self._target = self._step.hold(
            self.simulator.method.solution_for(self.state, self.observed)
        )
        self._weight = self.weight * self._step.stage.end**2
        self._inverse: LinearMap | None = None

    @override
    def start(self, first_guess: torch.Tensor | None) -> Point:
        return self.evaluate(self._target)

    @override
    def solution(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        return point.x, point.kept[0]

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        force = self._step.residual(x)
        misfit = (x - self._target).square().sum((1, 2))
        return Point(x, misfit + self._weight * force.square().sum((1, 2)), (force,))

    @override
    def linearise(self, point: Point) -> Move:
        step, weight = self._step, self._weight
        x = point.x
        (force,) = point.kept
        short = _SHORT * self.tolerance
        step.update(x)
        right = self._target - x - weight * step.product(force)
        if self._inverse is not None:
            last = self._inverse(right)
            if float(last.abs().max()) <= short:
                return lambda damping: x + last / (1.0 + damping)[:, None, None]
        factor = step.shifted(math.sqrt(weight))

        def inverse(r: torch.Tensor) -> torch.Tensor:
            fields = r[:, step.free].reshape(len(r), -1, 1)
            solved = factor.solve(factor.solve(fields)).reshape(len(r), -1, 3)
            return torch.zeros_like(r).index_copy(1, step.free, solved)

        self._inverse = inverse
        change = conjugate_gradients(
            lambda d: d + weight * step.product(step.product(d)),
            inverse,
            right,
            tolerance=1e-6,
            shortest=0.5 * short,
        ).x
        return lambda damping: x + change / (1.0 + damping)[:, None, None]


class MarkerPositionProblem(StepProblem):
    """|y - C(q+)|^2 + lambda |f|^2 over positions and forces at once, by full Gauss-Newton steps.

    The step with a force f ends where the residual g of the step without it equals f. Linearised at
    an iterate x, with the exact Hessian H = dg/dx, that is

        x+ = x - H^-1 g + H^-1 f

    so that f solves a ridge regression with J = C' H^-1 and r = y - C(x) + C' H^-1 g, C' being the
    derivative of C: f = J^T (J J^T + lambda I)^-1 r. One factorisation and 3 m + 2
    back-substitutions an iteration, no inner solve, and at convergence f = g(x) holds as it does
    for a step of the simulator.

    Where x stands at a fraction e of the time step, q+ moves 1/e times as far as x, so that
    e (y - C(q+)) replaces y - C(x), and lambda e^2 replaces lambda. The objective is set to zero,
    so that every step is accepted.
    """

    method = "sparse Gauss-Newton"

    @override
    def start(self, first_guess: torch.Tensor | None) -> Point:
        return self.evaluate(torch.stack([self._step.start, torch.zeros_like(self._step.start)], 1))

    @override
    def solution(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        return point.x[:, 0], point.x[:, 1]

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        return Point(x, x.new_zeros(len(x)))

    @override
    def linearise(self, point: Point) -> Move:
        x, step = point.x[:, 0], self._step
        transposed = self.transposed_jacobian(step, x)
        missing = self.missing(self._reached(step, x))
        residual = step.residual(x).reshape(len(x), -1, 1).to(x.dtype)
        step.factorise(x)
        response, settling = step.solve(torch.cat([transposed, residual], dim=2)).tensor_split(
            [-1], dim=2
        )
        right = step.stage.end * missing + transposed.mT @ settling
        force = ridge(response.mT, right, self.weight * step.stage.end**2)
        new = x + (step.solve(force) - settling).view_as(x)
        return lambda _: torch.stack([new, force.view_as(x)], 1)


class MarkerForceProblem(StepProblem):
    """|y - C(q+)|^2 + lambda |f|^2 over forces, for motions with which full steps fail,
    such as jerks of real bodies.

    Each trial force is applied in a whole step of the simulator, with its line search, so that
    every iterate is a state of the simulator. With J = C' H^-1 there, the next force minimises
    |r - J (f - f0)|^2 + lambda |f|^2 + d lambda |f - f0|^2.
    """

    method = "sparse Levenberg-Marquardt"

    @override
    def __post_init__(self) -> None:
        """Nothing is linearised before a whole step is made."""

    @override
    def start(self, first_guess: torch.Tensor | None) -> Point:
        """Starts at zero force where the step fails with the first guess."""
        if first_guess is not None and bool(
            torch.isfinite((point := self.evaluate(first_guess)).value).all()
        ):
            return point
        return self.evaluate(torch.zeros_like(self.state.q))

    @override
    def solution(self, point: Point) -> tuple[torch.Tensor, torch.Tensor]:
        return self.simulator.method.solution_for(self.state, point.kept[0]), point.x

    @override
    def evaluate(self, x: torch.Tensor) -> Point:
        try:
            end = self.simulator.step(self.state, self.inputs.plus(x, self.acts), self.constants)
        except ConvergenceError:
            return Point(x, x.new_full((len(x),), torch.inf), (self.state.q,))
        value = self.missing(end).square().sum((1, 2)) + self.weight * x.square().sum((1, 2))
        return Point(x, value, (end.q,))

    @override
    def linearise(self, point: Point) -> Move:
        force = point.x.flatten(1)[..., None]
        x = self.solution(point)[0]
        step = self.without_force()
        transposed = self.transposed_jacobian(step, x)
        missing = self.missing(self._reached(step, x))
        step.factorise(x)
        # q+ moves 1 / stage.end times as far as x.
        jacobian = step.solve(transposed).mT / step.stage.end

        def damped_step(damping: torch.Tensor) -> torch.Tensor:
            factor = (1.0 + damping)[:, None, None]
            change = ridge(jacobian, missing + jacobian @ (force / factor), self.weight * factor)
            return (force - force / factor + change).view_as(point.x)

        return damped_step


def load_reader(
    replay: Replay, start: Start, begun: State, prepared: Prepared, count: int
) -> Callable[[State, State, int], torch.Tensor] | None:
    """Returns the errors (B, C) of readings after a step of a number, for `follow`.

    None without force sensors.

    In a motion that begins in equilibrium, the zero of a sensor is that with which the first
    reading agrees. A pose with an unknown zero says nothing.

    Args:
        replay: of the trials.
        start: how they begin.
        begun: their initial state.
        prepared: constants and inputs.
        count: number of steps, the start among them.

    Raises:
        InputError: the zero is unknown, and the motion does not begin in equilibrium; or all
            vertices are observed.
    """
    sensors = replay.trials.sensors
    if not sensors:
        return None
    if isinstance(replay.observe, WholeState):
        raise InputError(
            "positions of all vertices determine the forces that are missing: leave the force "
            "sensors out of it."
        )
    constants, inputs, resting = prepared
    inputs = resting if replay.is_static else inputs
    reader, step = replay.changed(simulator=replace(replay.simulator)), replay.simulator.time_step
    loads = loads_at_steps(replay.trials, step, start.delay, 1 if replay.is_static else count)
    for number, sensor in enumerate(sensors):
        if sensor.zero and not start.at_rest:
            raise InputError(
                "a force sensor has a zero, which forces that are missing cannot be told from in "
                "motions that do not begin in equilibrium: "
                "subtract it from the readings, and set zero to 0."
            )
        if sensor.zero:
            first = reader.read(begun, None, resting, constants)[:, number]
            off = torch.nan if replay.is_static else loads[:, 0, number] - first
            loads[:, :, number] -= off if isinstance(off, float) else off[:, None]
    trials = replace(replay.trials, sensors=tuple(replace(sensor, zero=0.0) for sensor in sensors))
    deviations = chain.from_iterable(sensor.deviations for sensor in sensors)
    measured = [*map(math.isfinite, deviations)]

    def read(before: State, after: State, number: int) -> torch.Tensor:
        now = 0 if replay.is_static else number + 1
        sensed = reader.read(after, before, inputs.at(number), constants)[None, :, None]
        at = loads[:, now, None], loads.new_full((after.batch, 1), step * now)
        return trials.load_errors(sensed, at)[0].flatten(1)[:, measured]

    return read
