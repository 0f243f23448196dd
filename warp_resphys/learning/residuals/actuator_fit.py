"""Learns what the actuators of a robot do beyond their identified response.

Forces in the modes of a body are more than a few markers can tell. What a driven robot has and its
model lacks lies mostly in its few inputs: chambers made by hand differ, creep, and act on each
other. So the effective inputs are the identified response x to the commands and a network f of x
and its exponential means (`InputNetwork`).

The first weights come from linearised motions: the paper's equation 6, which changes a simulated
motion as little as possible to bring it to the markers, with the force restricted to what the
inputs can do. A roll-out also gives the derivatives J of its points p by lasting changes of the
inputs, and a kernel k with which points follow changes in time (`linearised`). With the change d of
the inputs by the networks, the weights w minimise

    sum |p + J (k * d) - y|^2 + trust |d|^2 + penalty |w|^2.

An epoch is a roll-out with these derivatives and this minimum, with the least trust for which the
motions come closer (Levenberg and Marquardt). The first one chooses the penalty, by the errors of
linearised motions that are left out in turn.
"""

import copy
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Final

import torch
from typing_extensions import override

from ...core.dynamics.simulator import Simulator
from ...core.energies.contact.contact_points import MOTION
from ...data.input_network import Actuator, InputNetwork
from ...data.input_response import InputResponse, with_means
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError, InputError, checks_types
from ...io.progress import Progress
from ...settings.learning import ActuatorSettings
from ..evaluation import HELD_OUT, HeldOutRollouts, left_out_in_turn
from ..observed_motions import Identified, ObservedMotions
from ..parameters import HUNG
from ..replay import Replay
from ..scores import HeldOutTest, held_out_test, text_of
from ..start import Start
from .in_the_loop import JudgedTrainer, MotionLoss, TrialGroup, cross_validated_epochs
from .linearised import Linearised, chosen_penalty, fit_linearised
from .training import Snapshot, run_epochs

log = logging.getLogger(__name__)

# Inputs that drive no actuator.
_OTHERS: Final = frozenset({*HUNG, *(quantity.name for quantity in MOTION)})
# Changes of the inputs that are tried in a round, of the largest input.
_NEAR: Final = (math.inf, 0.1, 0.03)


@checks_types
def fit_actuator(
    simulator: Simulator,
    motions: ObservedMotions,
    *,
    train: Sequence[str] | None = None,
    validation: Sequence[str] = (),
    parameters: Identified | Mapping[str, float] | None = None,
    settings: ActuatorSettings | None = None,
) -> Identified:
    """Trains networks that change the inputs of a simulator towards those that act in the robot.

    Args:
        simulator: to correct.
        motions: observed states or markers, under inputs.
        train: names of the trials to learn from; by default all that are not in `validation`.
        validation: names of the trials that choose the weights and test the result; a third of the
            training trials in turn if there are none, or one static pose.
        parameters: as for `reconstruct`.
        settings: size and training; the defaults of the class if None.

    Returns:
        The parameters with the actuator, to pass on as ``parameters`` of `reconstruct`, `fit_force`
        and `evaluate`, and its test on held-out trials.

    Raises:
        InputError: no trial of the training has inputs, or the body takes none.
        ConvergenceError: the simulation fails without the actuator.
    """
    others = [name for name in motions.trials.names if name not in validation]
    motions.need_points("an actuator")
    train = motions.trials.chosen(others if train is None else train)
    fitting = ActuatorFitting(
        simulator, motions, train, tuple(validation), Identified.of(parameters)
    )
    return fitting.fit(settings or ActuatorSettings())[0]


@dataclass(frozen=True)
class ActuatorFitting:
    """Data of a fit.

    Attributes:
        simulator: to correct.
        motions: observed trials.
        train: names of the trials to learn from.
        validation: names of the trials that choose the weights.
        identified: parameters of the simulator, without an actuator.
    """

    simulator: Simulator
    motions: ObservedMotions
    train: tuple[str, ...]
    validation: tuple[str, ...] = ()
    identified: Identified = field(default_factory=Identified)

    def fit(
        self,
        settings: ActuatorSettings,
        name: str = "fit_actuator",
        resumed: Snapshot | None = None,
        save: Callable[[Snapshot], None] = lambda kept: None,
    ) -> tuple[Identified, dict[str, Any]]:
        """Trains an actuator to the end, and tests it.

        Args:
            settings: of the network and the training.
            name: displayed beside the progress bar.
            resumed: a snapshot from which an interrupted training goes on.
            save: is called with a snapshot every ten seconds, and when the training ends or is
                interrupted.

        Returns:
            The parameters with the actuator and its test, and ``training`` as of `Learned`.
        """
        epochs, test = None, None
        folds = self._folds() if settings.gate or not self.validation else []
        if folds:
            epochs, test = self._held_out(folds, settings, name)
        judged = self.train if folds else self.validation or self.train
        trainer = self._trainer(self.train, judged, settings, epochs)
        if resumed is not None:
            trainer.resume(*resumed)
        trainer.begin()
        run_epochs(name, trainer, save)
        found = replace(self.identified, actuator=trainer.use_best().requires_grad_(False).inputs)
        if test is None and settings.gate:
            names = self.validation or self.train
            split = "validation" if self.validation else "training"
            errors, below = (
                self._rolled_out(identified, names) for identified in (found, self.identified)
            )
            test = self._tested(self._in_batches(names), split, errors, below)
        test = test if settings.gate else None
        if test is not None and not test["used"]:
            log.warning("%s: the learned actuator is no clear gain: %s", name, text_of(test))
        error = trainer.best_error if math.isfinite(trainer.best_error) else None
        kept = {
            "selection": trainer.selection,
            "epoch": trainer.best_epoch,
            "validation_rollout_error_mm": error,
        }
        return replace(found, test=test), {
            "kept": {**kept, "test": test},
            "epochs": trainer.history,
        }

    def _folds(self) -> list[tuple[str, ...]]:
        """Names of training trials that are left out of a fit together,
        as long as others have inputs.
        """
        trials, inputs = self.motions.trials, self.motions.trials.inputs.values()
        driven = {
            n for n in self.train if any(values[trials.names.index(n)].any() for values in inputs)
        }
        folds = left_out_in_turn(trials, self.train, self.validation)
        return [fold for fold in folds if driven.difference(fold)]

    def _held_out(
        self, folds: Sequence[tuple[str, ...]], settings: ActuatorSettings, name: str
    ) -> tuple[int, HeldOutTest]:
        """Number of epochs with the smallest error on trials
        that are left out in turn, and the test on these.
        """
        trainers = [
            self._trainer(
                [one for one in self.train if one not in fold],
                fold,
                settings.changed(rollout_every=1),
            )
            for fold in folds
        ]
        with Progress(
            f"{name}: held out", len(folds) * settings.epochs, "epochs at most"
        ) as progress:
            epochs, (below, errors) = cross_validated_epochs(trainers, progress.advance)
        names = [*chain.from_iterable(map(self._in_batches, folds))]
        return epochs, self._tested(names, HELD_OUT, errors, below)

    def _trainer(
        self,
        names: Sequence[str],
        judged: Sequence[str],
        settings: ActuatorSettings,
        epochs: int | None = None,
    ) -> "LinearisedTrainer":
        """Training of a new actuator on some trials, judged on others."""
        replays, values = self._replays(names), self.identified.values(self.simulator)
        felt = [felt_inputs(replay, values, settings.filters) for replay, _ in replays]
        return LinearisedTrainer(
            _untrained(felt, settings),
            FeltMotions(replays, felt, values),
            self._loss_of(replays),
            self._loss(judged),
            settings,
            epochs,
        )

    def _in_batches(self, names: Sequence[str]) -> list[str]:
        """Names of trials in the order of their batches, which is that of their errors."""
        return [*chain.from_iterable(self.motions.trials.batches(names))]

    def _tested(
        self,
        names: Sequence[str],
        split: str,
        errors: Sequence[FloatArray],
        below: Sequence[FloatArray],
    ) -> HeldOutTest:
        """Compares the errors (T,) of trials [mm] with those without the actuator."""
        sizes = [
            1e3 * float(self.motions.batch([name], self.simulator).amplitude) for name in names
        ]
        return held_out_test(names, split, errors, below, sizes)

    def _rolled_out(self, identified: Identified, names: Sequence[str]) -> list[FloatArray]:
        """Mean distances (T,) by frame of trials [mm], in the order of their batches."""
        counting = replace(
            self.simulator, solver=self.simulator.settings.changed(on_failure="count")
        )
        return HeldOutRollouts(counting, self.motions, names, identified).errors(None)

    def _loss(self, names: Sequence[str]) -> MotionLoss:
        return self._loss_of(self._replays(names))

    def _loss_of(self, replays: Sequence[tuple[Replay, Start]]) -> MotionLoss:
        return MotionLoss(
            [TrialGroup(*pair) for pair in replays], self.identified.values(self.simulator)
        )

    def _replays(self, names: Sequence[str]) -> list[tuple[Replay, Start]]:
        """Replays of the frames that are learned from,
        one for each batch of trials, each with its start.
        """
        replays = self.motions.replays(self.simulator, names, self.identified)
        return [(self.motions.learned(replay), start) for replay, start in replays]


@dataclass(frozen=True)
class FeltMotions:
    """Motions to learn from, with what the networks take in each.

    Attributes:
        replays: of the trials, each with its start.
        felt: what the networks take in each, see `felt_inputs`.
        values: (1,) identified parameters.
    """

    replays: Sequence[tuple[Replay, Start]]
    felt: Sequence[Mapping[str, torch.Tensor]]
    values: Mapping[str, torch.Tensor]

    def linearised(self, model: Actuator) -> list[Linearised]:
        """Returns the motions, linearised about those with an actuator."""
        pairs = zip(self.replays, self.felt, strict=True)
        return [Linearised.of(*pair, self.values, model, felt) for pair, felt in pairs]


class LinearisedTrainer(JudgedTrainer[Actuator]):
    """Fits an actuator to linearised motions, which an epoch linearises again.

    Without success, and where a motion has no derivatives, the weights stay as they are.

    Args:
        model: to train.
        motions: to learn from.
        train: loss of these trials.
        judge: loss whose error selects the weights.
        settings: epochs and patience.
        epochs: in place of the configured number.
    """

    def __init__(
        self,
        model: Actuator,
        motions: FeltMotions,
        train: MotionLoss,
        judge: MotionLoss,
        settings: ActuatorSettings,
        epochs: int | None = None,
    ) -> None:
        super().__init__(model, None, train, judge, settings, epochs)
        self._motions = motions
        self._near = list(_NEAR)

    @property
    @override
    def finished(self) -> bool:
        """Whether all epochs are done, or the last one found no weights
        with which the motions come closer.
        """
        return super().finished or not self._near

    @override
    def _run_epoch(self) -> dict[str, float]:
        self.begin()
        least = self.history[-1]["train_loss"]
        before = copy.deepcopy(self.model.network.state_dict())
        if not self._near:
            return {"train_loss": least}
        try:
            linearised = self._motions.linearised(self.model)
        except ConvergenceError as error:
            log.info("the actuator stays as it is: %s", error)
            self._near.clear()
        if self.epoch == 0 and self._near:
            self.penalty = chosen_penalty(linearised, self.train.weights, self.model)
        while self._near:  # A bound that was too far once is so again.
            trust = least / self._near[0] ** 2
            fit_linearised(linearised, self.train.weights, self.model, self.penalty, trust)
            found = self._value()
            if found < least:
                return {"train_loss": found}
            self.model.network.load_state_dict(before)
            self._near.pop(0)
        return {"train_loss": least}

    @override
    def snapshot(self) -> Snapshot:
        tensors, metadata = super().snapshot()
        return tensors, {**metadata, "bounds": len(self._near), "penalty": self.penalty}

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._near, self.penalty = (
            list(_NEAR[len(_NEAR) - metadata["bounds"] :]),
            metadata["penalty"],
        )

    def _value(self) -> float:
        """Loss and penalty; infinite where the simulation or the weights fail."""
        if not all(bool(torch.isfinite(weight).all()) for weight in self.model.parameters()):
            return math.inf
        try:
            with torch.no_grad():
                return float(self.loss())
        except ConvergenceError:
            return math.inf


def felt_inputs(
    replay: Replay, parameters: Mapping[str, torch.Tensor], filters: Sequence[float]
) -> dict[str, torch.Tensor]:
    """Returns inputs and their means (K + 1, R, C (1 + F)) by input,
    at the steps of trials, first before these.

    Args:
        replay: of the R trials.
        parameters: (1,) identified parameters.
        filters: F time constants of the means [s].

    Raises:
        InputError: the trials have no inputs of actuators.
    """
    _, inputs, resting = replay.changed(actuator={}).prepare(parameters)
    step = replay.simulator.time_step
    response, felt = InputResponse(step, filters=filters), dict[str, torch.Tensor]()
    for name, acting in inputs.actuation.items():
        if name in _OTHERS:
            continue
        before = resting.actuation.get(name, 0.0 * (acting if acting.ndim == 2 else acting[0]))
        still = before if replay.is_static else acting
        if still.ndim == 2:
            steps = math.ceil(float(replay.trials.times.max()) / step) + 2
            felt[name] = with_means(still, [still] * len(filters)).expand(steps, -1, -1)
            continue
        memory = response.steady(before)
        first = with_means(before, [before] * len(filters))
        felt[name] = torch.cat([first[None], with_means(*response(memory, acting)[:2])])
    if not felt:
        raise InputError(
            f"the trials {', '.join(replay.trials.names)} have no inputs whose actuator could be "
            "learned."
        )
    return felt


def _untrained(felt: Sequence[Mapping[str, torch.Tensor]], settings: ActuatorSettings) -> Actuator:
    """An actuator without an effect, for the values (K + 1, R, C (1 + F))
    of some batches of trials by input.
    """
    networks = {}
    for name in felt[0]:
        values = torch.cat([batch[name].flatten(0, 1) for batch in felt])
        if bool(values.any()):
            networks[name] = InputNetwork.of_training(values, settings.filters, settings.centres)
    if not networks:
        raise InputError(
            "all inputs of the training trials are zero: name trials in which the robot is driven."
        )
    return Actuator(networks).to(next(iter(felt[0].values())).device)
