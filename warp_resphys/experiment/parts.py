"""Trials through time, in one process or several: what is done is not done again, however a run ends.

A stage splits its trials into parts. Each part is a `March`: frame by frame it writes to a journal, and every few
seconds it keeps the state that the next frame goes on from.
"""

import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from ..io.errors import InputError
from ..io.fan_out import Advance, Workers, fan_out
from ..io.files import read_array, read_hdf5
from ..io.machine import available_cores
from ..io.progress import Progress
from ..io.resumable import Field, ResumableHDF5, forget_checkpoint, keep_checkpoint, resume_checkpoint
from ..io.stages import StageContext
from ..stepping.state import State
from .build import simulation_device

_KEEP_SECONDS = 10.0


class March(ABC):
    """Some trials, frame by frame.

    Attributes:
        frames: how many there are.
        fields: what is kept of each.
        like: a tensor on the device of the trials.
        state: of the last frame.
        shown: beside the progress.
    """

    frames: int
    fields: Mapping[str, Field]
    like: torch.Tensor
    state: State
    shown: Mapping[str, object] = {}

    @abstractmethod
    def begin(self) -> State:
        """The state of the first frame."""

    @abstractmethod
    def step(self, number: int) -> State:
        """The state of a frame, from that of the one before."""

    @abstractmethod
    def kept(self, number: int) -> dict[str, ArrayLike]:
        """What is kept of a frame."""

    def constants(self) -> dict[str, tuple[ArrayLike, str]]:
        """What is kept beside the frames, with units."""
        return {}

    def frame(self, number: int) -> dict[str, ArrayLike]:
        """Goes on to a frame; what is kept of it."""
        with torch.no_grad():
            self.state = self.begin() if number == 0 else self.step(number)
            return self.kept(number)

    def snapshot(self) -> dict[str, torch.Tensor]:
        """What the next frame goes on from; none of it is changed in place."""
        return self.state.tensors()

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Goes back to a `snapshot`."""
        self.state = State.from_tensors(tensors).map(lambda each: each.to(self.like))


@dataclass(frozen=True)
class Part:
    """Some of the trials of a stage.

    Attributes:
        context: of the stage.
        names: of the trials.
        path: the file with what was made of them.
        frames: of a trial.
        more: what else the function is told.
    """

    context: StageContext
    names: tuple[str, ...]
    path: Path
    frames: int
    more: Any = None

    def write(self, motion: March, advance: Advance) -> None:
        """Writes the part's file, from where an interrupted march was; tells of the frames that are done."""
        fingerprint, each = self.context.fingerprint, len(self.names)
        checkpoint = self.path.with_name(f"{self.path.stem}.state.safetensors")
        with ResumableHDF5(self.path, self.context.name, fingerprint, motion.frames, motion.fields) as file:
            if file.done == file.steps:
                advance(each * file.done)
            else:
                found = resume_checkpoint(checkpoint, "state", fingerprint)
                done = 0 if found is None else int(found[1]["done"])
                file.rewind(done if done <= file.done else 0)
                if found is not None and file.done:
                    motion.restore(found[0])
                advance(each * file.done)
                kept = following = (motion.snapshot() if file.done else {}, file.done)
                saved = time.monotonic()

                def keep() -> None:
                    tensors, frames = following if file.done == following[1] else kept
                    if 0 < frames < file.steps:
                        keep_checkpoint(checkpoint, "state", tensors, {"done": frames, "fingerprint": fingerprint})

                try:
                    while file.done < file.steps:
                        arrays = motion.frame(file.done)
                        following = (motion.snapshot(), file.done + 1)
                        file.append(**arrays)
                        kept = following
                        if time.monotonic() - saved > _KEEP_SECONDS:
                            keep()
                            saved = time.monotonic()
                        advance(each, **motion.shown)
                finally:
                    keep()
            file.finish(constants=motion.constants())
        forget_checkpoint(checkpoint)

    def read(self, name: str) -> NDArray[Any]:
        """An array of its file."""
        with read_hdf5(self.path, self.context.name) as file:
            return read_array(file, name)

    @property
    def done(self) -> bool:
        """Whether its file was made from the same settings."""
        if not self.path.is_file():
            return False
        with read_hdf5(self.path, self.context.name) as file:
            return str(file.attrs.get("fingerprint")) == self.context.fingerprint


def split_into_parts(
    context: StageContext, names: Sequence[str], frames: int, label: str = "part", more: Any = None
) -> list[Part]:
    """Parts of at most as many trials as the stage simulates at once (``batch``); all of them, if that is not set.

    Args:
        context: of the stage.
        names: of the trials.
        frames: of a trial.
        label: that the files' names begin with.
        more: see `Part`.
    """
    folder, size = _folder(context), context.settings.get("batch") or len(names)
    return [
        Part(context, tuple(names[first : first + size]), folder / f"{label}_{first:03d}.h5", frames, more)
        for first in range(0, len(names), size)
    ]


def _folder(context: StageContext) -> Path:
    """Where a stage keeps its parts until it is done."""
    return context.run_dir / f"{context.name}_parts"


def workers_for(config: Mapping[str, Any], wanted: int | None) -> Workers:
    """As many as wanted; if that is not said, one a core, but one for all where a GPU simulates.

    Raises:
        InputError: a cluster without a number of workers, or that cannot simulate on the device.
    """
    backend = config["parallel"]["backend"]
    if backend != "local" and wanted is None:
        raise InputError(f"parallel.processes is null: say how many workers of the {backend} cluster are to be used.")
    if backend == "ray" and simulation_device(config).type != "cpu":
        raise InputError(
            "parallel.backend is ray, which hands out CPUs here: choose device=cpu, or parallel.backend=dask."
        )
    if wanted is None:
        wanted = available_cores() if simulation_device(config).type == "cpu" else 1
    return Workers(wanted, backend, config["parallel"]["address"])


def work_on(parts: Sequence[Part], function: Callable[[Part], March], workers: Workers) -> None:
    """Marches through those parts that are not done yet.

    Args:
        parts: each with its own file.
        function: makes the march of a part; defined at the top of a module.
        workers: that share them.

    Raises:
        ConvergenceError, WorkerError: a part could not be done.
        DataFileError: a part could not be written.
    """
    left = [part for part in parts if not part.done]
    total, missing = (sum(part.frames * len(part.names) for part in some) for some in (parts, left))
    with Progress(parts[0].context.name, total, "frames", total - missing) as progress:
        if workers.alone or (workers.backend == "local" and len(parts) == 1):
            with threadpool_limits(1):  # As in a worker process: the same numbers, however many there are.
                for part in left:
                    part.write(function(part), progress.advance)
            return
        work, crew, first = partial(_quietly, function), workers.at_most(len(left)), parts[0]
        with closing(fan_out(work, left, crew, progress.advance, first.path.parent, first.context.memory)) as results:
            for _ in results:
                pass


def _quietly(function: Callable[[Part], March], part: Part, advance: Advance) -> None:
    part.write(function(part), lambda count=1, **shown: advance(count))


def read_parts(parts: Sequence[Part], name: str) -> NDArray[Any]:
    """The (R, T, ...) arrays of that name of all parts; those with fewer frames are padded with NaN."""
    return padded([part.read(name) for part in parts])


def padded(found: Sequence[NDArray[Any]], frames: int = 0) -> NDArray[Any]:
    """Arrays (R, T, ...) one after the other, with as many frames as the longest, or more: NaN past their ends."""
    frames = max(frames, *(each.shape[1] for each in found))
    ends = [[(0, 0), (0, frames - each.shape[1]), *[(0, 0)] * (each.ndim - 2)] for each in found]
    return np.concatenate(
        [np.pad(x, w, constant_values=np.nan) if any(map(any, w)) else x for x, w in zip(found, ends, strict=True)]
    )


def remove_parts(context: StageContext) -> None:
    """Removes what is no longer needed when a stage is done."""
    shutil.rmtree(_folder(context), ignore_errors=True)
