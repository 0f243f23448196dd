"""An experiment on recordings: its stages, for one split or for every fold of a cross-validation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ...files import read_json, write_json
from ...metrics import summarise_folds
from ...report.page import number_text
from ...stages import Stage, package_versions, resources_used, run_stages
from ...verdict import judgement
from ..trajectories import Split, shown, simulated, training_settings
from .evaluate import evaluate_markers
from .files import (
    ERRORS,
    IDENTIFICATION,
    METRICS,
    REPORT,
    ROLLOUTS,
    TRUTH,
    fold_folder,
    learned,
    training_file,
    weights_file,
)
from .identify import identify
from .reconstruct import reconstruct_markers
from .report import report_folds, report_measured
from .stages import import_stages
from .train import train_on_markers, train_simfree_on_markers
from .trials import folds_of, split_of

_SHARED = ("data", "markers", "published", "simulation", "identify", "release")
_CORRECTED = {"resphys_uncorrected": "simulation", "resphys": "identified"}  # model: simulator


def learning_stages(config: Mapping[str, Any], split: Split, shared: str, imported: str) -> list[Stage]:
    """The stages of one split, from the identification to the evaluation.

    Args:
        config: that `check_configuration` accepts.
        split: names of trials.
        shared: the folder of markers.h5, relative to that of the split.
        imported: fingerprint of markers.h5.
    """
    base = {**simulated(config), **{key: config[key] for key in (*_SHARED, "seed")}}
    base |= {"shared": shared, "imported": imported}
    base["split"] = {name: list(getattr(split, name)) for name in ("train", "validation", "test")}
    stages = [Stage("identify", identify, (IDENTIFICATION,), base)]
    for model, kind in _CORRECTED.items():
        settings = {**base, "base": [kind, model]}
        needs = ("identify",) if kind == "identified" else ()
        reconstruct = Stage(
            f"reconstruct_{model}",
            reconstruct_markers,
            (f"reconstruction_{model}.h5",),
            {**settings, "reconstruction": config["reconstruction"]},
            needs,
        )
        outputs = (weights_file(model), training_file(model))
        learned = {**settings, "network": config["network"], "in_the_loop": config["in_the_loop"]}
        train = Stage(f"train_{model}", train_on_markers, outputs, learned, (*needs, reconstruct.name))
        stages += [reconstruct, train]
    stages.append(
        Stage(
            "train_simfree",
            train_simfree_on_markers,
            (weights_file("simfree"), training_file("simfree")),
            {**base, **training_settings(dict(config), "simfree")},
            ("identify", "reconstruct_resphys"),
        )
    )
    trained = ("train_resphys_uncorrected", "train_resphys", "train_simfree")
    stages.append(Stage("evaluate", evaluate_markers, (ROLLOUTS, ERRORS), base, ("identify", *trained)))
    reported = {"config": shown(config), "imported": imported}
    stages.append(Stage("report", report_measured, (REPORT,), reported, ("evaluate",)))
    return stages


def run_measured(config: dict[str, Any], folder: Path) -> None:
    """Runs what has changed, writes metrics.json, and prints the errors."""
    first = import_stages(config)
    run_stages(first, folder)
    imported = read_json(folder / "stages" / "import.json")["fingerprint"]
    folds = folds_of(config)
    if folds is None:
        stages = learning_stages(config, split_of(config), ".", imported)
        run_stages(stages, folder)
        metrics = collect_metrics(folder, [*first, *stages])
    else:
        found = {}
        for trial, split in folds.items():
            inner = folder / fold_folder(trial)
            stages = learning_stages(config, split, "..", imported)
            run_stages(stages, inner)
            found[trial] = collect_metrics(inner, stages)
            write_json(inner / METRICS, found[trial])
        metrics = {
            "errors_mm": summarise_folds([each["errors_mm"] for each in found.values()]),
            "folds": found,
            **resources_used(folder, [stage.name for stage in first]),
            "versions": package_versions(),
        }
    write_json(folder / METRICS, metrics)
    if folds is not None:
        each = {trial: fold["errors_mm"] for trial, fold in metrics["folds"].items()}
        reported = {"config": shown(config), "folds": each}
        run_stages([*first, Stage("report", report_folds, (REPORT,), reported, ("import",))], folder)
    _print(metrics, folder, config)


def collect_metrics(folder: Path, stages: list[Stage]) -> dict[str, Any]:
    """Errors, the noise in them where known, identified parameters, time and memory of the stages, and versions."""
    simulated_reality = "synthesise" in [stage.name for stage in stages]
    return {
        **read_json(folder / ERRORS),
        **({"noise_mm": read_json(folder / TRUTH)["noise_mm"]} if simulated_reality else {}),
        **learned(folder),
        **resources_used(folder, [stage.name for stage in stages]),
        "versions": package_versions(),
    }


def _print(metrics: Mapping[str, Any], folder: Path, config: Mapping[str, Any]) -> None:
    """Errors as a table, a column for every fold, and where the report is."""
    folds: Mapping[str, Any] = metrics.get("folds", {})
    table = Table("model", "mean [mm]", *folds, title="Error of the markers of trials that no training saw")
    for model, summary in metrics["errors_mm"].items():
        each = [number_text(fold["errors_mm"][model]["mean"]) for fold in folds.values()]
        table.add_row(model, number_text(summary["mean"]), *each)
    console = Console()
    console.print(table)
    if "noise_mm" in metrics:
        console.print(f"The noise of the markers alone is {number_text(metrics['noise_mm'])} mm.")
    for said in judgement(metrics, config):
        console.print(said, soft_wrap=True)
    console.print(f"Report: {folder / REPORT}", soft_wrap=True)
