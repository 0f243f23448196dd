"""Stage: roll-outs of the test split, by every model, and their errors."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..io.files import write_json
from ..io.progress import Progress
from ..io.resumable import Field, ResumableHDF5
from ..io.stages import StageContext
from ..learning.metrics import summarise, summarise_each, trajectory_errors
from ..learning.rollout import DataDrivenRollout, HybridRollout, Rollout
from .build import build_simulator
from .train import force_predictor, load_model, load_simfree, state_predictor
from .trajectories import (
    ERRORS,
    RECONSTRUCTION,
    ROLLOUTS,
    SIMFREE,
    TRAJECTORIES,
    read_fields,
    split_of,
)

MODELS = ("simulation", "resphys", "simfree")


def evaluate(context: StageContext) -> None:
    """Writes rollouts.h5, (R, T + 1, N, 3) positions a model and the target, and errors.json."""
    settings = context.settings
    split, _ = split_of(settings["data"])
    part = split.indices("test")
    (target, velocity) = read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q", "v")
    (reconstruction,) = read_fields(context.run_dir / RECONSTRUCTION, "reconstruction", "q")
    target, reconstruction = target[part], reconstruction[part]
    _roll_out(context, target[:, 0], velocity[part, 0], target.shape[1])
    positions = dict(
        zip(MODELS, read_fields(context.run_dir / ROLLOUTS, "rollouts", *(f"{m}_q" for m in MODELS)), strict=True)
    )
    positions["reconstruction"] = reconstruction
    against_target = {m: _errors(q, target) for m, q in positions.items()}
    against_reconstruction = {m: _errors(positions[m], reconstruction) for m in MODELS}
    summary: dict[str, Any] = {
        "errors_mm": {m: summarise(e) for m, e in against_target.items()},
        "errors_vs_reconstruction_mm": {m: summarise(e) for m, e in against_reconstruction.items()},
        "per_trajectory": summarise_each(split.test, against_target),
    }
    write_json(context.run_dir / ERRORS, summary)


def _errors(positions: NDArray[np.float64], target: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    return [trajectory_errors(q, t) for q, t in zip(positions, target, strict=True)]


def _roll_out(context: StageContext, q: NDArray[np.float64], v: NDArray[np.float64], frames: int) -> None:
    """Every model over all frames; frame 0 is the start."""
    simulator = build_simulator(context.settings, on_failure="count")
    make = model_rollouts(context, simulator)
    batch, vertices, _ = q.shape
    fields = {}
    for m in MODELS:
        fields[f"{m}_q"] = Field((batch, vertices, 3), "m", batch_axes=1)
        fields[f"{m}_v"] = Field((batch, vertices, 3), "m/s", batch_axes=1)
    path = context.run_dir / ROLLOUTS
    with (
        ResumableHDF5(path, "rollouts", context.fingerprint, frames, fields) as file,
        Progress("evaluate", frames, "frames", file.done) as progress,
    ):
        runs = {m: _Run(simulator, make[m], m, file, q, v) for m in MODELS}
        while file.done < file.steps:
            arrays: dict[str, NDArray[np.float64]] = {}
            for run in runs.values():
                arrays |= run.frame(file.done)
            file.append(**arrays)
            progress.advance()
        file.finish({"names": list(split_of(context.settings["data"])[0].test)})


def model_rollouts(context: StageContext, simulator: Simulator) -> dict[str, Callable[[torch.Tensor | None], Rollout]]:
    """For each model, what makes its roll-out from the environments that are lost already."""
    force = force_predictor(load_model(context.run_dir / context.settings["force"]))
    following = state_predictor(load_simfree(context.run_dir / SIMFREE))
    return {
        "simulation": partial(HybridRollout, simulator, None),
        "resphys": partial(HybridRollout, simulator, force),
        "simfree": partial(DataDrivenRollout, simulator, following),
    }


class _Run:
    """One model's roll-out, from the start or from where a file ends."""

    def __init__(
        self,
        simulator: Simulator,
        make: Callable[[torch.Tensor | None], Rollout],
        name: str,
        file: ResumableHDF5,
        q: NDArray[np.float64],
        v: NDArray[np.float64],
    ) -> None:
        self.name = name
        previous = None
        if file.done > 0 and file.done < file.steps:
            q, v = (file.read(file.done - 1)[f"{name}_{key}"] for key in "qv")
            if file.done > 1:
                back = file.read(file.done - 2)
                previous = (
                    simulator.tensor(np.nan_to_num(back[f"{name}_q"])),
                    simulator.tensor(back[f"{name}_v"]),
                )
        positions = simulator.tensor(q)
        lost = ~torch.isfinite(positions).flatten(1).all(1)
        rest = simulator.rest_state(len(positions)).q
        start = torch.where(lost[:, None, None], rest, positions)
        self.rollout = make(lost)
        self.state = State(start, simulator.tensor(v), previous)

    def frame(self, index: int) -> dict[str, NDArray[np.float64]]:
        """Positions and velocities of the next frame; the first is the start."""
        if index > 0:
            self.state = self.rollout.step(self.state)
        q = self.rollout.positions(self.state)
        return {f"{self.name}_q": q.cpu().numpy(), f"{self.name}_v": self.state.v.cpu().numpy()}
