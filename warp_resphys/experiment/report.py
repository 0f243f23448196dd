"""Stage: the report page of a split, and the one over the folds; they show what the run folder holds.

What reads a file raises a DataFileError where that is missing or damaged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..io.errors import DataFileError
from ..io.files import read_array, read_hdf5, read_json
from ..io.stages import StageContext, package_versions, resources_used
from ..learning.parameters import configured_parameters
from ..mesh.chambers import Chamber
from ..mesh.mesh import Mesh, select_vertices
from ..mesh.surface import closest_points
from ..report.data import MODELS, Driven, Film, FollowedPath, Recordings, RunReport, TrialResults
from ..report.notes import error_notes, kept_note, material_note, network_note, published_note
from ..report.run_page import write_report
from .actuators import build_chambers, build_muscles, build_tendons, driving_quantity
from .build import bound_markers, build_mesh, choose_device, sight_of
from .files import (
    CONTROL,
    DATASET,
    DRIVEN,
    ERRORS,
    IDENTIFICATION,
    MESH_CHECK,
    METRICS,
    QUALITY,
    RECONSTRUCTION,
    REGISTRATION,
    REPORT,
    ROLLOUTS,
    SCALED_DATASET,
    STATIC,
    TIMES,
    TRUTH,
    Dataset,
    fold_folder,
    read_dataset,
    read_if_there,
    training_file,
)
from .scene import LEARNED
from .trials import sees_markers

FloatArray = NDArray[np.float64]


def make_report(context: StageContext) -> None:
    """Writes report.html of a split of the trials, with its figures and, where there is one, the video.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or one could not be written.
    """
    folder, config = context.run_dir, context.settings["config"]
    metrics, truth = collect_metrics(folder, config), read_if_there(common_folder(folder) / TRUTH)
    trials, identification = read_trials(folder, config), read_if_there(folder / IDENTIFICATION)
    mesh = build_mesh(config["mesh"])
    film, driven = read_film(folder, config, mesh), read_driven(folder, config)
    channels = () if driven is None else driven.channels
    tip = {} if trials.labels else config.get("tip") or {}
    learned = "resphys" in metrics["errors_mm"] and not config.get("in_the_loop")
    network = (config["network"], config["trainer"], config.get("refinement") or {}) if learned else None
    data = RunReport(
        **_common_parts(config, metrics, mesh),
        tip=select_vertices(mesh, **tip) if tip else np.empty(0, dtype=np.int64),
        chambers=_driven_chambers(build_chambers(config.get("chambers"), mesh), channels),
        tendons=_routes(config, mesh),
        trials=trials,
        film=film,
        driven=driven,
        recordings=read_recordings(folder, config, *_at_rest(mesh, trials, film)),
        notes=error_notes(metrics.get("sideways_mm", {}), truth, metrics.get("mesh_check", {})),
        identification=identification,
        start=data_sheet(config, identification),
        truth=truth.get("material", {}),
        training=_histories(folder, False),
        refinement=_histories(folder, True),
        network_note="" if network is None else network_note(*network),
        kept_note=kept_note(metrics["networks"]),
        followed=read_followed(folder, config),
        simulator=material_note(config["simulation"]),
        target=material_note(config["target"]) if config.get("target") else "",
    )
    write_report(folder / REPORT, data)


def make_folds_report(context: StageContext) -> None:
    """Writes report.html over the folds, from metrics.json and what is common to them.

    Raises:
        DataFileError: a file of an earlier stage is missing or damaged, or one could not be written.
    """
    folder, config = context.run_dir, context.settings["config"]
    metrics = {"device": str(choose_device(config["device"])), **read_json(folder / METRICS)}
    sideways = {trial: mm for fold in metrics["folds"].values() for trial, mm in fold.get("sideways_mm", {}).items()}
    mesh = build_mesh(config["mesh"])
    data = RunReport(
        **_common_parts(config, metrics, mesh),
        pages={trial: f"{fold_folder(trial)}/{REPORT}" for trial in metrics["folds"]},
        recordings=read_recordings(folder, config, mesh, {}),
        notes=error_notes(sideways, {}, {}),
    )
    write_report(folder / REPORT, data)


def _common_parts(config: Mapping[str, Any], metrics: Mapping[str, Any], mesh: Mesh) -> dict[str, Any]:
    """The parts of the report that all pages have."""
    return {
        "metrics": metrics,
        "settings": config,
        "mesh": mesh,
        "fixed": select_vertices(mesh, **config["fixed"]),
        "published_note": published_note(config),
    }


def common_folder(folder: Path) -> Path:
    """Folder of the files that do not depend on the fold: this one, or the one that has the folds' folders."""
    return folder if (folder / DATASET).is_file() else folder.parent


def _histories(folder: Path, refined: bool) -> dict[str, Any]:
    """The epochs of the trainings, or of the refinements, by model."""
    files = {model: folder / training_file(model, refined) for model in LEARNED}
    return {model: read_json(path)["epochs"] for model, path in files.items() if path.is_file()}


def collect_metrics(folder: Path, config: Mapping[str, Any], stages: Sequence[str] | None = None) -> dict[str, Any]:
    """Content of metrics.json of a split.

    Errors, the noise in them where known, which weights were kept, what was identified and reconstructed, time and
    memory of the stages (those that are done in the order of their end, if left out), versions and device.
    """
    if stages is None:
        records = sorted((folder / "stages").glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
        stages = [path.stem for path in records if not path.stem.endswith(".progress")]
    files = {
        f"{model}_refined" if refined else model: folder / training_file(model, refined)
        for model in LEARNED
        for refined in (False, True)
    }
    identified, truth = (read_if_there(each) for each in (folder / IDENTIFICATION, common_folder(folder) / TRUTH))
    more = {
        "reconstruction": read_if_there(folder / RECONSTRUCTION),
        "control": read_if_there(folder / CONTROL) if config["control"] is not None else {},
        "mesh_check": {} if config["mesh_check"] is None else read_if_there(folder / MESH_CHECK),
        "seconds_per_test_trajectory": read_if_there(folder / TIMES).get("seconds", {}) if config["timing"] else {},
        **({"noise_mm": truth["noise_mm"]} if "noise_mm" in truth else {}),
    }
    return {
        **read_json(folder / ERRORS),
        "networks": {name: read_json(path)["kept"] for name, path in files.items() if path.is_file()},
        "parameters": {name: each["parameters"] for name, each in identified.items() if "parameters" in each},
        **{key: value for key, value in more.items() if value},
        **resources_used(folder, stages),
        "versions": package_versions(),
        "device": str(choose_device(config["device"])),
    }


def data_sheet(config: Mapping[str, Any], identification: Mapping[str, Any]) -> dict[str, float]:
    """Values on the data sheet of the identified parameters and of those of the landscape."""
    names = {name for identified in identification.values() for name in identified.get("parameters", {})}
    return configured_parameters(config, (*names, "youngs_modulus", "poissons_ratio"))


def read_trials(folder: Path, config: Mapping[str, Any]) -> TrialResults:
    """Reads the observations of the test trials of a split and the models' roll-outs, for the time that counts.

    Roll-outs at other inputs than those of the data set are left out.

    Raises:
        DataFileError: a file is missing or damaged, or the two do not belong together.
    """
    path = common_folder(folder) / DATASET
    dataset = read_dataset(path)
    bound = build_mesh(config["mesh"]).vertices if dataset.bound is None else dataset.bound
    with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
        rolled = tuple(str(each) for each in file.attrs["names"])
        scaled = _read_scaled(folder)
        test = [name for name in rolled if scaled is None or name not in scaled.names]
        models = [model for model in MODELS if f"{model}_observed" in file]
        unknown = sorted(set(test) - set(dataset.names))
        if unknown or not models:
            what = f"names trials that {path} does not hold ({', '.join(unknown)})" if unknown else "holds no model"
            raise DataFileError(f"{folder / ROLLOUTS} {what}: delete it and run the same command again.")
        shape = (len(rolled), *dataset.observed.shape[1:])
        positions = {m: read_array(file, f"{m}_observed", shape)[: len(test)] for m in models}
    rows = dataset.rows(test)
    times, target = dataset.times[rows], dataset.observed[rows]
    begins = tuple(dataset.begins[row] for row in rows)
    seconds, length = config["data"].get("seconds"), times.shape[1]
    if seconds is not None:
        target = np.where((times <= seconds)[..., None, None], target, np.nan)
        length = max(1, int((times <= seconds).any(axis=0).sum()))
    if set(begins) == {STATIC}:  # Beside motions, poses have as many frames, of one time.
        length = 1
    return TrialResults(
        names=tuple(test),
        labels=dataset.labels,
        begins=begins,
        times=times[:, :length],
        target=target[:, :length],
        positions={model: each[:, :length] for model, each in positions.items()},
        bound=bound,
        gravity=dataset.gravity,
        time_step=dataset.time_step,
        **_seen(config, dataset),
    )


def _seen(config: Mapping[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Along which axes and in which frame markers are seen, for the pictures."""
    labels = dataset.labels
    if not labels:
        return {}
    sight = sight_of(config["markers"], labels, dataset.sets)
    return {"axes": tuple(axis for axis in range(3) if axis != sight.unseen), "own_frame": sight.own}


def _read_scaled(folder: Path) -> Dataset | None:
    """The trials at other inputs than those of the data set."""
    path = common_folder(folder) / SCALED_DATASET
    return read_dataset(path) if path.is_file() else None


def read_film(folder: Path, config: Mapping[str, Any], mesh: Mesh) -> Film | None:
    """The bodies of the film, where their markers are seen; None where there is none."""
    with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
        if "film_steps" not in file:
            return None
        steps = read_array(file, "film_steps", (None,)).astype(np.float64)
        models = [model for model in MODELS if f"{model}_film" in file]
        shape = (len(steps), None, 3)
        bodies = {model: read_array(file, f"{model}_film", shape).astype(np.float64) for model in models}
        film = Film(str(file.attrs["film_trial"]), float(file.attrs["time_step"]) * steps, bodies)
    return _as_seen(film, read_dataset(common_folder(folder) / DATASET), config, mesh)


def _as_seen(film: Film, dataset: Dataset, config: Mapping[str, Any], mesh: Mesh) -> Film:
    """The same, with the bodies carried to where their markers are seen."""
    if dataset.bound is None or not (sight := sight_of(config["markers"], dataset.labels, dataset.sets)).own:
        return film
    has = np.flatnonzero(dataset.present[dataset.names.index(film.trial)]).tolist()
    markers = bound_markers(config["markers"], mesh, dataset.bound, dataset.labels)
    sight = sight.select(has)
    at = {model: torch.from_numpy(each) for model, each in film.positions.items()}
    return replace(film, positions={model: sight.carried(q, markers(q)[:, has]).numpy() for model, q in at.items()})


def read_followed(folder: Path, config: Mapping[str, Any]) -> list[FollowedPath]:
    """Reads the paths that controllers followed on a simulated laboratory; empty without control."""
    if config["control"] is None or config["laboratory"] is None:
        return []
    followed = []
    with read_hdf5(folder / DRIVEN, "driven") as file:
        controllers = [str(each) for each in file.attrs["controllers"]]
        for name in map(str, file.attrs["names"]):
            shape, seconds = name.removesuffix("s").rsplit("_", 1)
            path = read_array(file, f"{name}/path", (None, 3)).astype(np.float64)
            points = read_array(file, f"{name}/points", (len(controllers), len(path), 3)).astype(np.float64)
            by_name = dict(zip(controllers, points, strict=True))
            followed.append(FollowedPath(name=shape, seconds=float(seconds), path=path, points=by_name))
    return followed


def read_driven(folder: Path, config: Mapping[str, Any]) -> Driven | None:
    """Reads the inputs of all trials of a split; None without inputs."""
    dataset, scaled = read_dataset(common_folder(folder) / DATASET), _read_scaled(folder)
    quantity = driving_quantity(config)
    if quantity is None or quantity.name not in dataset.inputs:
        return None
    values: dict[str, Any] = {}
    for each in (dataset, *([] if scaled is None else [scaled])):
        values |= dict(zip(each.names, each.inputs[quantity.name], strict=True))
    return Driven(
        quantity,
        dataset.channels[quantity.name],
        values,
        config["data"].get("input_limit"),
        scaled=() if scaled is None else scaled.names,
        poses=tuple(n for n, begins in zip(dataset.names, dataset.begins, strict=True) if begins == STATIC),
    )


def _routes(config: Mapping[str, Any], mesh: Mesh) -> dict[str, FloatArray]:
    """(G, 3) guides of the body's tendons, or a line through each of its muscles [m], by name."""
    if config.get("tendons"):
        tendons = build_tendons(config["tendons"])
        return dict(zip(tendons.names, tendons.guides, strict=True))
    return build_muscles(config["muscles"], mesh).lines(mesh) if config.get("muscles") else {}


def _driven_chambers(chambers: tuple[Chamber, ...], names: tuple[str, ...]) -> tuple[Chamber, ...]:
    """The chambers of a body that are under pressure, in the order of the pressures."""
    if not chambers:
        return ()
    by_name = {chamber.name: chamber for chamber in chambers}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise DataFileError(
            f"{DATASET} has pressures of {', '.join(unknown)}, but the body's chambers are "
            f"{', '.join(by_name) or 'none'}: take the mesh that the trials were imported for."
        )
    return tuple(by_name[name] for name in names)


def _at_rest(mesh: Mesh, trials: TrialResults, film: Film | None) -> tuple[Mesh, dict[str, FloatArray]]:
    """The body as it rests, and how far each marker has moved there (3,) [m], by label.

    Where trials begin at rest, that is how the simulator to correct has it before anything drives it; else it is
    undeformed.
    """
    model = "simulation"
    if film is None or model not in film.positions or film.trial not in trials.names:
        return mesh, {}
    row = trials.names.index(film.trial)
    if trials.begins[row] != "rest":
        return mesh, {}
    moved = trials.positions[model][row, 0] - trials.bound
    return Mesh(film.positions[model][0], mesh.cells), dict(zip(trials.labels, moved, strict=True))


def read_recordings(
    folder: Path, config: Mapping[str, Any], mesh: Mesh, moved: Mapping[str, FloatArray]
) -> Recordings | None:
    """Quality and registration of all trials, and the trial that fits worst; None where there are no recordings.

    Args:
        folder: of the split.
        config: with the group ``markers``, where markers are observed.
        mesh: the body as it is at rest.
        moved: (3,) how far nominal places, which are on the undeformed body, move until it is at rest, by label [m].
    """
    if not sees_markers(config):
        return None
    path = common_folder(folder) / REGISTRATION
    residuals = read_json(path)
    worst = max(residuals, key=lambda trial: residuals[trial]["rms_mm"])
    each = residuals[worst]
    if "positions" not in each:
        raise DataFileError(f"{path} has no positions: delete it and run the same command again.")
    nominal: dict[str, Any] = {**config["markers"]["tracked"], **(config["markers"]["reference"] or {})}
    labels = [label for label in each["positions"] if label in nominal]
    # What JSON has as null was not seen.
    places = np.array([each["positions"][label] or (None,) * 3 for label in labels], dtype=np.float64)
    seen = np.isfinite(places).all(axis=1)
    feet = np.full_like(places, np.nan)
    feet[seen] = closest_points(mesh, places[seen]).points
    return Recordings(
        quality=read_json(path.with_name(QUALITY)),
        residuals=residuals,
        drawn=worst,
        labels=tuple(labels),
        positions=places,
        residual_mm=np.array([each["residual_mm"].get(label) for label in labels], dtype=np.float64),
        outliers=tuple(each["outliers"]),
        nominal=np.array([np.add(nominal[label], moved.get(label, 0.0)) for label in labels], dtype=np.float64),
        feet=feet,
        mesh=mesh,
    )
