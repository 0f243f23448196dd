"""Reports of experiments with measured motions: a page for a split of the trials, and one over the folds."""

import base64
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from warp_resphys.files import write_text
from warp_resphys.mesh import Mesh
from warp_resphys.metrics import PublishedError
from warp_resphys.registration import Registration
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

_LOG = logging.getLogger(__name__)
T = TypeVar("T")
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_DRAWN = ("simulation", "sysid", "simfree", "resphys")  # Marker by marker, where all would hide each other.
_MOST_MARKERS: Final = 6  # That are drawn coordinate by coordinate.


@dataclass(frozen=True, eq=False)
class Recordings:
    """How the recordings are, and how they were registered.

    Attributes:
        quality: By trial, as `warp_resphys.recordings.quality.Quality.to_plain` gives it.
        residuals: By trial: `rms_mm`, `residual_mm` and `shift_mm` by label, `outliers`.
        registration: Of the trial that fits worst, for the picture.
        drawn: That trial's name.
        nominal: (M, 3) [m] where its markers should be.
        feet: (M, 3) [m] the closest points of the body.
    """

    quality: Mapping[str, Any]
    residuals: Mapping[str, Any]
    registration: Registration
    drawn: str
    nominal: FloatArray
    feet: FloatArray


@dataclass(frozen=True, eq=False)
class TestTrials:
    """What was measured in the R test trials, and what the models made of them.

    Attributes:
        names: Of the trials.
        labels: Of the M markers.
        times: (R, T) of the frames since the release [s]; those that count.
        measured: (R, T, M, 3) [m], NaN where a marker was not seen.
        bound: (M, 3) [m] the markers on the body at rest.
        gravity: (3,) [m/s^2].
        markers: (R, T, M, 3) [m] by model.
        positions: (R, K + 1, N, 3) [m] by model, at multiples of the time step.
        time_step: [s].
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    times: FloatArray
    measured: FloatArray
    bound: FloatArray
    gravity: FloatArray
    markers: Mapping[str, FloatArray]
    positions: Mapping[str, FloatArray]
    time_step: float

    def errors_mm(self) -> dict[str, FloatArray]:
        """(R, T) mean distance [mm] of the markers that were seen, by model; NaN where there is none."""
        return {model: _mean_distance(markers, self.measured) for model, markers in self.markers.items()}


@dataclass(frozen=True, eq=False)
class MeasuredReport:
    """Everything that the page of a split shows.

    Attributes:
        experiment: Its name.
        title: The page's heading.
        metrics: `errors_mm`, `per_trajectory`, `per_marker`, `seconds`, `peak_memory_gib`, `versions` and `device`.
        settings: The run's configuration, nested.
        published: Published errors, empty where there are none.
        published_note: Why they are not measured on the same data.
        mesh: The body at rest.
        fixed: Vertices of the clamped region.
        trials: The test trials.
        recordings: Quality and registration of all trials.
        identification: What identification.json holds.
        start: The values of the data sheet, by parameter.
        truth: The true ones, where they are known.
        training: Records of the epochs, by learned model.
        seconds: How much of each trial counts; None for all of it.
    """

    experiment: str
    title: str
    metrics: Mapping[str, Any]
    settings: Mapping[str, Any]
    published: Mapping[str, PublishedError]
    published_note: str
    mesh: Mesh
    fixed: IntArray
    trials: TestTrials
    recordings: Recordings
    identification: Mapping[str, Any]
    start: Mapping[str, float]
    truth: Mapping[str, float]
    training: Mapping[str, Sequence[Mapping[str, Any]]]
    seconds: float | None


@dataclass(frozen=True, eq=False)
class FoldsReport:
    """Everything that the page over the folds shows.

    Attributes:
        experiment: Its name.
        title: The page's heading.
        metrics: `folds` (a fold's metrics by its test trial) and `errors_mm` over all of them.
        pages: Address of each fold's page, by its test trial.
        settings: The run's configuration, nested.
        published: Published errors, empty where there are none.
        published_note: Why they are not measured on the same data.
        mesh: The body at rest.
        fixed: Vertices of the clamped region.
        recordings: Quality and registration of all trials.
        seconds: How much of each trial counts; None for all of it.
    """

    experiment: str
    title: str
    metrics: Mapping[str, Any]
    pages: Mapping[str, str]
    settings: Mapping[str, Any]
    published: Mapping[str, PublishedError]
    published_note: str
    mesh: Mesh
    fixed: IntArray
    recordings: Recordings
    seconds: float | None


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
        video = _attempt("video", folder / "motion.mp4", partial(_write_video, data), missing)
    models = [model for model in MODELS if model in errors]
    identified = {name: data.identification[name] for name in identifications(data.identification)}
    page = page_template("measured.html").render(
        **_common(data, pictures, missing),
        verdict=verdict(errors, data.trials.names, data.seconds),
        models=models,
        against=against(errors),
        measured={model: error_parts(each) for model, each in errors.items()},
        published=published_beside(data.published, models),
        identified={name: parameter_rows(found, data.start, data.truth) for name, found in identified.items()},
        uncertainty=[said for name, found in identified.items() if (said := uncertainty_text(name, found))],
        shown=shown_models(data.trials.markers),
        histories=[model for model in MODELS if f"training_{model}" in pictures],
        best_and_worst=best_and_worst(data.trials),
        hidden=len(data.trials.labels) - _MOST_MARKERS,
        video=None if video is None else _address(video, "video/mp4"),
        truth=data.truth,
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
        _draw_registration(data, folder, pictures, missing)
    errors = data.metrics["errors_mm"]
    models = [model for model in MODELS if model in errors]
    page = page_template("measured_folds.html").render(
        **_common(data, pictures, missing),
        verdict=verdict(errors, tuple(data.pages), data.seconds, folds=True),
        models=models,
        against=against(errors),
        measured={model: error_parts(each) for model, each in errors.items()},
        published=published_beside(data.published, models),
        folds={trial: fold["errors_mm"] for trial, fold in data.metrics["folds"].items()},
    )
    write_text(path, page)
    _LOG.info("report written: %s", path)


def _common(
    data: MeasuredReport | FoldsReport, pictures: Mapping[str, Picture], missing: Mapping[str, str]
) -> dict[str, Any]:
    """What both pages ask for."""
    return {
        "title": data.title,
        "data": data,
        "metrics": data.metrics,
        "pictures": pictures,
        "missing": missing,
        "names": MODELS,
        "residuals": residual_rows(data.recordings.residuals),
        "quality": quality_rows(data.recordings.quality),
        "warnings": [(trial, said) for trial, each in data.recordings.quality.items() for said in each["warnings"]],
        "number": number_text,
        "duration": duration_text,
        "settings": list(flatten(data.settings)),
    }


def _mean_distance(markers: FloatArray, measured: FloatArray) -> FloatArray:
    """(R, T) mean distance [mm] of the markers that were seen; NaN where none was, infinite where one diverged."""
    with np.errstate(invalid="ignore", over="ignore"):
        distance = 1e3 * np.linalg.norm(markers - measured, axis=3)
        seen = np.isfinite(measured).all(axis=3)
        distance = np.where(seen, np.where(np.isfinite(distance), distance, np.inf), 0.0)
        count = seen.sum(axis=2)
        mean: FloatArray = np.where(count > 0, distance.sum(axis=2) / np.maximum(count, 1), np.nan)
    return mean


def best_and_worst(trials: TestTrials) -> list[int]:
    """The trials in which the best model of all is farthest off, and closest; one where there is one only."""
    errors = trials.errors_mm()
    model = next(m for m in reversed(MODELS) if m in errors)
    each = np.array([row[~np.isnan(row)].mean() if (~np.isnan(row)).any() else np.inf for row in errors[model]])
    worst, best = int(np.argmax(each)), int(np.argmin(each))
    return [worst] if worst == best else [worst, best]


def _draw(data: MeasuredReport, folder: Path) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw the figures; say of those that cannot be drawn why."""
    from warp_resphys.report import figures, measured_figures

    pictures: dict[str, Picture] = {}
    missing: dict[str, str] = {}
    both = partial(draw_picture, folder)
    trials = data.trials
    times = np.nanmean(trials.times, axis=0)
    finite = {m: np.where(np.isfinite(rows), rows, np.nan) for m, rows in trials.errors_mm().items()}
    pictures["error_over_time"] = both(
        "error_over_time",
        partial(measured_figures.errors_over_time, times, finite),
        "Mean marker error of the models over time, on a logarithmic axis.",
    )
    for place, trial in zip(("worst", "best"), best_and_worst(trials), strict=False):
        pictures[f"paths_{place}"] = both(f"paths_{place}", _paths(trials, trial), _describe_paths(trials, trial))
    for model, records in data.training.items():
        alt = f"Losses and validation roll-out error of {MODELS[model][0]}, {len(records)} epochs, on logarithmic axes."
        pictures[f"training_{model}"] = both(f"training_{model}", partial(figures.training_curves, records), alt)
    _draw_identification(data, both, pictures)
    _draw_registration(data, folder, pictures, missing)
    frames = _attempt("motion", folder / "motion.png", partial(_instants, data), missing)
    if frames is not None:
        images, titles = frames
        pictures["motion"] = both(
            "motion",
            partial(measured_figures.motion_instants, images, titles),
            f"The deformed body {', '.join(titles)}, with measured and simulated markers.",
        )
    return pictures, missing


def _attempt(name: str, path: Path, draw: Callable[[Path], T], missing: dict[str, str]) -> T | None:
    """What a drawing gives, or None with the reason under its name; an earlier report's file is then removed."""
    try:
        return draw(path)
    except DrawingError as error:
        missing[name] = f"{error}, then delete this page and run the same command again."
        _LOG.warning("the report lacks a picture: %s", error)
        path.unlink(missing_ok=True)
        return None


def _paths(trials: TestTrials, trial: int) -> Callable[..., Any]:
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


def _describe_paths(trials: TestTrials, trial: int) -> str:
    return f"Coordinates of the markers over time in the trial {trials.names[trial]}: measured as dots, the models as lines."


def _draw_identification(data: MeasuredReport, both: Callable[..., Picture], pictures: dict[str, Picture]) -> None:
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
    elastic = found.get("sysid_elastic", {}).get("parameters", {})
    if keys[0] in elastic:
        points["identified"] = (elastic[keys[0]], elastic.get(keys[1], data.start.get(keys[1], 0.0)))
    marked = "; ".join(f"{name} at {1e-3 * e:.4g} kPa" for name, (e, _) in points.items())
    pictures["landscape"] = both(
        "landscape",
        partial(measured_figures.landscape, modulus, ratio, loss, points),
        f"Loss over Young's modulus{' and Poisson’s ratio' if loss.ndim > 1 else ''}: {marked}.",  # noqa: RUF001
    )


def _draw_registration(
    data: MeasuredReport | FoldsReport, folder: Path, pictures: dict[str, Picture], missing: dict[str, str]
) -> None:
    from warp_resphys.report.registration_picture import draw_registration

    recordings = data.recordings

    def draw(path: Path) -> Path:
        draw_registration(
            path, data.mesh, recordings.registration, recordings.nominal, recordings.feet, data.fixed, recordings.drawn
        )
        return path

    path = _attempt("registration", folder / "registration.png", draw, missing)
    if path is not None:
        address = _address(path, "image/png")
        alt = f"The body at rest with the registered markers of the trial {recordings.drawn}, from two sides."
        pictures["registration"] = Picture(address, address, alt)


def shown_models(markers: Mapping[str, FloatArray]) -> list[str]:
    """The models that are drawn as bodies: the uncorrected one, and last the best that there is."""
    plain = next((m for m in ("simulation", "published") if m in markers), None)
    solid = next((m for m in ("resphys", "resphys_uncorrected", "sysid", "sysid_elastic") if m in markers), None)
    return [m for m in (plain, solid) if m is not None]


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


def at_times(positions: FloatArray, time_step: float, times: FloatArray) -> FloatArray:
    """(T, N, 3) positions at some times, from those (K + 1, N, 3) at multiples of the time step; linear between."""
    at = np.clip(times / time_step, 0.0, len(positions) - 1.0)
    low = np.minimum(at.astype(int), max(len(positions) - 2, 0))
    share = (at - low)[:, None, None]
    with np.errstate(invalid="ignore", over="ignore"):
        between: FloatArray = (1.0 - share) * positions[low] + share * positions[
            np.minimum(low + 1, len(positions) - 1)
        ]
    return between


def _instants(data: MeasuredReport, _: Path) -> tuple[NDArray[np.uint8], list[str]]:
    """Pictures at the largest deflection, where the uncorrected model is farthest off, and at the end."""
    from warp_resphys.report.video import draw_instants

    motion = _motion(data)
    distance = np.linalg.norm(motion.measured - motion.bound, axis=2)
    moved = np.where(np.isfinite(distance), distance, 0.0).mean(axis=1)
    off = _mean_distance(next(iter(motion.markers.values()))[None], motion.measured[None])[0]
    worst = int(np.argmax(np.where(np.isfinite(off), off, -1.0)))
    frames = sorted({int(np.argmax(moved)), worst, len(motion.times) - 1})
    return draw_instants(motion.at(frames)), [f"{motion.times[frame]:.2f} s" for frame in frames]


def _write_video(data: MeasuredReport, path: Path) -> Path:
    from warp_resphys.report.video import write_video

    write_video(path, _motion(data), {model: MODELS[model][0] for model in MODELS})
    return path


def _address(path: Path, kind: str) -> str:
    """A file as a data address."""
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
