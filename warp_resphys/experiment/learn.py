"""Stages: the residual force and the data-driven baseline, from reconstructed trials or through the simulator."""

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..dynamics.modes import RestStiffness
from ..dynamics.simulator import Simulator
from ..io.files import read_array, read_hdf5, write_checkpoint, write_json
from ..io.progress import Progress
from ..io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ..io.stages import StageContext
from ..learning.markers_in_the_loop import MarkersInTheLoop, MotionLoss, Watched, cross_validated_epochs
from ..learning.networks import ResidualForce, StateMap, build_model, build_next_state
from ..learning.predictors import Range
from ..learning.refinement import Motion, SolverInTheLoop, WindowLoss
from ..learning.replay import Replay
from ..learning.training import EpochTrainer, Samples, SequenceTrainer, Trainer
from .build import choose_device
from .files import STATIC, reconstruction_file, training_file, weights_file
from .models import SIMFREE, Learned, kind_of, load, rollout_error
from .reconstruct import reconstructing_simulator
from .scene import Scene

log = logging.getLogger(__name__)
_CHECKPOINT_SECONDS = 10.0

Snapshot = tuple[dict[str, torch.Tensor], dict[str, Any]]


@dataclass(frozen=True)
class Steps:
    """S single steps that networks learn from, and poses, from which a body goes nowhere, in the frame of the base.

    Attributes:
        q: (S, N, 3) positions where they begin [m].
        v: (S, N, 3) velocities there [m/s].
        told: (S, A) what the networks are told of the inputs; None for nothing.
        force: (S, N, 3) that leads on [N]; None where the states were not reconstructed.
        following: positions and velocities (S, N, 3) where they end.
        lengths: of the series that the steps are, a trial each.
    """

    q: torch.Tensor
    v: torch.Tensor
    told: torch.Tensor | None
    force: torch.Tensor | None
    following: tuple[torch.Tensor, torch.Tensor]
    lengths: tuple[int, ...]


def steps_of(scene: Scene, model: str, names: Sequence[str], device: torch.device) -> Steps:
    """The steps of some trials that a model learns from: known ones, or what the reconstruction left.

    What no marker saw has no force to learn.
    """
    dataset = scene.dataset
    if model == SIMFREE and dataset.velocity is not None:
        rows = dataset.rows(names)
        q, v = (torch.as_tensor(field[rows], device=device) for field in (dataset.observed, dataset.velocity))
        given = _told(scene, model, names, q.shape[1] - 1)
        given = None if given is None else given.to(device)
        q, v = _in_base(scene, model, names, q, v)
        return _steps(q, v, None, given, torch.ones(q.shape[0], q.shape[1] - 1, dtype=torch.bool))
    found = []
    for some in scene.alike(names):
        q, v, force, seen = read_states(scene, model, some, device)
        q, v = _in_base(scene, model, some, q, v)
        force = _forces_in_base(scene, model, some, force)
        told = _told(scene, model, some, q.shape[1] - 1)
        if scene.begins(some[0]) == STATIC:
            q, v = q[:, 1:2].expand(-1, 2, -1, -1), torch.zeros_like(v[:, :2])
            force, seen = force[:, :2], seen[:, :1]
        found.append(_steps(q, v, force, None if told is None else told[:, : q.shape[1] - 1].to(device), seen))
    return found[0] if len(found) == 1 else _together(found)


def read_states(
    scene: Scene, model: str, names: Sequence[str], device: torch.device
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Positions, velocities, forces (R, K + 1, N, 3) of trials that begin alike, and (R, K) whether steps were seen."""
    source = "resphys" if model == SIMFREE else model
    with read_hdf5(scene.folder / reconstruction_file(source), "reconstruction") as file:
        order = [str(name) for name in file.attrs["names"]]
        rows = [order.index(name) for name in names]
        index = slice(rows[0], rows[-1] + 1) if rows == [*range(rows[0], rows[-1] + 1)] else rows
        found = {key: read_array(file, key)[index] for key in ("q", "v", "force", "error")}
    q, v, force = (torch.as_tensor(found[key], device=device) for key in ("q", "v", "force"))
    return q, v, force, torch.as_tensor(np.isfinite(found["error"][:, 1:]), device=device)


def _steps(
    q: torch.Tensor, v: torch.Tensor, force: torch.Tensor | None, told: torch.Tensor | None, seen: torch.Tensor
) -> Steps:
    """The steps between (R, K + 1, N, 3) states of which the end was seen (R, K)."""
    whole = bool(seen.all())

    def pick(field: torch.Tensor) -> torch.Tensor:
        return field.flatten(0, 1) if whole else field[seen]

    now = (pick(q[:, :-1]), pick(v[:, :-1]), None if told is None else pick(told))
    lengths = tuple(seen.sum(1).tolist())
    return Steps(*now, None if force is None else pick(force[:, 1:]), (pick(q[:, 1:]), pick(v[:, 1:])), lengths)


def _together(parts: Sequence[Steps]) -> Steps:
    def joined(fields: Sequence[torch.Tensor | None]) -> Any:
        known = [each for each in fields if each is not None]
        return torch.cat(known) if known else None

    own = {name: joined([getattr(each, name) for each in parts]) for name in ("q", "v", "told", "force")}
    following = (joined([p.following[0] for p in parts]), joined([p.following[1] for p in parts]))
    return Steps(**own, following=following, lengths=tuple(n for each in parts for n in each.lengths))


def _in_base(
    scene: Scene, model: str, names: Sequence[str], q: torch.Tensor, v: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """States (R, K + 1, N, 3) of some trials in the frame of their base."""
    simulator = scene.model_simulator(model)
    base, like = scene.base(names, simulator), simulator.rest_positions
    if base is None:
        return q, v
    steps = enumerate(zip(q.unbind(1), v.unbind(1), strict=True))
    inside = [base.enter(x.to(like), w.to(like), step) for step, (x, w) in steps]
    x, w = (torch.stack(each, 1).to(q) for each in zip(*inside, strict=True))
    return x, w


def _forces_in_base(scene: Scene, model: str, names: Sequence[str], force: torch.Tensor) -> torch.Tensor:
    """Forces (R, K + 1, N, 3), each that of the step before, in the frame of their base."""
    simulator = scene.model_simulator(model)
    base, like = scene.base(names, simulator), simulator.rest_positions
    if base is None:
        return force
    return torch.stack([base.force_inside(f.to(like), k - 1) for k, f in enumerate(force.unbind(1))], 1).to(force)


def _told(scene: Scene, model: str, names: Sequence[str], steps: int) -> torch.Tensor | None:
    """(R, K, A) what a model is told of the inputs of some trials that begin alike."""
    simulator = scene.model_simulator(model)
    replay = Replay(simulator, scene.observe, scene.trials(names, simulator))
    told = scene.conditions(replay, scene.parameters(model), model == SIMFREE)
    if told is None:
        return None
    return told[:steps].swapaxes(0, 1) if told.ndim == 3 else told[:, None].expand(-1, steps, -1)


@dataclass(frozen=True)
class Learning:
    """What is learned, from what, and how it is judged; the network and the way of training are open.

    Attributes:
        scene: of the experiment.
        model: name of what is learned.
        in_the_loop: whether weights come out of whole motions through the simulator.
    """

    scene: Scene
    model: str

    @property
    def in_the_loop(self) -> bool:
        """Whether the weights come out of whole trials through the simulator, not out of reconstructed steps."""
        return self.model != SIMFREE and self.scene.config.get("in_the_loop") is not None

    def trainer(self, groups: Mapping[str, Any]) -> "Prepared":
        """A trainer of a new model; the same settings and seed give the same model.

        Args:
            groups: ``network``, ``trainer``, ``in_the_loop`` and ``seed``, of the weights, the batches and the noise.

        Raises:
            InputError: a setting out of range, or an empty split.
        """
        split = self.scene.config["split"]
        device = choose_device(self.scene.config["device"])
        train = steps_of(self.scene, self.model, split["train"], device)
        if self.in_the_loop:
            return _in_the_loop(self.scene, self.model, train, groups)
        judged = split["validation"] or split["train"]
        validation = steps_of(self.scene, self.model, judged, device) if split["validation"] else train
        return _supervised(self.scene, self.model, {"train": train, "validation": validation}, judged, groups)


@dataclass(frozen=True)
class Prepared:
    """A trainer, and what goes with its weights.

    Attributes:
        trainer: to be run.
        learned: the weights as they are, for roll-outs.
    """

    trainer: EpochTrainer[Any]
    learned: Learned


def new_network(
    scene: Scene, model: str, steps: Steps, groups: Mapping[str, Any], forces: torch.Tensor | None
) -> StateMap:
    """An untrained network, with coders from the training steps; the same for the same seed."""
    rest = scene.simulator("simulation").rest_positions.to(steps.q.device)
    config = groups["network"]
    torch.manual_seed(groups["seed"])
    if forces is None:
        return build_next_state(config, rest, steps.q, steps.v, steps.told)
    by_displacement = config["kind"] == "reduced" and config["force_basis"] == "displacement"
    stiffness = RestStiffness(scene.model_simulator(model)) if by_displacement else None
    return build_model(config, rest, steps.q, steps.v, forces, steps.told, stiffness)


def _turned(scene: Scene, model: str, steps: Steps) -> torch.Tensor:
    """(S, N, 3) forces as a model is to learn them: those of the rest shape, where they turn with the body [N]."""
    assert steps.force is not None
    frames = scene.frames(scene.model_simulator(model))
    return steps.force if frames is None else frames.to_rest(steps.q, steps.v, steps.force)


def _supervised(
    scene: Scene, model: str, steps: Mapping[str, Steps], judged: Sequence[str], groups: Mapping[str, Any]
) -> Prepared:
    """Training on single steps, judged by roll-outs."""
    samples = {}
    for name, each in steps.items():
        if model == SIMFREE:
            rest = scene.simulator("simulation").rest_positions.to(each.q)
            outputs: tuple[torch.Tensor, ...] = (each.following[0] - rest, each.following[1])
        else:
            outputs = (_turned(scene, model, each),)
        samples[name] = Samples(each.q, each.v, outputs, each.told, each.lengths)
    train = samples["train"]
    network = new_network(scene, model, steps["train"], groups, None if model == SIMFREE else train.outputs[0])
    learned = Learned(network, _range_of(scene, network, train), scene.config["force_frame"])
    error = rollout_error(dataclasses.replace(scene, on_failure="count"), model, judged)
    kind: type[Trainer[Any]] = Trainer if network.recurrent is None else SequenceTrainer
    trainer = kind(
        network,
        train,
        samples["validation"],
        lambda weights: error(dataclasses.replace(learned, network=weights)),
        groups["trainer"],
        groups["seed"],
    )
    return Prepared(trainer, learned)


def _range_of(scene: Scene, network: StateMap, train: Samples) -> Range | None:
    """The range of a network's inputs in training, in which roll-outs hold it, if that is asked for."""
    if not scene.config["range_guard"]:
        return None
    with torch.no_grad():
        return Range.of(network.encode(train.q, train.v, train.actuation))


def _in_the_loop(scene: Scene, model: str, steps: Steps, groups: Mapping[str, Any]) -> Prepared:
    """Training on whole trials through the simulator.

    The reconstruction says in which modes bodies move and forces act. Without validation trials, each training trial is
    held out once to find how long training serves others; no epoch at all is one of the choices.
    """
    config, split = groups["in_the_loop"], scene.config["split"]
    parameters, forces = scene.parameters(model), _turned(scene, model, steps)
    simulator = scene.model_simulator(model)
    everyone = [(some, *scene.replay(simulator, some)) for some in scene.alike([*split["train"], *split["validation"]])]
    frames = scene.frames(simulator)

    def loss(names: Sequence[str]) -> MotionLoss:
        watched = []
        for some, replay, start in everyone:
            rows = [some.index(name) for name in names if name in some]
            if rows:
                part = Replay(simulator, replay.observe, replay.trials.select(rows))
                told = scene.conditions(part, parameters)
                base = scene.base(part.trials.names, simulator)
                watched.append(Watched(part, start.select(rows), told, frames, base))
        return MotionLoss(watched, parameters)

    def make_network() -> ResidualForce:
        found = new_network(scene, model, steps, groups, forces)
        assert isinstance(found, ResidualForce)
        return found.double()

    epochs, train, validation = None, split["train"], split["validation"]
    if config["hold_out"] and not validation and len(train) > 1:
        parts = [(loss([name for name in train if name != out]), loss([out])) for out in train]
        with Progress(f"{model}: held out", len(train) * config["epochs"], "epochs at most") as progress:
            epochs = cross_validated_epochs(make_network, parts, config, progress.advance)
        log.info("%s: %d epochs serve trials that are held out best", model, epochs)
    judged = loss(validation) if validation else None
    trainer = MarkersInTheLoop(make_network(), loss(train), judged, config, epochs)
    trainer.begin()
    range_ = _range_of(scene, trainer.model, Samples(steps.q, steps.v, (), steps.told))
    return Prepared(trainer, Learned(trainer.model, range_, scene.config["force_frame"]))


def train(context: StageContext) -> None:
    """Trains a model: <model>.safetensors, with the weights that are selected, and training_<model>.json."""
    settings, model = context.settings, context.settings["model"]
    prepared = Learning(Scene(settings, context.run_dir), model).trainer(settings)
    fit(context, prepared)


def refine(context: StageContext) -> None:
    """Trains a residual force on through the simulator: <model>_refined.safetensors and refinement_<model>.json."""
    settings, model = context.settings, context.settings["model"]
    scene = Scene(settings, context.run_dir, "count")
    simulator = scene.model_simulator(model)
    learned = load(context.run_dir, model, like=torch.zeros((), device=choose_device(settings["device"])))
    network, config = learned.network, settings["refinement"]
    assert isinstance(network, ResidualForce)
    split = settings["split"]
    judged = split["validation"] or split["train"]
    motions = {name: _motions(scene, model, split[name] or judged) for name in ("train", "validation")}
    error = rollout_error(scene, model, judged)
    loss = WindowLoss(
        network,
        partial(_fresh, scene, model),
        config["window"],
        config["batch_size"],
        observe=scene.observe,
        parameters=scene.parameters(model),
        frames=scene.frames(simulator, learned.force_frame),
        range_=learned.range_,
    )
    trainer = SolverInTheLoop(network, loss, motions["train"], motions["validation"], lambda _: error(learned), config)
    fit(context, Prepared(trainer, learned), refined=True)
    left_out = trainer.state.history[0]["left_out"]
    if left_out:
        log.warning("%s: %d windows could not be simulated and were left out", context.name, left_out)


def _fresh(scene: Scene, model: str) -> Simulator:
    """A simulator of a model whose solver has seen nothing yet."""
    simulator = scene.model_simulator(model)
    return dataclasses.replace(simulator)


def _motions(scene: Scene, model: str, names: Sequence[str]) -> list[Motion]:
    """What windows of some trials start from, and where they should go: a motion for those that begin alike."""
    found = []
    for some in scene.alike(scene.moving(names)):
        simulator = reconstructing_simulator(scene, model)
        replay, start = scene.replay(simulator, some)
        target = scene.explained(simulator, replay.trials, start)
        if scene.dataset.velocity is not None:
            q, v = (
                simulator.tensor(x[scene.dataset.rows(some)]) for x in (scene.dataset.observed, scene.dataset.velocity)
            )
        else:
            q, v, _, _ = read_states(scene, model, some, simulator.rest_positions.device)
            q, v = (field[:, : target.shape[1]].to(simulator.rest_positions) for field in (q, v))
        told = scene.conditions(replay, scene.parameters(model))
        found.append(Motion(q, v, target, replay.trials, told, scene.base(some, simulator)))
    return found


def fit(context: StageContext, prepared: Prepared, refined: bool = False) -> None:
    """Trains, going on from an interrupted run, and writes the selected weights and the history.

    Args:
        context: of the stage, whose settings name the model.
        prepared: the trainer, and what goes with the weights.
        refined: whether this is the refinement of a model that was trained before.
    """
    model, trainer = context.settings["model"], prepared.trainer
    checkpoint = context.run_dir / f"{context.name}.safetensors"
    found = resume_checkpoint(checkpoint, "training", context.fingerprint)
    if found is not None:
        trainer.resume(*found)
    run_epochs(context.name, trainer, lambda kept: save_training(checkpoint, kept, context.fingerprint))
    best = trainer.use_best()
    kept = {
        "selection": trainer.selection,
        "epoch": trainer.state.best_epoch,
        "validation_rollout_error_mm": trainer.best_error if math.isfinite(trainer.best_error) else None,
    }
    if kept["validation_rollout_error_mm"] is None:
        log.warning("%s: the weights that are kept diverge on the validation split", context.name)
    write_json(context.run_dir / training_file(model, refined), {"kept": kept, "epochs": trainer.state.history})
    write_checkpoint(
        context.run_dir / weights_file(model, refined),
        kind_of(model)[1],
        best.state_dict(),
        {**best.description(), **prepared.learned.description(), **kept, "fingerprint": context.fingerprint},
    )
    forget_checkpoint(checkpoint)


def run_epochs(
    name: str,
    trainer: EpochTrainer[Any],
    save: Callable[[Snapshot], None],
    watch: Callable[[Mapping[str, float]], None] | None = None,
) -> None:
    """Trains to the end; on the way, and however it ends, keeps the last whole epoch.

    Args:
        name: what is shown beside the progress.
        trainer: goes on from where it stands.
        save: keeps a snapshot.
        watch: is told the record of every epoch; what it raises ends the training.
    """
    saved = time.monotonic()
    kept = _copy(trainer.snapshot())
    with Progress(name, trainer.config["epochs"], "epochs", trainer.state.epoch) as progress:
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
    """The next epoch changes the tensors in place."""
    tensors, metadata = snapshot
    return {k: t.detach().clone() for k, t in tensors.items()}, {
        **metadata,
        "history": list(metadata["history"]),
    }


def save_training(checkpoint: Path, kept: Snapshot, fingerprint: str) -> None:
    """Writes a checkpoint that `resume_checkpoint` reads under the same fingerprint."""
    keep_checkpoint(checkpoint, "training", kept[0], {**kept[1], "fingerprint": fingerprint})
