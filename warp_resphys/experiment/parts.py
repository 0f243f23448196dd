"""Rolls trials out in parts, in one process or several; an interrupted stage keeps its finished parts.

A stage splits its trials into parts, with one file per part, and a function computes the arrays of a part. A
cross-validation runs its folds in parallel, with one folder per fold.
"""

import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ..io.errors import InputError, ResphysError
from ..io.fan_out import ALONE, WorkerError, Workers, fan_out
from ..io.files import atomic_hdf5, create, is_final, read_array, read_hdf5
from ..io.machine import available_cores
from ..io.progress import Progress
from ..io.stages import Stage, StageContext, StageInterrupted, run_stages, unfinished
from ..settings.run import ParallelSettings
from .build import simulation_device

Report = Callable[..., None]
Arrays = Mapping[str, tuple[NDArray[Any], str]]  # with their units
Stages = Callable[[Workers], list[Stage]]


@dataclass(frozen=True)
class TrialPart:
    """A subset of the trials of a stage, with the file that holds their results.

    Attributes:
        context: context of the stage.
        names: names of the trials.
        path: path of the file.
        frames: number of frames per trial that the progress bar expects; the roll-out may have a few more or less.
        more: further arguments for the function that computes it.
    """

    context: StageContext
    names: tuple[str, ...]
    path: Path
    frames: int
    more: Any = None

    def write(self, work: "Work", advance: Callable[..., None]) -> None:
        """Computes the arrays and writes the file, unless it is done; `advance` counts the frames."""
        count, rolled = len(self.names), 0
        if self.done:
            advance(count * self.frames)
            return

        def report(**shown: object) -> None:
            nonlocal rolled
            rolled += 1
            advance(count if rolled <= self.frames else 0, **shown)

        with torch.no_grad():
            arrays = work(self, report)
        advance(count * max(self.frames - rolled, 0))
        with atomic_hdf5(self.path, self.context.name, {"fingerprint": self.context.fingerprint}) as file:
            for name, (values, unit) in arrays.items():
                create(file, name, values, unit)

    def read(self, name: str) -> NDArray[Any]:
        """Reads an array of the file.

        Raises:
            DataFileError: the file or the array is missing or damaged.
        """
        with read_hdf5(self.path, self.context.name) as file:
            return read_array(file, name)

    @property
    def done(self) -> bool:
        """Whether a complete file made from the same settings exists."""
        return is_final(self.path, self.context.name, self.context.fingerprint)


# Computes the arrays (R, ...) of a part; the second argument is to be called after each frame, with named values that
# are displayed beside the progress bar. A top-level function, so that it can be pickled.
Work = Callable[[TrialPart, Report], Arrays]


def split_into_parts(
    context: StageContext,
    names: Sequence[str],
    frames: int,
    label: str = "part",
    more: Any = None,
    batch: int | None = None,
) -> list[TrialPart]:
    """Splits trials of a stage into parts.

    Args:
        context: context of the stage.
        names: names of the trials.
        frames: number of frames per trial.
        label: prefix of the file names.
        more: further arguments, see `TrialPart`.
        batch: maximum number of trials per part; by default there is one part.
    """
    folder, size = _folder(context), batch or len(names)
    return [
        TrialPart(context, tuple(names[first : first + size]), folder / f"{label}_{first:03d}.h5", frames, more)
        for first in range(0, len(names), size)
    ]


def _folder(context: StageContext) -> Path:
    """Folder of a stage's parts while the stage runs."""
    return context.run_dir / f"{context.name}_parts"


def workers_for(parallel: ParallelSettings, wanted: int | None, device: str) -> Workers:
    """Returns the wanted number of workers; by default one per core on the CPU, and a single one on a GPU.

    Args:
        parallel: parallel settings of the run.
        wanted: number of processes, or None for the default.
        device: device of the simulation.

    Raises:
        InputError: a cluster without a number of workers.
    """
    on_cpu = simulation_device(device).type == "cpu"
    if parallel.address is not None and wanted is None:
        raise InputError("parallel.processes is null: set the number of workers of the Dask cluster.")
    if wanted is None:
        wanted = available_cores() if on_cpu else 1
    return Workers(wanted, parallel.address)


def work_on(parts: Sequence[TrialPart], work: Work, workers: Workers) -> None:
    """Computes the parts that are not done yet and writes their files.

    Args:
        parts: parts of one stage.
        work: computes a part.
        workers: workers that share the parts.

    Raises:
        ConvergenceError, WorkerError: a part could not be computed.
        DataFileError: a file could not be written.
    """
    left, first = [part for part in parts if not part.done], parts[0]
    total, missing = (sum(part.frames * len(part.names) for part in subset) for subset in (parts, left))
    with Progress(first.context.name, total, "frames", total - missing) as progress:
        if workers.alone or (workers.address is None and len(parts) == 1):
            with threadpool_limits(1):  # As in worker processes, for the same results.
                for part in left:
                    part.write(work, progress.advance)
        else:
            first.path.parent.mkdir(parents=True, exist_ok=True)
            frames = [part.frames * len(part.names) for part in left]
            crew = workers.at_most(len(left))
            fan_out(partial(_write, work), left, crew, first.path.parent, lambda at: progress.advance(frames[at]))


def _write(work: Work, part: TrialPart) -> None:
    part.write(work, lambda count=1, **shown: None)


def read_parts(parts: Sequence[TrialPart], name: str, frames: int = 0) -> NDArray[Any]:
    """Reads an array from all parts and joins them, (R, T, ...), see `padded`."""
    return padded([part.read(name) for part in parts], frames)


def padded(arrays: Sequence[NDArray[Any]], frames: int = 0) -> NDArray[Any]:
    """Joins arrays (R, T, ...) along R, with at least `frames` frames: NaN past the end of shorter arrays."""
    frames = max(frames, *(array.shape[1] for array in arrays))

    def extended(array: NDArray[Any]) -> NDArray[Any]:
        missing = frames - array.shape[1]  # Integer arrays of full length keep their type.
        widths = [(0, 0), (0, missing), *[(0, 0)] * (array.ndim - 2)]
        return np.pad(array, widths, constant_values=np.nan) if missing else array

    return np.concatenate([extended(array) for array in arrays])


def remove_parts(context: StageContext) -> None:
    """Deletes the files of a stage's parts."""
    shutil.rmtree(_folder(context), ignore_errors=True)


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
            f"interrupted before the folds {', '.join(sorted(running))} ended; all saved results are kept, and the "
            "same command resumes there"
        ) from error


def _run(fold: Fold) -> None:
    """Runs a fold in a worker process, which logs its stages."""
    logging.basicConfig(level=logging.INFO, format=f"fold {fold.name}: %(message)s", force=True)
    try:
        run_stages(fold.stages(ALONE), fold.folder)
    except ResphysError as error:
        raise WorkerError(f"fold {fold.name}: {error}") from error
