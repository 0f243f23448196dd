"""Replays motions that controllers have driven on the simulated laboratory, with the whole body."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..experiment.files import DRIVEN
from ..io.errors import InputError
from ..io.progress import Progress
from ..io.settings import parse
from ..io.stages import finished_record
from ..report.driven_film import DrivenBodies
from ..robot.loading import load
from ..settings.stages import DriveStage
from .files import read_driven
from .plan import tracked_of
from .sampling import driven_input
from .stages import controllers_of
from .task import motions_of
from .worlds import Laboratory


def driven_settings(folder: Path) -> DriveStage:
    """Returns the settings with which controllers have driven the laboratory of a run.

    Raises:
        InputError: no motion was driven.
        DataFileError: there is no such run, or its files have changed.
    """
    if (folder / "stages").is_dir() and not (folder / DRIVEN).is_file():
        raise InputError(
            f"no motion was driven in {folder}: name a finished run of an experiment with control, as sopra_control."
        )
    return parse(DriveStage, finished_record(folder, "drive")["settings"])


def replay(folder: Path, motion: str, controllers: Sequence[str], seconds: float = np.inf) -> DrivenBodies:
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
    _check("motion", [motion], motions_of(control))
    _check("controllers", controllers, names)
    robot = load(folder, control.models[-1], settings.device)
    driven, rows = read_driven(folder / DRIVEN, motion), [names.index(name) for name in controllers]
    steps = max(int(min(len(driven.path), seconds / robot.time_step)), 1)
    laboratory = Laboratory(settings.played, folder, driven_input(robot).name, len(rows), 0)
    tracked = tracked_of(robot.labels, control.tracked)
    bodies, points = [laboratory.bodies()[1]], [laboratory.markers()]
    with Progress("laboratory", steps, "steps") as progress:
        for number in range(steps):
            laboratory.step(driven.inputs[rows, number])
            bodies.append(laboratory.bodies()[1])
            points.append(laboratory.markers())
            progress.advance()
    markers = np.stack(points, 1)  # (C, T + 1, M, 3)
    return DrivenBodies(
        robot.time_step * np.arange(steps + 1, dtype=np.float64),
        laboratory.bodies()[0],
        dict(zip(controllers, np.stack(bodies, 1), strict=True)),
        dict(zip(controllers, markers.reshape(*markers.shape[:2], -1) @ tracked.T, strict=True)),
        driven.path,
        np.array([control.right, control.up], dtype=np.float64),
        np.asarray(robot.simulator.gravity, dtype=np.float64),
    )


def _check(key: str, wanted: Sequence[str], choices: Sequence[str]) -> None:
    unknown = [name for name in wanted if name not in choices]
    if unknown or not wanted:
        raise InputError(f"{key} names {unknown[0] if unknown else 'none'}: choose from {', '.join(choices)}.")
