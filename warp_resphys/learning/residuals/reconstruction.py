r"""Reconstruction of residual forces from observed states or sparse markers.

For each step of an observed trajectory, find the force f that minimises

    |C q+(f) - y|^2 + lambda |f|^2

with q+ the simulator's next positions, y the observation, and C the map from positions to markers,
linear or not; the identity for full states. The next step starts from the reconstructed state, not
from the observed one, so that the forces reproduce the trajectory in closed loop. With sparse
markers, the second term sets the components of f that the markers do not determine to zero.
"""

import copy
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from typing import Any, Final, Self

import numpy as np
import scipy.optimize
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ...core.dynamics.simulator import Constants, Simulator
from ...core.linalg.least_squares import minimise
from ...core.linalg.threads import threads_for
from ...core.stepping.inputs import Acts, Inputs
from ...core.stepping.rollout import states
from ...core.stepping.state import State
from ...data.markers import WHOLE_STATE, Markers, Observation, WholeState
from ...io.arrays import Brief
from ...io.errors import ConvergenceError, InputError, checks_types
from ...io.parts import Arrays, Parts, Report, TrialPart, cut
from ...settings.learning import ReconstructionSettings
from ..metrics import mean_distance
from ..observed_motions import Identified, ObservedMotions
from .reconstruction_problems import (
    FullStateProblem,
    MarkerForceProblem,
    MarkerPositionProblem,
    Read,
    StepProblem,
    load_reader,
)

log = logging.getLogger(__name__)

UNITS: Final = {"q": "m", "v": "m/s", "force": "N", "error": "mm"}
_STATIC_STEP = 1e6  # s, time step for static poses, in which inertia is negligible


@dataclass(frozen=True)
class ReconstructedStep(Brief):
    """One reconstructed step."""

    state: State  # after the step with the force
    force: torch.Tensor  # (B, N, 3) [N]; zero at fixed vertices
    iterations: int  # of the optimisation


class Reconstructor(ABC):
    """Finds residual forces for a simulator; see `make_reconstructor`."""

    def __init__(
        self,
        simulator: Simulator,
        settings: ReconstructionSettings,
        observation: Observation,
        acts: Acts,
    ) -> None:
        self.simulator = simulator
        self.settings = settings
        self.acts = acts
        self.regularisation = settings.regularisation
        self.observation = observation.to(simulator.rest_positions)
        if not isinstance(observation, WholeState):
            self._check_sparse(observation)
        self._constants = simulator.prepare()

    def _check_sparse(self, observation: Observation) -> None:
        if not self.regularisation > 0.0:
            raise InputError(
                f"reconstruction.regularisation is {self.regularisation:g}: it must be positive, "
                "as markers do not determine the whole force."
            )
        last = self.simulator.body.n_vertices - 1
        markers = getattr(observation, "markers", observation)
        if (
            isinstance(markers, Markers)
            and not 0 <= int(markers.vertices.min()) <= int(markers.vertices.max()) <= last
        ):
            raise InputError(
                "a marker is on a vertex that the body does not have: "
                f"its vertices are 0 to {last}."
            )

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
        read: Read | None = None,
    ) -> ReconstructedStep:
        """Reconstructs the force of a step from a state to an observation.

        Args:
            state: at the start of the step.
            observed: (B, M, D) measured points, NaN where a point was not seen [unit].
            inputs: during the step; a force in them acts beside the reconstructed one.
            first_guess: (B, N, 3) initial guess of the force, such as that of the last step [N];
                not all methods use it.
            read: errors of force sensors after the step.

        Raises:
            ConvergenceError: the method did not converge.
        """


class LeastSquares(Reconstructor):
    """Gauss-Newton or Levenberg-Marquardt; ``tolerance`` is the last change of any position [m].

    Where one formulation does not converge, such as full steps far from the state without the
    force, the next is used.

    Args:
        problems: formulations of the same minimum, the fastest first.
        arguments: see `Reconstructor`.
    """

    def __init__(self, problems: Sequence[type[StepProblem]], *arguments: Any) -> None:
        super().__init__(*arguments)
        self._problems = tuple(problems)

    @override
    def step(
        self,
        state: State,
        observed: torch.Tensor,
        inputs: Inputs | None = None,
        first_guess: torch.Tensor | None = None,
        read: Read | None = None,
    ) -> ReconstructedStep:
        acting, constants = inputs or Inputs(), self._constants
        step = (
            self.simulator,
            constants,
            state,
            acting,
            observed,
            self.regularisation,
            self.observation,
        )
        with threads_for(state.q[0].numel()), torch.no_grad():
            for number, kind in enumerate(self._problems, 1):
                problem = kind(*step, self.settings.tolerance, read, self.acts)
                result = minimise(
                    problem,
                    problem.start(first_guess),
                    self.settings.tolerance,
                    self.settings.max_iterations,
                )
                if result.converged or number == len(self._problems):
                    break
                log.info(
                    "full steps moved by %.1e m after %d: damped ones follow",
                    result.last_step,
                    result.iterations,
                )
            x, force = (
                values.to(self.simulator.dtype) for values in problem.solution(result.point)
            )
            if not result.converged:
                raise ConvergenceError(
                    f"{problem.method} reconstruction moved by {result.last_step:.1e} m in its "
                    f"last iteration, the {result.iterations}th: raise {problem.remedies}.",
                    x,
                    None,
                )
            return ReconstructedStep(problem.without_force().finish(x), force, result.iterations)


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
        read: Read | None = None,
    ) -> ReconstructedStep:
        sim = self.simulator
        like = state.q
        acting = inputs or Inputs()
        free = sim.rest_positions.new_ones(sim.body.n_vertices, 1)
        free[sim.fixed] = 0.0
        whole = isinstance(self.observation, WholeState)

        def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
            force = torch.as_tensor(values, device=like.device, dtype=like.dtype).reshape(
                like.shape
            )
            force.requires_grad_(True)
            end = sim.step(state, acting.plus(free * force, self.acts), self._constants)
            residual = self.observation.residual(self.observation(end.q), observed)
            misfit = (free * residual if whole else residual).square().sum()
            misfit = misfit if read is None else misfit + read(end).square().sum()
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
            options={
                "maxiter": self.settings.max_iterations,
                "maxcor": 30,
                "ftol": self.settings.tolerance,
                "gtol": 0.0,
            },
        )
        if result.status == 1:
            # An early end of the line search is no failure: the change is down to rounding.
            raise ConvergenceError(
                f"L-BFGS-B found no minimum in {result.nit} iterations: raise "
                "reconstruction.max_iterations, reconstruction.tolerance or "
                "reconstruction.regularisation.",
                like,
                None,
            )
        force = free * sim.tensor(result.x.reshape(like.shape))
        with torch.no_grad():
            new = sim.step(state, acting.plus(force, self.acts), self._constants)
        return ReconstructedStep(new, force, int(result.nit))


def follow(
    method: Reconstructor,
    state: State,
    targets: Iterable[torch.Tensor],
    inputs: Inputs | None = None,
    read: Callable[[State, State, int], torch.Tensor] | None = None,
) -> Iterator[ReconstructedStep]:
    """Yields the steps that bring bodies to observed points.

    Each starts from the force of the last one.

    Args:
        method: reconstruction method.
        state: at the start.
        targets: (B, M, D) measured points at the end of each step [unit].
        inputs: of the steps.
        read: errors of force sensors (B, C) [m] from the states before and after the step of a
            number.
    """

    def step(last: ReconstructedStep, now: tuple[int, torch.Tensor]) -> ReconstructedStep:
        number, observed = now
        sensed = None if read is None else lambda after: read(last.state, after, number)
        with torch.enable_grad():
            acting = None if inputs is None else inputs.at(number)
            result = method.step(last.state, observed, acting, last.force, sensed)
        return ReconstructedStep(result.state.detach(), result.force.detach(), result.iterations)

    start = ReconstructedStep(state, torch.zeros_like(state.q), 0)
    return islice(states(step, start, enumerate(targets)), 1, None)


def without_ringing(simulator: Simulator, observation: Observation) -> Simulator:
    """Returns the simulator, with BDF2 in place of the midpoint rule where markers are observed.

    Velocities of the midpoint rule ring: v+ = 2 (q+ - q) / h - v keeps every deviation.
    """
    rings = simulator.integrator == "midpoint" and not isinstance(observation, WholeState)
    return replace(simulator, integrator="bdf2") if rings else simulator


def make_reconstructor(
    simulator: Simulator,
    settings: ReconstructionSettings,
    observation: Observation = WHOLE_STATE,
    acts: Acts = "internal",
) -> Reconstructor:
    """Returns the reconstruction method that settings name.

    Args:
        simulator: to correct.
        settings: method and tolerances; ``levenberg_marquardt`` is for markers, which need a
            positive regularisation.
        observation: C, for as many environments as the states have.
        acts: where the force acts; force sensors feel an ``external`` one.

    Raises:
        InputError: a method that does not fit the observation, or a marker on a vertex that the
            body does not have.
    """
    problems: dict[str, tuple[type[StepProblem], ...]] = {"gauss_newton": (FullStateProblem,)}
    method = settings.method
    if not isinstance(observation, WholeState):
        damped = (MarkerForceProblem,)
        problems = {"gauss_newton": (MarkerPositionProblem, *damped), "levenberg_marquardt": damped}
    if method not in (*problems, "lbfgsb"):
        raise InputError(
            f"reconstruction.method is {method!r}: choose one of {', '.join(problems)}, lbfgsb."
        )
    arguments = (simulator, settings, observation, acts)
    return LBFGSB(*arguments) if method == "lbfgsb" else LeastSquares(problems[method], *arguments)


@dataclass(frozen=True)
class ReconstructedTrials(Brief):
    """Reconstructed states and forces of R trials.

    Attributes:
        names: of the trials.
        read: returns an array of all trials by its name: ``q`` (R, K + 1, N, 3) [m], ``v`` [m/s],
            ``force`` [N], that of the step that ends in a state, zero in the first one, and
            ``error`` (R, K + 1), the mean distance of the observed points that were reached [mm].
    """

    names: tuple[str, ...]
    read: Callable[[str], NDArray[Any]]

    def of(self, names: Sequence[str], *arrays: str) -> list[NDArray[Any]]:
        """Returns some arrays of some trials.

        Raises:
            InputError: a trial was not reconstructed.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise InputError(
                f"the trial {missing[0]!r} was not reconstructed: there are "
                f"{', '.join(self.names)}."
            )
        rows = [self.names.index(name) for name in names]
        index = slice(rows[0], rows[-1] + 1) if rows == [*range(rows[0], rows[-1] + 1)] else rows
        return [self.read(name)[index] for name in arrays]


@checks_types
def reconstruct(
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str] | None = None,
    *,
    parameters: Identified | Mapping[str, float] | None = None,
    settings: ReconstructionSettings | None = None,
    acts: Acts = "internal",
    parts: Parts | None = None,
) -> ReconstructedTrials:
    """Finds the forces with which a simulator follows observed motions, step by step.

    Args:
        simulator: to correct. With markers, BDF2 replaces the midpoint rule.
        motions: observed states or markers.
        names: of the trials; all by default.
        parameters: values in place of the simulator's, such as `Identification.parameters`.
        settings: method, regularisation [unit^2/N^2], tolerance and iterations; the defaults of the
            class if None.
        acts: ``internal``, or ``external`` as of water or an obstacle that the simulator lacks:
            this a force sensor feels. The network must have the same (`NetworkSettings.acts`).
        parts: workers and files of the work; this process and its memory if None.

    Raises:
        InputError: a setting out of range, or an input that the body does not take.
        ConvergenceError: a step without a solution.
    """
    parts, known = parts or Parts("reconstruct"), Identified.of(parameters)
    used, wanted = without_ringing(simulator, motions.observe), settings or ReconstructionSettings()
    cut_up = list[TrialPart]()
    for number, whole in enumerate(motions.trials.batches(motions.trials.chosen(names))):
        frames = (
            motions.learned_steps(int(motions.trials.seconds(whole) / used.time_step + 1e-6)) + 1
        )
        for first, batch in cut(whole, parts.batch):
            work = partial(_reconstructed, used, motions, batch, known, wanted, acts)
            cut_up.append(TrialPart(f"part{number}_{first:03d}", batch, frames, work))
    parts.run(cut_up)
    order = chain.from_iterable(part.names for part in cut_up)
    return ReconstructedTrials(tuple(order), partial(parts.joined, cut_up))


def _reconstructed(
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str],
    identified: Identified,
    settings: ReconstructionSettings,
    acts: Acts,
    report: Report,
) -> Arrays:
    """Reconstruction of trials that begin in the same way, see `ReconstructedTrials`.

    Forces from markers are in single precision, which rounds positions to 1e-8 m. A copy of the
    simulator is used, so that results do not depend on other parts.
    """
    simulator = replace(simulator)
    replay = motions.replay(simulator, names, identified)
    start = motions.start(replay, identified)
    constants, inputs, resting = replay.prepare(identified.values(simulator))
    observed = motions.targets(replay, start)
    state = replay.initial_state(start, constants, resting)
    if replay.is_static:  # One very long step leads to the static pose.
        simulator = replace(simulator, time_step=_STATIC_STEP, integrator="implicit_euler")
        observed = torch.cat([torch.full_like(observed, torch.nan), observed], 1)
        inputs = resting
    method = make_reconstructor(simulator, settings, replay.observe, acts)
    reached, forces = [state], [torch.zeros_like(state.q)]
    report()
    prepared = replay.prepare(identified.values(replay.simulator))
    sensed = load_reader(replay, start, state, prepared, observed.shape[1])
    for step in follow(
        method.with_constants(constants), state, observed[:, 1:].unbind(1), inputs, sensed
    ):
        reached.append(step.state)
        forces.append(step.force)
        report(iterations=step.iterations)
    points = torch.stack([replay.observe(state.q) for state in reached], 1).cpu().numpy()
    series = {
        "q": [state.q for state in reached],
        "v": [state.v for state in reached],
        "force": forces,
    }
    arrays = {name: torch.stack(values, 1).cpu().numpy() for name, values in series.items()}
    arrays["error"] = mean_distance(points, observed.cpu().numpy())
    dtype = "float64" if motions.sees_states else "float32"
    return {name: (values.astype(dtype), UNITS[name]) for name, values in arrays.items()}
