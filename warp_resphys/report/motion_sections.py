"""Sections of the page of a run on its motion, and on the body and the inputs that drive it."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from ..learning.intervals import Intervals
from .bodies import ComparedMotion, distance_scene, largest_distances
from .camera import hangs
from .data import (
    MODELS,
    Driven,
    Film,
    FloatArray,
    RunReport,
    Trials,
    at_times,
    best_and_worst,
    drawn_markers,
    shown_markers,
    shown_models,
    tip_markers,
)
from .page import Block, Canvas, Drawn, Part, data_address, drawn_file, largest_text
from .render import Pixels, draw, write_film
from .verdict import unbroken

_ONE_BY_ONE: Final = ("simulation", "sysid", "simfree", "resphys")  # Marker by marker, where all would hide each other.
_MOST_MARKERS: Final = 6  # That are drawn coordinate by coordinate.
_PLANE_SECONDS: Final = 5.0  # Of a path in the plane.
_SPACE_SECONDS: Final = 2.5  # And in space, where a longer one cannot be told apart.
_MOST_FRAMES: Final = 256  # Of the view in space, as films have.
_SEQUENCES: Final = 3  # Trials whose inputs are drawn over time.


def start_drawing(data: RunReport, folder: Path, pool: Executor) -> "dict[str, Future[Any]]":
    """Have other processes draw the motion: the instants with, of vertices, the bodies after them, and the film."""
    motion = motion_of(data)
    if motion is None:
        return {}
    started: dict[str, Future[Any]] = {"pictures": pool.submit(_draw_pictures, data, motion)}
    # A film takes longer than all else on the page; of vertices, it shows no more than the instants.
    if data.sees_markers and len(motion.times) > 1:
        started["video"] = pool.submit(write_film, folder / "motion.mp4", motion.film())
    return started


def _draw_pictures(data: RunReport, motion: ComparedMotion) -> list[Pixels]:
    shape = None if data.trials is None or data.sees_markers else distance_scene(data.mesh, *_bodies(data.trials))
    return draw(motion.scene(), *([] if shape is None else [shape]))


def motion_of(data: RunReport, *, every_model: bool = False) -> ComparedMotion | None:
    """Return the motion that is drawn: that of the film; where vertices are observed, of the worst trial at its tip.

    Args:
        data: What the page shows.
        every_model: Whether all models are in it, not only the two that are compared in pictures.
    """
    trials, film = data.trials, data.film
    if trials is None:
        return None
    seen_from_below, away = hangs(data.mesh, data.fixed, trials.gravity)
    some = None
    if not trials.labels:
        row = trials.worst
        film = Film(trials.names[row], trials.times[row], {m: q[row] for m, q in trials.positions.items()})
        some = data.tip if len(data.tip) else np.flatnonzero(away >= away.max() - 1e-9)
        some = some[np.unique(np.linspace(0, len(some) - 1, _MOST_MARKERS).round().astype(int))]
    if film is None or film.trial not in trials.names or not shown_models(film.positions):
        return None
    row = trials.names.index(film.trial)
    models = shown_models(film.positions)
    if every_model:
        models = [model for model in MODELS if model in film.positions and model in trials.positions]
    some = shown_markers(trials.target[row]) if some is None else some
    times = trials.times[row]
    frames = np.flatnonzero(np.append(True, np.diff(times) > 0.0))
    if len(frames) > len(film.times):  # The closest ones.
        nearest = np.abs(times[frames][:, None] - film.times).argmin(axis=0)
        frames = frames[np.unique(nearest)]
    bodies = {m: at_times(film.positions[m], film.times, times[frames]) for m in models}
    target, *markers = (q[row][frames][:, some] for q in (trials.target, *(trials.positions[m] for m in models)))
    seen = dict(zip(models, markers, strict=True))
    whole = None if trials.labels else trials.target[row][frames]
    at_rest = trials.bound[some]
    return ComparedMotion(
        data.mesh, times[frames], target, bodies, seen, at_rest, trials.gravity, seen_from_below, whole
    )


def worst_state(trials: Trials, row: int) -> int:
    """Return the frame of a trial at which the uncorrected simulation, or the first model, is farthest off."""
    errors = trials.plain_errors_mm[row]
    return int(np.argmax(np.where(np.isfinite(errors), errors, -1.0)))


def _bodies(trials: Trials) -> tuple[dict[str, FloatArray], FloatArray]:
    """(N, 3) the bodies [m] in the worst frame of the worst trial by model, and the target."""
    at = trials.worst, worst_state(trials, trials.worst)
    return {m: trials.positions[m][at] for m in shown_models(trials.positions)}, trials.target[at]


def motion_section(data: RunReport, canvas: Canvas) -> Part | None:
    """A film and a few instants of a trial; with vertices, its tip and the deformed bodies as well."""
    motion, trials = motion_of(data), data.trials
    if motion is None or trials is None:
        return None
    models = list(motion.positions)
    name = data.film.trial if data.film is not None and data.sees_markers else trials.names[trials.worst]
    colours = f"Grey: {MODELS[models[0]][0]}. " if len(models) > 1 else ""
    colours += f"Blue: {MODELS[models[-1]][0]}."
    blocks = [] if data.sees_markers else _vertex_figures(data, trials, canvas)
    if "video" in canvas.started:
        views = "from the side and from below" if motion.from_below else "the whole body, and its markers from nearby"
        pace = "four times slower than it was" if motion.is_fast else "as fast as it was"
        said = Markup(
            "The trial {}, {}: {}. {} Dots: measured; rings: simulated. The film lies in "
            "<code>figures/motion.mp4</code>."
        ).format(name, pace, views, colours)

        def film(path: Path) -> Drawn:
            canvas.started["video"].result()
            return Drawn("video", said, film=data_address(path.read_bytes(), "video/mp4"))

        blocks += canvas.attempt("motion.mp4", film)
    blocks += _in_space(data, name)
    same = "The same trial" if blocks else f"The trial {name}"
    blocks += canvas.attempt("motion.png", lambda _: _instants_figure(data, motion, same, colours, canvas))
    return Part("The motion" if data.sees_markers else f"One test trial: {name}", blocks)


def _in_space(data: RunReport, name: str) -> list[Block]:
    """The bodies of all models, to be turned and played."""
    from .view import view_in_space

    motion = motion_of(data, every_model=True)
    if motion is None:
        return []
    if (count := len(motion.times)) > _MOST_FRAMES:
        motion = motion.at(np.unique(np.linspace(0, count - 1, _MOST_FRAMES).round().astype(int)))
    shown, compared = shown_models(motion.positions), "markers" if data.sees_markers else "vertices"
    against = "what was measured" if data.sees_markers else "the target"
    caption = (
        f"The trial {name} in space: drag to turn, with Shift to move, pinch or scroll to zoom; arrow keys turn, plus "
        f"and minus zoom, the space bar plays, comma and full stop step, 0 resets. Colours of errors are distances of "
        f"the {compared} of the solid body from {against}, from zero to its largest in this trial."
    )
    alt = f"The bodies of {', '.join(MODELS[model][0] for model in motion.positions)} in motion, to be turned."
    return [view_in_space("view", motion, shown, unbroken(caption), alt)]


def _instants_figure(data: RunReport, motion: ComparedMotion, name: str, colours: str, canvas: Canvas) -> Drawn:
    """The body at a few instants, and its markers."""
    from . import motion_figures

    frames = canvas.started["pictures"].result()[0]
    titles = [f"{motion.times[frame]:.2f} s" for frame in motion.instants]
    said, when = f"{name} at {len(titles)} instants; in one of them the grey body is farthest off.", ", ".join(titles)
    if len(motion.times) == 1:  # A pose has no time.
        titles, said, when = [""], f"{name}.", "rest"
    said += f" Drawn to scale; {'below, the view from below' if motion.from_below else 'the second view follows'}"
    said += "." if motion.from_below else (" the markers." if data.sees_markers else " some vertices of the tip.")
    if not data.sees_markers:
        said += f" {colours} Dots: the target’s tip; rings: simulated."  # noqa: RUF001
    last = list(motion.positions)[-1]
    if data.metrics["errors_mm"][last]["diverged"]:
        said += f" Where {MODELS[last][0]} is not drawn, it has diverged."
    alt = f"The deformed body at {when}, with observed and simulated markers."
    return canvas.figure("motion", partial(motion_figures.motion_instants, frames, titles), alt, said)


def _vertex_figures(data: RunReport, trials: Trials, canvas: Canvas) -> list[Block]:
    """The tip over time, and the bodies coloured by their error."""
    from . import motion_figures

    row, blocks = trials.worst, list[Block]()
    drawn = [m for m in ("simulation", "sysid", "resphys") if m in trials.positions]
    if trials.moves and len(data.tip):
        rest = data.mesh.vertices[data.tip].mean(axis=0)
        paths = {"target": trials.target[row], **{m: trials.positions[m][row] for m in drawn}}
        paths = {name: q[:, data.tip].mean(axis=1) - rest for name, q in paths.items()}
        reached = (f"{MODELS[m][0]} leaves the target by up to {_largest(paths[m] - paths['target'])}" for m in drawn)
        blocks.append(
            canvas.figure(
                "tip_displacement",
                partial(motion_figures.tip_displacement, paths, float(np.median(np.diff(trials.times[row])))),
                f"Tip displacement over time. {'; '.join(reached)}.",
                "Tip displacement from rest, the target drawn wide beneath the simulations. Below: distance of the "
                "simulated tip from the target’s, on a logarithmic axis.",  # noqa: RUF001
            )
        )
    bodies, target = _bodies(trials)
    reached = (f"{MODELS[m][0]}, up to {_largest(q - target)}" for m, q in bodies.items())
    moment = f"{trials.times[row, worst_state(trials, row)]:.2f} s, where the first body is farthest off"
    caption = (
        f"The same trial{f' at {moment}' if trials.moves else ''}: each body coloured by the distance of its vertices "
        "from the target’s. The colour scales differ. Grey: the undeformed body. Drawn to scale."  # noqa: RUF001
    )
    alt = f"The deformed body, coloured by its distance from the target: {'; '.join(reached)}."

    def shape(_: Path) -> Drawn:
        _, *pictures = canvas.started["pictures"].result()
        picture, largest = pictures[0][0] if pictures else None, largest_distances(data.mesh, bodies, target)
        return canvas.figure("shape", partial(motion_figures.shape_comparison, picture, largest), alt, caption)

    return blocks + canvas.attempt("shape.png", shape)


def _largest(differences: FloatArray) -> str:
    """The longest of (..., C) vectors [m], in words; not finite is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        distances = 1e3 * np.linalg.norm(differences, axis=-1)
    return largest_text(np.where(np.isnan(distances), np.inf, distances))


def paths_section(data: RunReport, canvas: Canvas) -> Part | None:
    """The motion of markers: of the tip where inputs drive it, else coordinate by coordinate."""
    trials = data.trials
    if trials is None or not trials.labels or not trials.moves:
        return None
    places = dict(zip(("worst", "best"), best_and_worst(trials), strict=False))
    which = {"worst": "", "best": ""}
    if len(places) > 1:
        which["worst"] = ", in which the last model of the table is farthest off"
        which["best"] = ", in which the same model is closest"
    if data.driven is None:
        found = [_markers(data, trials, row, at, which[at], canvas) for at, row in places.items()]
        return Part("Marker by marker", found)
    driven = _driven_markers(data, trials, places["worst"], data.driven, canvas)
    if trials.own_frame or len(trials.axes) < 3:  # Where the tip is in space is not told.
        return Part("Marker by marker", [driven])
    blocks = [_plane(data, trials, row, at, which[at], canvas) for at, row in places.items()]
    return Part("The tip", [*blocks[:1], _space(data, trials, places["worst"], canvas), driven, *blocks[1:]])


def _bands(data: RunReport, trials: Trials, row: int, kept: Sequence[int]) -> dict[str, FloatArray]:
    """(T, M) half-widths [m] of the prediction intervals of some markers, by model, of the last one that has any."""
    known = data.metrics.get("intervals", {}).get("models", {})
    model = next((m for m in ("resphys", "sysid") if "factor" in known.get(m, {}) and m in trials.positions), None)
    if model is None:
        return {}
    widths = Intervals.from_plain(known[model]).half_widths(trials.positions[model][row], trials.bound)
    return {model: widths[:, kept]}


def _band_note(bands: Mapping[str, FloatArray]) -> str:
    return " The band around it is to hold nine of ten measured coordinates." if bands else ""


def _markers(data: RunReport, trials: Trials, row: int, place: str, which: str, canvas: Canvas) -> Drawn:
    """Coordinates of the markers that move most."""
    from . import motion_figures

    reach = np.nanmax(np.linalg.norm(trials.target[row] - trials.bound, axis=2), axis=0, initial=0.0)
    shown = shown_markers(trials.target[row])
    kept = np.sort(shown[np.argsort(-reach[shown])[:_MOST_MARKERS]])
    moved = {m: (trials.positions[m][row] - trials.bound)[:, kept] for m in _ONE_BY_ONE if m in trials.positions}
    target, labels = (trials.target[row] - trials.bound)[:, kept], [trials.labels[marker] for marker in kept]
    name, hidden = trials.names[row], len(shown) - len(kept)
    bands, series = _bands(data, trials, row, kept.tolist()), (trials.times[row], target, moved)
    return canvas.figure(
        f"paths_{place}",
        partial(motion_figures.marker_paths, *series, labels, coordinates=trials.axes, bands=bands),
        f"Coordinates of the markers over time in the trial {name}: measured as dots, the models as lines.",
        f"Trial {name}{which}: coordinates of the markers from where they were held.{_band_note(bands)}"
        + (f" The {hidden} markers that move least are not drawn." if hidden else ""),
    )


def _start(trials: Trials, row: int) -> FloatArray:
    """(M, 3) where markers were seen first [m]."""
    first = trials.target[row, 0]
    return np.where(np.isfinite(first), first, trials.bound)


def _tip_paths(data: RunReport, trials: Trials, row: int, seconds: float) -> tuple[Any, ...]:
    """(T,) first times [s], and (T, 3) how the mean of the markers at the tip moves [m]: measured, and by model."""
    shown = shown_markers(trials.target[row])
    tip = np.intersect1d(tip_markers(trials.bound, data.mesh.vertices[data.fixed]), shown)
    tip = tip if len(tip) else shown
    rest = _start(trials, row)[tip].mean(axis=0)
    near = trials.times[row] <= seconds + 1e-9
    models = {m: trials.positions[m] for m in MODELS if m in trials.positions}
    seen, *paths = (q[row][near][:, tip].mean(axis=1) - rest for q in (trials.target, *models.values()))
    return trials.times[row][near], seen, dict(zip(models, paths, strict=True))


def _plane(data: RunReport, trials: Trials, row: int, place: str, which: str, canvas: Canvas) -> Drawn:
    """The path of the tip in the plane."""
    from . import motion_figures

    name = trials.names[row]
    _, seen, paths = _tip_paths(data, trials, row, _PLANE_SECONDS)
    return canvas.figure(
        f"plane_{place}",
        partial(motion_figures.tip_planes, seen, paths),
        f"Path of the tip in the plane of x and y in the trial {name}: measured in grey, the models over it.",
        f"Path of the tip across gravity over the first {min(_PLANE_SECONDS, trials.times[row, -1]):g} s of the trial "
        f"{name}{which}: displacement of the mean of the markers at the tip, measured in grey. What leaves the frame "
        "is cut.",
    )


def _space(data: RunReport, trials: Trials, row: int, canvas: Canvas) -> Drawn:
    """The path of the tip in space."""
    from . import motion_figures

    name = trials.names[row]
    times, seen, paths = _tip_paths(data, trials, row, _SPACE_SECONDS)
    last = [m for m in ("sysid", "resphys") if m in paths] or list(paths)[-1:]
    return canvas.figure(
        "space",
        partial(motion_figures.tip_in_space, times, seen, {m: paths[m] for m in last}),
        f"Path of the tip in space in the trial {name}: measured in grey, the models as lines beside it.",
        f"The first {min(_SPACE_SECONDS, trials.times[row, -1]):g} s of the trial {name} in space, with points every "
        "0.5 s that are joined to the measured ones.",
    )


def _driven_markers(data: RunReport, trials: Trials, row: int, driven: Driven, canvas: Canvas) -> Drawn:
    """Markers over what drives them."""
    from . import motion_figures

    name, start = trials.names[row], _start(trials, row)
    kept = drawn_markers(trials.target[row], trials.bound, data.mesh.vertices[data.fixed])
    compared = [m for m in _ONE_BY_ONE[1:] if m in trials.positions] or [m for m in MODELS if m in trials.positions]
    moved = {m: (trials.positions[m][row] - start)[:, kept] for m in compared}
    target, labels = (trials.target[row] - start)[:, kept], [trials.labels[marker] for marker in kept]
    words, per = driven.quantity.plural, driven.quantity.per
    own = replace(driven, values={words.capitalize(): driven.values[name]})
    bands, series = _bands(data, trials, row, kept), (trials.times[row], target, moved)
    return canvas.figure(
        "markers",
        partial(motion_figures.marker_paths, *series, labels, own, coordinates=trials.axes, bands=bands),
        f"Coordinates of markers over time in the trial {name}, and below them the {words} of the {per}s.",
        f"The trial {name}: displacement of markers from rest, and the {words} that drive it.{_band_note(bands)}",
    )


def body_section(data: RunReport, canvas: Canvas) -> Part | None:
    """The body with its chambers or tendons, and what drives them."""
    trials, driven = data.trials, data.driven
    if trials is None or driven is None:
        return None
    quantity, markers = driven.quantity, len(trials.labels)
    parts = f"{len(driven.channels)} {quantity.per}{'s' if len(driven.channels) > 1 else ''}"
    dots = f", and the {f'{markers} markers' if markers > 1 else 'marker'} as dots" if markers else ""
    said = (
        f"The body that is simulated: {len(data.mesh.vertices)} vertices, {parts} under {quantity.words}{dots}. Dark: "
        "clamped."
    )
    alt = f"The body at rest from outside, cut open and translucent, with {parts} in colours."

    def body(path: Path) -> Drawn:
        from .body_picture import MeshSummary, draw_mesh

        density = float(data.settings["simulation"]["density"])
        coloured = f"{quantity.per}s".capitalize()
        summary = MeshSummary(data.mesh, density, data.fixed, data.chambers, data.tendons, coloured)
        draw_mesh(path, summary, trials.bound if trials.labels else None)
        return drawn_file(path, alt, said)

    blocks = canvas.attempt("body.png", body)
    return Part(f"The body and its {quantity.plural}", [*blocks, *_input_figures(driven, trials, canvas)])


def _input_figures(driven: Driven, trials: Trials, canvas: Canvas) -> list[Drawn]:
    """The inputs of a few trials over time, and those of the poses."""
    from . import motion_figures

    over_time, poses = _sequences(driven, trials), {}
    for name in driven.poses:
        poses[f"{name} (test)" if name in trials.names else name] = driven.values[name]
    words, per = driven.quantity.plural.capitalize(), driven.quantity.per
    limit = "" if not driven.limit else f"; dashed, the limit of {driven.quantity.shown(driven.limit)}"
    whose = "a few trials" if len(driven.values) > 1 else "the trial"
    what, blocks = f"{words} of {len(driven.channels)} {per}s", []
    if over_time:
        drawn = partial(motion_figures.input_sequences, trials.time_step, replace(driven, values=over_time))
        alt, said = f"{what} over time: {', '.join(over_time)}.", f"{words} of {whose}{limit}."
        blocks.append(canvas.figure("inputs", drawn, alt, unbroken(said)))
    if poses:
        drawn = partial(motion_figures.pose_inputs, replace(driven, values=poses))
        alt, said = (
            f"{what} by pose: {', '.join(poses)}.",
            f"{words} that hold the poses; {per}s without any are left out{limit}.",
        )
        blocks.append(canvas.figure("pose_inputs", drawn, alt, unbroken(said)))
    return blocks


def _sequences(driven: Driven, trials: Trials) -> dict[str, FloatArray]:
    """A few trials' inputs by the panels' titles: of the test, of the training, and at the highest inputs."""
    values = {name: each for name, each in driven.values.items() if name not in driven.poses}
    test = [name for name in trials.names if name in values]
    others = [name for name in values if name not in test and name not in driven.scaled][:1]
    highest = sorted(driven.scaled, key=lambda name: float(values[name].max()))[-1:]
    many = _SEQUENCES - len(others) - len(highest)
    picked = [test[at] for at in np.unique(np.linspace(0, len(test) - 1, many).round().astype(int))] if test else []
    titles = {name: f"{name}, a trial of the training" for name in others}
    titles |= {name: f"{name}, a test trial" for name in picked}
    titles |= {name: f"{name}, a test trial at higher {driven.quantity.words}" for name in highest}
    return {title: values[name] for name, title in titles.items()}
