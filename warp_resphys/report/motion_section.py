"""The section of the page of a run on the motion in a trial: a film, a view in space, pictures, and the tip."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from ..learning.baselines import BASELINES
from .bodies import LABORATORY_MARKERS, MEASURED_MARKERS, TARGET_VERTICES, ComparedMotion
from .data import MODELS, Film, RunReport, TrialResults, at_times, shown_markers, shown_models
from .page import Block, Canvas, Drawn, Part, largest_text, unbroken
from .render import Renderer, draw, hangs, write_film

_MOST_POINTS: Final = 6  # Vertices of the tip that are shown, where every vertex is observed.
_MOST_FRAMES: Final = 256  # Of the interactive view.


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
    observed = LABORATORY_MARKERS if "laboratory" in data.settings.targets else MEASURED_MARKERS
    observed = observed if trials.labels else TARGET_VERTICES
    return ComparedMotion(
        data.mesh,
        times[frames],
        target,
        bodies,
        seen,
        at_rest,
        trials.gravity,
        seen_from_below,
        whole,
        around,
        observed,
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
    blocks: list[Block] = []
    if "video" in canvas.started:
        views = "from the side and from below" if motion.from_below else "the whole body, and its markers from nearby"
        pace = "four times slower than real time" if motion.is_fast else "in real time"
        caption = Markup(
            "The trial {}, {}: {}. {} Dots: {}; rings: simulated. The film lies in <code>figures/motion.mp4</code>."
        ).format(name, pace, views, colours, motion.observed)

        def film(path: Path) -> Drawn:
            canvas.started["video"].result()
            alt = "The simulated bodies and what was observed, in motion"
            return replace(Drawn.of(path, alt, caption), name="video")

        blocks += canvas.attempt("motion.mp4", film)
    blocks += _in_space(data, name)
    blocks += [] if data.sees_markers else _tip_figure(data, trials, canvas)
    same = "The same trial" if blocks else f"The trial {name}"
    blocks += canvas.attempt("motion.png", lambda _: _instants_figure(data, motion, same, colours, canvas))
    where = ", beyond the training loads" if name in data.others else ""
    return Part(f"One test trial: {name}{where}", blocks)


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
    """Shows the body at a few instants, each with a second view of its markers."""
    from . import figures

    frames = canvas.started["pictures"].result()  # (F, H, 2 W, 4)
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
    count, height, width, _ = frames.shape
    figure = figures.new_figure(4.0 * height / width * figures.WIDE / count + 0.35)
    panels = figure.subplots(2, count, squeeze=False)
    for row, frame, title in zip(panels.T, frames, titles, strict=True):
        for axes, picture in zip(row, np.split(frame, 2, axis=1), strict=True):
            axes.imshow(picture)
            axes.set_axis_off()
        row[0].set_title(title)
    return canvas.figure("motion", figure, alt, caption)


def _tip_figure(data: RunReport, trials: TrialResults, canvas: Canvas) -> list[Block]:
    """Draws the tip over time and, below it, the distance of each model's tip from that of the target."""
    from . import figures

    if not trials.moves or not len(data.tip):
        return []
    row = trials.worst
    drawn = [m for m in (*BASELINES, "simulation", "sysid", "law", "resphys") if m in trials.positions]
    rest = data.mesh.vertices[data.tip].mean(axis=0)
    every = [trials.target, *(trials.positions[m] for m in drawn)]
    target, *paths = (1e3 * (q[row][:, data.tip].mean(axis=1) - rest) for q in every)  # (T, 3)
    axis, time = int(np.argmax(np.ptp(target, axis=0))), trials.times[row]
    figure = figures.new_figure(3.9)
    motion, distance = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    motion.plot(time, target[:, axis], color=figures.TONES["target"].light, linewidth=4.0, label="Target")
    reached = []
    for model, path in zip(drawn, paths, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            gap = np.linalg.norm(path - target, axis=1)
        motion.plot(time, path[:, axis], **figures.model_line(model))
        distance.plot(time, figures.positive(gap), **figures.model_line(model))
        largest = largest_text(np.where(np.isnan(gap), np.inf, gap))
        reached.append(f"{MODELS[model][0]} leaves the target by up to {largest}")
    figures.keep_in_view(motion, target[:, axis], 0.8)
    motion.set_ylabel(f"tip displacement\nalong {'xyz'[axis]} [mm]")
    figures.few_ticks(motion.yaxis, 5)
    figures.use_logarithm(distance)
    distance.set(xlabel="time [s]", ylabel="off target\n[mm]", xlim=(0.0, np.nanmax(time)))
    figures.legend_above(figure, motion)
    return [
        canvas.figure(
            "tip_displacement",
            figure,
            f"Tip displacement over time. {'; '.join(reached)}.",
            "Tip displacement from rest; the wide line is the target. Below: distance of the simulated tip from "
            "the target’s, on a logarithmic axis.",  # noqa: RUF001
        )
    ]
