"""Identification, reconstruction, training and evaluation as four functions, without configuration or run folder.

The commands do this work in stages, through files. Here results stay in memory::

    motions = ObservedMotions.of(simulator, observed, start)
    identified = identify(simulator, motions, {"youngs_modulus": (1e5, 1e6)}).parameters
    samples = reconstruct(simulator, motions, parameters=identified)
    force = fit_force(simulator, samples)
    errors = evaluate(simulator, held_out, force, parameters=identified)

Every function accepts whole states and markers. Forces are in the world's frame. Parameters are the simulator's own
unless others are given. `tests/learning/test_library.py` checks them on a beam.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import torch

from ..dynamics.simulator import Simulator
from ..io.errors import InputError
from ..settings.learning import NetworkSettings, ReconstructionSettings, TrainerSettings
from ..stepping.rollout import rollout
from .correction import CorrectedSimulator, LearnedPredictor, Predictor, known_positions
from .identification import Identification, ParameterSearch
from .misfit import Misfit
from .networks import ResidualForce, build_model
from .observed_motions import Identified, ObservedMotions
from .parameters import Bounds, configured_parameters
from .reconstruction import follow, make_reconstructor, without_ringing
from .training import Samples, Trainer


def identify(
    simulator: Simulator,
    motions: ObservedMotions,
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
        motions: observed states or markers.
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
    search = ParameterSearch(Misfit(motions.replays(simulator), ranges))
    guess = {**configured_parameters(simulator, ranges), **(first_guess or {})}
    return search.run(search.starts(guess, starts, 4 * starts, seed), max_evaluations, tolerance=tolerance)


def reconstruct(
    simulator: Simulator,
    motions: ObservedMotions,
    *,
    parameters: Mapping[str, float] | None = None,
    settings: ReconstructionSettings | None = None,
) -> Samples:
    """Finds the forces with which a simulator follows observed motions, step by step.

    Args:
        simulator: to correct. With markers, BDF2 replaces the midpoint rule.
        motions: observed states or markers.
        parameters: values in place of the simulator's own, such as `Identification.parameters`.
        settings: method, regularisation [unit^2/N^2], tolerance and iterations; the defaults of the class.

    Returns:
        The S = B T steps, motion after motion: initial positions (S, N, 3) [m] and velocities (S, N, 3) [m/s], the
        force as the only output (S, N, 3) [N], and the inputs (S, A).

    Raises:
        InputError: a setting out of range, or an input that the body does not take.
        ConvergenceError: a step without a solution.
    """
    used = without_ringing(simulator, motions.observe)
    known, parts = Identified(parameters or {}), list[Samples]()
    for names in motions.dataset.batches(motions.dataset.names):
        replay = motions.replay(used, names, known)
        start = motions.start(replay, known)
        with torch.no_grad():
            constants, inputs, resting = replay.prepare(known.values(used))
            state = replay.initial_state(start, constants, resting)
            method = make_reconstructor(used, **dict(settings or ReconstructionSettings()), observation=replay.observe)
            targets = motions.targets(replay, start)[:, 1:].unbind(1)
            steps = [*follow(method.with_constants(constants), state, targets, inputs)]
            states = [state, *(step.state for step in steps)][:-1]
            series = ([one.q for one in states], [one.v for one in states], [step.force for step in steps])
            q, v, f = (torch.stack(values, 1).flatten(0, 1) for values in series)
            context = motions.conditions(replay, known.values(used))
            if context is not None:
                context = context.expand(len(steps), *context.shape[-2:]).transpose(0, 1).flatten(0, 1)
        parts.append(Samples(q, v, (f,), context, (len(steps),) * len(names)))
    return Samples.joined(parts)


def fit_force(
    simulator: Simulator,
    samples: Samples,
    validation: ObservedMotions | None = None,
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
    motions: ObservedMotions,
    force: ResidualForce | Predictor | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
) -> torch.Tensor:
    """Rolls a simulator out from the start of observed motions and measures its error.

    Args:
        simulator: to evaluate.
        motions: observed states or markers.
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
    known, names = Identified(parameters or {}), motions.dataset.names
    errors = used.rest_positions.new_full((motions.dataset.observed.shape[1], len(names)), torch.nan)
    for replay, start in motions.replays(used, identified=known):
        observed = replay.trials.observed
        with torch.no_grad():
            constants, inputs, resting = replay.prepare(known.values(used))
            predict = force
            if isinstance(force, ResidualForce):
                predict = LearnedPredictor(force, motions.conditions(replay, known.values(used)))
            state = replay.initial_state(start, constants, resting)
            step = CorrectedSimulator(used, predict, inputs, constants).step
            positions = rollout(step, state, range(replay.steps(start)), known_positions)
            points = torch.stack([replay.observe(q) for q in positions], 1)
            away = replay.observe.residual(replay.at_frames(points, start), observed)
            distance = away.norm(dim=-1).nan_to_num(math.inf)
            mean = torch.where(replay.trials.seen, distance, torch.nan).nanmean(2)
        errors[: mean.shape[1], motions.dataset.rows(replay.trials.names)] = mean.transpose(0, 1)
    return errors
