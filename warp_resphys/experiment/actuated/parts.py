"""Trials in several processes: each works on a few of them at once; what is done is not done again."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ...io.files import atomic_hdf5, create, read_array, read_hdf5
from ...io.processes import Advance, available_cores, in_processes
from ...io.progress import Progress
from ...io.stages import StageContext
from ..build import choose_device

Made = tuple[NDArray[Any], str]  # an array and its units
_KIND = "part"


@dataclass(frozen=True)
class Part:
    """Some of the trials of a stage.

    Attributes:
        context: of the stage.
        names: of the trials.
        path: the file with what was made of them.
        more: what else the function is told.
    """

    context: StageContext
    names: tuple[str, ...]
    path: Path
    more: Any = None


def parts_folder(context: StageContext) -> Path:
    """Where a stage keeps its parts until it is done."""
    return context.run_dir / f"{context.name}_parts"


def split_into_parts(
    context: StageContext, names: Sequence[str], batch: int, label: str = "part", more: Any = None
) -> list[Part]:
    """Parts of at most so many trials.

    Args:
        context: of the stage.
        names: of the trials.
        batch: most trials of a part.
        label: that the files' names begin with.
        more: see `Part`.
    """
    folder = parts_folder(context)
    return [
        Part(context, tuple(names[first : first + batch]), folder / f"{label}_{first:03d}.h5", more)
        for first in range(0, len(names), batch)
    ]


def processes_for(settings: Any) -> int:
    """Worker processes: as many as configured; one a core, but one for all where a GPU simulates."""
    wanted = settings["parallel"]["processes"]
    if wanted is not None:
        return int(wanted)
    device = "cpu" if settings["device"] == "auto" else settings["device"]
    return available_cores() if choose_device(device).type == "cpu" else 1


def work_on(
    parts: Sequence[Part], function: Callable[[Part, Advance], Mapping[str, Made]], processes: int, steps: int
) -> None:
    """Works on those parts that have no file yet.

    Args:
        parts: each with its own file.
        function: of a part, and of what it calls with the steps that are done; returns what is to be written, with
            units; defined at the top of a module.
        processes: at most so many at once.
        steps: of a trial.

    Raises:
        WorkerError: a part could not be done.
        DataFileError: a part could not be written.
    """
    left = [part for part in parts if not _is_done(part)]
    total, missing = (steps * sum(len(part.names) for part in some) for some in (parts, left))
    with Progress(parts[0].context.name, total, "steps", total - missing) as progress:
        work = partial(_work_on_one, function)
        if processes == 1:
            with threadpool_limits(1):  # As in a worker process: the same numbers, however many there are.
                for part in left:
                    work(part, progress.advance)
            return
        crew, memory = max(min(processes, len(left)), 1), parts[0].context.memory
        with closing(in_processes(work, left, crew, progress.advance, memory)) as results:
            for _ in results:
                pass


def _work_on_one(function: Callable[[Part, Advance], Mapping[str, Made]], part: Part, advance: Advance) -> None:
    made = function(part, advance)
    part.path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_hdf5(part.path, _KIND, {"names": list(part.names), "fingerprint": part.context.fingerprint}) as file:
        for name, (values, unit) in made.items():
            create(file, name, values, unit)


def _is_done(part: Part) -> bool:
    """Whether a part's file was made from the same settings."""
    if not part.path.is_file():
        return False
    with read_hdf5(part.path, _KIND) as file:
        return str(file.attrs.get("fingerprint")) == part.context.fingerprint


def read_parts(parts: Sequence[Part], name: str) -> NDArray[Any]:
    """The arrays of that name of all parts, one after the other."""
    found = []
    for part in parts:
        with read_hdf5(part.path, _KIND) as file:
            found.append(read_array(file, name))
    return np.concatenate(found)


def remove_parts(context: StageContext) -> None:
    """Removes what is no longer needed when a stage is done."""
    shutil.rmtree(parts_folder(context), ignore_errors=True)
