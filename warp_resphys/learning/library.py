"""Identification, reconstruction, training and evaluation as four functions, without configuration or run folder.

The commands do this work in stages, through files. Here observations are tensors and results stay in memory::

    identified = identify(simulator, motion, {"youngs_modulus": (1e5, 1e6)}).parameters
    samples = reconstruct(simulator, motion, parameters=identified)
    force = fit_force(simulator, samples)
    errors = evaluate(simulator, held_out, force, parameters=identified)

Every function accepts whole states and markers. Forces are in the world's frame. Parameters are the simulator's own
unless others are given. `tests/learning/test_library.py` checks them on a beam.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from ..data.markers import WHOLE_STATE, Observation, WholeState
from ..data.trials import Trials
from ..dynamics.simulator import Simulator
from ..io.errors import InputError
from ..settings.learning import NetworkSettings, ReconstructionSettings, TrainerSettings
from ..stepping.inputs import Inputs
from ..stepping.rollout import rollout
from ..stepping.state import State
from .correction import CorrectedSimulator, LearnedPredictor, Predictor, known_positions
from .identification import Identification, ParameterSearch
from .misfit import Misfit
from .networks import ResidualForce, build_model
from .parameters import Bounds, configured_parameters
from .reconstruction import follow, make_reconstructor, without_ringing
from .replay import Replay, Start
from .training import Samples, Trainer


@dataclass(frozen=True)
class ObservedMotion:
    """B motions of one body, observed at the start and after every time step of the simulator.

    Raises:
        InputError: observations of a wrong shape or number of vertices, or a motion of which nothing was seen.
    """

    # (T + 1, B, M, D) measured points [unit of `observation`], NaN where a point was not seen; by default the positions
    # of all vertices, as in `Trajectory.q`. (T + 1, M, D) is one motion
    observed: torch.Tensor
    # initial positions and velocities; None: at rest in equilibrium under `resting`
    start: State | None = None
    inputs: Inputs = field(default_factory=Inputs)  # during the motion, with or without a time axis
    resting: Inputs = field(default_factory=Inputs)  # before the motion, where `start` is None
    observation: Observation = WHOLE_STATE  # the sensor, such as markers from `bind_markers`

    def __post_init__(self) -> None:
        """Adds the batch axis to a single motion and checks the shape."""
        if self.observed.ndim == 3:
            object.__setattr__(self, "observed", self.observed[:, None])
        dimension, unit = self.observation.dimension, self.observation.unit
        if self.observed.ndim != 4 or self.observed.shape[-1] != dimension or len(self.observed) < 2:
            raise InputError(
                f"observed has shape {tuple(self.observed.shape)}: it must be (time, motion, point, {dimension}) in "
                f"{unit}, of two times or more."
            )

    def replay(self, simulator: Simulator) -> tuple[Replay, Start]:
        """Returns the replay that simulates these motions, and their start."""
        like = simulator.rest_positions
        observed = self.observed.to(like).transpose(0, 1)
        count, frames = observed.shape[:2]
        if isinstance(self.observation, WholeState) and observed.shape[2] != len(like):
            raise InputError(f"{observed.shape[2]} points were observed, but the body has {len(like)} vertices.")
        times = simulator.time_step * torch.arange(frames).to(like).expand(count, -1)
        names = tuple(f"motion {number}" for number in range(count))
        inputs, resting = self.inputs.to(like), self.resting.to(like)
        trials = Trials(names, times, observed, observed[:, 0], inputs, resting)
        if self.start is None:
            start = Start.resting(like.expand(count, -1, -1).clone())
        else:
            start = Start(self.start.map(lambda values: values.to(like)), like.new_zeros(count))
        return Replay(simulator, self.observation.to(like), trials), start


def identify(
    simulator: Simulator,
    motion: ObservedMotion,
    parameters: Mapping[str, Bounds | tuple[float, float]],
    first_guess: Mapping[str, float] | None = None,
    *,
    starts: int = 1,
    max_evaluations: int = 30,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> Identification:
    """Finds the parameters with which a simulator comes closest to observed motions.

    Args:
        simulator: gives all other parameters.
        motion: observed states or markers.
        parameters: range of every parameter to identify, by a name of `Replay.parameter_names`, in its unit. A pair of
            positive numbers is searched on a logarithmic scale.
        first_guess: start of the search; the simulator's own values where left out.
        starts: number of searches; those after the first start at the best of four times as many random candidates.
        max_evaluations: of the loss and its gradient, for each start.
        tolerance: relative decrease of the loss below which a search ends.
        seed: of the random candidates.

    Returns:
        The parameters, the loss, its history, parameters that ended on a bound, and the uncertainty.

    Raises:
        InputError: an unknown parameter, an empty range, or a motion in which nothing moves.
        ConvergenceError: the simulation fails at every start.
    """
    ranges = {n: b if isinstance(b, Bounds) else Bounds(*b, logarithmic=min(b) > 0.0) for n, b in parameters.items()}
    search = ParameterSearch(Misfit([motion.replay(simulator)], ranges))
    guess = {**configured_parameters(simulator, ranges), **(first_guess or {})}
    return search.run(search.starts(guess, starts, 4 * starts, seed), max_evaluations, tolerance=tolerance)


def reconstruct(
    simulator: Simulator,
    motion: ObservedMotion,
    *,
    parameters: Mapping[str, float] | None = None,
    settings: ReconstructionSettings | None = None,
) -> Samples:
    """Finds the forces with which a simulator follows observed motions, step by step.

    Args:
        simulator: to correct. With markers, BDF2 replaces the midpoint rule.
        motion: observed states or markers.
        parameters: values in place of the simulator's own, such as `Identification.parameters`.
        settings: method, regularisation [unit^2/N^2], tolerance and iterations; the defaults of the class.

    Returns:
        The S = B T steps, motion after motion: initial positions (S, N, 3) [m] and velocities (S, N, 3) [m/s], the
        force as the only output (S, N, 3) [N], and the inputs (S, A).

    Raises:
        InputError: a setting out of range, or an input that the body does not take.
        ConvergenceError: a step without a solution.
    """
    used = without_ringing(simulator, motion.observation)
    replay, start = motion.replay(used)
    with torch.no_grad():
        constants, inputs, resting = replay.prepare(_values(used, parameters))
        state = replay.initial_state(start, constants, resting)
        method = make_reconstructor(used, **dict(settings or ReconstructionSettings()), observation=motion.observation)
        method = method.with_constants(constants)
        targets = replay.trials.observed[:, 1:].unbind(1)
        steps = [*follow(method, state, targets, inputs)]
        states = [state, *(step.state for step in steps)][:-1]
        series = ([one.q for one in states], [one.v for one in states], [step.force for step in steps])
        q, v, f = (torch.stack(values, 1).flatten(0, 1) for values in series)
        context = _context(inputs, len(steps))
        actuation = None if context is None else context.transpose(0, 1).flatten(0, 1)
    return Samples(q, v, (f,), actuation, (len(steps),) * replay.trials.observed.shape[0])


def fit_force(
    simulator: Simulator,
    samples: Samples,
    validation: ObservedMotion | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    network: NetworkSettings | None = None,
    trainer: TrainerSettings | None = None,
    seed: int = 0,
) -> ResidualForce:
    """Trains a network that predicts the residual force of a simulator from its state and inputs.

    Args:
        simulator: to correct.
        samples: from `reconstruct`.
        validation: held-out motions, which select the weights with the smallest roll-out error; if None, the weights
            with the smallest loss on the samples are kept.
        parameters: as for `reconstruct`.
        network: kind and size; the defaults of the class if None.
        trainer: epochs, rates and noise; the defaults of the class if None.
        seed: of the weights, batches and noise; torch's global generator is restored.

    Returns:
        The network, to pass to `evaluate`. It maps q (S, N, 3) [m], v (S, N, 3) [m/s] and the inputs (S, A) to forces
        (S, N, 3) [N].

    Raises:
        InputError: sizes that do not fit the samples, or a recurrent network.
    """
    network = network or NetworkSettings()
    trainer = trainer or TrainerSettings()
    if network.recurrent is not None:
        raise InputError("fit_force does not train recurrent networks: leave network.recurrent out.")
    if validation is None:
        trainer = trainer.changed(selection="validation_loss")

    def rollout_error(model: ResidualForce) -> float:
        if validation is None:
            return math.nan
        return 1e3 * float(evaluate(simulator, validation, model, parameters=parameters).nanmean())

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        fields = samples.q, samples.v, samples.outputs[0], samples.actuation
        model = build_model(ResidualForce, network, simulator.rest_positions, *fields)
    trained = Trainer(model, samples, samples, rollout_error, trainer, seed)
    while not trained.finished:
        trained.run_epoch()
    return trained.use_best()


def evaluate(
    simulator: Simulator,
    motion: ObservedMotion,
    force: ResidualForce | Predictor | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
) -> torch.Tensor:
    """Rolls a simulator out from the start of observed motions and measures its error.

    Args:
        simulator: to evaluate.
        motion: observed states or markers.
        force: residual force from `fit_force`, or a function of the state and the number of the step that returns
            forces (B, N, 3) [N]; None for the simulator alone.
        parameters: as for `reconstruct`.

    Returns:
        (T + 1, B) mean distance of the observed points in the unit of the observation, such as m; NaN where none was
        seen, infinite after a simulation diverged.

    Raises:
        InputError: an input that the body does not take.
        ConvergenceError: no initial equilibrium.
    """
    used = replace(simulator, solver=replace(simulator.settings, on_failure="count"))
    replay, start = motion.replay(used)
    observed = replay.trials.observed
    with torch.no_grad():
        constants, inputs, resting = replay.prepare(_values(used, parameters))
        predict: Predictor | None
        if isinstance(force, ResidualForce):
            predict = LearnedPredictor(force, _context(inputs, observed.shape[1] - 1))
        else:
            predict = force
        state = replay.initial_state(start, constants, resting)
        step = CorrectedSimulator(used, predict, inputs, constants).step
        seen = rollout(step, state, range(observed.shape[1] - 1), lambda now: replay.observe(known_positions(now)))
        points = torch.stack(seen, 1)
        distance = replay.observe.residual(points, observed).norm(dim=-1).nan_to_num(math.inf)
        mean = torch.where(replay.trials.seen, distance, torch.nan).nanmean(2)
    return mean.transpose(0, 1)


def _values(simulator: Simulator, parameters: Mapping[str, float] | None) -> dict[str, torch.Tensor]:
    """(1,) values of parameters."""
    return {name: simulator.tensor([value]) for name, value in (parameters or {}).items()}


def _context(inputs: Inputs, steps: int) -> torch.Tensor | None:
    """(K, B, A) actuation during every step, the network's inputs beside the state; None without actuation."""
    series: list[Any] = [[*inputs.at(step).actuation.values()] for step in range(steps)]
    return torch.stack([torch.cat(values, 1) for values in series]) if series and series[0] else None
