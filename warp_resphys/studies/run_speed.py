"""Speed of the environments and of the receding-horizon controllers of a run, for the benchmark."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..control.controllers import Controller, timed_command
from ..control.files import PlannedMotion, plans_file, read_plan, reduced_file
from ..control.replay import driven_settings
from ..control.sampling import driven_input
from ..control.stages import receding_controllers
from ..control.task import motions_of
from ..experiment.files import LINEAR
from ..io.errors import InputError
from ..io.progress import Progress
from ..linalg.threads import threads_for
from ..robot.loading import load
from ..robot.robot import Robot
from .tables import Sheet
from .timing import median_seconds

if TYPE_CHECKING:
    from ..environments.vector import RobotVectorEnv

_ACTIONS: Final = 5  # in a repeat
_WARM_UP: Final = 5  # commands that are not timed
_COMMANDS: Final = 60  # largest number in a repeat


def time_environments(run: Path, counts: Sequence[int], repeats: int, device: str) -> list[dict[str, Any]]:
    """Times environments with random actions of the task reach, where an action is several steps of the simulation.

    The reduced world and the laboratory are timed if the run has them.

    Returns:
        Rows with ``world``, ``robots``, ``ms`` of an action of all robots, and ``actions_s`` and ``steps_s`` a second.

    Raises:
        InputError: Gymnasium is not installed, or the folder has no run of a driven robot.
        DataFileError: the folder has no run that can be loaded.
    """
    try:
        from ..environments.making import make_vector
    except ImportError as error:
        raise InputError(f"environments need Gymnasium ({error}): pip install 'warp-resphys[environments]'.") from None
    model = load(run).description.model
    optional = {"reduced": run / reduced_file(model), "laboratory": run / "stages" / "laboratory.json"}
    worlds = ["simulator", *(world for world, file in optional.items() if file.is_file())]
    rows = []
    with Progress("environments", len(worlds) * len(counts), "cases") as progress:
        for world, count in product(worlds, counts):
            place = device if world == "simulator" else "cpu"
            robots = make_vector("reach", run, count, world=world, spread=0.0, seconds=100.0, device=place)
            robots.reset(seed=0)
            robots.step(np.zeros((count, robots.world.parts), dtype=np.float32))  # loads kernels and makes buffers
            seconds = median_seconds(partial(_act, robots, np.random.default_rng(0)), repeats) / _ACTIONS
            rate = count / seconds
            speeds = {"ms": 1e3 * seconds, "actions_s": rate, "steps_s": rate * robots.frames}
            rows.append({"world": world, "robots": count, **speeds})
            progress.advance()
    return rows


def _act(robots: "RobotVectorEnv", random: np.random.Generator) -> None:
    """Takes random actions with all robots."""
    for _ in range(_ACTIONS):
        robots.step(random.uniform(-1.0, 1.0, (robots.num_envs, robots.world.parts)).astype(np.float32))


def environment_sheet(rows: Sequence[Mapping[str, Any]]) -> Sheet:
    """The table of `time_environments`."""
    columns = (
        "world {world} | robots {robots} | an action of all, ms {ms:.1f} | actions a second {actions_s:.0f} | "
        "steps a second {steps_s:.0f}"
    )
    return Sheet.of("Environments, task reach", columns, rows)


def time_commands(run: Path, repeats: int) -> list[dict[str, Any]]:
    """Times commands of the receding-horizon controllers on one thread, with markers as predicted by the model.

    Returns:
        Rows with ``controller``, ``horizon_s``, and ``ms`` and ``largest_of_20_ms`` of a command. The last row, ``full
        simulator``, is a simulation of the horizon under the planned inputs, for comparison.

    Raises:
        DataFileError: the folder has no run with a finished stage drive.
    """
    settings = driven_settings(run)
    control = settings.control
    model = control.models[-1]
    robot = load(run, model, settings.device)
    names = [*control.receding, LINEAR]
    seconds: dict[str, list[float]] = {name: [] for name in [*names, "full simulator"]}
    motions, horizon = motions_of(control), control.horizon.seconds
    with threads_for(1):
        for number in range(repeats):
            plan = read_plan(run / plans_file(model), motions[number % len(motions)])
            rests = np.repeat(plan.markers[:1].reshape(1, -1, 3), len(names), axis=0)
            controllers = receding_controllers(settings, run, robot, plan.path, rests)
            for name, controller in zip(names, controllers, strict=True):
                seconds[name] += _command_seconds(controller, plan)
            inputs = plan.inputs[: round(horizon / robot.time_step)]
            seconds["full simulator"].append(_rollout_seconds(robot, inputs))
    return [
        {
            "controller": name,
            "horizon_s": horizon,
            "ms": 1e3 * float(np.median(durations)),
            "largest_of_20_ms": 1e3 * float(np.quantile(durations, 0.95)),
        }
        for name, durations in seconds.items()
    ]


def _command_seconds(controller: Controller, plan: PlannedMotion) -> list[float]:
    """Durations [s] of the commands of a motion, without the first ones."""
    seen = plan.markers.reshape(len(plan.markers), -1, 3)
    count = min(len(plan.inputs), _WARM_UP + _COMMANDS)
    return [timed_command(controller, number, seen[number])[1] for number in range(count)][_WARM_UP:]


@torch.no_grad()
def _rollout_seconds(robot: Robot, inputs: NDArray[np.float64]) -> float:
    """Duration [s] of a simulation of the full model under inputs (T, n)."""
    state, given = robot.begin(), dict[str, Any]({driven_input(robot).name: inputs})
    began = time.perf_counter()
    robot.rollout(state, len(inputs), **given)
    return time.perf_counter() - began


def command_sheet(rows: Sequence[Mapping[str, Any]]) -> Sheet:
    """The table of `time_commands`."""
    columns = (
        "controller {controller} | a command, ms {ms:.2f} | the slowest of 20, ms {largest_of_20_ms:.2f} | "
        "commands a second {rate:.0f}"
    )
    title = f"Plans that begin anew at each step, over {rows[0]['horizon_s']:g} s, one thread"
    return Sheet.of(title, columns, [{**row, "rate": 1e3 / row["ms"]} for row in rows])
