"""Sections of the page of a run on its motion, and on the body and the pressures that drive it."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from .data import (
    MODELS,
    FloatArray,
    Pressures,
    RunReport,
    Trials,
    at_times,
    best_and_worst,
    drawn_markers,
    mean_distance,
    shown_models,
    tip_markers,
)
from .page import Canvas, Drawn, Part, file_address, number_text
from .verdict import unbroken
from .video import Motion, draw_instants, write_video

_ONE_BY_ONE: Final = ("simulation", "sysid", "simfree", "resphys")  # Marker by marker, where all would hide each other.
_MOST_MARKERS: Final = 6  # That are drawn coordinate by coordinate.
_PLANE_SECONDS: Final = 5.0  # Of a path in the plane.
_SPACE_SECONDS: Final = 2.5  # And in space, where a longer one cannot be told apart.
_SEQUENCES: Final = 3  # Trials whose pressures are drawn.
_FAST: Final = 2.5  # [s] that a motion lasts which is shown slowed down, and from its start only,
_FINE: Final = 0.025  # where its frames are no farther apart [s].
_SLOWER, _LONGEST = {True: 4.0, False: 1.0}, {True: 1.5, False: 10.0}  # By whether it is fast; [s] that are shown.
_HANGING: Final = 0.7  # Cosine between gravity and a body that hangs.


def moving_pictures(data: RunReport) -> dict[str, tuple[str, Callable[[Path], Any]]]:
    """Return what other processes draw of the motion: by name, a file and what draws into it or gives pictures."""
    motion = motion_of(data)
    if motion is None:
        return {}
    found: dict[str, tuple[str, Callable[[Path], Any]]] = {
        "motion": ("motion.png", lambda _: draw_instants(motion.at(_instants_of(motion)))),
    }
    if not data.sees_markers:  # A film takes longer than all else on the page, and shows no more than the instants.
        return {"shape": ("shape.png", partial(_bodies, data)), **found}
    if len(motion.times) > 1:
        found["video"] = ("motion.mp4", partial(_write_video, motion))
    return found


def motion_of(data: RunReport) -> Motion | None:
    """Return the motion that is drawn: that of the film; where vertices are observed, of the worst trial at its tip."""
    trials, film = data.trials, data.film
    if trials is None or not shown_models(trials.positions):
        return None
    hangs = _hangs(data)
    if not trials.labels:
        row, models = trials.worst, shown_models(trials.positions)
        some = data.tip if len(data.tip) else np.flatnonzero(hangs[1] >= hangs[1].max() - 1e-9)
        some = some[np.unique(np.linspace(0, len(some) - 1, _MOST_MARKERS).round().astype(int))]
        bodies = {m: trials.positions[m][row] for m in models}
        seen = {m: q[:, some] for m, q in bodies.items()}
        target = trials.target[row][:, some]
        return Motion(data.mesh, trials.times[row], target, bodies, seen, trials.bound[some], trials.gravity, hangs[0])
    if film is None or film.trial not in trials.names or not shown_models(film.positions):
        return None
    row, models = trials.names.index(film.trial), shown_models(film.positions)
    times = trials.times[row]
    frames = np.flatnonzero(np.append(True, np.diff(times) > 0.0))
    if len(frames) > len(film.times):  # The closest ones.
        nearest = np.abs(times[frames][:, None] - film.times).argmin(axis=0)
        frames = frames[np.unique(nearest)]
    bodies = {m: at_times(film.positions[m], film.times, times[frames]) for m in models}
    seen = {m: trials.positions[m][row][frames] for m in models}
    return Motion(
        data.mesh, times[frames], trials.target[row][frames], bodies, seen, trials.bound, trials.gravity, hangs[0]
    )


def _hangs(data: RunReport) -> tuple[bool, FloatArray]:
    """Whether the body hangs, so that its motion is seen from below, and (N,) how far vertices are from the clamp."""
    assert data.trials is not None
    start = data.mesh.vertices[data.fixed].mean(axis=0) if len(data.fixed) else data.mesh.vertices[0]
    away = data.mesh.vertices - start
    axis, down = away.mean(axis=0), data.trials.gravity
    size = float(np.linalg.norm(axis) * np.linalg.norm(down))
    return bool(size > 0.0 and axis @ down > _HANGING * size), np.linalg.norm(away, axis=1)


def _instants_of(motion: Motion) -> list[int]:
    return instants(motion.measured, motion.bound, next(iter(motion.markers.values())))


def instants(target: FloatArray, bound: FloatArray, simulated: FloatArray) -> list[int]:
    """Return three frames that lie apart, or fewer of a short motion.

    They are where the simulation is farthest off, where the markers have moved most, and the last one; where two of
    these are close to each other, one from between is taken.

    Args:
        target: (T, M, 3) [m], NaN where a marker was not seen.
        bound: (M, 3) [m] on the undeformed body.
        simulated: (T, M, 3) [m].
    """
    count = len(target)
    moved = np.nan_to_num(np.linalg.norm(target - bound, axis=2)).mean(axis=1)
    off = mean_distance(simulated[None], target[None])[0]
    worst = int(np.argmax(np.where(np.isfinite(off), off, -1.0)))
    chosen: list[int] = []
    for frame in (worst, int(np.argmax(moved)), count - 1, count // 2, count // 4):
        if len(chosen) < 3 and all(abs(frame - other) > count // 10 for other in chosen):
            chosen.append(frame)
    return sorted(chosen)


def _is_fast(motion: Motion) -> bool:
    """Whether a motion is shown slowed down."""
    return bool(motion.times[-1] <= _FAST and np.diff(motion.times).max(initial=0.0) <= _FINE)


def _write_video(motion: Motion, path: Path) -> Path:
    fast = _is_fast(motion)
    names = {model: name for model, (name, _) in MODELS.items()}
    write_video(path, motion, names, _SLOWER[fast], _LONGEST[fast])
    return path


def _bodies(data: RunReport, _: Path) -> Any:
    from .render import draw_bodies

    assert data.trials is not None
    trials, row = data.trials, data.trials.worst
    state = worst_state(trials, row)
    models = shown_models(trials.positions)
    return draw_bodies(data.mesh, {m: trials.positions[m][row, state] for m in models}, trials.target[row, state])


def worst_state(trials: Trials, row: int) -> int:
    """Return the frame of a trial at which the uncorrected simulation, or the first model, is farthest off."""
    errors = trials.errors_mm.get("simulation", next(iter(trials.errors_mm.values())))[row]
    return int(np.argmax(np.where(np.isfinite(errors), errors, -1.0)))


def motion_section(data: RunReport, canvas: Canvas) -> Part | None:
    """A film and a few instants of a trial; with vertices, its tip and the deformed bodies as well."""
    motion, trials = motion_of(data), data.trials
    if motion is None or trials is None:
        return None
    from . import motion_figures

    models = list(motion.positions)
    film = data.film if data.sees_markers else None
    name = trials.names[trials.worst] if film is None else film.trial
    fast = _is_fast(motion)
    colours = f"Grey: {MODELS[models[0]][0]}. " if len(models) > 1 else ""
    colours += f"Blue: {MODELS[models[-1]][0]}."
    blocks: list[Any] = []
    if not data.sees_markers:
        blocks += _vertex_figures(data, trials, canvas)
    if "video" in canvas.started:
        path = canvas.attempt("video", "motion.mp4")
        views = "from the side and from below" if motion.from_below else "the whole body, and its markers from nearby"
        pace = "four times slower than it was" if fast else "as fast as it was"
        film_said = Markup(
            "The trial {}, {}: {}. {} Dots: measured; rings: simulated. The film lies in "
            "<code>figures/motion.mp4</code>."
        ).format(name, pace, views, colours)
        address = "" if path is None else file_address(path, "video/mp4")
        blocks += canvas.reason("video") if path is None else [Drawn("video", film_said, film=address)]
    images = canvas.attempt("motion", "motion.png")
    if images is None:
        return Part(_motion_title(data, name), blocks + canvas.reason("motion"))
    titles = [f"{motion.times[frame]:.2f} s" for frame in _instants_of(motion)]
    same = "The same trial" if blocks else f"The trial {name}"
    said = f"{same} at {len(titles)} instant{'s' if len(titles) > 1 else ''}"
    said += "; in one of them the grey body is farthest off." if trials.moves else "."
    said += f" Drawn to scale; {'below, the view from below' if motion.from_below else 'the second view follows'}"
    said += "." if motion.from_below else (" the markers." if data.sees_markers else " some vertices of the tip.")
    if not data.sees_markers:
        said += f" {colours} Dots: the target’s tip; rings: simulated."  # noqa: RUF001
    if data.metrics["errors_mm"][models[-1]]["diverged"]:
        said += f" Where {MODELS[models[-1]][0]} is not drawn, it has diverged."
    alt = f"The deformed body at {', '.join(titles)}, with observed and simulated markers."
    blocks.append(canvas.figure("motion", partial(motion_figures.motion_instants, images, titles), alt, said))
    return Part(_motion_title(data, name), blocks)


def _motion_title(data: RunReport, name: str) -> str:
    return "The motion" if data.sees_markers else f"One test trial: {name}"


def _vertex_figures(data: RunReport, trials: Trials, canvas: Canvas) -> list[Any]:
    """The tip over time, and the bodies coloured by their error."""
    from . import motion_figures

    row, blocks = trials.worst, list[Any]()
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
    bodies = canvas.attempt("shape", "shape.png")
    if bodies is None:
        return blocks + canvas.reason("shape")
    state = worst_state(trials, row)
    reached = (f"{MODELS[m][0]}, up to {_largest((trials.positions[m] - trials.target)[row, state])}" for m in bodies)
    at = f" at {trials.times[row, state]:.2f} s, where the first body is farthest off" if trials.moves else ""
    caption = (
        f"The same trial{at}: each body coloured by the distance of its vertices from the target’s. "  # noqa: RUF001
        "The colour scales differ. Grey: the undeformed body. Drawn to scale."
    )
    alt = f"The deformed body, coloured by its distance from the target: {'; '.join(reached)}."
    return [*blocks, canvas.figure("shape", partial(motion_figures.shape_comparison, bodies), alt, caption)]


def _largest(differences: FloatArray) -> str:
    """The longest of (..., C) vectors [m], in words."""
    if not np.isfinite(differences).all():
        return "more than any number (it diverged)"
    with np.errstate(over="ignore"):
        return f"{number_text(1e3 * float(np.linalg.norm(differences, axis=-1).max()))} mm"


def paths_section(data: RunReport, canvas: Canvas) -> Part | None:
    """The motion of markers: of the tip where pressures drive it, else coordinate by coordinate."""
    trials = data.trials
    if trials is None or not trials.labels or not trials.moves:
        return None
    places = list(zip(("worst", "best"), best_and_worst(trials), strict=False))
    which = {"worst": "", "best": ""}
    if len(places) > 1:
        which = {
            "worst": ", in which the last model of the table is farthest off",
            "best": ", in which the same model is closest",
        }
    if data.pressures is not None:
        blocks = [each for place, row in places for each in _tip_figures(data, trials, row, place, which, canvas)]
        return Part("The tip", blocks)
    return Part("Marker by marker", [_marker_figure(trials, row, place, which[place], canvas) for place, row in places])


def _marker_figure(trials: Trials, row: int, place: str, which: str, canvas: Canvas) -> Drawn:
    """Coordinates of the markers that move most."""
    from . import motion_figures

    reach = np.nanmax(np.linalg.norm(trials.target[row] - trials.bound, axis=2), axis=0, initial=0.0)
    kept = np.sort(np.argsort(-reach)[:_MOST_MARKERS])
    models = {m: trials.positions[m][row][:, kept] for m in _ONE_BY_ONE if m in trials.positions}
    labels, name = [trials.labels[marker] for marker in kept], trials.names[row]
    hidden = len(trials.labels) - len(kept)
    return canvas.figure(
        f"paths_{place}",
        partial(
            motion_figures.marker_paths,
            trials.times[row],
            trials.target[row][:, kept],
            models,
            labels,
            trials.bound[kept],
        ),
        f"Coordinates of the markers over time in the trial {name}: measured as dots, the models as lines.",
        f"Trial {name}{which}: coordinates of the markers from where they were held."
        + (f" The {hidden} markers that move least are not drawn." if hidden else ""),
    )


def _tip_figures(
    data: RunReport, trials: Trials, row: int, place: str, which: Mapping[str, str], canvas: Canvas
) -> list[Drawn]:
    """The path of the tip in the plane and, in the worst trial, in space, and markers beside the pressures."""
    from . import motion_figures

    assert data.pressures is not None
    name, times, target = trials.names[row], trials.times[row], trials.target[row]
    clamped = data.mesh.vertices[data.fixed]
    tip = tip_markers(trials.bound, clamped)
    start = np.where(np.isfinite(target[0]), target[0], trials.bound)
    models = [m for m in MODELS if m in trials.positions]
    rest = start[tip].mean(axis=0)
    seen = target[:, tip].mean(axis=1) - rest
    paths = {m: trials.positions[m][row][:, tip].mean(axis=1) - rest for m in models}
    near, nearer = (times <= seconds + 1e-9 for seconds in (_PLANE_SECONDS, _SPACE_SECONDS))
    plane = canvas.figure(
        f"plane_{place}",
        partial(motion_figures.tip_planes, seen[near], {m: path[near] for m, path in paths.items()}),
        f"Path of the tip in the plane of x and y in the trial {name}: measured in grey, the models over it.",
        f"Path of the tip across gravity over the first {min(_PLANE_SECONDS, times[-1]):g} s of the trial {name}"
        f"{which[place]}: displacement of the mean of the markers at the tip, measured in grey. What leaves the frame "
        "is cut.",
    )
    if place == "best":
        return [plane]
    last = [m for m in ("sysid", "resphys") if m in paths] or models[-1:]
    space = canvas.figure(
        "space",
        partial(motion_figures.tip_in_space, times[nearer], seen[nearer], {m: paths[m][nearer] for m in last}),
        f"Path of the tip in space in the trial {name}: measured in grey, the models as lines beside it.",
        f"The first {min(_SPACE_SECONDS, times[-1]):g} s of the trial {name} in space, with points every 0.5 s that "
        "are joined to the measured ones.",
    )
    kept = drawn_markers(target, trials.bound, clamped)
    compared = [m for m in _ONE_BY_ONE[1:] if m in models] or models
    markers = canvas.figure(
        "markers",
        partial(
            motion_figures.markers_and_pressures,
            times,
            target[:, kept],
            {m: trials.positions[m][row][:, kept] for m in compared},
            [trials.labels[marker] for marker in kept],
            start[kept],
            data.pressures.values[name],
            data.pressures.channels,
            data.pressures.limit,
        ),
        f"Coordinates of markers over time in the trial {name}, and below them the pressures in the chambers.",
        f"The trial {name}: displacement of markers from rest, and the pressures that drive it.",
    )
    return [plane, space, markers]


def body_section(data: RunReport, canvas: Canvas) -> Part | None:
    """The body with its chambers, and the pressures in them."""
    trials, pressures = data.trials, data.pressures
    if trials is None or pressures is None:
        return None
    from . import motion_figures
    from .mesh import MeshSummary, draw_mesh

    def draw(path: Path) -> None:
        density = float(data.settings["simulation"]["density"])
        summary = MeshSummary(data.mesh, density, data.fixed, data.chambers)
        draw_mesh(path, summary, trials.bound if trials.labels else None)

    chambers, markers = len(data.chambers), len(trials.labels)
    dots = f", and the {f'{markers} markers' if markers > 1 else 'marker'} as dots" if markers else ""
    said = (
        f"The body that is simulated: {len(data.mesh.vertices)} vertices, {chambers} "
        f"chamber{'s' if chambers > 1 else ''} under pressure{dots}. Dark: clamped."
    )
    alt = f"The body at rest from outside, cut open and translucent, with {chambers} chambers in colours."
    blocks = canvas.file("body", draw, alt, said)
    chosen = _sequences(pressures, trials)
    limit = "" if not pressures.limit else f"; dashed, the limit of {1e-3 * pressures.limit:g} kPa"
    blocks.append(
        canvas.figure(
            "pressures",
            partial(motion_figures.pressure_sequences, trials.time_step, chosen, pressures.channels, pressures.limit),
            f"Pressures in {len(pressures.channels)} chambers over time: {', '.join(chosen)}.",
            unbroken(f"Gauge pressures of {'a few trials' if len(pressures.values) > 1 else 'the trial'}{limit}."),
        )
    )
    return Part("The body and its pressures", blocks)


def _sequences(pressures: Pressures, trials: Trials) -> dict[str, FloatArray]:
    """A few trials' pressures by the panels' titles: of the test, of the training, and at the highest pressure."""
    values, test = pressures.values, list(trials.names)
    others = [name for name in values if name not in test and name not in pressures.scaled]
    highest = sorted(pressures.scaled, key=lambda name: float(values[name].max()))[-1:]
    many = _SEQUENCES - len(others[:1]) - len(highest)
    picked = [test[at] for at in np.unique(np.linspace(0, len(test) - 1, many).round().astype(int))]
    titles = {name: f"{name}, a trial of the training" for name in others[:1]}
    titles |= {name: f"{name}, a test trial" for name in picked}
    titles |= {name: f"{name}, a test trial at higher pressure" for name in highest}
    return {title: values[name] for name, title in titles.items()}
