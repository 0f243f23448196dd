"""Cross-validation: runs the folds of an experiment in parallel, with one folder per fold."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from ..io.errors import ResphysError
from ..io.fan_out import ALONE, Advance, WorkerError, Workers, fan_out
from ..io.progress import Progress
from ..io.stages import Stage, StageInterrupted, run_stages, up_to_date

Stages = Callable[[Workers], list[Stage]]


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
    """Runs the folds that are not up to date, one per worker; a single remaining fold uses all workers.

    The results do not depend on the number of workers.

    Args:
        folds: by the trial that is left out.
        workers: share the folds.

    Raises:
        WorkerError: a fold failed; the other folds keep their results.
        StageInterrupted: Ctrl-C; all folds keep their results.
    """
    left = [fold for fold in folds.values() if not up_to_date(fold.stages(ALONE), fold.folder)]
    if workers.alone or len(left) <= 1:
        with threadpool_limits(1):
            for fold in left:
                run_stages(fold.stages(workers), fold.folder)
        return
    total = sum(len(fold.stages(ALONE)) for fold in left)
    running: dict[str, str] = {}

    def advance(count: int, name: str = "", stage: str = "") -> None:
        if stage:
            running[name] = f"{name}: {stage}"
        else:
            running.pop(name, None)
        progress.advance(count, now=", ".join(running.values()))

    try:
        with Progress(f"{len(left)} folds", total, "stages") as progress:
            fan_out(_run, left, workers.at_most(len(left)), advance, left[0].folder.parent)
    except KeyboardInterrupt as error:
        raise StageInterrupted(
            f"interrupted in the folds {', '.join(running)}; all saved results are kept, and "
            "the same command resumes there"
        ) from error


def _run(fold: Fold, advance: Advance) -> None:
    """Runs a fold in a worker process; calls `advance` at the beginning of every stage."""
    logging.basicConfig(level=logging.WARNING, format=f"fold {fold.name}: %(message)s", force=True)
    counts = iter([0])
    try:
        run_stages(
            fold.stages(ALONE), fold.folder, begins=lambda stage: advance(next(counts, 1), name=fold.name, stage=stage)
        )
    except ResphysError as error:
        raise WorkerError(f"fold {fold.name}: {error}") from error
    advance(1, name=fold.name, stage="")
