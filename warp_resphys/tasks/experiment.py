"""An experiment: its stages in order, from a configuration."""

from pathlib import Path
from typing import Any

import torch
import warp as wp
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from ..files import write_json
from ..report.page import number_text
from ..stages import Stage, StageContext, run_stages
from ..verdict import judgement
from .ablation import run_ablation
from .actuated.checks import PRESSURE
from .actuated.experiment import run_driven
from .checks import check_configuration
from .evaluate import evaluate
from .generate import generate
from .measured.checks import RECORDINGS
from .measured.experiment import run_measured
from .reconstruct import reconstruct
from .refine import refine
from .report import collect_metrics, make_report
from .timing import time_models
from .train import train, train_simfree
from .trajectories import (
    ERRORS,
    METRICS,
    MODEL,
    RECONSTRUCTION,
    REFINED,
    REFINEMENT,
    REPORT,
    ROLLOUTS,
    SIMFREE,
    SIMFREE_TRAINING,
    TIMES,
    TRAINING,
    TRAJECTORIES,
    shown,
    simulated,
    training_settings,
)


def stages(config: dict[str, Any]) -> list[Stage]:
    """The stages of an experiment, each with the settings that it depends on."""
    base = simulated(config)
    corrected = {**base, "simulation": config["simulation"]}
    learned = {**corrected, "data": config["data"]}
    refined = config["refinement"]["kind"] != "none"
    force, force_file = ("refine", REFINED) if refined else ("train", MODEL)
    refinement = Stage(
        "refine",
        refine,
        (REFINED, REFINEMENT),
        {**learned, **_pick(config, "refinement")},
        ("generate", "train"),
    )
    return [
        Stage("generate", generate, (TRAJECTORIES,), {**base, **_pick(config, "reality", "data")}),
        Stage(
            "reconstruct",
            reconstruct,
            (RECONSTRUCTION,),
            {**corrected, **_pick(config, "reconstruction")},
            ("generate",),
        ),
        Stage(
            "train",
            train,
            (MODEL, TRAINING),
            {**learned, **training_settings(config, "resphys")},
            ("generate", "reconstruct"),
        ),
        *([refinement] if refined else []),
        Stage(
            "train_simfree",
            train_simfree,
            (SIMFREE, SIMFREE_TRAINING),
            {**base, **_pick(config, "reality", "data"), **training_settings(config, "simfree")},
            ("generate",),
        ),
        Stage(
            "evaluate",
            evaluate,
            (ROLLOUTS, ERRORS),
            {**learned, "force": force_file},
            ("generate", "reconstruct", force, "train_simfree"),
        ),
        Stage(
            "time",
            time_models,
            (TIMES,),
            {**learned, **_pick(config, "reality"), "force": force_file},
            ("generate", force),
        ),
        Stage(
            "report",
            make_report,
            (REPORT,),
            {"config": shown(config)},
            (force, "train_simfree", "evaluate", "time"),
        ),
    ]


def _pick(config: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: config[key] for key in keys}


def prepare(config: DictConfig) -> tuple[dict[str, Any], Path]:
    """The checked configuration as plain data, and the run folder.

    Raises:
        InputError: a value of the wrong kind or out of range, or an unknown key.
    """
    wp.config.log_level = wp.LOG_WARNING
    if config.device == "cpu" or not torch.cuda.is_available():
        torch.set_num_threads(1)  # The networks are small: see threads.py.
    plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    check_configuration(plain)
    return plain, Path(HydraConfig.get().runtime.output_dir)


def run_experiment(config: DictConfig) -> None:
    """Runs what has changed, writes metrics.json and prints the errors."""
    plain, folder = prepare(config)
    if plain["data"]["kind"] == RECORDINGS:
        run_measured(plain, folder)
        return
    if plain["data"]["kind"] == PRESSURE:
        run_driven(plain, folder)
        return
    if "markers" in plain:
        run_ablation(shown(plain), simulated(plain), folder)
        return
    run_stages(stages(plain), folder)
    metrics = collect_metrics(StageContext("metrics", folder, "", {}), plain)
    write_json(folder / METRICS, metrics)
    _print(metrics, folder, plain)


def _print(metrics: dict[str, Any], folder: Path, config: dict[str, Any]) -> None:
    """Errors as a table, and where the report is."""
    table = Table("model", "mean [mm]", "std [mm]", "diverged", title="Roll-out error against the target, test split")
    for model, summary in metrics["errors_mm"].items():
        row = (number_text(summary["mean"]), number_text(summary["std"]), str(summary["diverged"]))
        table.add_row(model, *row)
    console = Console()
    console.print(table)
    for said in judgement(metrics, config):
        console.print(said, soft_wrap=True)
    console.print(f"Report: {folder / REPORT}", soft_wrap=True)
