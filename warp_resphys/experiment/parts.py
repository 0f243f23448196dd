"""Trials rolled out frame by frame, in one process or several; an interrupted run goes on where it was.

A stage splits its trials into parts, each with a file of its own. A `ResumableRollout` computes the frames of a part,
and `io.resumable.ResumableHDF5` keeps them with the state that the next frame goes on from.
"""

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
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
from ..io.resumable import Field, ResumableHDF5, is_final
from ..io.stages import StageContext
from ..settings.run import ParallelSettings
from ..stepping.state import State
from .build import simulation_device


class ResumableRollout(ABC):
    """Computes some trials frame by frame.

    Attributes:
        frames: number of frames.
        fields: the arrays of a frame that go to the file.
        like: a tensor of the type and on the device of the trials.
        state: of the last frame.
        shown: named values to show beside the progress.
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
        """The arrays of a frame, which is that of `state`, for the file."""

    def constants(self) -> dict[str, tuple[ArrayLike, str]]:
        """Arrays that do not depend on the frame, with units, for the file."""
        return {}

    def frame(self, number: int) -> dict[str, ArrayLike]:
        """Computes a frame from the one before; returns its arrays for the file."""
        with torch.no_grad():
            self.state = self.begin() if number == 0 else self.step(number)
            return self.kept(number)

    def snapshot(self) -> dict[str, torch.Tensor]:
        """Tensors that the next frame goes on from; they are not changed in place."""
        return self.state.tensors()

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Goes back to a `snapshot`."""
        self.state = State.from_tensors(tensors).map(lambda each: each.to(self.like))


@dataclass(frozen=True)
class TrialPart:
    """Some of the trials of a stage, and their file.

    Attributes:
        context: of the stage.
        names: of the trials.
        path: of the file.
        frames: number of frames of a trial.
        more: further arguments for what makes the roll-out.
    """

    context: StageContext
    names: tuple[str, ...]
    path: Path
    frames: int
    more: Any = None

    def write(self, make: "Callable[[TrialPart], ResumableRollout]", advance: Advance) -> None:
        """Computes the frames from where an interrupted run was, and writes the file; `advance` counts the frames."""
        count = len(self.names)
        if self.done:
            advance(count * self.frames)
            return
        rollout = make(self)
        arguments = self.path, self.context.name, self.context.fingerprint, rollout.frames, rollout.fields
        with ResumableHDF5(*arguments) as file:
            if file.done:
                rollout.restore(file.state)
            advance(count * file.done)
            while file.done < file.frames:
                arrays = rollout.frame(file.done)
                file.append(rollout.snapshot(), **arrays)
                advance(count, **rollout.shown)
            file.finish(rollout.constants())

    def read(self, name: str) -> NDArray[Any]:
        """An array of the file.

        Raises:
            DataFileError: the file or the array is missing or damaged.
        """
        with read_hdf5(self.path, self.context.name) as file:
            return read_array(file, name)

    @property
    def done(self) -> bool:
        """Whether the file is there, made from the same settings."""
        return is_final(self.path, self.context.name, self.context.fingerprint)


def split_into_parts(
    context: StageContext,
    names: Sequence[str],
    frames: int,
    label: str = "part",
    more: Any = None,
    batch: int | None = None,
) -> list[TrialPart]:
    """Parts of some trials of a stage.

    Args:
        context: of the stage.
        names: of the trials.
        frames: of a trial.
        label: that the files' names begin with.
        more: see `TrialPart`.
        batch: trials of a part, at most; all of them, if left out.
    """
    folder, size = _folder(context), batch or len(names)
    return [
        TrialPart(context, tuple(names[first : first + size]), folder / f"{label}_{first:03d}.h5", frames, more)
        for first in range(0, len(names), size)
    ]


def _folder(context: StageContext) -> Path:
    """Where a stage keeps its parts until it is done."""
    return context.run_dir / f"{context.name}_parts"


def workers_for(parallel: ParallelSettings, wanted: int | None, device: str) -> Workers:
    """As many as wanted; if that is not said, one a core, but one for all where a GPU simulates.

    Args:
        parallel: of the run.
        wanted: number of processes.
        device: of the simulation.

    Raises:
        InputError: a cluster without a number of workers, or that cannot simulate on the device.
    """
    on_cpu = simulation_device(device).type == "cpu"
    if parallel.backend != "local" and wanted is None:
        raise InputError(
            f"parallel.processes is null: say how many workers of the {parallel.backend} cluster are to be used."
        )
    if parallel.backend == "ray" and not on_cpu:
        raise InputError(
            "parallel.backend is ray, which hands out CPUs here: choose device=cpu, or parallel.backend=dask."
        )
    if wanted is None:
        wanted = available_cores() if on_cpu else 1
    return Workers(wanted, parallel.backend, parallel.address)


def work_on(parts: Sequence[TrialPart], make: Callable[[TrialPart], ResumableRollout], workers: Workers) -> None:
    """Computes those parts that are not done yet, and writes their files.

    Args:
        parts: of one stage.
        make: makes the roll-out of a part; defined at the top of a module.
        workers: that share the parts.

    Raises:
        ConvergenceError, WorkerError: a part could not be computed.
        DataFileError: a file could not be written.
    """
    left, first = [part for part in parts if not part.done], parts[0]
    total, missing = (sum(part.frames * len(part.names) for part in some) for some in (parts, left))
    with Progress(first.context.name, total, "frames", total - missing) as progress:
        if workers.alone or (workers.backend == "local" and len(parts) == 1):
            with threadpool_limits(1):  # As in a worker process: the same numbers, however many there are.
                for part in left:
                    part.write(make, progress.advance)
        else:
            crew, memory = workers.at_most(len(left)), first.context.memory
            fan_out(partial(_write, make), left, crew, progress.advance, first.path.parent, memory)


def _write(make: Callable[[TrialPart], ResumableRollout], part: TrialPart, advance: Advance) -> None:
    part.write(make, lambda count=1, **shown: advance(count))


def read_parts(parts: Sequence[TrialPart], name: str) -> NDArray[Any]:
    """The arrays (R, T, ...) of a name in all parts, one after the other; NaN past the end of shorter ones."""
    return padded([part.read(name) for part in parts])


def padded(found: Sequence[NDArray[Any]], frames: int = 0) -> NDArray[Any]:
    """Joins arrays (R, T, ...) along R, with as many frames as the longest has, or more: NaN past their ends."""
    frames = max(frames, *(each.shape[1] for each in found))
    ends = [[(0, 0), (0, frames - each.shape[1]), *[(0, 0)] * (each.ndim - 2)] for each in found]
    return np.concatenate(
        [np.pad(x, w, constant_values=np.nan) if any(map(any, w)) else x for x, w in zip(found, ends, strict=True)]
    )


def remove_parts(context: StageContext) -> None:
    """Removes the files of a stage's parts."""
    shutil.rmtree(_folder(context), ignore_errors=True)
