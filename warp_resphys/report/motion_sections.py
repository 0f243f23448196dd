"""Sections of the page of a run on its motion, and on the body and the inputs that drive it."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from ..learning.baselines import BASELINES
from .bodies import ComparedMotion
from .data import (
    MODELS,
    Driven,
    Film,
    FloatArray,
    RunReport,
    TrialResults,
    at_times,
    shown_markers,
    shown_models,
)
from .page import Block, Canvas, Drawn, Part, data_address, drawn_file, largest_text, unbroken
from .render import Renderer, draw, hangs, write_film

_MOST_POINTS: Final = 6  # Vertices of the tip that are shown, where every vertex is observed.
_MOST_FRAMES: Final = 256  # Of the interactive view.
_SEQUENCES: Final = 3  # Trials whose inputs are drawn over time.


def start_drawing(data: RunReport, folder: Path, pool: Executor) -> "dict[str, Future[Any]]":
    """Start a process that draws the motion: instants, and the film where markers are observed."""
    motion = motion_of(data)
    if motion is None:
        return {}
    renderer = Renderer()
    started: dict[str, Future[Any]] = {"pictures": pool.submit(draw, motion.scene(), renderer)}
    # A film takes longer than the rest of the page; where vertices are observed, it adds nothing to the instants.
    if data.sees_markers and len(motion.times) > 1:
        started["video"] = pool.submit(write_film, folder / "motion.mp4", motion.film(), renderer)
    return started


def motion_of(data: RunReport, *, every_model: bool = False) -> ComparedMotion | None:
    """Return the motion that is drawn: that of the film or, where vertices are observed, of the worst trial.

    Args:
        data: Data of the page.
        every_model: Whether it has all models, rather than the two that are compared in pictures.
    """
    trials, film = data.trials, data.film
    if trials is None:
        return None
    seen_from_below, away = hangs(data.mesh, data.fixed, trials.gravity)
    points = None
    if not trials.labels:
        row = trials.worst
        film = Film(trials.names[row], trials.times[row], {m: q[row] for m, q in trials.positions.items()})
        points = data.tip if len(data.tip) else np.flatnonzero(away >= away.max() - 1e-9)
        points = points[np.unique(np.linspace(0, len(points) - 1, _MOST_POINTS).round().astype(int))]
    if film is None or film.trial not in trials.names or not shown_models(film.positions):
        return None
    row = trials.names.index(film.trial)
    models = shown_models(film.positions)
    if every_model:
        models = [model for model in MODELS if model in film.positions and model in trials.positions]
    points = shown_markers(trials.target[row]) if points is None else points
    times = trials.times[row]
    frames = np.flatnonzero(np.append(True, np.diff(times) > 0.0))
    if len(frames) > len(film.times):  # The frames that are closest to those of the film.
        nearest = np.abs(times[frames][:, None] - film.times).argmin(axis=0)
        frames = frames[np.unique(nearest)]
    bodies = {m: at_times(film.positions[m], film.times, times[frames]) for m in models}
    target, *markers = (q[row][frames][:, points] for q in (trials.target, *(trials.positions[m] for m in models)))
    seen = dict(zip(models, markers, strict=True))
    whole = None if trials.labels else trials.target[row][frames]
    at_rest = trials.bound[points]
    around = data.obstacles_at(film.trial, times[frames])
    return ComparedMotion(
        data.mesh, times[frames], target, bodies, seen, at_rest, trials.gravity, seen_from_below, whole, around
    )


def motion_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return a film, a view in space and a few instants of a trial and, where vertices are observed, its tip."""
    motion, trials = motion_of(data), data.trials
    if motion is None or trials is None:
        return None
    models = list(motion.positions)
    name = data.film.trial if data.film is not None and data.sees_markers else trials.names[trials.worst]
    colours = f"Grey: {MODELS[models[0]][0]}. " if len(models) > 1 else ""
    colours += f"Blue: {MODELS[models[-1]][0]}."
    blocks: list[Block] = [] if data.sees_markers else _tip_figure(data, trials, canvas)
    if "video" in canvas.started:
        views = "from the side and from below" if motion.from_below else "the whole body, and its markers from nearby"
        pace = "four times slower than real time" if motion.is_fast else "in real time"
        caption = Markup(
            "The trial {}, {}: {}. {} Dots: measured; rings: simulated. The film lies in "
            "<code>figures/motion.mp4</code>."
        ).format(name, pace, views, colours)

        def film(path: Path) -> Drawn:
            canvas.started["video"].result()
            return Drawn("video", caption, film=data_address(path.read_bytes(), "video/mp4"))

        blocks += canvas.attempt("motion.mp4", film)
    blocks += _in_space(data, name)
    same = "The same trial" if blocks else f"The trial {name}"
    blocks += canvas.attempt("motion.png", lambda _: _instants_figure(data, motion, same, colours, canvas))
    where = ", outside of the training loads" if name in data.others else ""
    head = f"The motion in a test trial, {name}" if data.sees_markers else f"One test trial: {name}{where}"
    return Part(head, blocks)


def _in_space(data: RunReport, name: str) -> list[Block]:
    """Returns an interactive view of the bodies of all models."""
    from .view import view_in_space

    motion = motion_of(data, every_model=True)
    if motion is None:
        return []
    if (count := len(motion.times)) > _MOST_FRAMES:
        motion = motion.at(np.unique(np.linspace(0, count - 1, _MOST_FRAMES).round().astype(int)))
    shown, compared = shown_models(motion.positions), "markers" if data.sees_markers else "vertices"
    against = "the measured ones" if data.sees_markers else "the target"
    caption = (
        f"The trial {name} in space: drag to turn, with Shift to move, pinch or scroll to zoom; arrow keys turn, plus "
        f"and minus zoom, the space bar plays, comma and full stop step, 0 resets. Colours show the distance of the "
        f"{compared} of the solid body from {against}, from zero to the largest in this trial."
    )
    alt = f"An interactive view of the bodies of {', '.join(MODELS[model][0] for model in motion.positions)} in motion."
    return [view_in_space("view", motion, shown, unbroken(caption), alt)]


def _instants_figure(data: RunReport, motion: ComparedMotion, name: str, colours: str, canvas: Canvas) -> Drawn:
    """Draws the body and its markers at a few instants."""
    from . import motion_figures

    frames = canvas.started["pictures"].result()
    titles = [f"{motion.times[frame]:.2f} s" for frame in motion.instants]
    caption, when = f"{name} at {len(titles)} instants, one with the largest error of the grey body.", ", ".join(titles)
    if len(motion.times) == 1:  # A pose.
        titles, caption, when = [""], f"{name}.", "rest"
    caption += f" Drawn to scale; {'below, the view from below' if motion.from_below else 'the second view follows'}"
    caption += "." if motion.from_below else (" the markers." if data.sees_markers else " some vertices of the tip.")
    if not data.sees_markers:
        caption += f" {colours} Dots: the target’s tip; rings: simulated."  # noqa: RUF001
    last = list(motion.positions)[-1]
    if data.metrics["errors_mm"][last]["diverged"]:
        caption += f" Where {MODELS[last][0]} is not drawn, it has diverged."
    alt = f"The deformed body at {when}, with observed and simulated markers."
    return canvas.figure("motion", partial(motion_figures.motion_instants, frames, titles), alt, caption)


def _tip_figure(data: RunReport, trials: TrialResults, canvas: Canvas) -> list[Block]:
    """Draws the tip over time."""
    from . import motion_figures

    if not trials.moves or not len(data.tip):
        return []
    row = trials.worst
    drawn = [m for m in (*BASELINES, "simulation", "sysid", "law", "resphys") if m in trials.positions]
    rest = data.mesh.vertices[data.tip].mean(axis=0)
    paths = {"target": trials.target[row], **{m: trials.positions[m][row] for m in drawn}}
    paths = {name: q[:, data.tip].mean(axis=1) - rest for name, q in paths.items()}
    reached = (f"{MODELS[m][0]} leaves the target by up to {_largest(paths[m] - paths['target'])}" for m in drawn)
    return [
        canvas.figure(
            "tip_displacement",
            partial(motion_figures.tip_displacement, paths, float(np.median(np.diff(trials.times[row])))),
            f"Tip displacement over time. {'; '.join(reached)}.",
            "Tip displacement from rest; the wide line is the target. Below: distance of the simulated tip from "
            "the target’s, on a logarithmic axis.",  # noqa: RUF001
        )
    ]


def _largest(differences: FloatArray) -> str:
    """The largest length of vectors (..., C) [m] as text, where values that are not finite count as infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        distances = 1e3 * np.linalg.norm(differences, axis=-1)
    return largest_text(np.where(np.isnan(distances), np.inf, distances))


def body_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return the picture of the body with its chambers or tendons, and the inputs."""
    trials, driven = data.trials, data.driven
    if trials is None or driven is None:
        return None
    quantity, markers = driven.quantity, len(trials.labels)
    parts = f"{len(driven.channels)} {quantity.per}{'s' if len(driven.channels) > 1 else ''}"
    dots = f", and the {f'{markers} markers' if markers > 1 else 'marker'} as dots" if markers else ""
    dark = " Dark: clamped." if len(data.fixed) else ""
    caption = f"The simulated body: {len(data.mesh.vertices)} vertices, {parts} under {quantity.words}{dots}.{dark}"
    alt = f"The body at rest from outside, cut open and translucent, with {parts} in colours."

    def body(path: Path) -> Drawn:
        from .body_picture import MeshSummary, draw_mesh

        constants = data.settings.simulation.parameters
        density = fmean(value for name, value in constants.items() if name.endswith("density"))
        coloured = f"{quantity.per}s".capitalize()
        summary = MeshSummary(data.mesh, density, data.fixed, data.chambers, data.tendons, coloured, data.obstacles)
        draw_mesh(path, summary, trials.bound if trials.labels else None, canvas.renderer)
        return drawn_file(path, alt, caption)

    blocks = canvas.attempt("body.png", body)
    return Part(f"The body and its {quantity.plural}", [*blocks, *_input_figures(driven, trials, canvas)])


def _input_figures(driven: Driven, trials: TrialResults, canvas: Canvas) -> list[Drawn]:
    """Draws the inputs of a few trials over time, and those of the poses."""
    from . import motion_figures

    over_time, poses = input_sequences(driven, trials), {}
    for name in driven.poses:
        poses[f"{name} (test)" if name in trials.names else name] = driven.values[name]
    words, per = driven.quantity.plural.capitalize(), driven.quantity.per
    limit = "" if not driven.limit else f"; dashed, the limit of {driven.quantity.shown(driven.limit)}"
    whose = "a few trials" if len(driven.values) > 1 else "the trial"
    what, blocks = f"{words} of {len(driven.channels)} {per}s", []
    if over_time:
        drawn = partial(motion_figures.input_sequences, trials.time_step, replace(driven, values=over_time))
        alt, caption = f"{what} over time: {', '.join(over_time)}.", f"{words} of {whose}{limit}."
        blocks.append(canvas.figure("inputs", drawn, alt, unbroken(caption)))
    if poses:
        drawn = partial(motion_figures.pose_inputs, replace(driven, values=poses))
        alt, caption = (
            f"{what} by pose: {', '.join(poses)}.",
            f"{words} of the poses; unused {per}s are left out{limit}.",
        )
        blocks.append(canvas.figure("pose_inputs", drawn, alt, unbroken(caption)))
    return blocks


def input_sequences(driven: Driven, trials: TrialResults) -> dict[str, FloatArray]:
    """Return inputs of a few trials by the titles of their panels: test, training, and highest inputs."""
    values = {name: inputs for name, inputs in driven.values.items() if name not in driven.poses}
    test = [name for name in trials.names if name in values]
    others = [name for name in values if name not in test and name not in driven.scaled][:1]
    highest = sorted(driven.scaled, key=lambda name: float(values[name].max()))[-1:]
    many = _SEQUENCES - len(others) - len(highest)
    picked = [test[at] for at in np.unique(np.linspace(0, len(test) - 1, many).round().astype(int))] if test else []
    titles = {name: f"{name}, a trial of the training" for name in others}
    titles |= {name: f"{name}, a test trial" for name in picked}
    titles |= {name: f"{name}, a test trial at higher {driven.quantity.words}" for name in highest}
    return {title: values[name] for name, title in titles.items()}
