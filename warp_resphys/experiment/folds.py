"""The folds of a cross-validation, each with a folder, in parallel."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from ..data.trials import Trials
from ..io.arrays import FloatArray
from ..io.errors import InputError, ResphysError
from ..io.fan_out import ALONE, WorkerError, Workers, fan_out
from ..io.machine import available_cores
from ..io.progress import Progress
from ..io.resuming import Stage, StageInterrupted, run_stages, unfinished
from ..io.safe_files import read_array, read_hdf5
from ..learning.baselines import BASELINES
from ..learning.intervals import LEVEL, IntervalTable, ModelIntervals, intervals_of_each_other
from ..settings.run_keys import ParallelSettings
from .build import simulation_device
from .experiment import INTERVAL_MODELS
from .files import DATASET, ROLLOUTS

Stages = Callable[[Workers], list[Stage]]


def workers_for(parallel: ParallelSettings, wanted: int | None, device: str) -> Workers:
    """Returns the wanted number of workers.

    By default one per core on the CPU, and a single one on a GPU.

    Args:
        parallel: parallel settings of the run.
        wanted: number of processes, or None for the default.
        device: device of the simulation.

    Raises:
        InputError: a cluster without a number of workers.
    """
    on_cpu = simulation_device(device).type == "cpu"
    if parallel.address is not None and wanted is None:
        raise InputError(
            "parallel.processes is null: set the number of workers of the Dask cluster."
        )
    if wanted is None:
        wanted = available_cores() if on_cpu else 1
    return Workers(wanted, parallel.address)


@dataclass(frozen=True)
class Fold:
    """One fold of a cross-validation.

    Attributes:
        name: name of the trial that is left out.
        folder: folder of the fold's files.
        stages: makes the stages of the fold for given workers; can be sent to another process.
    """

    name: str
    folder: Path
    stages: Stages


def run_folds(folds: Mapping[str, Fold], workers: Workers) -> None:
    """Runs the folds that are not up to date, one per worker.

    A single remaining fold uses all workers.

    The results do not depend on the number of workers.

    Args:
        folds: by the trial that is left out.
        workers: share the folds.

    Raises:
        WorkerError: a fold failed; the other folds keep their results.
        StageInterrupted: Ctrl-C; all folds keep their results.
    """
    left = [fold for fold in folds.values() if unfinished(fold.stages(ALONE), fold.folder)]
    if workers.alone or len(left) <= 1:
        with threadpool_limits(1):
            for fold in left:
                run_stages(fold.stages(workers), fold.folder)
        return
    running = {fold.name for fold in left}
    folder = left[0].folder.parent
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with Progress("cross-validation", len(left), "folds") as progress:

            def finished(number: int) -> None:
                running.discard(left[number].name)
                progress.advance()

            fan_out(_run, left, workers.at_most(len(left)), folder, finished)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            f"interrupted before the folds {', '.join(sorted(running))} ended; all saved results "
            "are kept, and the same command resumes there"
        ) from error


def _run(fold: Fold) -> None:
    """Runs a fold in a worker process, which logs its stages."""
    logging.basicConfig(level=logging.INFO, format=f"fold {fold.name}: %(message)s", force=True)
    try:
        run_stages(fold.stages(ALONE), fold.folder)
    except ResphysError as error:
        raise WorkerError(f"fold {fold.name}: {error}") from error


def intervals_of_folds(folder: Path, folders: Mapping[str, Path]) -> IntervalTable:
    """Prediction intervals of a cross-validation.

    Each fold is calibrated on the test trials of the other folds.

    Args:
        folder: of the dataset.
        folders: folders of the folds, by the trial that a fold leaves out.
    """
    data = Trials.read(folder / DATASET)
    names = list(folders)
    models = dict[str, ModelIntervals]()
    for model in (
        (*BASELINES, *INTERVAL_MODELS) if data.bound is not None and len(names) > 2 else ()
    ):
        series: dict[str, list[FloatArray]] = {"observed": [], "spread": []}
        for fold in folders.values():
            with read_hdf5(fold / ROLLOUTS, "rollouts") as file:
                for key, rows in series.items():
                    rows += (
                        [read_array(file, f"{model}_{key}")[0]] if f"{model}_{key}" in file else []
                    )
        if len(series["observed"]) == len(names):
            spreads = series["spread"] if len(series["spread"]) == len(names) else None
            covered = intervals_of_each_other(data, names, series["observed"], spreads)
            if covered is not None:
                models[model] = covered
    return {"level": LEVEL, "calibrated_on": "folds", "models": models}
