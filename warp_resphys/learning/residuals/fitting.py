"""Fits networks to observed motions: residual forces, and next states in place of the simulator.

On single steps of reconstructed trials, or through the simulator on whole motions (`in_the_loop`).
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import torch

from ...core.dynamics.modes import RestStiffness
from ...core.dynamics.simulator import Simulator
from ...data.trials import GIVEN, RESTING, STATIC
from ...io.arrays import FloatArray
from ...io.errors import InputError, checks_types
from ...io.progress import Progress
from ...io.settings import parse
from ...settings.learning import (
    InTheLoopSettings,
    NetworkSettings,
    TrainerSettings,
    TrainingSettings,
)
from ..acceptance import Acceptance
from ..evaluation import HELD_OUT, HeldOutRollouts, left_out_in_turn
from ..observed_motions import Identified, ObservedMotions
from ..replay import Replay
from ..scores import HeldOutTest, held_out_test, text_of
from ..start import Start
from .correction import Learned, Range, force_frames
from .in_the_loop import InTheLoop, MotionLoss, TrialGroup, cross_validated_epochs
from .networks import NextState, ResidualForce, StateMap, build_model
from .reconstruction import ReconstructedTrials
from .training import EpochTrainer, Samples, Snapshot, Trainer, run_epochs

log = logging.getLogger(__name__)

# a trainer, ready to run, and its network with settings of roll-outs
Prepared = tuple[EpochTrainer[Any], Learned]


@checks_types
def fit_force(
    simulator: Simulator,
    motions: ObservedMotions,
    reconstructed: ReconstructedTrials,
    *,
    train: Sequence[str] | None = None,
    validation: Sequence[str] = (),
    parameters: Identified | Mapping[str, float] | None = None,
    network: NetworkSettings | None = None,
    trainer: TrainerSettings | None = None,
    in_the_loop: InTheLoopSettings | None = None,
    seed: int = 0,
    **more: Any,
) -> Learned:
    """Trains a network that predicts the residual force of a simulator from its state and inputs.

    Args:
        simulator: to correct.
        motions: observed states or markers.
        reconstructed: from `reconstruct`.
        train: names of the trials to learn from; by default all that are not in `validation`.
        validation: names of the trials that choose the weights, by the error of their roll-outs;
            the training trials if empty.
        parameters: as for `reconstruct`.
        network: kind and size; the defaults of the class if None.
        trainer: epochs, rates and noise of training on steps; the defaults of the class if None.
        in_the_loop: training through the simulator; None for training on steps.
        seed: of the weights, batches and noise; torch's global generator is restored.
        more: further attributes of `Fitting`.

    Returns:
        The network, to pass to `evaluate`. It maps q (S, N, 3) [m], v (S, N, 3) [m/s] and the
        inputs (S, A) to forces (S, N, 3) [N].

    Raises:
        InputError: sizes, or a number of reconstructed steps, that do not fit the motions.
    """
    others = [name for name in motions.trials.names if name not in validation]
    motions.need_points("a force")
    train = motions.trials.chosen(others if train is None else train)
    fitting = Fitting(
        simulator,
        motions,
        reconstructed,
        train,
        tuple(validation),
        Identified.of(parameters),
        **more,
    )
    groups = {"network": network or NetworkSettings(), "trainer": trainer or TrainerSettings()}
    settings = parse(TrainingSettings, {**groups, "in_the_loop": in_the_loop, "seed": seed})
    with torch.random.fork_rng():
        return fit(fitting, settings)


@dataclass(frozen=True)
class Fitting:
    """Data of a fit: the simulator, the trials, their reconstructed forces,
    and options of the roll-outs.

    Attributes:
        simulator: whose force is learned, or which shows the network's states.
        motions: observed trials.
        reconstructed: their states and forces; None where the trials have the states of all
            vertices.
        train: names of the trials to learn from.
        validation: names of the trials that choose the weights.
        identified: parameters of the simulator.
        data_driven: whether the network predicts the next state, in place of the simulator.
        force_frame: ``world``, or ``corotated`` for forces that turn with the body.
        range_guard: whether roll-outs clamp the network's inputs to their range in training.
        fades: whether the force fades out beyond that range.
        device: of the training.
        coded: names of the trials whose states and forces give the modes of the network; those of
            `train` if None.
    """

    simulator: Simulator
    motions: ObservedMotions
    reconstructed: ReconstructedTrials | None
    train: tuple[str, ...]
    validation: tuple[str, ...] = ()
    identified: Identified = field(default_factory=Identified)
    data_driven: bool = False
    force_frame: str = "world"
    range_guard: bool = False
    fades: bool = False
    device: torch.device | str = "cpu"
    coded: tuple[str, ...] | None = None

    def samples(self, names: Sequence[str]) -> Samples:
        """Collects the single steps of trials; a static pose is one step without motion.

        States are in the frame of the base. The output is the force during the step, rotated to the
        rest shape if forces are corotated, or the displacement and velocity at the end of the step.
        Steps without any visible marker are left out.
        """
        samples = Samples.joined(
            [self._samples(batch) for batch in self.motions.trials.batches(names)]
        )
        frames = None if self.data_driven else force_frames(self.simulator, self.force_frame)
        if frames is None:
            return samples
        return replace(samples, outputs=(frames.to_rest(samples.q, samples.v, *samples.outputs),))

    def _samples(self, names: Sequence[str]) -> Samples:
        """Samples of trials that begin in the same way, with forces in the world frame."""
        q, v, force, seen = self._states(names)
        base, like = self.motions.base(names, self.simulator), self.simulator.rest_positions
        if base is not None:
            pairs = enumerate(zip(q.unbind(1), v.unbind(1), strict=True))
            inside = [base.enter(x.to(like), w.to(like), k) for k, (x, w) in pairs]
            q, v = (torch.stack(field, 1).to(q) for field in zip(*inside, strict=True))
            # The force of a frame belongs to the previous step.
            forces = enumerate(force.unbind(1))
            force = torch.stack([base.force_inside(f.to(like), k - 1) for k, f in forces], 1).to(
                force
            )
        if self.motions.trials.begin_of(names[0]) == STATIC:
            q = q[:, 1:2].expand(-1, 2, -1, -1)
            v = torch.zeros_like(v[:, :2])
            force = force[:, :2]
            seen = seen[:, :1]
        steps, whole = q.shape[1] - 1, bool(seen.all())

        def pick(field: torch.Tensor) -> torch.Tensor:
            return field.flatten(0, 1) if whole else field[seen]

        values = self.identified.values(self.simulator)
        replay = self.motions.replay(self.simulator, names)
        inputs = self.motions.conditions(replay, values, self.data_driven)
        if inputs is not None:  # (K, R, A), or (R, A) constant in time
            inputs = (
                inputs[:steps].swapaxes(0, 1)
                if inputs.ndim == 3
                else inputs[:, None].expand(-1, steps, -1)
            )
            inputs = pick(inputs.expand(-1, steps, -1).to(self.device))
        now = pick(q[:, :-1]), pick(v[:, :-1])
        if not self.data_driven:
            return Samples(*now, (pick(force[:, 1:]),), inputs)
        return Samples(*now, (pick(q[:, 1:]) - like.to(q), pick(v[:, 1:])), inputs)

    def _states(self, names: Sequence[str]) -> tuple[torch.Tensor, ...]:
        """Positions, velocities and forces (R, K + 1, N, 3) of trials,
        and (R, K) whether steps were seen.

        States are the reconstructed ones; for next states, those of the trials themselves, with
        zero forces, if known.
        """
        trials = self.motions.trials
        if self.data_driven and trials.velocity is not None:
            rows = trials.rows(names)
            q, v = (
                torch.as_tensor(field[rows], device=self.device)
                for field in (trials.observed, trials.velocity)
            )
            return (
                q,
                v,
                q.new_zeros(()).expand_as(q),
                torch.ones(len(q), q.shape[1] - 1, dtype=torch.bool),
            )
        if self.reconstructed is None:
            raise InputError(
                "the trials have no velocities of all vertices to learn from: "
                "reconstruct them first."
            )
        arrays = self.reconstructed.of(names, "q", "v", "force", "error")
        given = arrays[0].shape[2]
        wanted = len(self.simulator.rest_positions)
        if given != wanted:
            raise InputError(
                f"forces on {given} vertices were reconstructed, "
                f"but the body has {wanted}: do so for it."
            )
        q, v, force, error = (torch.as_tensor(array, device=self.device) for array in arrays)
        steps = None if self.data_driven else self._steps(names)
        if steps is not None and len(q[0]) != steps + 1:
            raise InputError(
                f"forces of {len(q[0]) - 1} steps were reconstructed, but {names[0]} has {steps} "
                f"of {1e3 * self.simulator.time_step:g} ms: "
                "do so with this simulator and these motions."
            )
        return q, v, force, error[:, 1:].isfinite()

    def _steps(self, names: Sequence[str]) -> int | None:
        """Number of steps of trials that are learned from.

        None if delays, smoothing or other trials determine it.
        """
        trials, release = self.motions.trials, self.motions.release
        begins = trials.begin_of(names[0])
        exact = begins == GIVEN or (
            begins in RESTING and trials.smoothed is None and release.delay == 0.0
        )
        lengths = {trials.seconds([name]) for name in trials.names}
        if not exact or len(lengths) > 1:
            return None
        return self.motions.learned_steps(int(lengths.pop() / self.simulator.time_step + 1e-6))

    def new_network(self, train: Samples, settings: TrainingSettings) -> StateMap:
        """Makes an untrained network with coders fitted to the training steps,
        deterministic for a seed.
        """
        rest, network = self.simulator.rest_positions.to(train.q.device), settings.network
        train = train if self.coded is None else self.samples(self.coded)
        if not self.motions.trials.moving(self.coded or self.train):
            network = self._limited(network, len(train.q))
        torch.manual_seed(settings.seed)
        by_displacement = (
            not self.data_driven
            and network.kind == "reduced"
            and network.force_basis == "displacement"
        )
        stiffness = RestStiffness(self.simulator) if by_displacement else None
        force = None if self.data_driven else train.outputs[0]
        kind = NextState if self.data_driven else ResidualForce
        return build_model(kind, network, rest, train.q, train.v, force, train.actuation, stiffness)

    def _limited(self, network: NetworkSettings, poses: int) -> NetworkSettings:
        """The group ``network`` with at most as many modes as there are training poses."""
        names = ("position_modes",) if self.data_driven else ("position_modes", "force_modes")
        many = {name: getattr(network, name) for name in names if getattr(network, name) > poses}
        if many:
            reduced = " and ".join(f"network.{name} from {count}" for name, count in many.items())
            log.info("reduced %s to %d, the number of training poses", reduced, poses)
        return network.changed(**dict.fromkeys(many, poses))

    def trainer(self, settings: TrainingSettings, name: str = "") -> Prepared:
        """Prepares the trainer of a new network; the result depends on the settings only.

        Args:
            settings: of the training.
            name: of the training, displayed beside progress bars.

        Raises:
            InputError: a setting out of range, or an empty split.
        """
        samples = self.samples(self.train)
        if settings.in_the_loop is not None:
            return self._through_the_simulator(samples, settings, settings.in_the_loop, name)
        return self._on_steps(samples, settings)

    def _on_steps(self, train: Samples, settings: TrainingSettings) -> Prepared:
        """Prepares training on single steps, validated by roll-outs:
        of the training trials without others.
        """
        judged = self.validation or self.train
        validation = self.samples(judged) if self.validation else train
        network = self.new_network(train, settings)
        learned = Learned(network, self._range_of(network, train), self.force_frame)
        counting = replace(
            self.simulator, solver=self.simulator.settings.changed(on_failure="count")
        )
        rollouts = HeldOutRollouts(
            counting, self.motions, judged, self.identified, self.data_driven
        )

        def judge(weights: StateMap) -> float:
            return rollouts.error_mm(replace(learned, network=weights))

        return Trainer(network, train, validation, judge, settings.trainer, settings.seed), learned

    def _range_of(self, network: StateMap, train: Samples) -> Range | None:
        """Training range of a network's inputs, to which roll-outs clamp them.

        None without a guard.
        """
        if not self.range_guard:
            return None
        with torch.no_grad():
            missed = network.missed(train.q, train.v) if self.fades else None
            return Range.of(network.encode(train.q, train.v, train.actuation), missed)

    def _through_the_simulator(
        self, samples: Samples, settings: TrainingSettings, loop: InTheLoopSettings, name: str
    ) -> Prepared:
        """Prepares training through the simulator, on whole trials.

        The reconstruction provides the modes of motions and forces. Without validation trials, the
        number of epochs is found by cross-validation, holding out each training trial once; it may
        be zero.
        """
        parameters = self.identified.values(self.simulator)
        train = self.train
        validation = self.validation
        replays = self.motions.replays(self.simulator, train + validation, self.identified)

        def loss(names: Sequence[str]) -> MotionLoss:
            groups = (self._group(*pair, names, parameters) for pair in replays)
            return MotionLoss([group for group in groups if group is not None], parameters)

        def make_network() -> ResidualForce:
            network = self.new_network(samples, settings)
            assert isinstance(network, ResidualForce)
            return network.double()

        epochs, test = None, None
        if loop.hold_out and not validation and len(train) > 1:
            each = loop.changed(rollout_every=1)
            rest = {out: [one for one in train if one != out] for out in train}
            parts = [InTheLoop(make_network(), loss(rest[out]), loss([out]), each) for out in train]
            with Progress(
                f"{name}: held out", len(train) * loop.epochs, "epochs at most"
            ) as progress:
                epochs, (below, errors) = cross_validated_epochs(parts, progress.advance)
            sizes = [*chain.from_iterable(part.judge.amplitudes_mm() for part in parts)]
            test = (
                held_out_test(train, HELD_OUT, errors, below, sizes)
                if settings.trainer.gate
                else None
            )
            epochs = epochs if test is None or test["used"] else 0
            log.debug("%s: %d epochs are best for held-out trials", name, epochs)
        trainer = InTheLoop(make_network(), loss(train), loss(validation or train), loop, epochs)
        trainer.begin()
        return trainer, Learned(
            trainer.model, self._range_of(trainer.model, samples), self.force_frame, test=test
        )

    def test(self, learned: Learned, settings: TrainingSettings, name: str) -> HeldOutTest:
        """Tests a network beside the simulator alone:
        on the validation trials, or on training trials in turn.

        Where validation trials do not suffice (`left_out_in_turn`), a third of the training trials
        that begin alike is left out of a fit each time, with the modes of all; a single one is
        tested on itself.
        """
        folds = left_out_in_turn(self.motions.trials, self.train, self.validation)
        parts = [] if folds else [(learned, self.validation or self.train)]
        for number, left_out in enumerate(folds, 1):
            rest = tuple(name for name in self.train if name not in left_out)
            trainer, fitted = replace(self, train=rest, coded=self.train).trainer(settings, name)
            run_epochs(f"{name}: without {number} of {len(folds)}", trainer)
            parts.append((replace(fitted, network=trainer.use_best()), left_out))
        counting = replace(
            self.simulator, solver=self.simulator.settings.changed(on_failure="count")
        )
        names = list[str]()
        errors = list[FloatArray]()
        below = list[FloatArray]()
        sizes = list[float]()
        for fitted, trials in parts:
            runs = HeldOutRollouts(counting, self.motions, trials, self.identified)
            names, sizes = names + runs.names, sizes + runs.amplitudes_mm()
            errors, below = errors + runs.errors(fitted), below + runs.errors(None)
        split = HELD_OUT if folds else "validation" if self.validation else "training"
        return held_out_test(names, split, errors, below, sizes)

    def accepted(self, learned: Learned, test: HeldOutTest) -> HeldOutTest:
        """Returns the test of a network that is accurate,
        refused where `Acceptance` objects to it.
        """
        if not test["used"]:
            return test
        acceptance = Acceptance(
            self.simulator, self.motions, self.identified, test["below_mm"] or math.inf
        )
        refused = acceptance.objections(
            learned, self.train + self.validation, self.validation or self.train
        )
        return {**test, "used": not refused, "refused": refused}

    def _group(
        self,
        replay: Replay,
        start: Start,
        names: Sequence[str],
        parameters: Mapping[str, torch.Tensor],
    ) -> TrialGroup | None:
        """The trials of a replay that are among some; None without any."""
        batch, simulator = replay.trials.names, self.simulator
        rows = [batch.index(name) for name in names if name in batch]
        if not rows:
            return None
        part = self.motions.learned(replay.changed(trials=replay.trials.select(rows)))
        inputs = self.motions.conditions(part, parameters)
        base = self.motions.base(part.trials.names, simulator)
        frames = force_frames(simulator, self.force_frame)
        return TrialGroup(part, start.select(rows), inputs, frames, base)


def fit(
    fitting: Fitting,
    settings: TrainingSettings,
    name: str = "fit_force",
    resumed: Snapshot | None = None,
    save: Callable[[Snapshot], None] = lambda kept: None,
) -> Learned:
    """Trains a network to the end.

    Args:
        fitting: what it is fitted to.
        settings: of the training.
        name: displayed beside the progress bar.
        resumed: a snapshot from which an interrupted training goes on.
        save: is called with a snapshot every ten seconds, and when the training ends or is
            interrupted.
    """
    trainer, learned = fitting.trainer(settings, name)
    if resumed is not None:
        trainer.resume(*resumed)
    run_epochs(name, trainer, save)
    best = trainer.use_best()
    error = trainer.best_error if math.isfinite(trainer.best_error) else None
    if error is None:
        log.warning("%s: the selected weights diverge on the validation split", name)
    learned = replace(learned, network=best)
    tested = fitting.data_driven or learned.test is not None or not settings.trainer.gate
    test = learned.test if tested else fitting.test(learned, settings, name)
    test = None if test is None else fitting.accepted(learned, test)
    if test is not None and not test["used"]:
        log.warning("%s: the network is not used: %s", name, text_of(test))
    kept = {
        "selection": trainer.selection,
        "epoch": trainer.best_epoch,
        "validation_rollout_error_mm": error,
    }
    return replace(
        learned, training={"kept": {**kept, "test": test}, "epochs": trainer.history}, test=test
    )
