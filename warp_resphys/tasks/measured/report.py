"""Stages: the report of a split of measured trials, and the one over the folds."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...configured import build_mesh, choose_device
from ...errors import DataFileError
from ...files import read_array, read_hdf5, read_json
from ...mesh import Mesh, select_vertices
from ...metrics import published_errors
from ...registration import Registration, RigidTransform
from ...replay import PARAMETERS
from ...report.measured_data import FoldsReport, MeasuredReport, Recordings, Trials
from ...report.measured_page import write_folds_report, write_measured_report
from ...report.measured_tables import MODELS
from ...stages import StageContext, package_versions, resources_used
from ...surface import closest_points
from .files import (
    ERRORS,
    IDENTIFICATION,
    MARKERS,
    METRICS,
    QUALITY,
    REGISTRATION,
    REPORT,
    ROLLOUTS,
    TRAINED,
    TRUTH,
    fold_folder,
    learned,
    training_file,
)
from .identify import first_guess
from .trials import is_synthetic

FloatArray = NDArray[np.float64]

PUBLISHED_NOTE = (
    "The published errors are those of other data: recordings with ten markers on the beam's sides, whose weight is "
    "cut off at the release, compared with trajectories reconstructed from them; the published uncorrected simulation "
    "has the published setting, the published SysID elastic parameters only."
)


def report_measured(context: StageContext) -> None:
    """Writes report.html of a split of the trials, its figures and the video.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or one could not be written.
    """
    folder, config = context.run_dir, context.settings["config"]
    mesh = build_mesh(config["mesh"])
    metrics, truth = read_metrics(folder, config), read_if_there(_common(folder) / TRUTH)
    data = MeasuredReport(
        experiment=config["name"],
        title=config["title"],
        metrics=metrics,
        settings=config,
        published=published_errors(config["name"]),
        published_note=PUBLISHED_NOTE,
        notes=error_notes(metrics.get("sideways_mm", {}), truth),
        mesh=mesh,
        fixed=select_vertices(mesh, **config["fixed"]),
        trials=read_trials(folder, config),
        recordings=read_recordings(_common(folder), config, mesh),
        identification=read_if_there(folder / IDENTIFICATION),
        start=first_guess(config, PARAMETERS),
        truth=truth.get("material", {}),
        training={m: read_json(path)["epochs"] for m in TRAINED if (path := folder / training_file(m)).is_file()},
        seconds=config["data"]["seconds"],
        synthetic=is_synthetic(config),
    )
    write_measured_report(folder / REPORT, data)


def report_folds(context: StageContext) -> None:
    """Writes report.html over the folds, from metrics.json and what is common to them.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or one could not be written.
    """
    folder, config = context.run_dir, context.settings["config"]
    mesh = build_mesh(config["mesh"])
    metrics: dict[str, Any] = {"versions": package_versions(), "device": str(choose_device(config["device"]))}
    metrics |= read_json(folder / METRICS)
    sideways = {k: v for fold in metrics["folds"].values() for k, v in fold.get("sideways_mm", {}).items()}
    data = FoldsReport(
        experiment=config["name"],
        title=config["title"],
        metrics=metrics,
        pages={trial: f"{fold_folder(trial)}/{REPORT}" for trial in metrics["folds"]},
        settings=config,
        published=published_errors(config["name"]),
        published_note=PUBLISHED_NOTE,
        notes=error_notes(sideways, {}),
        mesh=mesh,
        fixed=select_vertices(mesh, **config["fixed"]),
        recordings=read_recordings(folder, config, mesh),
        seconds=config["data"]["seconds"],
        synthetic=is_synthetic(config),
    )
    write_folds_report(folder / REPORT, data)


def _common(folder: Path) -> Path:
    """Where the files lie that do not depend on the fold: here, or beside the folders of the folds."""
    return folder if (folder / MARKERS).is_file() else folder.parent


def read_if_there(path: Path) -> dict[str, Any]:
    """What a JSON file holds; nothing where there is none."""
    content: dict[str, Any] = read_json(path) if path.is_file() else {}
    return content


def read_metrics(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """Errors, time and memory of the stages that are done, in the order of their end, versions and device."""
    records = sorted((folder / "stages").glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    return {
        **read_json(folder / ERRORS),
        **learned(folder),
        **resources_used(folder, [path.stem for path in records]),
        "versions": package_versions(),
        "device": str(choose_device(config["device"])),
    }


def error_notes(sideways: Mapping[str, float], truth: Mapping[str, Any]) -> list[str]:
    """How the bodies of the test trials were held, and what of the errors is noise, as far as these are known."""
    notes = []
    if sideways:
        each = ", ".join(f"{distance:.1f} mm ({trial})" for trial, distance in sideways.items())
        notes.append(
            "The first frames of a trial tell how far sideways its body was held: the markers by "
            f"{each}, as the identified simulator has it. Every simulator begins with its own estimate."
        )
    if "noise_mm" in truth:
        notes.append(f"The noise of the markers alone is {truth['noise_mm']:.2f} mm.")
    return notes


def read_trials(folder: Path, config: Mapping[str, Any]) -> Trials:
    """What was measured in the test trials and what the models made of them, as long as it counts."""
    path = _common(folder) / MARKERS
    with read_hdf5(path, "markers") as file:
        names, labels = ([str(each) for each in file.attrs[key]] for key in ("names", "labels"))
        gravity = np.asarray(file.attrs["gravity"], dtype=np.float64)
        times, markers, bound = (read_array(file, key) for key in ("times", "markers", "bound"))
    with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
        test = [str(each) for each in file.attrs["names"]]
        models = [model for model in MODELS if f"{model}_markers" in file]
        simulated = {model: read_array(file, f"{model}_markers") for model in models}
        positions = {model: read_array(file, f"{model}_q") for model in models if f"{model}_q" in file}
    unknown = sorted(set(test) - set(names))
    if unknown or not models:
        what = f"names trials that {path} does not hold ({', '.join(unknown)})" if unknown else "holds no model"
        raise DataFileError(f"{folder / 'rollouts.h5'} {what}: delete it and run the same command again.")
    rows = [names.index(name) for name in test]
    seconds = config["data"]["seconds"]
    length = min(markers.shape[1], *(each.shape[1] for each in simulated.values()))
    times, measured = times[rows, :length], markers[rows, :length]
    if seconds is not None:
        measured = np.where((times <= seconds)[..., None, None], measured, np.nan)
        length = max(1, int((times <= seconds).any(axis=0).sum()))
    return Trials(
        names=tuple(test),
        labels=tuple(labels),
        times=times[:, :length],
        measured=measured[:, :length],
        bound=bound,
        gravity=gravity,
        markers={model: each[:, :length] for model, each in simulated.items()},
        positions=positions,
        time_step=config["time_step"],
    )


def read_recordings(
    folder: Path, config: Mapping[str, Any], mesh: Mesh, moved: Mapping[str, FloatArray] = MappingProxyType({})
) -> Recordings:
    """Quality and registration of all trials; the picture is of the one that fits worst.

    Args:
        folder: of the run.
        config: with the group ``markers``.
        mesh: the body as it is at rest.
        moved: (3,) how far nominal places, which are on the undeformed body, move until it is at rest, by label [m].

    Raises:
        DataFileError: a file is missing or damaged.
    """
    residuals = read_json(folder / REGISTRATION)
    worst = max(residuals, key=lambda trial: residuals[trial]["rms_mm"])
    each = residuals[worst]
    if "positions" not in each:
        raise DataFileError(f"{folder / REGISTRATION} has no positions: delete it and run the same command again.")
    nominal: dict[str, Any] = {**config["markers"]["followed"], **(config["markers"]["others"] or {})}
    labels = [label for label in each["positions"] if label in nominal]
    places = np.array([_numbers(each["positions"][label]) for label in labels])
    residual = np.array([np.nan if (r := each["residual_mm"].get(label)) is None else 1e-3 * r for label in labels])
    registration = Registration(
        names=tuple(labels),
        transform=RigidTransform(np.eye(3), np.zeros(3)),
        positions=places,
        residual=residual,
        inliers=np.array([label not in each["outliers"] for label in labels]),
        outliers=tuple(each["outliers"]),
        rms=1e-3 * each["rms_mm"],
    )
    seen = np.isfinite(places).all(axis=1)
    feet = np.full_like(places, np.nan)
    feet[seen] = closest_points(mesh, places[seen]).points
    return Recordings(
        quality=read_json(folder / QUALITY),
        residuals=residuals,
        registration=registration,
        drawn=worst,
        nominal=np.array([np.add(nominal[label], moved.get(label, 0.0)) for label in labels], dtype=np.float64),
        feet=feet,
        mesh=mesh,
    )


def _numbers(point: Any) -> list[float]:
    """Three coordinates; what JSON has as null was not seen."""
    return [float("nan") if each is None else float(each) for each in point or (None,) * 3]
