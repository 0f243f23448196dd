"""Stages: the residual force and the data-driven baseline, from what markers saw."""

import logging
from collections.abc import Sequence

import torch

from ...io.progress import Progress
from ...io.stages import StageContext
from ...learning.markers_in_the_loop import MarkersInTheLoop, MotionLoss, epochs_that_hold_up
from ...learning.networks import NextState, ResidualForce, build_model, build_next_state
from ...learning.replay import Replay
from ...learning.rollout import DataDrivenRollout
from ...learning.training import Samples, Trainer
from ..train import fit
from ..trajectories import read_fields
from .evaluate import marker_error_mm, state_predictor_of
from .files import training_file, weights_file
from .scene import Scene, loads, parameters_of

log = logging.getLogger(__name__)


def _samples(context: StageContext, scene: Scene, model: str, like: torch.Tensor) -> dict[str, torch.Tensor]:
    """What the reconstruction of the training trials holds, and the loads of its trajectories (R, 1)."""
    path = context.run_dir / f"reconstruction_{model}.h5"
    fields = read_fields(path, "reconstruction", "q", "v", "force")
    found = {name: like.new_tensor(field) for name, field in zip(("q", "v", "force"), fields, strict=True)}
    found["load"] = loads(scene.pick(tuple(context.settings["split"]["train"]))).to(like)
    return found


def train_on_markers(context: StageContext) -> None:
    """Trains the residual force of a simulator: <model>.safetensors and training_<model>.json.

    The reconstruction says in which modes bodies move and forces act; the weights come from the markers themselves,
    through the simulator. Without validation trials, each training trial is held out once to find how long training
    serves others; no epoch at all is one of the choices.
    """
    settings = context.settings
    kind, model = settings["base"]
    scene = Scene(settings, context.run_dir / settings["shared"])
    simulator = scene.simulator(kind)
    parameters = parameters_of(context.run_dir, model, simulator.rest_positions)
    found = _samples(context, scene, model, simulator.rest_positions)
    steps = found["q"].shape[1] - 1
    config = settings["in_the_loop"]

    def make_model() -> ResidualForce:
        torch.manual_seed(settings["seed"])
        return build_model(
            settings["network"],
            simulator.rest_positions,
            found["q"][:, :-1].flatten(0, 1),
            found["v"][:, :-1].flatten(0, 1),
            found["force"][:, 1:].flatten(0, 1),
            found["load"].repeat_interleave(steps, 0) if config["sees_loads"] else None,
        ).double()

    train, validation = (settings["split"][name] for name in ("train", "validation"))
    everyone = (*train, *validation)
    replay, release = scene.replay(kind, everyone)

    def loss(names: Sequence[str]) -> MotionLoss:
        rows = [everyone.index(name) for name in names]
        motions = replay.motions.select(rows)
        part = Replay(replay.simulator, replay.markers, motions)
        return MotionLoss(part, release.select(rows), parameters, loads(motions))

    epochs = None
    if config["hold_out"] and not validation and len(train) > 1:
        parts = [(loss([name for name in train if name != out]), loss([out])) for out in train]
        with Progress(f"{context.name}: held out", len(train) * config["epochs"], "epochs at most") as progress:
            epochs = epochs_that_hold_up(make_model, parts, config, progress.advance)
        log.info("%s: %d epochs serve trials that are held out best", context.name, epochs)
    judged = loss(validation) if validation else None
    trainer = MarkersInTheLoop(make_model(), loss(train), judged, config, epochs)
    trainer.begin()
    fit(context, trainer, weights_file(model), training_file(model), "residual force")


def train_simfree_on_markers(context: StageContext) -> None:
    """Trains the data-driven baseline on the reconstructed states: simfree.safetensors and training_simfree.json."""
    settings = context.settings
    scene = Scene(settings, context.run_dir / settings["shared"])
    simulator = scene.simulator("identified")
    torch.manual_seed(settings["seed"])
    found = _samples(context, scene, "resphys", simulator.rest_positions)
    rest = simulator.rest_positions
    q, v, steps = found["q"], found["v"], found["q"].shape[1] - 1
    actuation = found["load"].repeat_interleave(steps, 0)
    now = (q[:, :-1].flatten(0, 1), v[:, :-1].flatten(0, 1))
    samples = Samples(*now, ((q[:, 1:] - rest).flatten(0, 1), v[:, 1:].flatten(0, 1)), actuation)
    model = build_next_state(settings["network"], rest, *now, actuation)
    judged = tuple(settings["split"]["validation"]) or tuple(settings["split"]["train"])
    motions = scene.pick(judged)
    start = scene.release(simulator, motions)

    def error(candidate: NextState) -> float:
        rollout = DataDrivenRollout(simulator, state_predictor_of(candidate, loads(motions)))
        return marker_error_mm(rollout, simulator, scene.markers, motions, start)

    trainer = Trainer(model, samples, samples, error, settings["trainer"], settings["seed"])
    fit(context, trainer, weights_file("simfree"), training_file("simfree"), "next state")
