"""An experiment: its stages in order, for one split or for every fold of a cross-validation.

The configuration determines the stages. The settings of a stage are exactly what its files depend
on.
"""

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from threading import Thread

import torch

from .applications import FURTHER_STAGES, function_at, own_run
from .experiment import files
from .experiment.build import choose_device
from .experiment.checks import check_run
from .experiment.digests import digest_of, files_read
from .experiment.folds import Fold, intervals_of_folds, run_folds, workers_for
from .experiment.laboratory import run_laboratory
from .experiment.recordings.importing import import_recordings, import_scaled
from .experiment.report import make_folds_report
from .experiment.run_metrics import collect_metrics
from .experiment.simulate import simulate
from .experiment.split_stages import SplitStages
from .experiment.splits import folds_of, scaled_trials_of, split_of, trials_of
from .io.fan_out import ALONE, Workers
from .io.kernel_cache import start_quietly
from .io.progress import show, title_of
from .io.resuming import (
    Stage,
    expected_seconds,
    package_versions,
    resources_used,
    run_stages,
    unfinished,
)
from .io.safe_files import read_json, write_json
from .learning.metrics import summarise_folds
from .report.conditions import conditions
from .report.control_section import tracking_table
from .report.data import Metrics
from .report.ranking import recommended, shown_metrics
from .report.sections import shapes_table
from .report.verdict import results_table, verdict
from .report.wording import duration_text
from .settings.performed import Split, Trial
from .settings.run import RunSettings
from .settings.stage_keys import BATCH, IMPORTED, PLAYED, SIMULATOR, StageSettings

log = logging.getLogger(__name__)


_LEAST_SECONDS = 60.0  # that are announced
_MOST_THREADS = (
    4  # that share the trials of a batch, as Python's part of a step runs in one at a time
)


def acquisition_stages(run: RunSettings) -> list[Stage]:
    """Returns the stages that write dataset.h5: simulation of the trials,
    or import of (simulated) recordings.

    Args:
        run: settings that `check_run` accepts.

    Raises:
        DataFileError: a recording cannot be read.
    """
    digests, trials = files_read(run, run), trials_of(run)
    if run.recorded is None:
        keys = (*SIMULATOR, "target", "data")
        settings = StageSettings.reading(
            run, *keys, files=files_read(run, run, run.target), trials=trials
        )
        return [Stage("simulate", simulate, (files.DATASET,), settings)]
    split = None if folds_of(run) is not None else split_of(run)
    learned = None if split is None else split.train + split.validation

    def imported(trials: Sequence[Trial]) -> StageSettings:
        return StageSettings.reading(run, *IMPORTED, files=digests, trials=trials, learned=learned)

    outputs = (files.DATASET, files.QUALITY, files.REGISTRATION)
    if not run.is_laboratory:
        digests |= {
            str(trial.file): digest_of(Path(str(trial.file)), f"data.trials.{trial.name}.file")
            for trial in trials
        }
        return [Stage("import", import_recordings, outputs, imported(trials))]
    stages = [
        _laboratory_stage("laboratory", run, trials, files.TRUTH),
        Stage("import", import_recordings, outputs, imported(trials), ("laboratory",)),
    ]
    if scaled := scaled_trials_of(run):
        stages += [
            replace(_laboratory_stage("laboratory_scaled", run, scaled), upstream=("laboratory",)),
            Stage(
                "import_scaled",
                import_scaled,
                (files.SCALED_DATASET,),
                imported(scaled),
                ("import", "laboratory_scaled"),
            ),
        ]
    return stages


def _laboratory_stage(name: str, run: RunSettings, trials: Sequence[Trial], *truth: str) -> Stage:
    """Returns a stage that simulates the recordings of trials."""
    outputs = (*(trial.recording for trial in trials), *truth)
    settings = StageSettings.reading(
        run, *PLAYED, BATCH, files=files_read(run, run.laboratory), trials=trials
    )
    return Stage(name, partial(run_laboratory, workers=workers_of(run)), outputs, settings)


def workers_of(run: RunSettings) -> Workers:
    """Returns the workers of a run."""
    return workers_for(run.parallel, run.parallel.processes, run.device)


def learning_stages(
    run: RunSettings, split: Split, shared: str, acquired: str, workers: Workers | None = None
) -> list[Stage]:
    """Returns the stages of one split, from identification to report.

    Args:
        run: settings that `check_run` accepts.
        split: names of trials.
        shared: the folder of dataset.h5, relative to that of the split.
        acquired: fingerprint of the stage that wrote dataset.h5.
        workers: of the stages; those of the configuration if omitted.
    """
    split_stages = SplitStages(
        run, split, shared, acquired, workers_of(run) if workers is None else workers
    )
    split_stages.identification()
    split_stages.learning()
    split_stages.evaluation()
    for key, place in FURTHER_STAGES.items():
        if getattr(run, key) is not None:
            function_at(place)(split_stages)
    return split_stages.with_report()


def prepare(run: RunSettings) -> None:
    """Checks a run, and configures Warp and torch for it.

    Raises:
        InputError: values that do not match the mesh or the trials.
    """
    start_quietly()
    os.environ.setdefault("WARP_RESPHYS_THREADS", str(min(torch.get_num_threads(), _MOST_THREADS)))
    if run.device == "cpu" or not torch.cuda.is_available():
        # The networks are too small for several threads (linalg/threads.py).
        torch.set_num_threads(1)
    own = own_run(run)
    check = check_run if own is None else function_at(own.check)
    check(run)


def acquire(run: RunSettings, folder: Path, wait: bool = False) -> tuple[list[Stage], str]:
    """Runs the stages that write dataset.h5; returns them, and the fingerprint of the last."""
    stages = acquisition_stages(run)
    if unfinished(stages, folder):
        # Torch's first optimiser imports it for a second, in which kernels are compiled.
        Thread(target=import_module, args=("torch._dynamo",)).start()
    run_stages(stages, folder, wait)
    (written,) = (stage.name for stage in stages if files.DATASET in stage.outputs)
    return stages, str(read_json(folder / "stages" / f"{written}.json")["fingerprint"])


def run_experiment(run: RunSettings, folder: Path) -> None:
    """Runs the stages that have changed, writes metrics.json to the run folder
    and prints the errors.

    Raises:
        InputError: an invalid setting.
    """
    prepare(run)
    own = own_run(run)
    if own is not None:
        function_at(own.work)(run, folder)
        return
    if played := " and ".join(run.targets):
        log.info(
            "The %s is simulated as well: errors compare simulators, and no real robot", played
        )
    first, acquired = acquire(run, folder)
    folds = folds_of(run)
    if folds is None:
        stages = learning_stages(run, split_of(run), ".", acquired)
        _announce(unfinished(stages, folder), folder)
        run_stages(stages, folder)
        metrics = collect_metrics(folder, run, [stage.name for stage in (*first, *stages)])
    else:
        metrics = _run_folds(run, folder, folds, first, acquired)
    write_json(folder / files.METRICS, metrics)
    if folds is not None:
        errors = {trial: fold["errors_mm"] for trial, fold in metrics["folds"].items()}
        reported = StageSettings.reading(run, *RunSettings.model_fields, folds=errors)
        run_stages(
            [
                *first,
                Stage("report", make_folds_report, (files.REPORT,), reported, (first[-1].name,)),
            ],
            folder,
        )
    _print(metrics, folder, run)


def _announce(left: Sequence[Stage], folder: Path, times: float = 1.0) -> None:
    """Logs how long unfinished stages took the last time,
    if that is known of all and is more than a minute.

    Args:
        left: the stages.
        folder: of the split.
        times: factor of the duration, as of several folds.
    """
    took = {
        name: times * seconds
        for name, seconds in expected_seconds(left, folder).items()
        if name != "report"
    }
    if sum(took.values()) < _LEAST_SECONDS or not {stage.name for stage in left} <= {
        *took,
        "report",
    }:
        return
    longest = sorted(took, key=lambda name: -took[name])[:3]
    parts = ", ".join(f"{title_of(name)} {duration_text(took[name])}" for name in longest)
    log.info("About %s more, as the last time (%s)", duration_text(sum(took.values())), parts)


def _run_folds(
    run: RunSettings,
    folder: Path,
    splits: Mapping[str, Split],
    first: Sequence[Stage],
    acquired: str,
) -> Metrics:
    """Runs a cross-validation, each fold in its own folder; returns the content of metrics.json."""
    folds = {
        name: Fold(
            name,
            folder / files.fold_folder(name),
            partial(learning_stages, run, split, "..", acquired),
        )
        for name, split in splits.items()
    }
    left = [fold for fold in folds.values() if unfinished(fold.stages(ALONE), fold.folder)]
    if left:
        times = len(left) / workers_of(run).at_most(len(left)).count
        _announce(left[0].stages(ALONE), left[0].folder, times)
    run_folds(folds, workers_of(run))
    metrics = dict[str, Metrics]()
    for name, fold in folds.items():
        metrics[name] = collect_metrics(
            fold.folder, run, [stage.name for stage in fold.stages(ALONE)]
        )
        write_json(fold.folder / files.METRICS, metrics[name])
    over_folds: Metrics = {
        "errors_mm": summarise_folds([of_fold["errors_mm"] for of_fold in metrics.values()]),
        "folds": metrics,
        **resources_used(folder, [stage.name for stage in first]),
        "versions": package_versions(),
        "device": str(choose_device(run.device)),
    }
    if (intervals := intervals_of_folds(folder, {n: fold.folder for n, fold in folds.items()}))[
        "models"
    ]:
        over_folds["intervals"] = intervals
    over_folds["recommended"] = recommended(over_folds, run)
    return over_folds


def _print(metrics: Metrics, folder: Path, run: RunSettings) -> None:
    """Prints what the report begins with: the mean errors,
    the verdict, the advice and the conditions.
    """
    metrics = shown_metrics(metrics)
    tables = [results_table(metrics, run)]
    tables += [tracking_table(metrics["control"]["tracking"])] if "control" in metrics else []
    tables += [shapes_table(metrics["shapes"])] if "shapes" in metrics else []
    holds = [f"- {line}" for line in conditions(metrics, run)]
    show(*tables, *verdict(metrics, run), *holds, f"Report: {folder / files.REPORT}")
