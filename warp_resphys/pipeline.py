"""An experiment: its stages in order, from a configuration, for one split or for every fold of a cross-validation.

A stage is there because the configuration asks for what it makes; its settings are all that its files depend on.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import warp as wp
from rich.console import Console
from rich.table import Table

from .control.files import BASELINES, plan_table, plans_file, reduced_file
from .control.stages import drive, fit_baselines, plan_motions, reduce_robot
from .control.task import motions_of
from .experiment.ablation import ablation_stages, print_ablation
from .experiment.build import choose_device
from .experiment.checks import check_configuration, training_settings
from .experiment.evaluate import check_mesh, evaluate, intervals_of_folds, time_models
from .experiment.files import (
    CONTROL,
    DATASET,
    DRIVEN,
    ERRORS,
    IDENTIFICATION,
    MESH_CHECK,
    METRICS,
    QUALITY,
    REGISTRATION,
    REPORT,
    ROLLOUTS,
    SCALED_DATASET,
    TIMES,
    TRUTH,
    fold_folder,
    reconstruction_file,
    training_file,
    weights_file,
)
from .experiment.folds import Fold, run_folds
from .experiment.identify import identify
from .experiment.importing import import_recordings, import_scaled
from .experiment.learn import refine, train
from .experiment.models import SIMFREE
from .experiment.parts import workers_for
from .experiment.reconstruct import reconstruct
from .experiment.report import collect_metrics, make_folds_report, make_report
from .experiment.scene import LEARNED, models_of
from .experiment.simulate import run_laboratory, simulate
from .experiment.trials import (
    Split,
    folds_of,
    is_laboratory,
    scaled_trials_of,
    sees_markers,
    split_of,
    test_groups,
    trials_of,
)
from .io.atomic import digest
from .io.errors import DataFileError
from .io.fan_out import ALONE, Workers
from .io.files import read_json, write_json
from .io.stages import Stage, StageContext, package_versions, resources_used, run_stages
from .learning.metrics import summarise_folds
from .report.conclusions import conclusions
from .report.control_section import controller_name
from .report.page import number_text

_SIMULATED = (
    *("mesh", "physics", "fixed", "gravity", "time_step", "integrator", "solver", "device", "dtype"),
    *("chambers", "fibres", "tendons", "muscles", "coupling"),
)
_DRAWN = (
    *("laboratory", "fixed", "chambers", "tendons", "muscles", "gravity"),
    *("time_step", "solver", "device", "dtype", "seed", "tip"),
)
_DRAWN_DATA = (
    *("folder", "trials", "sequences", "begins", "train", "validation", "test", "folds", "limit"),
    *("payload_at", "up", "rest", "steps", "input_limit", "base_motion"),
)
_DRAWN_MARKERS = ("tracked", "reference", "bind", "bind_to", "patch", "largest_distance")
_LATER_DATA = ("horizons", "train_fraction", "input_scales")
_LEARNED_FROM = ("simulation", "markers", "release", "force_frame")
_OF_NETWORKS = ("actuation", "range_guard")
_LEARNED_DATA = ("payload_at", "train_fraction", "seconds")
_PLANNED = ("tracked", "shapes", "seconds", "centre", "size", "right", "up", "limits", "plan")
_OF_HORIZONS = ("receding", "horizon", "estimate", "plan", "reduction")

_MOST_COLUMNS = 5  # folds that stand beside each other in a terminal

Work = Callable[[StageContext], None]


def simulated(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that every simulation of an experiment depends on."""
    base = _pick(config, *_SIMULATED, *_around(config))
    if "path" in config["mesh"]:
        base["mesh_digest"] = digest(config["mesh"]["path"])
    trials = config["data"].get("trials") or {}
    motions = [each.get("base_motion") for each in (config["data"], *trials.values()) if isinstance(each, Mapping)]
    files = [each["file"] for each in motions if isinstance(each, Mapping) and "file" in each]
    if files:
        folder = Path(config["data"].get("folder") or ".").expanduser()
        base["base_motions"] = {name: _digest(folder / name, "the file of base_motion") for name in files}
    return base


def _around(config: Mapping[str, Any]) -> tuple[str, ...]:
    """The keys of what is around a body and hangs on it, where there is any."""
    return tuple(key for key in ("medium", "payload_string") if config.get(key) is not None)


def shown(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration without what has no bearing on a run."""
    return {key: value for key, value in config.items() if key != "tune"}


def _pick(config: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: config[key] for key in keys if key in config}


def acquisition_stages(config: Mapping[str, Any]) -> list[Stage]:
    """The stages that lead to dataset.h5: a simulation of the trials, or their import, perhaps from a laboratory.

    Args:
        config: that `check_configuration` accepts.

    Raises:
        DataFileError: a recording that is not there.
    """
    base, data = simulated(config), config["data"]
    if not sees_markers(config):
        return [Stage("simulate", simulate, (DATASET,), {**base, **_pick(config, "target", "data")})]
    stages, workers = [], workers_for(config, config["parallel"]["processes"])
    imported = {**base, **_pick(config, "simulation", "markers")}
    imported["data"] = {key: value for key, value in data.items() if key not in _LATER_DATA} | {"input_scales": []}
    trials = trials_of(config)
    if folds_of(config) is None:
        imported["split"] = {name: each for name, each in split_of(config).plain().items() if name != "test"}
    imported |= {"laboratory": config["laboratory"], "in_the_loop": config["in_the_loop"] is not None}
    if is_laboratory(config):
        files = (*(trial.recording for trial in trials), TRUTH)
        play = partial(run_laboratory, workers=workers)
        stages.append(Stage("laboratory", play, files, _laboratory_settings(config, ())))
    else:
        imported["recordings"] = {trial.name: _digest(trial.file, f"data.trials.{trial.name}.file") for trial in trials}
    needs = tuple(stage.name for stage in stages)
    stages.append(Stage("import", import_recordings, (DATASET, QUALITY, REGISTRATION), imported, needs))
    scales = data["input_scales"]
    if scales:
        files = tuple(trial.recording for trial in scaled_trials_of(config))
        play = partial(run_laboratory, workers=workers, scaled=True)
        stages.append(Stage("laboratory_scaled", play, files, _laboratory_settings(config, scales), needs))
        more = {**imported, "data": {**imported["data"], "input_scales": scales}}
        needs = ("import", "laboratory_scaled")
        stages.append(Stage("import_scaled", import_scaled, (SCALED_DATASET,), more, needs))
    return stages


def _laboratory_settings(config: Mapping[str, Any], scales: Sequence[float]) -> dict[str, Any]:
    """What the recordings of a simulated laboratory depend on."""
    own: dict[str, Any] = {
        **_pick(config, *_DRAWN, *_around(config)),
        "data": {**_pick(config["data"], *_DRAWN_DATA), "input_scales": list(scales)},
        "markers": _pick(config["markers"], *_DRAWN_MARKERS),
        "batch": config["parallel"]["batch"],
        "in_the_loop": config["in_the_loop"] is not None,
    }
    if "path" in config["laboratory"]["mesh"]:
        own["mesh_digest"] = digest(config["laboratory"]["mesh"]["path"])
    return own


def _digest(path: Path | None, key: str) -> str:
    try:
        return digest(str(path))
    except OSError as error:
        raise DataFileError(f"cannot read {path} ({error.strerror}): check data.folder and {key}.") from error


def learning_stages(
    config: Mapping[str, Any], split: Split, shared: str, acquired: str, workers: Workers | None = None
) -> list[Stage]:
    """The stages of one split, from the identification to the report.

    Args:
        config: that `check_configuration` accepts.
        split: names of trials.
        shared: the folder of dataset.h5, relative to that of the split.
        acquired: fingerprint of the stage that wrote it.
        workers: that share the work; as the configuration says, if left out.
    """
    workers = workers_for(config, config["parallel"]["processes"]) if workers is None else workers
    markers = sees_markers(config)
    needs = ("identify",) if config["identify"] is not None else ()
    base: dict[str, Any] = {
        **simulated(config),
        **_pick(config, *_LEARNED_FROM),
        "data": _pick(config["data"], *_LEARNED_DATA),
        "identify": _pick(config["identify"], "integrator", "substeps", "elastic") if needs else None,
        "batch": config["parallel"]["batch"],
        "shared": shared,
        "acquired": acquired,
        "split": split.plain(),
    }
    stages: list[Stage] = []

    def add(name: str, work: Work, outputs: tuple[str, ...], settings: Mapping[str, Any], *upstream: str) -> None:
        stages.append(Stage(name, work, outputs, {**base, **settings}, (*needs, *upstream)))

    if needs:
        stages.append(Stage("identify", identify, (IDENTIFICATION,), {**base, **_pick(config, "identify", "seed")}))
    reconstructed = [*split.train, *split.validation, *(() if markers else split.test)]
    networks, learned = _pick(config, *_OF_NETWORKS), []
    for model in (each for each in models_of(config) if each in LEARNED and each != SIMFREE):
        own, first, second = {"model": model}, f"reconstruct_{model}", f"train_{model}"
        settings = {**own, **_pick(config, "reconstruction"), "reconstructed": reconstructed}
        add(first, partial(reconstruct, workers=workers), (reconstruction_file(model),), settings)
        settings = {**own, **networks, **training_settings(config, model)}
        add(second, train, (weights_file(model), training_file(model)), settings, first)
        if config["refinement"]["kind"] != "none":
            outputs = (weights_file(model, True), training_file(model, True))
            settings = {**own, **networks, **_pick(config, "refinement", "seed")}
            add(f"refine_{model}", refine, outputs, settings, first, second)
        learned.append(stages[-1].name)
    settings = {"model": SIMFREE, **networks, **training_settings(config, SIMFREE)}
    if not markers:  # What replaces a simulator depends on none, where states are known without.
        settings["simulation"] = config["target"]
    outputs = (weights_file(SIMFREE), training_file(SIMFREE))
    add("train_simfree", train, outputs, settings, *(("reconstruct_resphys",) if markers else ()))
    learned.append("train_simfree")
    tested = {"groups": test_groups(config, split), **networks, "refinement": config["refinement"]["kind"]}
    calibration = [*(split.validation or split.train)] if markers and folds_of(config) is None else []
    settings = {**tested, "calibration": calibration, **_pick(config, "published", "correct_uncorrected")}
    settings["data"] = {**base["data"], **_pick(config["data"], "horizons")}
    work = partial(evaluate, workers=workers)
    add("evaluate", work, (ROLLOUTS, ERRORS), settings, *learned, "reconstruct_resphys")
    if config["timing"]:
        add("time", time_models, (TIMES,), {**tested, **_pick(config, "target")}, *learned)
    if config["mesh_check"] is not None:
        add("mesh_check", check_mesh, (MESH_CHECK,), {**tested, **_pick(config, "mesh_check")})
    if config["control"] is not None:
        stages += control_stages(config, base, acquired, workers)
    last = tuple(stage.name for stage in stages if stage.name in ("evaluate", "time", "mesh_check", "drive"))
    stages.append(Stage("report", make_report, (REPORT,), {"config": shown(config), "acquired": acquired}, last))
    return stages


def control_stages(config: Mapping[str, Any], base: Mapping[str, Any], acquired: str, workers: Workers) -> list[Stage]:
    """The stages of a run that plan on its models, and where a simulation plays the robot, drive it.

    Args:
        config: that `check_configuration` accepts.
        base: the settings that all stages of the split depend on.
        acquired: see `learning_stages`.
        workers: that share the motions.
    """
    control, stages = config["control"], list[Stage]()
    for model in reversed(control["models"]):  # The last is to reach the paths, which is seen first.
        first, own = f"reduce_{model}", {**base, "model": model, "seed": config["seed"], "device": config["device"]}
        known = {"control": _pick(control, "reduction")}
        stages.append(Stage(first, reduce_robot, (reduced_file(model),), {**own, **known}, ("evaluate",)))
        known = {"control": _pick(control, *_PLANNED), "must_reach": model == control["models"][-1]}
        tables = [plan_table(model, motion) for motion in motions_of(control)]
        stages.append(Stage(f"plan_{model}", plan_motions, (plans_file(model), *tables), {**own, **known}, (first,)))
    if config["laboratory"] is None:
        return stages
    played = {**base, **_laboratory_settings(config, ()), "device": config["device"]}
    needs = tuple(stage.name for stage in stages)
    settings = {**played, "control": {key: value for key, value in control.items() if key not in _OF_HORIZONS}}
    stages.append(Stage("baselines", fit_baselines, (BASELINES,), settings, ("evaluate",)))
    work = partial(drive, workers=workers)
    stages.append(Stage("drive", work, (DRIVEN, CONTROL), {**played, "control": control}, (*needs, "baselines")))
    return stages


def prepare(config: Mapping[str, Any]) -> None:
    """Checks a configuration, and sets up libraries for it.

    Raises:
        InputError: a value of the wrong kind or out of range, or an unknown key.
    """
    wp.config.log_level = wp.LOG_WARNING
    if config["device"] == "cpu" or not torch.cuda.is_available():
        torch.set_num_threads(1)  # The networks are small: see threads.py.
    check_configuration(config)


def acquire(config: Mapping[str, Any], folder: Path, wait: bool = False) -> tuple[list[Stage], str]:
    """Runs the stages that lead to the trials; returns them, and the fingerprint of the one that writes dataset.h5."""
    stages = acquisition_stages(config)
    run_stages(stages, folder, wait)
    (written,) = (stage.name for stage in stages if DATASET in stage.outputs)
    return stages, str(read_json(folder / "stages" / f"{written}.json")["fingerprint"])


def run_experiment(plain: dict[str, Any], folder: Path) -> None:
    """Runs what has changed, writes metrics.json into the run folder and prints the errors.

    Raises:
        InputError: a value that cannot be used.
    """
    prepare(plain)
    if "ablation" in plain:
        run_stages(ablation_stages(plain, simulated(plain), shown(plain)), folder)
        print_ablation(plain, folder)
        return
    first, acquired = acquire(plain, folder)
    folds = folds_of(plain)
    if folds is None:
        stages = learning_stages(plain, split_of(plain), ".", acquired)
        run_stages(stages, folder)
        metrics = collect_metrics(folder, plain, [stage.name for stage in (*first, *stages)])
    else:
        metrics = _run_folds(plain, folder, folds, first, acquired)
    write_json(folder / METRICS, metrics)
    if folds is not None:
        each = {trial: fold["errors_mm"] for trial, fold in metrics["folds"].items()}
        reported = {"config": shown(plain), "folds": each}
        run_stages([*first, Stage("report", make_folds_report, (REPORT,), reported, (first[-1].name,))], folder)
    _print(metrics, folder, plain)


def _run_folds(
    config: dict[str, Any], folder: Path, splits: Mapping[str, Split], first: Sequence[Stage], acquired: str
) -> dict[str, Any]:
    """What metrics.json says of a cross-validation, each fold of which has a folder of its own."""
    folds = {
        name: Fold(name, folder / fold_folder(name), partial(learning_stages, config, split, "..", acquired))
        for name, split in splits.items()
    }
    run_folds(folds, workers_for(config, config["parallel"]["processes"]))
    found = {}
    for name, fold in folds.items():
        found[name] = collect_metrics(fold.folder, config, [stage.name for stage in fold.stages(ALONE)])
        write_json(fold.folder / METRICS, found[name])
    return {
        "errors_mm": summarise_folds([each["errors_mm"] for each in found.values()]),
        "folds": found,
        **intervals_of_folds(folder / DATASET, {name: fold.folder for name, fold in folds.items()}),
        **resources_used(folder, [stage.name for stage in first]),
        "versions": package_versions(),
        "device": str(choose_device(config["device"])),
    }


def _print(metrics: Mapping[str, Any], folder: Path, config: Mapping[str, Any]) -> None:
    """Errors as a table, a column for every fold, horizon and pressure scale that tells more, and what they say."""
    whole = metrics["errors_mm"]
    folds = {trial: fold["errors_mm"] for trial, fold in metrics.get("folds", {}).items()}
    columns = folds if len(folds) <= _MOST_COLUMNS else {}
    columns |= {f"first {seconds} s": found for seconds, found in metrics.get("horizons", {}).items()}
    columns |= {f"{scale} x": found for scale, found in metrics.get("scales", {}).items()}
    columns = {name: found for name, found in columns.items() if found != whole}
    what = "markers" if sees_markers(config) else "vertices"
    title = f"Error of the {what} in what no training saw" + "; x: times the inputs" * ("scales" in metrics)
    table = Table("model", "mean [mm]", "std [mm]", *columns, "diverged", title=title)
    for model, summary in whole.items():
        each = [number_text(found[model]["mean"]) if model in found else "" for found in columns.values()]
        std = "" if summary["std"] is None else number_text(summary["std"])
        table.add_row(model, number_text(summary["mean"]), std, *each, str(summary["diverged"]))
    console = Console()
    console.print(table)
    if folds and not columns:
        by_trial = Table("left out", *whole, title="Error of each trial [mm]")
        for trial, errors in folds.items():
            by_trial.add_row(trial, *(number_text(errors[model]["mean"]) for model in whole))
        console.print(by_trial)
    for model, found in metrics.get("range", {}).items():
        if found["left"]:
            first = min(found["first_s"].values())
            console.print(
                f"{model}: {found['left']} test trials leave the states of the training, from {first:.2f} s on."
            )
    if metrics.get("control"):
        console.print(_driven(metrics["control"]["tracking"]))
    if "noise_mm" in metrics:
        console.print(f"The noise of the markers alone is {number_text(metrics['noise_mm'])} mm.")
    for said in conclusions(metrics, config):
        console.print(said, soft_wrap=True)
    console.print(f"Report: {folder / REPORT}", soft_wrap=True)


def _driven(tracking: Mapping[str, Mapping[str, Any]]) -> Table:
    """How well each controller followed paths, by the seconds that these took."""
    columns = [f"in {float(seconds):g} s [mm]" for seconds in tracking]
    table = Table("controller", *columns, title="Mean distance from the paths that were driven")
    for name in next(iter(tracking.values())):
        table.add_row(controller_name(name), *(number_text(each[name]["mean_mm"]) for each in tracking.values()))
    return table
