"""Stage: computing times of the models."""

import time
from statistics import mean, pstdev

import torch

from ..core.dynamics.simulator import Simulator
from ..io.progress import Progress
from ..io.resuming import StageContext
from ..io.safe_files import write_json
from ..learning.evaluation import TrialRollout
from ..learning.residuals.correction import Learned
from ..settings.stage_keys import StageSettings
from .experiment import Experiment
from .files import TIMES

_WARM_UP = 20  # steps before computing times are measured


def time_models(context: StageContext) -> None:
    """Writes times.json: computing time per test trial [s],
    mean and standard deviation over the trials.

    The rows are those of the published table: the uncorrected simulator, the simulator with the
    true parameters if the target has its mesh and time step, the simulator with the learned force,
    and the network alone. Trials run one at a time, once, after the first steps of the first trial,
    which load kernels.
    """
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    names = experiment.trials.moving(settings.groups["1"])
    simulator = experiment.model_simulator("resphys")
    learned = experiment.learned("resphys")
    replays = {
        name: experiment.motions.replay(simulator, [name], experiment.identified("resphys"))
        for name in names
    }
    starts = {name: experiment.motions.start(replay) for name, replay in replays.items()}
    uncorrected = experiment.simulator("simulation")
    rows: dict[str, tuple[str, Learned | None, Simulator]] = {
        "simulation": ("simulation", None, uncorrected)
    }
    target, shared = settings.target, ("mesh", "parts", "time_step")
    if target is not None and all(getattr(target, key) == getattr(settings, key) for key in shared):
        rows["target"] = ("simulation", None, experiment.simulator("target"))
    rows |= {"resphys": ("resphys", learned, simulator)}
    rows |= {} if learned is None else {"inference": ("resphys", learned, simulator)}
    times: dict[str, dict[str, float]] = {}
    steps = 0
    with Progress(context.name, len(rows) * len(names), "trials") as progress, torch.no_grad():
        for row, (model, network, stepping) in rows.items():
            identified, motions = experiment.identified(model), experiment.motions
            runs = [
                TrialRollout(stepping, motions, [name], identified, start=starts[name])
                for name in names
            ]
            seconds = []
            for number, run in enumerate((runs[0], *runs)):
                steps = min(run.steps, _WARM_UP) if number == 0 else run.steps
                predictor = None if network is None else run.predictor(network)
                state = run.begin(predictor)
                rolled = run.roll(predictor)
                next(rolled)
                before = time.perf_counter()
                for step in range(steps):
                    if row == "inference" and predictor is not None:
                        predictor(state, step)
                    else:
                        next(rolled)
                seconds.append(time.perf_counter() - before)
            progress.advance(len(names))
            times[row] = {"mean": mean(seconds[1:]), "std": pstdev(seconds[1:])}
    write_json(context.run_dir / TIMES, {"steps": steps, "seconds": times})
