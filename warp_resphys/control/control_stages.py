"""Control stages: reduced models, plans, baselines without a simulator,
and all controllers on the laboratory.
"""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Final

import numpy as np

from ..core.mesh.motion_files import input_columns, write_csv
from ..core.stepping.rollout import rollout
from ..core.stepping.state import State
from ..data.trials import Trials
from ..experiment.digests import files_read
from ..experiment.files import CONTROL, DATASET, DRIVEN, FEEDBACK, LINEAR, OPEN, RECEDING
from ..experiment.split_stages import SplitStages
from ..io.arrays import FloatArray
from ..io.errors import InputError
from ..io.fan_out import ALONE, Workers
from ..io.parts import Arrays, Report, TrialPart
from ..io.progress import Progress
from ..io.resuming import StageContext, finished_record
from ..io.safe_files import write_json
from ..io.settings import parse
from ..report.body_motions import DrivenBodies
from ..report.data import ControlResults, ReducedErrors, TrackingErrors
from ..robot.loading import load
from ..settings import stage_keys
from ..settings.control import ControlSettings
from ..settings.stage_keys import StageSettings
from .control_files import (
    BASELINES,
    PLANNED,
    PLAYED,
    plan_table,
    plans_file,
    read_baselines,
    read_motion,
    read_quality,
    read_reduced,
    reduced_file,
    write_baselines,
    write_motions,
    write_reduced,
)
from .control_files import Arrays as MotionArrays
from .controllers import Controller, JacobianFeedback, LinearRecedingHorizon, RecedingHorizon
from .linear_model import fit_linear
from .plan import check_chosen, follow, tracked_of
from .reduction import reduce
from .sampling import driven_input
from .task import Task, motions_of
from .worlds import Laboratory

# Weight of the inputs in plans with a receding horizon, and iterations.
_RECEDING: Final = (1e-2, 1)
_PRESSED: Final = 0.3  # share of the range by which inputs are changed to measure the Jacobian
_ALL_SEEN: Final = 0.5  # share of a trial's frames that must show all markers, for the linear model


def add_control(split: SplitStages) -> None:
    """Adds plans on the models, and with a simulated laboratory, driven motions."""
    control = split.run.control
    assert control is not None
    last = control.models[-1]
    planned = list[str]()
    # The last model must reach the paths, so it is checked first.
    for model in reversed(control.models):
        first, second = f"reduce_{model}", f"plan_{model}"
        planned += [first, second]
        keys: tuple[str, ...] = ("seed", "control.reduction")
        split.add(first, reduce_robot, (reduced_file(model),), keys, ("evaluate",), model=model)
        outputs = (
            plans_file(model),
            *(plan_table(model, motion) for motion in motions_of(control)),
        )
        keys = (*stage_keys.FIGURES, "control.plan")
        split.add(
            second, plan_motions, outputs, keys, (first,), model=model, must_reach=model == last
        )
    if split.run.laboratory is None:
        return
    digests = split.digests | files_read(split.run, split.run.laboratory)
    keys = (*stage_keys.PLAYED, *stage_keys.FIGURES, "control.feedback")
    split.add(
        "baselines", fit_baselines, (BASELINES,), keys, ("evaluate",), model=last, files=digests
    )
    split.add(
        "drive",
        drive,
        (DRIVEN, CONTROL),
        (*stage_keys.PLAYED, "control"),
        (*planned, "baselines"),
        files=digests,
    )


def reduce_robot(context: StageContext) -> None:
    """Writes the reduced form of a model.

    Raises:
        InputError, ConvergenceError: the model cannot be reduced, see `reduction.reduce`.
    """
    settings: StageSettings = context.settings
    robot = load(context.run_dir, settings.model, settings.device)
    with Progress(context.name, settings.control.reduction.total, "samples") as progress:
        reduced = reduce(robot, settings.control.reduction, settings.seed, progress.advance)
    write_reduced(context.run_dir / reduced_file(settings.model), reduced)


def plan_motions(context: StageContext) -> None:
    """Writes the plans of all motions on a model, as HDF5 and as tables to be played on a robot.

    Raises:
        InputError: the robot cannot reach a path, and ``must_reach`` is set.
        ConvergenceError: the robot diverges on a plan.
    """
    settings: StageSettings = context.settings
    model, plan = settings.model, settings.control.plan
    robot = load(context.run_dir, model, settings.device)
    task = Task(settings.control, robot)
    reduced = read_reduced(context.run_dir / reduced_file(model), robot.description.learned)
    if settings.must_reach:
        task.check_reach(reduced, plan.reach)
    # The point starts where the recordings have it before anything moved.
    start = task.tracked @ np.nanmean(Trials.read(context.run_dir / DATASET).held, axis=0).ravel()
    plans = dict[str, MotionArrays]()
    total = (plan.corrections + 1) * sum(map(task.steps, settings.control.seconds))
    with Progress(context.name, total, "steps") as progress:
        for seconds in settings.control.seconds:
            paths = np.stack([path.timed(seconds, task.time_step, start) for path in task.paths])
            followed = follow(
                robot,
                reduced,
                partial(task.planner, reduced),
                paths,
                plan.corrections,
                progress.advance,
            )
            plans |= dict(zip(motions_of(settings.control, seconds), followed, strict=True))
    write_motions(context.run_dir / plans_file(model), PLANNED, plans)
    driven = driven_input(robot)
    for name, motion in plans.items():
        columns = input_columns(driven.name, driven.parts, driven.unit, motion["inputs"])
        markers = motion["markers"].reshape(len(motion["markers"]), -1, 3)
        times = robot.time_step * np.arange(len(markers), dtype=np.float64)
        write_csv(context.run_dir / plan_table(model, name), times, robot.labels, markers, columns)


def fit_baselines(context: StageContext) -> None:
    """Writes the linear model of the recordings, and the Jacobian of the laboratory,
    measured one input at a time.

    Raises:
        InputError: too few frames of the trials show all markers.
    """
    settings: StageSettings = context.settings
    robot = load(context.run_dir, settings.model, settings.device)
    task = Task(settings.control, robot)
    driven = driven_input(robot)
    data = Trials.read(context.run_dir / DATASET)
    assert driven.high is not None
    series = partial(_series, data, driven=driven.name, time_step=robot.time_step)
    train = list(map(series, settings.split.train))
    validation = list(map(series, settings.split.validation))
    linear = fit_linear(train, validation or train, np.asarray(driven.high), robot.time_step)
    feedback, limits = settings.control.feedback, settings.control.limits
    parts, steps = task.parts, max(round(feedback.settles / robot.time_step), 2)
    pressed = _PRESSED * limits.range * np.eye(parts)
    laboratory = Laboratory(
        settings, context.run_dir, driven.name, parts, len(motions_of(settings.control))
    )
    rest, pressing = laboratory.seen_at_rest(), repeat(limits.low + pressed, steps)
    with Progress(context.name, steps, "steps") as progress:
        moving = rollout(
            laboratory.step, laboratory.rest, progress.each(pressing), lambda state: state
        )
    last = [laboratory.seen(state, number) for number, state in enumerate(moving)]
    last = last[-max(steps // 5, 1) :]
    moved = (np.mean(last, axis=0) - rest).reshape(parts, -1) @ task.tracked.T  # (n, d)
    write_baselines(context.run_dir / BASELINES, linear, moved.T / np.diag(pressed))


def _series(
    data: Trials, name: str, driven: str, time_step: float
) -> tuple[FloatArray, FloatArray]:
    """Resamples a trial at a robot's steps: markers (T + 1, 3 M) [m] and inputs (T, n)."""
    (row,) = data.rows([name])
    observed = data.observed if data.smoothed is None else data.smoothed
    seen, times = observed[row].reshape(len(data.times[row]), -1), data.times[row]
    whole = np.isfinite(seen).all(1)
    if whole.mean() < _ALL_SEEN:
        raise InputError(
            f"trial {name} shows all markers in {100 * whole.mean():.0f} % of its frames: the "
            f"linear model of control needs {100 * _ALL_SEEN:.0f} %."
        )
    steps = round(float(times[whole].max()) / time_step)
    at = time_step * np.arange(steps + 1)
    markers = np.stack([np.interp(at, times[whole], column[whole]) for column in seen.T], axis=1)
    inputs = data.inputs[driven][row]
    number = np.minimum((at[:-1] / data.time_step + 1e-9).astype(np.int64), len(inputs) - 1)
    return markers, inputs[number]


def drive(context: StageContext, workers: Workers = ALONE) -> None:
    """Drives all motions on the simulated laboratory with all controllers,
    and writes the result.
    """
    settings: StageSettings = context.settings
    control = settings.control
    controllers = controllers_of(control)
    robot = load(context.run_dir, control.models[-1], settings.device)
    task, cut_up = Task(control, robot), list[TrialPart]()
    for seconds in control.seconds:
        for name in motions_of(control, seconds):
            steps = task.steps(seconds)
            cut_up.append(
                TrialPart(
                    name,
                    (name,),
                    steps + 1,
                    partial(_driven, settings, context.run_dir, name, steps),
                )
            )
    parts = context.parts(workers)
    parts.run(cut_up)
    motions = {}
    for part in cut_up:
        (name,) = part.names
        path = read_motion(context.run_dir / plans_file(control.models[-1]), PLANNED, name)["path"]
        driven = {key: parts.read(part, key) for key in ("points", "inputs", "seconds")}
        motions[name] = {"path": path, **driven}
    common = {"controllers": controllers, "time_step": robot.time_step}
    write_motions(context.run_dir / DRIVEN, PLAYED, motions, **common)
    write_json(context.run_dir / CONTROL, _summary(context.run_dir, control, controllers, motions))
    parts.remove()


def controllers_of(control: ControlSettings) -> list[str]:
    """Returns the names of all controllers, in the order of the tables."""
    return [
        *(f"{OPEN}{model}" for model in control.models),
        *(f"{RECEDING}{model}" for model in control.receding),
        f"{RECEDING}{LINEAR}",
        *(f"{FEEDBACK}{gain:g}" for gain in control.feedback.gains),
    ]


def _driven(settings: StageSettings, folder: Path, name: str, steps: int, report: Report) -> Arrays:
    """One motion with all controllers, each on a body of its own:
    points, inputs and computing times.
    """
    control = settings.control
    robot = load(folder, control.models[-1], settings.device)
    task, driven = Task(control, robot), driven_input(robot)
    count = len(controllers_of(control))
    laboratory = Laboratory(settings, folder, driven.name, count, motions_of(control).index(name))
    plans = {
        model: read_motion(folder / plans_file(model), PLANNED, name) for model in control.models
    }
    rest, path = laboratory.seen_at_rest(), plans[control.models[-1]]["path"]
    linear, jacobian = read_baselines(folder / BASELINES)
    controllers = list[Controller]()
    for model in control.receding:
        learned = (
            robot if model == robot.description.model else load(folder, model, settings.device)
        )
        reduced = read_reduced(folder / reduced_file(model), learned.description.learned)
        planner = task.planner(reduced, path, control.horizon, *_RECEDING)
        controllers.append(RecedingHorizon(planner, reduced, rest[len(plans) + len(controllers)]))
    planner = task.planner(linear, path, control.horizon, *_RECEDING)
    controllers.append(LinearRecedingHorizon(planner, linear, rest[len(plans) + len(controllers)]))
    for gain in control.feedback.gains:
        start = rest[len(plans) + len(controllers)]
        controllers.append(
            JacobianFeedback(
                jacobian, control.limits, gain, task.time_step, task.tracked, path, start
            )
        )
    inputs, seconds = list[FloatArray](), list[FloatArray]()

    def step(state: State, number: int) -> State:
        seen = laboratory.seen(state, number)
        acting, took = np.zeros((count, task.parts)), np.zeros(count)
        acting[: len(plans)] = [plan["inputs"][number] for plan in plans.values()]
        for row, controller in enumerate(controllers, len(plans)):
            began = time.perf_counter()
            acting[row] = controller(number, seen[row])
            took[row] = time.perf_counter() - began
        inputs.append(acting)
        seconds.append(took)
        report()
        return laboratory.step(state, acting)

    def point(state: State) -> FloatArray:
        return np.asarray(laboratory.markers(state).reshape(count, -1) @ task.tracked.T)

    points = rollout(step, laboratory.rest, range(steps), point)[1:]
    series = (("points", points, "m"), ("inputs", inputs, driven.unit), ("seconds", seconds, "s"))
    return {key: (np.stack(values, 1), unit) for key, values, unit in series}


def _summary(
    folder: Path,
    control: ControlSettings,
    controllers: Sequence[str],
    motions: Mapping[str, MotionArrays],
) -> ControlResults:
    """Content of control.json: errors [mm] by speed and controller,
    computing times, quality of the reduced models.
    """
    by_speed: dict[str, dict[str, TrackingErrors]] = {}
    for seconds in control.seconds:
        names = motions_of(control, seconds)
        errors = {
            name: 1e3 * np.linalg.norm(motions[name]["points"] - motions[name]["path"], axis=2)
            for name in names
        }
        of_speed: dict[str, TrackingErrors] = {}
        for row, controller in enumerate(controllers):
            of_motions = {name: of_motion[row] for name, of_motion in errors.items()}
            of_speed[controller] = {
                "mean_mm": float(np.mean([error.mean() for error in of_motions.values()])),
                "max_mm": float(max(error.max() for error in of_motions.values())),
                "motions_mm": {name: float(error.mean()) for name, error in of_motions.items()},
            }
        by_speed[f"{seconds:g}"] = of_speed
    times = np.concatenate([motion["seconds"] for motion in motions.values()], axis=1)
    planned: dict[str, dict[str, list[float]]] = {}
    for model in control.models:
        plans = {name: read_motion(folder / plans_file(model), PLANNED, name) for name in motions}
        planned[model] = {name: plan["errors_mm"].tolist() for name, plan in plans.items()}
    models: dict[str, ReducedErrors] = {
        model: read_quality(folder / reduced_file(model)) for model in control.models
    }
    return {
        "tracking": by_speed,
        "command_ms": {
            name: {
                "median": 1e3 * float(np.median(row)),
                "largest_of_20": 1e3 * float(np.quantile(row, 0.95)),
            }
            for name, row in zip(controllers, times, strict=True)
        },
        "planned_mm": planned,
        "reduced": models,
        "linear_validation_mm": read_baselines(folder / BASELINES)[0].validation_mm,
    }


def driven_settings(folder: Path) -> StageSettings:
    """Returns the settings with which controllers have driven the laboratory of a run.

    Raises:
        InputError: no motion was driven.
        DataFileError: there is no such run, or its files have changed.
    """
    if (folder / "stages").is_dir() and not (folder / DRIVEN).is_file():
        raise InputError(
            f"no motion was driven in {folder}: name a finished run of an experiment with "
            "control, as sopra_control."
        )
    return parse(StageSettings, finished_record(folder, "drive")["settings"])


def replay(
    folder: Path, motion: str, controllers: Sequence[str], seconds: float = np.inf
) -> DrivenBodies:
    """Drives the laboratory with the recorded inputs of a motion.

    Args:
        folder: of the run.
        motion: such as ``eight_4s``.
        controllers: such as ``open_resphys``.
        seconds: after which the replay stops.

    Raises:
        InputError: no such motion or controller, or no motion was driven.
        DataFileError: there is no such run, or its files have changed.
        ConvergenceError: the simulation diverges.
    """
    settings = driven_settings(folder)
    control = settings.control
    names = controllers_of(control)
    check_chosen("motion", [motion], motions_of(control))
    check_chosen("controllers", controllers, names)
    robot = load(folder, control.models[-1], settings.device)
    driven = read_motion(folder / DRIVEN, PLAYED, motion)
    rows = [names.index(name) for name in controllers]
    steps = max(int(min(len(driven["path"]), seconds / robot.time_step)), 1)
    laboratory = Laboratory(settings, folder, driven_input(robot).name, len(rows), 0)
    tracked = tracked_of(robot.labels, control.tracked)
    acting = driven["inputs"][rows, :steps].swapaxes(0, 1)
    with Progress("laboratory", steps, "steps") as progress:
        moved = rollout(
            laboratory.step, laboratory.rest, progress.each(acting), lambda state: state
        )
    bodies = np.stack([laboratory.bodies(state)[1] for state in moved], 1)
    markers = np.stack([laboratory.markers(state) for state in moved], 1)  # (C, T + 1, M, 3)
    return DrivenBodies(
        robot.time_step * np.arange(steps + 1, dtype=np.float64),
        laboratory.bodies(laboratory.rest)[0],
        dict(zip(controllers, bodies, strict=True)),
        dict(zip(controllers, markers.reshape(*markers.shape[:2], -1) @ tracked.T, strict=True)),
        driven["path"],
        np.array([control.right, control.up], dtype=np.float64),
        np.asarray(robot.simulator.gravity, dtype=np.float64),
    )
