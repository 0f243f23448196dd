"""The expected duration of a run: a few steps of its simulators on its trials, times the steps of its stages.

The bodies move as fast as if they had fallen a tenth of their length. Forces are reconstructed that support a fifth of
their weight, from rest, as bodies that start fast need far more iterations in the first step. Networks are trained for
an epoch on random samples. Reports, laws of materials, other bodies and control have no estimate.
"""

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch

from ..dynamics.simulator import Simulator
from ..io.errors import number_of
from ..io.stages import Stage
from ..learning.parameters import configured_parameters, split_name
from ..learning.reconstruction import make_reconstructor
from ..learning.replay import Replay, Start
from ..learning.training import Samples, SequenceTrainer, Trainer
from ..report.page import duration_text
from ..settings.learning import RangeSettings
from ..settings.stages import (
    EvaluateStage,
    IdentifyStage,
    LearningStage,
    MeshCheckStage,
    ReconstructStage,
    ReportStage,
    TimeStage,
    TrainStage,
)
from ..stepping.state import State
from .build import choose_device
from .experiment import MODELS, Experiment
from .learn import new_network
from .models import SIMFREE
from .prediction_intervals import INTERVAL_MODELS
from .trials import evenly

log = logging.getLogger(__name__)

LEAST_SECONDS: Final = 60.0  # of the estimates that are shown
_CALLS, _MEASURED = 3, 0.5  # calls that are timed, and seconds after which no further one begins
_MOST_TRIALS = 16  # that are simulated for the estimate
_FALL, _SUPPORTED = 0.1, 0.2
_EVALUATIONS = 0.5  # typical number of evaluations of a search, over the largest
_ITERATIONS = 1.3  # evaluations of the loss in an iteration of L-BFGS
_SHOWN = 3  # stages
_SHORT = 1e6  # steps times vertices of all reconstructed trials that take about a minute


@dataclass(frozen=True)
class ExpectedDuration:
    """Expected duration of the stages of one split.

    Attributes:
        seconds: by stage [s].
        without: names of stages that have no estimate.
        vertices: of the simulated body.
        at_once: time during which two stages run [s].
    """

    seconds: Mapping[str, float]
    without: Sequence[str] = ()
    vertices: int = 0
    at_once: float = 0.0

    @property
    def total(self) -> float:
        """From the first stage with an estimate to the last [s]."""
        return sum(self.seconds.values()) - self.at_once

    def sentence(self, remedies: Sequence[str], times: float = 1.0) -> str:
        """Returns the estimate in words; empty for less than a minute.

        Args:
            remedies: changes of the configuration that make the run shorter.
            times: factor of the duration, as of several folds.
        """
        if self.total * times < LEAST_SECONDS:
            return ""
        longest = sorted(self.seconds, key=lambda name: -self.seconds[name])[:_SHOWN]
        parts = ", ".join(f"{name} {duration_text(times * self.seconds[name])}" for name in longest)
        without = f", without {', '.join(self.without)}" if self.without else ""
        took = f"about {duration_text(times * self.total)} more for {self.vertices:,} vertices"
        return f"{took}{without} (longest: {parts}); shorter with {', '.join(remedies)}."


def may_be_long(stages: Sequence[Stage], folder: Path) -> bool:
    """Whether stages may take over a minute: those that identify, or reconstruct many steps.

    Args:
        stages: of one split.
        folder: of the split; its dataset exists.
    """
    folder.mkdir(parents=True, exist_ok=True)  # The dataset of a fold lies beside it.
    work = 0.0
    for settings in (stage.settings for stage in stages):
        if isinstance(settings, IdentifyStage):
            return True
        if isinstance(settings, ReconstructStage):
            experiment, names = Experiment(settings, folder, "count"), settings.reconstructed
            steps = _Pace(experiment, {}).steps(experiment.simulator("simulation"), names)
            work += steps * len(names) * experiment.body.n_vertices
    return work > _SHORT


def estimate(stages: Sequence[Stage], folder: Path, background: bool = False) -> ExpectedDuration:
    """Measures a few steps and returns the expected duration of stages of one split.

    Args:
        stages: to estimate.
        folder: of the split; its dataset exists.
        background: whether a second process trains networks.
    """
    seconds, without, vertices = dict[str, float](), list[str](), 0
    known = dict[tuple[Any, ...], float]()
    for stage in stages:
        settings = stage.settings
        own = None
        if isinstance(settings, LearningStage):
            pace = _Pace(Experiment(settings, folder, "count"), known)
            vertices = pace.experiment.body.n_vertices
            try:
                own = pace.stage()
            except Exception as error:  # An estimate never ends a run.
                log.debug("%s has no estimate: %s", stage.name, error)
        if own is not None:
            seconds[stage.name] = own
        elif not isinstance(settings, ReportStage):
            without.append(stage.name)
    at_once = sum(seconds.values()) - _elapsed(stages, seconds) if background else 0.0
    return ExpectedDuration(seconds, without, vertices, at_once)


def _elapsed(stages: Sequence[Stage], seconds: Mapping[str, float]) -> float:
    """Time that stages take [s] if a second process runs some of them, in the order of `io.stages.run_stages`."""
    left, now, ends = {stage.name for stage in stages}, 0.0, dict[str, float]()
    for number, stage in enumerate(stages):
        if stage.name in ends:
            now = max(now, ends[stage.name])
        else:
            for other in stages[number + 1 :]:
                if other.background is not None and not left & {*ends, *other.upstream}:
                    ends[other.name] = now + seconds.get(other.name, 0.0)
            now += seconds.get(stage.name, 0.0)
        left.remove(stage.name)
    return now


def remedies(stages: Sequence[Stage], quick: bool) -> list[str]:
    """Changes of the configuration that make stages shorter.

    Args:
        stages: of one split.
        quick: whether the run is a first look already.
    """
    named = ["a coarser mesh", "fewer or shorter trials"]
    count = max((len(own.settings.identify.parameters) for own in stages if own.name == "identify"), default=0)
    named += [f"fewer of the {number_of(count, 'parameter')} of identify.parameters"] if count > 1 else []
    return named if quick else [*named, "or at first budget=quick"]


@dataclass(frozen=True)
class _Pace:
    """Durations of the parts of a stage.

    Attributes:
        experiment: of the settings of the stage.
        known: durations that were measured for other stages [s].
    """

    experiment: Experiment
    known: dict[tuple[Any, ...], float]

    def stage(self) -> float | None:
        """Duration of the stage [s]; None if it is unknown."""
        match self.experiment.settings:
            case IdentifyStage() as settings:
                return self._identify(settings)
            case ReconstructStage() as settings:
                return self._each(settings.model, settings.reconstructed, self._reconstructed_step)
            case TrainStage() as settings:
                return self._train(settings)
            case EvaluateStage() as settings:
                return self._evaluate(settings)
            case TimeStage() as settings:
                names = self.experiment.moving(settings.groups["1"])
                return 3.0 * sum(self._each("simulation", [name], self._step) for name in names)
            case MeshCheckStage() as settings:
                whole = self._each("simulation", settings.groups["1"], self._step)
                return whole * (1.0 + settings.mesh_check**3)
        return None

    def _evaluate(self, settings: EvaluateStage) -> float:
        """Duration of the roll-outs of the test trials, and of those for the prediction intervals [s]."""
        tested = [name for group in settings.groups.values() for name in group]
        models = [model for model in self.experiment.models if model != SIMFREE]
        seconds = sum(self._each(model, tested, self._step) for model in models)
        calibrated = [model for model in INTERVAL_MODELS if model in models]
        return seconds + sum(self._each(model, settings.calibration, self._step) for model in calibrated)

    def _identify(self, settings: IdentifyStage) -> float:
        wanted, names = settings.identify, settings.split.train
        names = names if wanted.trials is None else tuple(evenly(names, wanted.trials))
        searches = {"sysid": wanted.parameters, "sysid_elastic": wanted.elastic or {}}
        candidates = wanted.candidates if wanted.starts > 1 else 0
        points = 1
        for axis in dict(wanted.grid).values() if wanted.landscape and wanted.grid is not None else ():
            points *= axis.points if axis is not None else 1
        seconds = 0.0
        for model, search in searches.items():
            if search:
                evaluations = _EVALUATIONS * wanted.starts * wanted.max_evaluations
                released = any(self.experiment.begins(name) == "released" for name in names)
                evaluations *= 1.5 if released else 1.0  # Releases are estimated again.
                seconds += evaluations * self._evaluation(model, search, names)
                seconds += candidates * self._each(model, names, self._step)
        landscape = points * self._each("sysid", names, self._step) if points > 1 else 0.0
        return seconds + landscape

    def _evaluation(self, model: str, search: Mapping[str, RangeSettings], names: Sequence[str]) -> float:
        """Duration of the loss and its derivatives by all parameters [s]."""
        simulator, sets = self.experiment.simulator(MODELS[model][0]), 1 + len(search)
        values = configured_parameters(simulator, [split_name(name)[0] for name in search])
        settings = self.experiment.settings
        assert isinstance(settings, IdentifyStage)
        values = {name: settings.identify.first_guess.get(name, value) for name, value in values.items()}
        parameters = {name: simulator.tensor([value] * sets) for name, value in values.items()}

        def calls(replay: Replay) -> Callable[[], Any]:
            short = Replay(simulator, replay.observe, replay.trials.first((_CALLS + 0.5) * simulator.time_step))
            if short.is_static:
                start = Start.resting(simulator.rest_positions.expand(len(short.trials.names), -1, -1))
                return lambda: short.varied(start, parameters)
            state = _moving(simulator, len(short.trials.names))
            start = Start(state, state.q.new_zeros(state.batch))
            steps = max(short.steps(start), 1)
            return lambda: [short.varied(start, parameters) for _ in range(max(_CALLS // steps, 1))]

        return self._each(model, names, calls, together=_CALLS, parameters=len(search))

    def _train(self, settings: TrainStage) -> float:
        training, model, split = settings.training, settings.model, settings.split
        judged = split.validation or split.train
        loop = training.in_the_loop
        if loop is not None and model != SIMFREE:
            epoch = _ITERATIONS * self._each(model, split.train, self._step_and_adjoint)
            epoch += self._each(model, judged, self._step)
            held_out = loop.start == "zero" and loop.hold_out and not split.validation and len(split.train) > 1
            in_the_loop = loop.epochs * epoch * (len(split.train) if held_out else 1.0)
            if loop.start == "zero":
                return in_the_loop
        else:
            in_the_loop = 0.0
        trainer, rollouts = training.trainer, training.trainer.epochs / training.trainer.rollout_every
        rolled = 0.0 if model == SIMFREE else self._each(model, judged, self._step)
        return in_the_loop + trainer.epochs * self._epoch(settings) + rollouts * rolled

    def _epoch(self, settings: TrainStage) -> float:
        """Duration of an epoch of a network on the steps of the training trials [s]."""
        experiment, training = self.experiment, settings.training
        simulator = experiment.model_simulator(settings.model)
        count = sum(self.steps(simulator, [name]) for name in settings.split.train)
        rest = experiment.like.to(choose_device(settings.device), torch.float32)
        used = min(count, 4 * training.trainer.batch_size)
        q, v, force = (torch.randn(used, *rest.shape).to(rest) for _ in range(3))
        names = settings.split.train[:1]
        inputs = experiment.conditions(experiment.replay(simulator, names), {}, settings.model == SIMFREE)
        actuation = None if inputs is None else inputs.flatten(0, -2)[:1].to(rest).expand(used, -1)
        samples = Samples(rest + 1e-3 * q, v, (force, v) if settings.model == SIMFREE else (force,), actuation, (used,))
        network = new_network(experiment, settings.model, samples, training)
        kind = Trainer if network.recurrent is None else SequenceTrainer
        trainer = kind(network, samples, samples, lambda _: 0.0, training.trainer, 0)
        return _timed(trainer.run_epoch) * count / used

    def _each(
        self,
        model: str,
        names: Sequence[str],
        calls: Callable[[Replay], Callable[[], Any]],
        together: int = 1,
        parameters: int = 0,
    ) -> float:
        """Duration of the steps of trials [s].

        Args:
            model: whose simulator is used.
            names: of the trials.
            calls: returns a function of some trials, whose calls are timed.
            together: number of steps of a call.
            parameters: number of parameters that a call differentiates by.
        """
        seconds, simulator = 0.0, self._simulator(model)
        for batch in self.experiment.batches(names):
            size = min(self.experiment.settings.batch or len(batch), len(batch))
            probed = batch[: min(size, _MOST_TRIALS)]
            replay = self.experiment.replay(simulator, probed)
            steps = 1.0 if replay.is_static else self.steps(simulator, batch) / together
            same = (calls.__name__, parameters, repr(simulator), simulator.integrator, replay.is_static)
            seconds += self._a_call(same, len(probed), partial(calls, replay)) * len(batch) / len(probed) * steps
        return seconds

    def _a_call(self, same: tuple[Any, ...], trials: int, make: Callable[[], Callable[[], Any]]) -> float:
        """Duration of a call for some trials [s]; slow ones are measured for one number of trials alone."""
        slow = {n: t for (*key, n), t in self.known.items() if tuple(key) == same and t > _MEASURED}
        if (*same, trials) not in self.known and slow:
            most = max(slow)
            return slow[most] * trials / most
        if (*same, trials) not in self.known:
            self.known[*same, trials] = _timed(make())
        return self.known[*same, trials]

    def _simulator(self, model: str) -> Simulator:
        """Simulator of a model, without a law, which is not identified yet."""
        kind = MODELS[model][0]
        plain = kind in ("law", "identified") and self.experiment.settings.identified is None
        return self.experiment.simulator("simulation" if plain else kind)

    def steps(self, simulator: Simulator, names: Sequence[str]) -> int:
        """Number of steps of the longest trial; the end of the dataset for those that are read in part."""
        replay = self.experiment.trials(names)
        limit = float(replay.times.max())
        if isinstance(self.experiment.settings, IdentifyStage):
            limits = (limit, self.experiment.settings.trial_seconds, self.experiment.settings.identify.seconds)
            limit = min(own for own in limits if own is not None)
        return max(math.ceil(limit / simulator.time_step - 1e-6), 1)

    def _step(self, replay: Replay) -> Callable[[], Any]:
        """Function that simulates a step; that of poses solves for their equilibrium."""
        simulator, (constants, inputs, resting) = replay.simulator, replay.prepare()
        if replay.is_static:
            return lambda: simulator.static_equilibrium(resting, constants, batch=len(replay.trials.names))
        state = _moving(simulator, len(replay.trials.names))

        def step() -> None:
            nonlocal state
            state = simulator.step(state, inputs.at(0), constants)[0]

        return torch.no_grad()(step)

    def _step_and_adjoint(self, replay: Replay) -> Callable[[], Any]:
        """Function that simulates a step and computes its gradient."""
        simulator, (constants, inputs, resting) = replay.simulator, replay.prepare()
        state = _moving(simulator, len(replay.trials.names))

        def step() -> None:
            force = torch.zeros_like(state.q).requires_grad_()
            if replay.is_static:
                new = simulator.static_equilibrium(resting.plus(force), constants)
            else:
                new = simulator.step(state, inputs.at(0).plus(force), constants)[0]
            new.q.sum().backward()

        return step

    def _reconstructed_step(self, replay: Replay) -> Callable[[], Any]:
        """Function that reconstructs the forces of a step."""
        settings = self.experiment.settings
        assert isinstance(settings, ReconstructStage)
        simulator, (constants, inputs, resting) = replay.simulator, replay.prepare()
        if replay.is_static:
            simulator, inputs = replace(simulator, time_step=1e6, integrator="implicit_euler"), resting
        method = make_reconstructor(simulator, **dict(settings.reconstruction), observation=replay.observe)
        method = method.with_constants(constants)
        state = simulator.rest_state(len(replay.trials.names))
        support = -_SUPPORTED * constants.load_mass[..., None] * constants.gravity[:, None]
        acting = inputs if replay.is_static else inputs.at(0)

        def step() -> None:
            nonlocal state
            with torch.no_grad():
                target = simulator.step(state, acting.plus(support.expand_as(state.q)), constants)[0]
            state = method.step(state, replay.observe(target.q), acting).state.detach()

        return step


def _moving(simulator: Simulator, batch: int) -> State:
    """Undeformed bodies that swing sideways, the faster the farther from where they are fixed."""
    state = simulator.rest_state(batch)
    q = simulator.rest_positions
    size = q.amax(0) - q.amin(0)
    held = q[simulator.fixed].mean(0) if len(simulator.fixed) else q.mean(0)
    away = (q - held).norm(dim=1)
    speed = math.sqrt(2.0 * 9.81 * _FALL * float(size.max()))
    v = torch.zeros_like(q)
    v[:, int(size.argmin())] = speed * away / away.max()
    v[simulator.fixed] = 0.0
    return replace(state, v=v.expand_as(state.q).clone())


def _timed(call: Callable[[], Any]) -> float:
    """Mean duration of a few calls after a first one, which may compile kernels [s]."""
    begin = time.perf_counter()
    call()
    first = time.perf_counter()
    if first - begin > _MEASURED:
        return first - begin
    count = 0
    while count < _CALLS and time.perf_counter() - first < _MEASURED:
        call()
        count += 1
    return (time.perf_counter() - first) / count
