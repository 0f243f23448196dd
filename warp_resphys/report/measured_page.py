"""Reports of experiments with measured motions: a page for a split of the trials, and one over the folds."""

import base64
import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from warp_resphys.files import write_text
from warp_resphys.report.measured_data import (
    FoldsReport,
    MeasuredReport,
    RunReport,
    SplitReport,
    Trials,
    at_times,
    best_and_worst,
    mean_distance,
    shown_models,
)
from warp_resphys.report.measured_tables import (
    MODELS,
    against,
    identifications,
    parameter_rows,
    published_beside,
    quality_rows,
    residual_rows,
    uncertainty_text,
    verdict,
)
from warp_resphys.report.page import (
    Picture,
    draw_picture,
    duration_text,
    error_parts,
    figures_beside,
    flatten,
    number_text,
    page_template,
)
from warp_resphys.report.render import DrawingError
from warp_resphys.verdict import best, epochs_kept, judgement, untrained

_LOG = logging.getLogger(__name__)
T = TypeVar("T")
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_DRAWN = ("simulation", "sysid", "simfree", "resphys")  # Marker by marker, where all would hide each other.
_MOST_MARKERS: Final = 6  # That are drawn coordinate by coordinate.


def write_measured_report(path: Path, data: MeasuredReport) -> None:
    """Write the page of a split, with its figures and the video in `figures/` beside it.

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
    models = [model for model in MODELS if model in errors]
    page = page_template("measured.html").render(
        **common_parts(data, pictures, missing),
        verdict=verdict(errors, data.trials.names, data.seconds, without=untrained(epochs_kept(metrics))),
        models=models,
        against=against(errors),
        measured={model: error_parts(each) for model, each in errors.items()},
        published=published_beside(data.published, models),
        shown=shown_models(data.trials.markers),
        best_and_worst=best_and_worst(data.trials),
        hidden=len(data.trials.labels) - _MOST_MARKERS,
        video=None if video is None else file_address(video, "video/mp4"),
        **split_parts(data, pictures),
    )
    write_text(path, page)
    _LOG.info("report written: %s", path)


def write_folds_report(path: Path, data: FoldsReport) -> None:
    """Write the page over the folds.

    Args:
        path: The page's file, such as `report.html`; missing folders are made.
        data: What to show.

    Raises:
        DataFileError: A file could not be written.
    """
    pictures: dict[str, Picture] = {}
    missing: dict[str, str] = {}
    with figures_beside(path) as folder:
        draw_registration_picture(data, folder, pictures, missing)
    errors = data.metrics["errors_mm"]
    models = [model for model in MODELS if model in errors]
    page = page_template("measured_folds.html").render(
        **common_parts(data, pictures, missing),
        verdict=verdict(
            errors, tuple(data.pages), data.seconds, folds=True, without=untrained(epochs_kept(data.metrics))
        ),
        models=models,
        against=against(errors),
        measured={model: error_parts(each) for model, each in errors.items()},
        published=published_beside(data.published, models),
        folds={trial: fold["errors_mm"] for trial, fold in data.metrics["folds"].items()},
    )
    write_text(path, page)
    _LOG.info("report written: %s", path)


def common_parts(data: RunReport, pictures: Mapping[str, Picture], missing: Mapping[str, str]) -> dict[str, Any]:
    """Return what every page on recordings asks for."""
    idle = untrained(epochs_kept(data.metrics))
    no_force = {model: (MODELS[model][0], "no force: none of its training was kept") for model in idle}
    return {
        "judged": judgement(data.metrics, data.settings),
        "answer": best(data.metrics["errors_mm"], idle),
        "title": data.title,
        "data": data,
        "metrics": data.metrics,
        "pictures": pictures,
        "missing": missing,
        "names": {**MODELS, **no_force},
        "residuals": residual_rows(data.recordings.residuals),
        "quality": quality_rows(data.recordings.quality),
        "warnings": [(trial, said) for trial, each in data.recordings.quality.items() for said in each["warnings"]],
        "number": number_text,
        "duration": duration_text,
        "settings": list(flatten(data.settings)),
    }


def split_parts(data: SplitReport, pictures: Mapping[str, Picture]) -> dict[str, Any]:
    """Return what the sections on identification and training ask for."""
    identified = {name: data.identification[name] for name in identifications(data.identification)}
    return {
        "identified": {name: parameter_rows(found, data.start, data.truth) for name, found in identified.items()},
        "uncertainty": [said for name, found in identified.items() if (said := uncertainty_text(name, found))],
        "histories": [model for model in MODELS if f"training_{model}" in pictures],
        "truth": data.truth,
    }


def _draw(data: MeasuredReport, folder: Path) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw the figures; say of those that cannot be drawn why."""
    from warp_resphys.report import measured_figures

    pictures: dict[str, Picture] = {}
    missing: dict[str, str] = {}
    both = partial(draw_picture, folder)
    trials = data.trials
    times = np.nanmean(trials.times, axis=0)
    pictures["error_over_time"] = both(
        "error_over_time",
        partial(measured_figures.errors_over_time, times, trials.errors_mm()),
        "Mean marker error of the models over time, on a logarithmic axis.",
    )
    for place, trial in zip(("worst", "best"), best_and_worst(trials), strict=False):
        pictures[f"paths_{place}"] = both(f"paths_{place}", _paths(trials, trial), _describe_paths(trials, trial))
    draw_training(data, both, pictures)
    draw_identification(data, both, pictures)
    draw_registration_picture(data, folder, pictures, missing)
    frames = attempt("motion", folder / "motion.png", partial(_instants, data), missing)
    if frames is not None:
        images, titles = frames
        pictures["motion"] = both(
            "motion",
            partial(measured_figures.motion_instants, images, titles),
            f"The deformed body {', '.join(titles)}, with measured and simulated markers.",
        )
    return pictures, missing


def attempt(name: str, path: Path, draw: Callable[[Path], T], missing: dict[str, str]) -> T | None:
    """Return what a drawing gives, or None with the reason under its name; an earlier report's file is then removed."""
    try:
        return draw(path)
    except DrawingError as error:
        missing[name] = f"{error}, then delete this page and run the same command again."
        _LOG.warning("the report lacks a picture: %s", error)
        path.unlink(missing_ok=True)
        return None


def _paths(trials: Trials, trial: int) -> Callable[..., Any]:
    """The figure of one trial, marker by marker."""
    from warp_resphys.report import measured_figures

    reach = np.nanmax(np.linalg.norm(trials.measured[trial] - trials.bound, axis=2), axis=0, initial=0.0)
    kept = np.sort(np.argsort(-reach)[:_MOST_MARKERS])
    models = {m: trials.markers[m][trial][:, kept] for m in _DRAWN if m in trials.markers}
    return partial(
        measured_figures.marker_paths,
        trials.times[trial],
        trials.measured[trial][:, kept],
        models,
        [trials.labels[marker] for marker in kept],
        trials.bound[kept],
    )


def _describe_paths(trials: Trials, trial: int) -> str:
    name = trials.names[trial]
    return f"Coordinates of the markers over time in the trial {name}: measured as dots, the models as lines."


def draw_training(data: SplitReport, both: Callable[..., Picture], pictures: dict[str, Picture]) -> None:
    """Draw how the training of each learned model went."""
    from warp_resphys.report import figures

    for model, records in data.training.items():
        alt = f"Losses and validation roll-out error of {MODELS[model][0]}, {len(records)} epochs, on logarithmic axes."
        pictures[f"training_{model}"] = both(f"training_{model}", partial(figures.training_curves, records), alt)


def draw_identification(data: SplitReport, both: Callable[..., Picture], pictures: dict[str, Picture]) -> None:
    """Draw the losses of an identification over its evaluations, and over a grid, where they are known."""
    from warp_resphys.report import measured_figures

    found = data.identification
    histories = {name: found[name]["history"] for name in identifications(found) if any(found[name]["history"])}
    if histories:
        pictures["loss_history"] = both(
            "loss_history",
            partial(measured_figures.loss_histories, histories),
            "Loss of the identification over its evaluations, a line a start, on a logarithmic axis.",
        )
    grid = found.get("landscape")
    if not grid:
        return
    loss = np.array(grid["loss"], dtype=np.float64)
    modulus = np.array(grid["youngs_modulus"], dtype=np.float64)
    ratio = np.atleast_1d(np.array(grid.get("poissons_ratio", []), dtype=np.float64))
    points: dict[str, tuple[float, float]] = {}
    if np.isfinite(loss).any():
        row, *column = np.unravel_index(int(np.nanargmin(loss)), loss.shape)
        points["lowest of the grid"] = (float(modulus[row]), float(ratio[column[0]]) if column else 0.0)
    keys = ("youngs_modulus", "poissons_ratio")
    if all(key in data.start for key in keys):
        points["data sheet"] = (data.start[keys[0]], data.start[keys[1]])
    identified = found.get("sysid", {}).get("parameters", {})
    if keys[0] in identified:
        points["identified"] = (identified[keys[0]], identified.get(keys[1], data.start.get(keys[1], 0.0)))
    if all(key in data.truth for key in keys):
        points["true"] = (data.truth[keys[0]], data.truth[keys[1]])
    marked = "; ".join(f"{name} at {1e-3 * e:.4g} kPa" for name, (e, _) in points.items())
    pictures["landscape"] = both(
        "landscape",
        partial(measured_figures.landscape, modulus, ratio, loss, points),
        f"Loss over Young's modulus{' and Poisson’s ratio' if loss.ndim > 1 else ''}: {marked}.",  # noqa: RUF001
    )


def draw_registration_picture(
    data: RunReport, folder: Path, pictures: dict[str, Picture], missing: dict[str, str]
) -> None:
    """Draw the body at rest with the registered markers."""
    from warp_resphys.report.registration_picture import draw_registration

    recordings = data.recordings

    def draw(path: Path) -> Path:
        draw_registration(
            path,
            recordings.mesh,
            recordings.registration,
            recordings.nominal,
            recordings.feet,
            data.fixed,
            recordings.drawn,
        )
        return path

    path = attempt("registration", folder / "registration.png", draw, missing)
    if path is not None:
        address = file_address(path, "image/png")
        alt = f"The body at rest with the registered markers of the trial {recordings.drawn}, from two sides."
        pictures["registration"] = Picture(address, address, alt)


def _motion(data: MeasuredReport) -> Any:
    """The worst test trial, the simulated bodies brought to the times of the frames."""
    from warp_resphys.report.video import Motion

    trials = data.trials
    worst = best_and_worst(trials)[0]
    kept = np.append(True, np.diff(trials.times[worst]) > 0.0)
    times = trials.times[worst][kept]
    models = shown_models(trials.markers)
    positions = {m: at_times(trials.positions[m][worst], trials.time_step, times) for m in models}
    markers = {m: trials.markers[m][worst][kept] for m in models}
    return Motion(data.mesh, times, trials.measured[worst][kept], positions, markers, trials.bound, trials.gravity)


def _instants(data: MeasuredReport, _: Path) -> tuple[NDArray[np.uint8], list[str]]:
    """Pictures of three instants: see `instants`."""
    from warp_resphys.report.video import draw_instants

    motion = _motion(data)
    frames = instants(motion.measured, motion.bound, next(iter(motion.markers.values())))
    return draw_instants(motion.at(frames)), [f"{motion.times[frame]:.2f} s" for frame in frames]


def instants(measured: FloatArray, bound: FloatArray, simulated: FloatArray) -> list[int]:
    """Return three frames that lie apart, or fewer of a short motion.

    They are where the simulation is farthest off, where the markers have moved most, and the last one; where two of
    these are close to each other, one from between is taken.

    Args:
        measured: (T, M, 3) [m], NaN where a marker was not seen.
        bound: (M, 3) [m] at rest.
        simulated: (T, M, 3) [m].
    """
    count = len(measured)
    moved = np.nan_to_num(np.linalg.norm(measured - bound, axis=2)).mean(axis=1)
    off = mean_distance(simulated[None], measured[None])[0]
    worst = int(np.argmax(np.where(np.isfinite(off), off, -1.0)))
    chosen: list[int] = []
    for frame in (worst, int(np.argmax(moved)), count - 1, count // 2, count // 4):
        if len(chosen) < 3 and all(abs(frame - other) > count // 10 for other in chosen):
            chosen.append(frame)
    return sorted(chosen)


def _write_video(data: MeasuredReport, path: Path) -> Path:
    from warp_resphys.report.video import write_video

    write_video(path, _motion(data), {model: MODELS[model][0] for model in MODELS})
    return path


def file_address(path: Path, kind: str) -> str:
    """Return a file as a data address."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
