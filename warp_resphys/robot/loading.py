"""Loads a robot from a finished run or a file, and the trials of the run, to replay them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.dynamics.trajectory import Motion
from ..core.stepping.state import State
from ..data.input_response import response_of
from ..data.rigid_bodies import as_markers
from ..data.trials import PAYLOAD, STATIC
from ..experiment.build import choose_device
from ..experiment.experiment import Experiment
from ..io.errors import DataFileError, InputError, checks_types, listed
from ..learning.parameters import split_name
from .actuation import BASE
from .description import SUFFIX, Description, describe, finished_experiment
from .robot import Robot


@checks_types
def load(
    path: str | Path, model: str | None = None, device: str = "cpu", on_failure: str = "raise"
) -> Robot:
    """Loads the robot of a finished run, or of a file that `Robot.save` wrote.

    Args:
        path: of the run folder, such as ``runs/sopra/default``, of one of its folds, or of the
            file.
        model: ``resphys``, the identified simulator with its learned force; ``actuator``, with its
            learned actuator alone; ``sysid``, the identified simulator; ``simulation``, the
            uncorrected one; ``simfree``, a network alone. None: the one that the report of the run
            recommends. A file contains one model.
        device: of the simulation: ``cpu``, ``cuda`` or ``auto``.
        on_failure: ``raise``, or ``count``, see `Robot`.

    Raises:
        DataFileError: there is no such run, it has not identified or trained the model, it is of
            another version, or a file of it has changed.
        InputError: the experiment has no such model, or the device is unknown.
    """
    place = Path(path).expanduser()
    where = choose_device(device)
    if place.is_file():
        if place.suffix != SUFFIX:
            raise DataFileError(
                f"{place} is no robot: name a run folder, or a {SUFFIX} file of `Robot.save`."
            )
        description = Description.read(place)
        if model not in (None, description.model):
            raise InputError(
                f"the model is {model!r}, but {place} contains {description.model!r}: load that, "
                "or the run folder."
            )
        return Robot(description, where, on_failure)
    if not place.is_dir():
        raise DataFileError(
            f"{place} does not exist: name a run folder, or a file that `Robot.save` wrote."
        )
    return Robot(describe(place, model), where, on_failure, folder=place)


@dataclass(frozen=True)
class RecordedTrial:
    """A trial of a run, for a robot loaded from the run.

    Attributes:
        name: of the trial.
        start: initial state.
        steps: number of steps, past the last frame; zero for a pose.
        inputs: by name, in the form of `Robot.rollout`.
        times: (F,) of the frames since the initial state [s].
        markers: (F, M, 3) observed positions [m], NaN where a marker was not seen.
        shift: (M, 3) offset of the markers from where they are bound, estimated from a release [m].
    """

    name: str
    start: State
    steps: int
    inputs: Mapping[str, Any]
    times: NDArray[np.float64]
    markers: NDArray[np.float64]
    shift: NDArray[np.float64] | None = None

    def play(self, robot: Robot) -> Motion:
        """Simulates the trial with a robot."""
        return robot.rollout(self.start, self.steps, **self.inputs)

    def shown(self, motion: Motion) -> NDArray[np.float64]:
        """Markers (F, M, 3) of a motion at the times of the frames [m]."""
        markers = motion.at(self.times)[:, 0].detach().cpu().numpy()
        return np.asarray(markers if self.shift is None else markers + self.shift)

    def errors_mm(self, motion: Motion) -> NDArray[np.float64]:
        """Returns the distances of a motion's markers from the observed ones [mm],
        as the report counts them.

        Returns:
            (F, K) for K markers and rigid bodies, each of these at its position; NaN where one was
            not seen.
        """
        away = as_markers(self.shown(motion) - self.markers, motion.labels)
        return np.asarray(1e3 * np.linalg.norm(away, axis=-1))


def trial_names(robot: Robot) -> tuple[str, ...]:
    """Returns the names of the trials of a robot's run,
    first those of the test, which no model was trained on.

    Raises:
        InputError: the robot was loaded from a file.
    """
    first = held_out_names(robot)
    return (*first, *(name for name in _experiment(robot).trials.names if name not in first))


def held_out_names(robot: Robot, moving: bool = False) -> tuple[str, ...]:
    """Returns the names of the test trials of a robot's run, from which nothing was learned.

    Args:
        robot: loaded from a run.
        moving: whether poses are left out.

    Raises:
        InputError: the robot was loaded from a file.
    """
    experiment = _experiment(robot)
    names = experiment.settings.split.test
    return experiment.trials.moving(names) if moving else names


def recorded_trial(robot: Robot, name: str) -> RecordedTrial:
    """Returns a trial of a robot's run, with its initial state computed by the robot's simulator.

    Raises:
        InputError: there is no such trial, or the robot was loaded from a file.
        ConvergenceError: the simulator cannot reach the initial state.
    """
    experiment = _experiment(robot)
    names = experiment.trials.names
    if name not in names:
        raise InputError(f"the trial is {name!r}: {robot.folder} has {listed(names)}.")
    simulator, model = experiment.model_simulator(robot.description.model), robot.description.model
    with torch.no_grad():
        identified = experiment.identified(model)
        replay = experiment.motions.replay(simulator, [name], identified)
        start = experiment.motions.start(replay, identified)
        constants, _, resting = replay.prepare(identified.values(simulator))
        inputs = {
            key: value.to(simulator.rest_positions)
            for key, value in replay.trials.inputs.actuation.items()
        }
        inputs = _commands(experiment, robot, name, inputs)
        load = float(experiment.trials.payload[experiment.trials.rows([name])[0]])
        if load:
            inputs[PAYLOAD.name] = simulator.tensor([load])
        base = experiment.trials.base_at([name], simulator.time_step)
        if experiment.trials.begin_of(name) == STATIC:
            inputs = {key: value[-1] if value.ndim == 3 else value for key, value in inputs.items()}
            begun, steps = robot.settle(1, **inputs), 0
        else:
            q = replay.initial_state(start, constants, resting).q
            before = {key: 0.0 * value[0] for key, value in inputs.items() if key in robot.driven}
            before |= {key: value.to(q) for key, value in replay.trials.resting.actuation.items()}
            commands: dict[str, Any] = _commands(experiment, robot, name, before)
            begun, steps = robot.state(q, start.state.v, **commands), replay.steps(start)
            if base is not None:
                poses = base.to(simulator.rest_positions)
                inputs[BASE] = poses[1:]
                begun = begun.with_memory(
                    {**begun.memory_of(), BASE: poses[0][:, None].repeat(1, 2, 1)}
                )
    trials = replay.trials
    since = (trials.times - start.delay[:, None]).clamp_min(0.0)[0].cpu().numpy()
    shift = None if start.shift is None else start.shift[0].cpu().numpy()
    return RecordedTrial(name, begun, steps, inputs, since, trials.observed[0].cpu().numpy(), shift)


def _commands(
    experiment: Experiment, robot: Robot, name: str, inputs: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Commands under which the robot does what it did
    under those of a trial with a zero or factor of its own.
    """
    values, commands = experiment.parameters(robot.description.model), dict(inputs)
    of_trial = dict(values)
    for owner in (experiment.trials.session(name), name):
        of_trial |= {
            split_name(full)[0]: value
            for full, value in values.items()
            if split_name(full)[1] == owner
        }
    for key, series in inputs.items():
        quantity, parts = robot.simulator.inputs[key], robot.simulator.parts.get(key, ())
        here, there = (response_of(quantity, known, parts) for known in (of_trial, values))
        same = [word for word in here if here[word] is there.get(word)]
        if "zero" in here and "zero" not in same:
            commands[key] = (series - _column(here["zero"]) + _column(there["zero"])).clamp_min(
                quantity.lower
            )
        if "factor" in here and "factor" not in same:
            beyond = commands[key] - sum(
                _column(there[word]) for word in ("zero", "dead_band") if word in there
            )
            beyond = beyond.clamp_min(0.0) if "dead_band" in there else beyond
            commands[key] = commands[key] + beyond * (
                _column(here["factor"]) / _column(there["factor"]) - 1.0
            )
    return commands


def _column(values: torch.Tensor) -> torch.Tensor:
    """Returns values (1,) of all parts, or (1, C) of each, as (1, 1 or C)."""
    return values.view(1, -1)


def _experiment(robot: Robot) -> Experiment:
    if robot.folder is None:
        raise InputError(
            "the robot was loaded from a file, which has no trials: load its run folder instead."
        )
    return finished_experiment(robot.folder, robot.description.model)
