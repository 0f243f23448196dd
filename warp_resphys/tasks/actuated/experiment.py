"""An experiment with pressures: its stages in order, from a configuration."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ...errors import DataFileError
from ...files import digest, read_json, write_json
from ...report.page import number_text
from ...stages import Stage, package_versions, resources_used, run_stages
from ...verdict import judgement
from ..measured.files import (
    ERRORS,
    IDENTIFICATION,
    METRICS,
    QUALITY,
    REGISTRATION,
    REPORT,
    ROLLOUTS,
    TRUTH,
    learned,
    training_file,
    weights_file,
)
from ..trajectories import shown, simulated, training_settings
from .evaluate import evaluate_driven
from .files import LEARNED, MOTIONS, RAISED_MOTIONS, RECONSTRUCTED, RECONSTRUCTION
from .identify import identify_driven
from .importing import import_driven, import_raised
from .parts import processes_for
from .reconstruct import reconstruct_driven
from .report import report_driven
from .synthesise import synthesise_driven
from .train import train_driven, train_simfree_driven
from .trials import groups_of, is_synthetic, raised_trials_of, split_of, trials_of

_TRIALS = ("folder", "trials", "sequences", "train", "validation", "test", "factors", "limit")
_SYNTHESISED = (
    "synthetic",
    "fixed",
    "chambers",
    "gravity",
    "time_step",
    "solver",
    "device",
    "dtype",
    "seed",
)
_SYNTHESISED_MARKERS = ("followed", "others", "bind", "bind_to", "largest_distance")
_LEARNED = ("markers", "simulation", "actuation")


def driven_stages(config: Mapping[str, Any]) -> list[Stage]:
    """The stages of an experiment.

    Args:
        config: that `check_configuration` accepts.

    Raises:
        DataFileError: a recording that is not there.
    """
    trials, split = trials_of(config), split_of(config)
    processes = processes_for(config)
    base = {**simulated(config), **_pick(config, *_LEARNED), "batch": config["parallel"]["batch"]}
    later = ("windows", "train_fraction")
    nominal = {**config["data"], "factors": []}  # what is learned from does not depend on what else is tested
    imported = {**base, "data": {key: value for key, value in nominal.items() if key not in later}}
    stages = []
    if is_synthetic(config):
        files = (*(trial.made for trial in trials), TRUTH)
        simulate = partial(synthesise_driven, processes=processes)
        stages.append(Stage("synthesise", simulate, files, _synthesised(config, nominal)))
    else:
        imported["recordings"] = {trial.name: _digest(trial.file) for trial in trials}
    needs = tuple(stage.name for stage in stages)
    imported["split"] = known = {name: list(getattr(split, name)) for name in ("train", "validation")}
    stages.append(Stage("import", import_driven, (MOTIONS, QUALITY, REGISTRATION), imported, needs))
    learned = {**base, "data": _pick(config["data"], "train_fraction"), "split": known}
    stages += [
        Stage(
            "identify",
            identify_driven,
            (IDENTIFICATION,),
            {**learned, **_pick(config, "identify", "seed")},
            ("import",),
        ),
        Stage(
            "reconstruct",
            partial(reconstruct_driven, processes=processes),
            (RECONSTRUCTED, RECONSTRUCTION),
            {**learned, **_pick(config, "reconstruction", "force_frame")},
            ("import", "identify"),
        ),
    ]
    for model, function in zip(LEARNED, (train_simfree_driven, train_driven), strict=True):
        settings = {**learned, **training_settings(dict(config), model)}
        if model == "resphys":
            settings["force_frame"] = config["force_frame"]
        outputs = (weights_file(model), training_file(model))
        needs = ("import", "identify", "reconstruct")
        stages.append(Stage(f"train_{model}", function, outputs, settings, needs, format_version=2))
    tested = {**base, "data": _pick(config["data"], "windows"), "tip": config["tip"], "groups": groups_of(config)}
    needs = ("import", "identify", *(f"train_{model}" for model in LEARNED))
    if config["data"]["factors"]:
        stages += _raised_stages(config, imported, processes)
        needs = (*needs, stages[-1].name)
    stages += [
        Stage(
            "evaluate",
            partial(evaluate_driven, processes=processes),
            (ROLLOUTS, ERRORS),
            tested,
            needs,
            format_version=2,
        ),
        Stage("report", report_driven, (REPORT,), {"config": shown(config)}, ("evaluate",)),
    ]
    return stages


def _raised_stages(config: Mapping[str, Any], imported: Mapping[str, Any], processes: int) -> list[Stage]:
    """Those that make and import the test trials at higher pressures, as ``imported`` says of the others."""
    files = tuple(trial.made for trial in raised_trials_of(config))
    function = partial(synthesise_driven, processes=processes, higher=True)
    settings = _synthesised(config, config["data"])
    data = {**imported["data"], "factors": config["data"]["factors"]}
    return [
        Stage("synthesise_raised", function, files, settings, ("synthesise",)),
        Stage(
            "import_raised",
            import_raised,
            (RAISED_MOTIONS,),
            {**imported, "data": data},
            ("import", "synthesise_raised"),
        ),
    ]


def _synthesised(config: Mapping[str, Any], data: Mapping[str, Any]) -> dict[str, Any]:
    """What simulated recordings depend on, with the group ``data``."""
    own: dict[str, Any] = {
        **_pick(config, *_SYNTHESISED),
        "data": _pick(data, *_TRIALS, "steps", "pressure_limit"),
        "markers": _pick(config["markers"], *_SYNTHESISED_MARKERS),
        "batch": config["parallel"]["batch"],
    }
    if config["synthetic"]["mesh"]["kind"] == "file":
        own["mesh_digest"] = digest(config["synthetic"]["mesh"]["path"])
    return own


def _pick(config: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: config[key] for key in keys}


def _digest(path: Path | None) -> str:
    try:
        return digest(str(path))
    except OSError as error:
        raise DataFileError(f"cannot read {path} ({error.strerror}): check data.folder and data.trials.") from error


def run_driven(config: dict[str, Any], folder: Path) -> None:
    """Runs what has changed, writes metrics.json, and prints the errors."""
    stages = driven_stages(config)
    run_stages(stages, folder)
    metrics = collect_metrics(folder, stages)
    write_json(folder / METRICS, metrics)
    _print(metrics, folder, config)


def collect_metrics(folder: Path, stages: list[Stage]) -> dict[str, Any]:
    """Errors, the noise in them where known, identified parameters, time and memory of the stages, and versions."""
    names = [stage.name for stage in stages]
    return {
        **read_json(folder / ERRORS),
        **({"noise_mm": read_json(folder / TRUTH)["noise_mm"]} if "synthesise" in names else {}),
        "reconstruction": read_json(folder / RECONSTRUCTION),
        **learned(folder),
        **resources_used(folder, names),
        "versions": package_versions(),
    }


def _print(metrics: Mapping[str, Any], folder: Path, config: Mapping[str, Any]) -> None:
    """Errors as a table, a column for every window and pressure factor that tells more, and where the report is."""
    whole = metrics["errors_mm"]
    groups = {f"first {seconds} s": found for seconds, found in metrics["windows"].items()}
    groups |= {f"{factor} x": found for factor, found in metrics.get("overpressure", {}).items()}
    groups = {name: found for name, found in groups.items() if found != whole}
    title = "Error of the markers, test split" + "; x: times the pressure" * ("overpressure" in metrics)
    table = Table("model", "mean [mm]", *groups, "diverged", title=title)
    for model, summary in whole.items():
        each = [number_text(found[model]["mean"]) for found in groups.values()]
        table.add_row(model, number_text(summary["mean"]), *each, str(summary["diverged"]))
    console = Console()
    console.print(table)
    for model, found in metrics["range"].items():
        if found["left"]:
            first = min(found["first_s"].values())
            console.print(
                f"{model}: {found['left']} test trials leave the states of the training, from {first:.2f} s on."
            )
    if "noise_mm" in metrics:
        console.print(f"The noise of the markers alone is {number_text(metrics['noise_mm'])} mm.")
    for said in judgement(metrics, config):
        console.print(said, soft_wrap=True)
    console.print(f"Report: {folder / REPORT}", soft_wrap=True)
