"""Time of a command of the controllers that plan anew at each step, for the benchmark."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..control.controllers import Controller, timed_command
from ..control.files import PlannedMotion, plans_file, read_plan
from ..control.sampling import driven_input
from ..control.stages import receding_controllers
from ..control.task import motions_of
from ..experiment.files import LINEAR
from ..io.stages import finished_record
from ..linalg.threads import threads_for
from ..robot.loading import load
from ..robot.robot import Robot

_WARMS_UP: Final = 5  # commands that are not counted
_COMMANDS: Final = 60  # of a repeat, at most


def time_commands(run: Path, repeats: int) -> list[dict[str, Any]]:
    """Rows with ``controller``, ``horizon_s``, and ``ms`` and ``largest_of_20_ms`` of a command, all on one thread.

    The controllers follow the motions of the run in turn; what they see is where the model expects the markers. The
    last row, ``full simulator``, is what they do without: it foretells the horizon once, under inputs that are planned.

    Raises:
        DataFileError: the folder has no run whose stage drive is done.
    """
    settings = finished_record(run, "drive")["settings"]
    control = settings["control"]
    model = control["models"][-1]
    robot = load(run, model, settings["device"])
    names = [*control["receding"], LINEAR]
    seconds: dict[str, list[float]] = {name: [] for name in names}
    foretold = list[float]()
    motions, horizon = motions_of(control), float(control["horizon"]["seconds"])
    with threads_for(1):
        for number in range(repeats):
            plan = read_plan(run / plans_file(model), motions[number % len(motions)])
            rests = np.repeat(plan.markers[:1].reshape(1, -1, 3), len(names), axis=0)
            made = receding_controllers(settings, run, robot, plan.path, rests)
            for name, each in zip(names, made, strict=True):
                seconds[name] += _followed(each, plan)
            foretold.append(_foretold(robot, plan.inputs[: round(horizon / robot.time_step)]))
    rows = [_row(name, horizon, found) for name, found in seconds.items()]
    return [*rows, _row("full simulator", horizon, foretold)]


def _followed(controller: Controller, plan: PlannedMotion) -> list[float]:
    """Seconds of each command, once warm."""
    seen = plan.markers.reshape(len(plan.markers), -1, 3)
    count = min(len(plan.inputs), _WARMS_UP + _COMMANDS)
    return [timed_command(controller, number, seen[number])[1] for number in range(count)][_WARMS_UP:]


@torch.no_grad()
def _foretold(robot: Robot, inputs: NDArray[np.float64]) -> float:
    """Seconds of a motion under inputs (T, n)."""
    state = robot.begin()
    begun = time.perf_counter()
    robot.rollout(state, len(inputs), **{driven_input(robot).name: inputs})
    return time.perf_counter() - begun


def _row(name: str, horizon: float, seconds: Sequence[float]) -> dict[str, Any]:
    return {
        "controller": name,
        "horizon_s": horizon,
        "ms": 1e3 * float(np.median(seconds)),
        "largest_of_20_ms": 1e3 * float(np.quantile(seconds, 0.95)),
    }
