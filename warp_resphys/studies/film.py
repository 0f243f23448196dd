"""A film of any trial of a run, and of any models of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import warp as wp

from ..experiment.files import METRICS
from ..experiment.schema import POSITIVE, WORD, check, optional
from ..io.errors import InputError
from ..io.files import read_json
from ..io.stages import finished_record
from ..report.bodies import Motion, hangs, write_film
from ..report.data import MODELS, at_times
from ..report.render import DrawingError
from ..robot.loading import load, recorded_trial
from ..robot.robot import Robot
from .command import WORDS, show

_USUAL: Final = ("simulation", "resphys")
_MOST_MARKERS: Final = 6  # vertices that are shown where every one is observed
_AT_THE_TIP: Final = 0.97  # of the largest distance from what is fixed, from which on they are


def film(config: Mapping[str, Any], folder: Path) -> None:
    """Plays a trial by some models and writes the film into the run folder, or where ``file`` says.

    Raises:
        InputError: an unknown trial or model, a trial that is a pose, or a machine that cannot draw.
        DataFileError: there is no finished run, or the film cannot be written.
    """
    del folder
    check("run", config["run"], WORD)
    for key, kind in (("trial", WORD), ("models", WORDS), ("file", WORD), ("slower", POSITIVE), ("seconds", POSITIVE)):
        check(key, config[key], optional(kind))
    wp.config.log_level = wp.LOG_WARNING
    run = Path(config["run"]).expanduser()
    finished_record(run, "evaluate")
    found = read_json(run / METRICS)
    models, name, seconds = config["models"], config["trial"], config["seconds"]
    if models is None:
        models = [each for each in _USUAL if each in found["errors_mm"]] or list(found["errors_mm"])[:2]
    name = found["per_trajectory"][0]["name"] if name is None else name
    motion = motion_of(run, name, models, np.inf if seconds is None else seconds)
    path = run / "films" / f"{name}.mp4" if config["file"] is None else Path(config["file"]).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        write_film(path, motion, seconds, config["slower"])
    except DrawingError as error:
        raise InputError(f"no film can be drawn on this machine: {error}.") from None
    show(f"Written: {path}")


def motion_of(run: Path, trial: str, models: Sequence[str], seconds: float = np.inf) -> Motion:
    """The first seconds of a trial, as measured and as models of a run play it.

    Raises:
        InputError: see `film`.
        DataFileError: likewise.
    """
    unknown = [name for name in models if name not in MODELS]
    if unknown or not models:
        raise InputError(f"models names {unknown[0] if unknown else 'none'}: choose some of {', '.join(MODELS)}.")
    positions, markers = {}, {}
    for model in models:
        robot = load(run, model)
        played = recorded_trial(robot, trial)
        if not played.steps:
            raise InputError(f"the trial {trial} is a pose, of which there is no film: choose a motion.")
        with torch.no_grad():
            whole = played.play(robot)
        frames = np.flatnonzero((np.diff(played.times, prepend=-1.0) > 0.0) & (played.times <= seconds + 1e-9))
        some, times = _shown(robot, played.markers.shape[1]), played.times[frames]
        positions[model] = at_times(whole.q[:, 0].double().cpu().numpy(), np.asarray(whole.times), times)
        markers[model] = played.shown(whole)[frames][:, some]
    mesh = robot.simulator.body.mesh
    bound = robot.observe(robot.state(mesh.vertices))[0].double().cpu().numpy()[some]
    gravity = np.asarray(robot.simulator.gravity, dtype=np.float64)
    from_below, _ = hangs(mesh, robot.simulator.body.fixed_vertices, gravity)
    return Motion(mesh, times, played.markers[frames][:, some], positions, markers, bound, gravity, from_below)


def _shown(robot: Robot, count: int) -> np.ndarray:
    """Numbers of the markers that are shown: all; or of some vertices at the tip, where every vertex is observed."""
    if robot.labels:
        return np.arange(count)
    body = robot.simulator.body
    _, away = hangs(body.mesh, body.fixed_vertices, np.asarray(robot.simulator.gravity))
    tip = np.flatnonzero(away >= _AT_THE_TIP * away.max())
    return np.asarray(tip[np.unique(np.linspace(0, len(tip) - 1, _MOST_MARKERS).round().astype(int))])
