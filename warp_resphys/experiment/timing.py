"""Stage: how long a test trajectory takes, for the simulator without and with the learned force."""

import time
from collections.abc import Callable
from statistics import mean, pstdev

import torch

from ..dynamics.integrator import State
from ..io.files import write_json
from ..io.progress import Progress
from ..io.stages import StageContext
from ..learning.rollout import HybridRollout, closed_loop
from .build import build_simulator
from .train import force_predictor, load_model
from .trajectories import TIMES, TRAJECTORIES, read_fields, split_of


def time_models(context: StageContext) -> None:
    """Writes times.json: seconds a test trajectory, mean and standard deviation over the trajectories.

    The published table's rows: the uncorrected simulator, the simulator with the true parameters, the simulator with
    the learned force, and the network alone. One trajectory at a time, each once, after a run of the first to warm up.
    """
    settings = context.settings
    split, _ = split_of(settings["data"])
    part = split.indices("test")
    q, v = read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q", "v")
    steps = q.shape[1] - 1
    simulator = build_simulator(settings, on_failure="count")
    true = build_simulator(settings, "reality", on_failure="count")
    predict = force_predictor(load_model(context.run_dir / settings["force"]))
    starts = [
        State(simulator.tensor(a[None, 0]), simulator.tensor(b[None, 0])) for a, b in zip(q[part], v[part], strict=True)
    ]

    def inference(start: State) -> None:
        with torch.no_grad():
            for _ in range(steps):
                predict(start.q, start.v)

    rows: dict[str, Callable[[State], object]] = {
        "simulation": lambda start: closed_loop(HybridRollout(simulator, None), start, steps),
        "true_parameters": lambda start: closed_loop(HybridRollout(true, None), start, steps),
        "resphys": lambda start: closed_loop(HybridRollout(simulator, predict), start, steps),
        "inference": inference,
    }
    times: dict[str, dict[str, float]] = {}
    with Progress("time", len(rows) * len(starts), "trajectories") as progress:
        for name, run in rows.items():
            run(starts[0])
            seconds = []
            for start in starts:
                before = time.perf_counter()
                run(start)
                seconds.append(time.perf_counter() - before)
                progress.advance()
            times[name] = {"mean": mean(seconds), "std": pstdev(seconds)}
    write_json(context.run_dir / TIMES, {"steps": steps, "seconds": times})
