"""The command `view film`: films of a trial with models of a run,
or of the laboratory as controllers drove it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
import warp as wp

from ..control.control_stages import driven_settings, replay
from ..experiment.files import METRICS, OPEN
from ..io.errors import InputError
from ..io.progress import show
from ..io.resuming import finished_record
from ..io.safe_files import read_json
from ..io.settings import Many, Positive, Settings, Word, setting
from ..learning.baselines import BASELINES
from ..report.body_motions import (
    LABORATORY_MARKERS,
    MEASURED_MARKERS,
    TARGET_VERTICES,
    ComparedMotion,
    hangs,
)
from ..report.data import at_times, spread
from ..report.layers import RenderScene
from ..report.render import DrawingError, write_film
from ..report.wording import MODELS, compared_controllers, shown_models
from ..robot.loading import load, recorded_trial
from ..robot.robot import Robot

# By the stage that simulates them.
_PLAYED: Final = {"simulate": TARGET_VERTICES, "laboratory": LABORATORY_MARKERS}
_MOST_VIEWS: Final = 3  # of controllers, side by side
_MOST_MARKERS: Final = 6  # vertices of the tip that are shown where every vertex is observed
_AT_THE_TIP: Final = 0.97  # distance of these from the fixed vertices, over the largest


class FilmSettings(Settings):
    """The configuration ``view_film``, which explains its keys."""

    run: Word
    trial: Word | None
    models: Many[Word] | None
    motion: Word | None
    controllers: Many[Word] | None
    seconds: Positive | None = setting(unit="s")
    slower: Positive | None
    file: Word | None


def film(settings: FilmSettings, folder: Path) -> None:
    """Writes a film of a trial with some models, or of a driven motion with some controllers.

    It is written into the run folder, or to ``file``.

    Raises:
        InputError: an unknown trial, model, motion or controller, a pose for a trial, or a machine
            that cannot draw.
        DataFileError: there is no finished run, or the film cannot be written.
    """
    del folder
    wp.config.log_level = wp.LOG_WARNING
    run = Path(settings.run).expanduser()
    if settings.motion is None:
        name, scene = _film_of_trial(run, settings)
    else:
        name, scene = _film_of_motion(run, settings.motion, settings)
    path = (
        run / "films" / f"{name}.mp4" if settings.file is None else Path(settings.file).expanduser()
    )
    try:
        write_film(path, scene)
    except DrawingError as error:
        raise InputError(f"no film can be drawn on this machine: {error}.") from None
    show(f"Written: {path}")


def _film_of_trial(run: Path, settings: FilmSettings) -> tuple[str, RenderScene]:
    """Name and film of a trial."""
    if settings.controllers is not None:
        raise InputError("controllers drive motions: name one by motion=, such as motion=eight_4s.")
    finished_record(run, "evaluate")
    metrics = read_json(run / METRICS)
    models, seconds = settings.models, settings.seconds
    if models is None:
        available = tuple(model for model in metrics["errors_mm"] if model not in BASELINES)
        models = (
            tuple(shown_models(metrics["errors_mm"], metrics.get("recommended", "")))
            or available[:2]
        )
    name = metrics["per_trajectory"][0]["name"] if settings.trial is None else settings.trial
    motion = motion_of(run, name, models, np.inf if seconds is None else seconds)
    return name, motion.film(seconds, settings.slower)


def _film_of_motion(run: Path, name: str, settings: FilmSettings) -> tuple[str, RenderScene]:
    """Name and film of a motion that controllers drove."""
    for key in ("trial", "models"):
        if getattr(settings, key) is not None:
            raise InputError(
                f"{key} is for films of trials, "
                "and motion for films of control: leave one of them out."
            )
    seconds = settings.seconds
    controllers = settings.controllers
    control = driven_settings(run).control
    if controllers is None:
        controllers = tuple(name for name in compared_controllers(control) if name.startswith(OPEN))
    if len(controllers) > _MOST_VIEWS:
        raise InputError(
            f"controllers names {len(controllers)}: "
            f"a film shows at most {_MOST_VIEWS} side by side."
        )
    played = replay(run, name, controllers, np.inf if seconds is None else seconds)
    return name, played.film(1.0 if settings.slower is None else settings.slower)


def motion_of(
    run: Path, trial: str, models: Sequence[str], seconds: float = np.inf
) -> ComparedMotion:
    """Returns the first seconds of a trial, as measured and as simulated with models of a run.

    Raises:
        InputError: an unknown trial or model, or a pose.
        DataFileError: there is no finished run.
    """
    known = [name for name in MODELS if name not in BASELINES]
    unknown = [name for name in models if name not in known]
    if unknown or not models:
        raise InputError(
            f"models names {unknown[0] if unknown else 'none'}: choose some of {', '.join(known)}."
        )
    positions, markers = {}, {}
    for model in models:
        robot = load(run, model)
        played = recorded_trial(robot, trial)
        if not played.steps:
            raise InputError(
                f"the trial {trial} is a pose, which cannot be filmed: choose a motion."
            )
        with torch.no_grad():
            whole = played.play(robot)
        frames = np.flatnonzero(
            (np.diff(played.times, prepend=-1.0) > 0.0) & (played.times <= seconds + 1e-9)
        )
        some, times = _shown(robot, played.markers.shape[1]), played.times[frames]
        positions[model] = at_times(
            whole.q[:, 0].double().cpu().numpy(), np.asarray(whole.times), times
        )
        markers[model] = played.shown(whole)[frames][:, some]
    mesh = robot.simulator.body.mesh
    bound = robot.observe(robot.state(mesh.vertices))[0].double().cpu().numpy()[some]
    gravity = np.asarray(robot.simulator.gravity, dtype=np.float64)
    from_below, _ = hangs(mesh, robot.simulator.body.fixed_vertices, gravity)
    seen = played.markers[frames][:, some]
    obstacles = whole.surface().at(np.rint(times / robot.time_step).astype(int))
    shared = run / read_json(run / "stages" / "evaluate.json")["settings"]["shared"] / "stages"
    simulated = (text for stage, text in _PLAYED.items() if (shared / f"{stage}.json").is_file())
    observed = next(simulated, MEASURED_MARKERS)
    return ComparedMotion(
        mesh,
        times,
        seen,
        positions,
        markers,
        bound,
        gravity,
        from_below,
        obstacles=obstacles,
        observed=observed,
    )


def _shown(robot: Robot, count: int) -> np.ndarray:
    """Indices of the markers that are shown: all, or some vertices at the tip
    where every vertex is observed.
    """
    if robot.labels:
        return np.arange(count)
    body = robot.simulator.body
    _, away = hangs(body.mesh, body.fixed_vertices, np.asarray(robot.simulator.gravity))
    return spread(np.flatnonzero(away >= _AT_THE_TIP * away.max()), _MOST_MARKERS)
