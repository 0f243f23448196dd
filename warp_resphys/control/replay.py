"""What controllers did on the simulated laboratory, done again to be looked at."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..experiment.files import DRIVEN
from ..io.errors import InputError
from ..io.progress import Progress
from ..io.settings import parse
from ..io.stages import finished_record
from ..robot.loading import load
from ..settings.stages import DriveStage
from .files import DrivenMotion, read_driven
from .laboratory import Laboratory
from .plan import tracked_of
from .sampling import driven_input
from .stages import controllers_of
from .task import motions_of

FloatArray = NDArray[np.float64]


def driven_settings(folder: Path) -> DriveStage:
    """Settings of a run whose laboratory controllers have driven.

    Raises:
        InputError: none have.
        DataFileError: there is no such run, or it has changed since.
    """
    if (folder / "stages").is_dir() and not (folder / DRIVEN).is_file():
        raise InputError(
            f"no motion was driven in {folder}: name a finished run of an experiment with control, as sopra_control."
        )
    return parse(DriveStage, finished_record(folder, "drive")["settings"])


@dataclass(frozen=True)
class DrivenReplay:
    """A motion as C controllers drove it.

    Attributes:
        times: (T + 1,) since the first command [s].
        triangles: (S, 3) of the surface of the laboratory's body.
        bodies: (C, T + 1, N, 3) its vertices [m].
        points: (C, T + 1, 3) where the point was that is to follow the path [m].
        driven: the motion.
        gravity: (3,) in the frame of the bodies [m/s^2].
    """

    times: FloatArray
    triangles: NDArray[np.int64]
    bodies: FloatArray
    points: FloatArray
    driven: DrivenMotion
    gravity: FloatArray


def replay(folder: Path, motion: str, controllers: Sequence[str], seconds: float = np.inf) -> DrivenReplay:
    """Gives the laboratory the inputs that it was given, for the first seconds of a motion.

    Args:
        folder: of the run.
        motion: such as ``eight_4s``.
        controllers: such as ``open_resphys``.
        seconds: of the motion.

    Raises:
        InputError: no such motion or controller, or see `driven_settings`.
        DataFileError: likewise.
        ConvergenceError: the simulation diverges.
    """
    settings = driven_settings(folder)
    control = settings.control
    known = controllers_of(control)
    _check("motion", [motion], motions_of(control))
    _check("controllers", controllers, known)
    robot = load(folder, control.models[-1], settings.device)
    driven, rows = read_driven(folder / DRIVEN, motion), [known.index(each) for each in controllers]
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
    places = np.stack(points, 1)  # (C, T + 1, M, 3)
    return DrivenReplay(
        robot.time_step * np.arange(steps + 1, dtype=np.float64),
        laboratory.bodies()[0],
        np.stack(bodies, 1),
        places.reshape(*places.shape[:2], -1) @ tracked.T,
        driven,
        np.asarray(robot.simulator.gravity, dtype=np.float64),
    )


def _check(key: str, wanted: Sequence[str], known: Sequence[str]) -> None:
    unknown = [each for each in wanted if each not in known]
    if unknown or not wanted:
        raise InputError(f"{key} names {unknown[0] if unknown else 'none'}: choose of {', '.join(known)}.")
