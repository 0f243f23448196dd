"""Stage: the residual force trained on through the simulator."""

import logging

from ..dynamics.simulator import Simulator
from ..io.stages import StageContext
from ..learning.refinement import Motion, SolverInTheLoop, WindowLoss
from ..learning.rollout import HybridRollout
from .build import build_simulator, choose_device
from .train import Validation, fit, force_predictor, load_model
from .trajectories import MODEL, REFINED, REFINEMENT, TRAJECTORIES, read_fields, split_of

log = logging.getLogger(__name__)


def refine(context: StageContext) -> None:
    """Refines what `train` wrote: refined.safetensors, with the selected weights, and refinement.json."""
    settings = context.settings
    split, _ = split_of(settings["data"])
    validation = Validation(context, split, "simulation")
    simulator = validation.simulator
    q, v = map(simulator.tensor, read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q", "v"))
    motions = {name: Motion(q[part], v[part]) for name in ("train", "validation") for part in [split.indices(name)]}
    model = load_model(context.run_dir / MODEL).to(choose_device(settings["device"]))
    predict = force_predictor(model)

    def make_simulator() -> Simulator:
        return build_simulator(settings, "simulation", simulator.body, on_failure="count")

    config = settings["refinement"]
    trainer = SolverInTheLoop(
        model,
        WindowLoss(predict, make_simulator, config["window"], config["batch_size"]),
        motions["train"],
        motions["validation"],
        lambda _: validation.error_mm(HybridRollout(simulator, predict)),
        config,
    )
    fit(context, trainer, REFINED, REFINEMENT, "residual force")
    left_out = trainer.state.history[0]["left_out"]
    if left_out:
        log.warning("%s: %d windows could not be simulated and were left out", context.name, left_out)
