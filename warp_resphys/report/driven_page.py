"""The report of an experiment with motions that pressure drives: one page for a split of the trials."""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..io.files import write_text
from .driven_data import DrivenReport, drawn_markers, mean_of, tip_markers
from .driven_tables import (
    DRIVEN_MODELS,
    driven_verdict,
    factor_table,
    largest_filtered,
    range_texts,
    window_table,
)
from .measured_data import best_and_worst, shown_models
from .measured_page import (
    attempt,
    common_parts,
    draw_identification,
    draw_registration_picture,
    draw_training,
    file_address,
    instants,
    split_parts,
)
from .measured_tables import against, published_beside
from .page import Picture, draw_picture, error_parts, figures_beside, page_template
from .video import Motion

_LOG = logging.getLogger(__name__)
FloatArray = NDArray[np.float64]

_COMPARED: Final = ("sysid", "simfree", "resphys")  # Marker by marker, where all would hide each other.
_PLANE_SECONDS: Final = 5.0  # Of a path in the plane.
_SPACE_SECONDS: Final = 2.5  # And in space, where a longer one cannot be told apart.
_SEQUENCES: Final = 3  # Trials whose pressures are drawn.
_FILTER: Final = 1.0  # [s] of the median filter, as published.
_WINDOWS: Final = 4.0  # That a roll-out must last for it.
_LONGEST: Final = 10.0  # [s] of the video.


def write_driven_report(path: Path, data: DrivenReport) -> None:
    """Write the page, with its figures and the video in `figures/` beside it.

    What cannot be drawn on this machine is replaced by a sentence that says why.

    Args:
        path: The page's file, such as `report.html`; missing folders are made.
        data: What to show.

    Raises:
        DataFileError: A file could not be written.
    """
    metrics = data.metrics
    errors = metrics["errors_mm"]
    with figures_beside(path) as folder:
        pictures, missing = _draw(data, folder)
        video = attempt("video", folder / "motion.mp4", partial(_write_video, data), missing)
    models = [model for model in DRIVEN_MODELS if model in errors]
    extrapolated = data.settings["data"]["train_fraction"] < 1.0
    page = page_template("driven.html").render(
        **common_parts(data, pictures, missing) | {"names": DRIVEN_MODELS},
        **split_parts(data, pictures),
        verdict=driven_verdict(metrics, data.trials.names, data.published, data.published_windows, extrapolated),
        models=models,
        against=against(errors),
        measured={model: error_parts(each) for model, each in errors.items()},
        published=published_beside(data.published, models),
        comparisons={
            "windows": window_table(metrics, data.published_windows),
            "factors": factor_table(metrics),
        },
        diverged_beyond=sum(s["diverged"] for each in metrics.get("overpressure", {}).values() for s in each.values()),
        ranges=range_texts(metrics, data.trials.names),
        each_trajectory={row["name"]: row["errors_mm"] for row in metrics["per_trajectory"]},
        each_marker=_by_marker(data),
        length=_length(data),
        extrapolated=extrapolated,
        plane_seconds=_PLANE_SECONDS,
        space_seconds=_SPACE_SECONDS,
        filtered=_window(data) is not None,
        largest=largest_filtered(metrics),
        shown=_shown(data),
        drawn=[data.trials.names[trial] for trial in best_and_worst(data.trials)],
        video=None if video is None else file_address(video, "video/mp4"),
    )
    write_text(path, page)
    _LOG.info("report written: %s", path)


def _length(data: DrivenReport) -> float:
    """Of the roll-outs [s]."""
    return data.trials.time_step * (data.trials.measured.shape[1] - 1)


def _window(data: DrivenReport) -> float | None:
    """Of the median filter [s]; None for roll-outs that it would take too much of."""
    return _FILTER if _length(data) >= _WINDOWS * _FILTER - 1e-9 else None


def _by_marker(data: DrivenReport) -> dict[str, dict[str, float | None]]:
    """The mean error of each model at each marker [mm]."""
    found: Mapping[str, Mapping[str, float | None]] = data.metrics["per_marker"]
    return {label: {model: found[model].get(label) for model in found} for label in data.trials.labels}


def _shown(data: DrivenReport) -> list[str]:
    """The models whose bodies are drawn."""
    return shown_models({model: data.trials.markers[model] for model in data.film.positions})


def _draw(data: DrivenReport, folder: Path) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw the figures; say of those that cannot be drawn why."""
    from . import driven_figures

    pictures: dict[str, Picture] = {}
    missing: dict[str, str] = {}
    both = partial(draw_picture, folder)
    trials = data.trials
    pictures["error_over_time"] = both(
        "error_over_time",
        partial(driven_figures.filtered_errors, trials.time_step, trials.errors_mm(), _window(data)),
        "Mean marker error of the models over time, as a median over 1 s where they are long, on a logarithmic axis.",
    )
    over = data.metrics.get("overpressure", {})
    if over:
        pictures["error_over_factor"] = both(
            "error_over_factor",
            partial(driven_figures.errors_over_factor, _means(over)),
            "Mean marker error of the models against the factor of the pressure, on a logarithmic axis.",
        )
    _draw_paths(data, both, pictures)
    chosen = _sequences(data)
    pictures["pressures"] = both(
        "pressures",
        partial(
            driven_figures.pressure_sequences,
            trials.time_step,
            chosen,
            data.actuation.chambers,
            data.actuation.limit,
        ),
        f"Pressures in {len(data.actuation.chambers)} chambers over time: {', '.join(chosen)}.",
    )
    draw_training(data, both, pictures)
    draw_identification(data, both, pictures)
    draw_registration_picture(data, folder, pictures, missing)
    _draw_body(data, folder, both, pictures, missing)
    return pictures, missing


def _means(over: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[float, float]]:
    """Mean errors [mm] by model and factor, where no roll-out diverged."""
    models = [model for model in DRIVEN_MODELS if any(model in each for each in over.values())]
    return {
        model: {
            float(factor): each[model]["mean"]
            for factor, each in over.items()
            if model in each and each[model]["mean"] is not None
        }
        for model in models
    }


def _draw_paths(data: DrivenReport, both: Callable[..., Picture], pictures: dict[str, Picture]) -> None:
    """The paths of the tip, and the markers over time with the pressures."""
    from . import driven_figures

    trials = data.trials
    clamped = data.mesh.vertices[data.fixed]
    tip = tip_markers(trials.bound, clamped)
    order = [model for model in DRIVEN_MODELS if model in trials.markers]
    for place, trial in zip(("worst", "best"), best_and_worst(trials), strict=False):
        name = trials.names[trial]
        times = trials.times[trial]
        near = times <= _PLANE_SECONDS + 1e-9
        start = np.where(np.isfinite(trials.measured[trial, 0]), trials.measured[trial, 0], trials.bound)
        rest = start[tip].mean(axis=0)
        seen = mean_of(trials.measured[trial], tip) - rest
        paths = {model: mean_of(trials.markers[model][trial], tip) - rest for model in order}
        pictures[f"plane_{place}"] = both(
            f"plane_{place}",
            partial(driven_figures.tip_planes, seen[near], {m: path[near] for m, path in paths.items()}),
            f"Path of the tip in the plane of x and y in the trial {name}: measured in grey, the models over it.",
        )
        if place == "best":
            continue
        near = times <= _SPACE_SECONDS + 1e-9
        last = [model for model in ("sysid", "resphys") if model in paths] or order[-1:]
        pictures["space"] = both(
            "space",
            partial(driven_figures.tip_in_space, times[near], seen[near], {m: paths[m][near] for m in last}),
            f"Path of the tip in space in the trial {name}: measured in grey, the models as lines beside it.",
        )
        kept = drawn_markers(trials.measured[trial], trials.bound, clamped)
        compared = [model for model in _COMPARED if model in trials.markers] or order
        pictures["markers"] = both(
            "markers",
            partial(
                driven_figures.markers_and_pressures,
                times,
                trials.measured[trial][:, kept],
                {model: trials.markers[model][trial][:, kept] for model in compared},
                [trials.labels[marker] for marker in kept],
                start[kept],
                data.actuation.pressure[name],
                data.actuation.chambers,
                data.actuation.limit,
            ),
            f"Coordinates of markers over time in the trial {name}, and below them the pressures in the chambers.",
        )


def _sequences(data: DrivenReport) -> dict[str, FloatArray]:
    """A few trials' pressures by the panels' titles: of the test, of the training, and at the highest pressure."""
    pressure = data.actuation.pressure
    test = list(data.trials.names)
    others = [name for name in pressure if name not in test and name not in data.beyond]
    highest = sorted(data.beyond, key=lambda name: float(pressure[name].max()))[-1:]
    many = _SEQUENCES - len(others[:1]) - len(highest)
    picked = [test[at] for at in np.unique(np.linspace(0, len(test) - 1, many).round().astype(int))]
    titles = {name: f"{name}, a trial of the training" for name in others[:1]}
    titles |= {name: f"{name}, a test trial" for name in picked}
    titles |= {name: f"{name}, a test trial at higher pressure" for name in highest}
    return {title: pressure[name] for name, title in titles.items()}


def _draw_body(
    data: DrivenReport,
    folder: Path,
    both: Callable[..., Picture],
    pictures: dict[str, Picture],
    missing: dict[str, str],
) -> None:
    """The body with its chambers and markers, and instants of its motion."""
    from . import measured_figures
    from .mesh import MeshSummary, draw_mesh

    def draw(path: Path) -> Path:
        density = float(data.settings["simulation"]["density"])
        draw_mesh(path, MeshSummary(data.mesh, density, data.fixed, data.chambers), data.trials.bound)
        return path

    drawn = attempt("body", folder / "body.png", draw, missing)
    if drawn is not None:
        address = file_address(drawn, "image/png")
        alt = f"The body at rest from outside, cut open and translucent, with {len(data.chambers)} chambers in colours."
        pictures["body"] = Picture(address, address, alt)
    frames = attempt("motion", folder / "motion.png", partial(_instants, data), missing)
    if frames is not None:
        images, titles = frames
        pictures["motion"] = both(
            "motion",
            partial(measured_figures.motion_instants, images, titles),
            f"The deformed body {', '.join(titles)}, with measured and simulated markers.",
        )


def _motion(data: DrivenReport) -> Motion:
    """The first test trial at the film's frames."""
    trials, steps = data.trials, data.film.steps
    models = _shown(data)
    return Motion(
        data.mesh,
        trials.times[0][steps],
        trials.measured[0][steps],
        {model: data.film.positions[model] for model in models},
        {model: trials.markers[model][0][steps] for model in models},
        trials.bound,
        trials.gravity,
        from_below=True,
    )


def _instants(data: DrivenReport, _: Path) -> tuple[NDArray[np.uint8], list[str]]:
    """Pictures of three instants of the film."""
    from .video import draw_instants

    motion = _motion(data)
    frames = instants(motion.measured, motion.bound, next(iter(motion.markers.values())))
    return draw_instants(motion.at(frames)), [f"{motion.times[frame]:.2f} s" for frame in frames]


def _write_video(data: DrivenReport, path: Path) -> Path:
    from .video import write_video

    names = {model: name for model, (name, _) in DRIVEN_MODELS.items()}
    write_video(path, _motion(data), names, slower=1.0, longest=_LONGEST)
    return path
