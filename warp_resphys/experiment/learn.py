"""Stages: train the residual force and the data-driven baseline, on reconstructed steps or through the simulator."""

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from ..data.dataset import STATIC
from ..dynamics.modes import RestStiffness
from ..io.files import read_array, read_hdf5, resume_checkpoint, write_checkpoint, write_json
from ..io.progress import Progress
from ..io.stages import StageContext
from ..learning.correction import Range, force_frames
from ..learning.in_the_loop import InTheLoop, MotionLoss, TrialGroup, cross_validated_epochs
from ..learning.networks import ResidualForce, StateMap, build_model
from ..learning.replay import Replay, Windows
from ..learning.training import EpochTrainer, Samples, SequenceTrainer, Trainer
from ..settings.learning import InTheLoopSettings, NetworkSettings, TrainingSettings
from ..settings.stages import StageSettings
from .build import choose_device
from .experiment import LAW, Experiment
from .files import reconstruction_file, training_file, weights_file
from .models import SIMFREE, Learned, kind_of, rollout_error

log = logging.getLogger(__name__)
_CHECKPOINT_SECONDS = 10.0

Snapshot = tuple[dict[str, torch.Tensor], dict[str, Any]]


def samples_of(experiment: Experiment, model: str, names: Sequence[str], device: torch.device) -> Samples:
    """Collects the single steps of trials that a model is trained on; a static pose is one step without motion.

    States are in the frame of the base. The output is the force during the step, rotated to the rest shape if forces
    are corotated; for ``simfree`` it is the displacement and velocity at the end of the step. Steps without any visible
    marker are left out.
    """
    parts = [_samples(experiment, model, batch, device) for batch in experiment.dataset.batches(names)]
    samples = Samples.joined(parts)
    frames = (
        None if model == SIMFREE else force_frames(experiment.model_simulator(model), experiment.settings.force_frame)
    )
    if frames is None:
        return samples
    return dataclasses.replace(samples, outputs=(frames.to_rest(samples.q, samples.v, *samples.outputs),))


def _samples(experiment: Experiment, model: str, names: Sequence[str], device: torch.device) -> Samples:
    """Samples of trials that begin in the same way, with forces in the world frame."""
    simulator = experiment.model_simulator(model)
    q, v, force, seen = _states(experiment, model, names, device, simulated=model == SIMFREE)
    base, like = experiment.motions.base(names, simulator), simulator.rest_positions
    if base is not None:
        pairs = enumerate(zip(q.unbind(1), v.unbind(1), strict=True))
        inside = [base.enter(x.to(like), w.to(like), k) for k, (x, w) in pairs]
        q, v = (torch.stack(field, 1).to(q) for field in zip(*inside, strict=True))
        forces = enumerate(force.unbind(1))  # The force of a frame belongs to the previous step.
        force = torch.stack([base.force_inside(f.to(like), k - 1) for k, f in forces], 1).to(force)
    if experiment.dataset.begin_of(names[0]) == STATIC:
        q, v, force, seen = q[:, 1:2].expand(-1, 2, -1, -1), torch.zeros_like(v[:, :2]), force[:, :2], seen[:, :1]
    steps, whole = q.shape[1] - 1, bool(seen.all())

    def pick(field: torch.Tensor) -> torch.Tensor:
        return field.flatten(0, 1) if whole else field[seen]

    inputs = experiment.motions.conditions(
        experiment.motions.replay(simulator, names), experiment.parameters(model), model == SIMFREE
    )
    if inputs is not None:  # (K, R, A), or (R, A) constant in time
        inputs = inputs[:steps].swapaxes(0, 1) if inputs.ndim == 3 else inputs[:, None].expand(-1, steps, -1)
        inputs = pick(inputs.to(device))
    now = pick(q[:, :-1]), pick(v[:, :-1])
    lengths = tuple(seen.sum(1).tolist())
    if model != SIMFREE:
        return Samples(*now, (pick(force[:, 1:]),), inputs, lengths)
    return Samples(*now, (pick(q[:, 1:]) - experiment.like.to(q), pick(v[:, 1:])), inputs, lengths)


def _states(
    experiment: Experiment, model: str, names: Sequence[str], device: torch.device, simulated: bool = True
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Positions, velocities and forces (R, K + 1, N, 3) of trials, and (R, K) whether steps were seen.

    States are the reconstructed ones; those of the trials themselves, with zero forces, if `simulated` and known.
    """
    dataset, rows = experiment.dataset, experiment.dataset.rows(names)
    if simulated and dataset.velocity is not None:
        q, v = (torch.as_tensor(field[rows], device=device) for field in (dataset.observed, dataset.velocity))
        return q, v, q.new_zeros(()).expand_as(q), torch.ones(len(q), q.shape[1] - 1, dtype=torch.bool)
    source = "resphys" if model == SIMFREE else model
    with read_hdf5(experiment.folder / reconstruction_file(source), "reconstruction") as file:
        order = [str(name) for name in file.attrs["names"]]
        rows = [order.index(name) for name in names]
        index = slice(rows[0], rows[-1] + 1) if rows == [*range(rows[0], rows[-1] + 1)] else rows
        q, v, force, error = (
            torch.as_tensor(read_array(file, key)[index], device=device) for key in ("q", "v", "force", "error")
        )
    return q, v, force, error[:, 1:].isfinite()


Prepared = tuple[EpochTrainer[Any], Learned]  # a trainer, ready to run, and its network with settings of roll-outs


def trainer_of(experiment: Experiment, model: str, settings: TrainingSettings) -> Prepared:
    """Prepares the trainer of a new model; the result depends on the settings only.

    Raises:
        InputError: a setting out of range, or an empty split.
    """
    train = samples_of(experiment, model, experiment.settings.split.train, choose_device(experiment.settings.device))
    if settings.in_the_loop is not None:
        return _in_the_loop(experiment, model, train, settings, settings.in_the_loop)
    return _supervised(experiment, model, train, settings)


def new_network(experiment: Experiment, model: str, train: Samples, settings: TrainingSettings) -> StateMap:
    """Makes an untrained network with coders fitted to the training steps, deterministic for a seed."""
    rest, network = experiment.like.to(train.q.device), settings.network
    if not experiment.dataset.moving(experiment.settings.split.train):
        network = _limited(network, len(train.q), model)
    torch.manual_seed(settings.seed)
    by_displacement = model != SIMFREE and network.kind == "reduced" and network.force_basis == "displacement"
    stiffness = RestStiffness(experiment.model_simulator(model)) if by_displacement else None
    force = None if model == SIMFREE else train.outputs[0]
    return build_model(kind_of(model)[0], network, rest, train.q, train.v, force, train.actuation, stiffness)


def _limited(network: NetworkSettings, poses: int, model: str) -> NetworkSettings:
    """The group ``network`` with at most as many modes as there are training poses."""
    names = ("position_modes",) if model == SIMFREE else ("position_modes", "force_modes")
    many = {name: getattr(network, name) for name in names if getattr(network, name) > poses}
    if many:
        reduced = " and ".join(f"network.{name} from {count}" for name, count in many.items())
        log.info("%s: reduced %s to %d, the number of training poses", model, reduced, poses)
    return network.changed(**dict.fromkeys(many, poses))


def _supervised(experiment: Experiment, model: str, train: Samples, settings: TrainingSettings) -> Prepared:
    """Prepares training on single steps, validated by roll-outs; without validation trials, of the training trials."""
    split = experiment.settings.split
    judged = split.validation or split.train
    validation = samples_of(experiment, model, judged, train.q.device) if split.validation else train
    network = new_network(experiment, model, train, settings)
    learned = Learned(network, _range_of(experiment, model, network, train), experiment.settings.force_frame)
    error = rollout_error(dataclasses.replace(experiment, on_failure="count"), model, judged)
    kind: type[Trainer[Any]] = Trainer if network.recurrent is None else SequenceTrainer

    def judge(weights: StateMap) -> float:
        return error(dataclasses.replace(learned, network=weights))

    return kind(network, train, validation, judge, settings.trainer, settings.seed), learned


def _range_of(experiment: Experiment, model: str, network: StateMap, train: Samples) -> Range | None:
    """Training range of a network's inputs, to which roll-outs clamp them; None without ``range_guard``.

    A force on the law of the material fades out beyond it.
    """
    if not experiment.settings.range_guard:
        return None
    with torch.no_grad():
        missed = network.missed(train.q, train.v) if experiment.sources(model)[0] == LAW else None
        return Range.of(network.encode(train.q, train.v, train.actuation), missed)


def _in_the_loop(
    experiment: Experiment, model: str, samples: Samples, settings: TrainingSettings, loop: InTheLoopSettings
) -> Prepared:
    """Prepares training through the simulator, on whole trials or on windows; weights are chosen on whole trials.

    The reconstruction provides the modes of motions and forces, the states at which windows begin, and the force to
    begin with if it is not zero. From zero and without validation trials, the number of epochs is found by
    cross-validation, holding out each training trial once; it may be zero.
    """
    split = experiment.settings.split
    parameters, simulator = experiment.parameters(model), experiment.model_simulator(model)
    replays = experiment.motions.replays(simulator, split.train + split.validation, experiment.identified(model))
    frames = force_frames(simulator, experiment.settings.force_frame)

    def loss(names: Sequence[str], window: int | None = None) -> MotionLoss:
        watched = []
        for replay, start in replays:
            batch = replay.trials.names
            rows = [batch.index(name) for name in names if name in batch]
            if rows:
                part = Replay(simulator, replay.observe, replay.trials.select(rows))
                inputs = experiment.motions.conditions(part, parameters)
                base = experiment.motions.base(part.trials.names, simulator)
                windows = None
                if window is not None:
                    like = simulator.rest_positions
                    q, v, *_ = _states(experiment, model, part.trials.names, like.device)
                    windows = Windows(q.to(like), v.to(like), window)
                watched.append(TrialGroup(part, start.select(rows), inputs, frames, base, windows))
        return MotionLoss(watched, parameters)

    def make_network() -> ResidualForce:
        network = new_network(experiment, model, samples, settings)
        assert isinstance(network, ResidualForce)
        return network.double()

    epochs, after, train, validation = None, 0, split.train, split.validation
    if loop.start == "steps":
        first, _ = _supervised(experiment, model, samples, settings)
        run_epochs(f"{model}: steps", first, lambda _: None)
        network, after = first.use_best().double().train(), first.best_epoch
    elif loop.hold_out and not validation and len(train) > 1:
        parts = [(loss([name for name in train if name != out], loop.window), loss([out])) for out in train]
        with Progress(f"{model}: held out", len(train) * loop.epochs, "epochs at most") as progress:
            epochs = cross_validated_epochs(make_network, parts, loop, progress.advance)
        log.debug("%s: %d epochs are best for held-out trials", model, epochs)
        network = make_network()
    else:
        network = make_network()
    trainer = InTheLoop(network, loss(train, loop.window), loss(validation or train), loop, epochs, after)
    trainer.begin()
    range_ = _range_of(experiment, model, trainer.model, samples)
    return trainer, Learned(trainer.model, range_, experiment.settings.force_frame)


def train(context: StageContext) -> None:
    """Trains a model; writes <model>.safetensors, with the selected weights, and training_<model>.json.

    An interrupted training resumes.
    """
    settings: StageSettings = context.settings
    model = settings.model
    trainer, learned = trainer_of(Experiment(settings, context.run_dir), model, settings.training)
    checkpoint = context.run_dir / f"{context.name}.safetensors"
    if (snapshot := resume_checkpoint(checkpoint, "training", context.fingerprint)) is not None:
        trainer.resume(*snapshot)

    def save(kept: Snapshot) -> None:
        write_checkpoint(checkpoint, "training", kept[0], {**kept[1], "fingerprint": context.fingerprint})

    run_epochs(context.name, trainer, save)
    best = trainer.use_best()
    kept = {
        "selection": trainer.selection,
        "epoch": trainer.best_epoch,
        "validation_rollout_error_mm": trainer.best_error if math.isfinite(trainer.best_error) else None,
    }
    if kept["validation_rollout_error_mm"] is None:
        log.warning("%s: the selected weights diverge on the validation split", context.name)
    write_json(context.run_dir / training_file(model), {"kept": kept, "epochs": trainer.history})
    write_checkpoint(
        context.run_dir / weights_file(model),
        kind_of(model)[1],
        best.state_dict(),
        {**best.description(), **learned.description(), **kept, "fingerprint": context.fingerprint},
    )
    checkpoint.unlink(missing_ok=True)


def run_epochs(
    name: str,
    trainer: EpochTrainer[Any],
    save: Callable[[Snapshot], None],
    watch: Callable[[Mapping[str, float]], None] | None = None,
) -> None:
    """Trains to the end; saves the last complete epoch regularly, and whenever training ends or is interrupted.

    Args:
        name: description of the progress bar.
        trainer: trainer, possibly resumed.
        save: saves a snapshot.
        watch: is called with the record of every epoch; an exception raised by it ends the training.
    """
    saved = time.monotonic()
    kept = _copy(trainer.snapshot())
    with Progress(name, trainer.settings.epochs, "epochs", trainer.epoch) as progress:
        try:
            while not trainer.finished:
                record = trainer.run_epoch()
                kept = _copy(trainer.snapshot())
                if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                    save(kept)
                    saved = time.monotonic()
                shown: dict[str, object] = {"loss": f"{record['train_loss']:.2e}"}
                if not math.isnan(trainer.best_error):
                    shown["rollout"] = f"{trainer.best_error:.2g} mm"
                progress.advance(1, **shown)
                if watch is not None:
                    watch(record)
        finally:
            save(kept)


def _copy(snapshot: Snapshot) -> Snapshot:
    """Copies a snapshot, whose tensors the next epoch changes in place."""
    tensors, metadata = snapshot
    copies = {name: tensor.detach().clone() for name, tensor in tensors.items()}
    return copies, {**metadata, "history": list(metadata["history"])}
