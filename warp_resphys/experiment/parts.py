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

from ..dynamics.integrator import State
from ..io.files import read_array, read_hdf5
from ..io.processes import Advance, available_cores, in_processes
from ..io.progress import Progress
from ..io.resumable import Field, ResumableHDF5, forget_checkpoint, keep_checkpoint, resume_checkpoint
from ..io.stages import StageContext
from .build import choose_device

_KEEP_SECONDS = 10.0


class March(ABC):
    """Some trials, frame by frame.

    Attributes:
        frames: how many there are.
        fields: what is kept of each.
    """

    frames: int
    fields: Mapping[str, Field]

    @abstractmethod
    def frame(self, number: int) -> tuple[dict[str, ArrayLike], dict[str, object]]:
        """Goes on to a frame, from the one before; what is kept of it, and what is shown beside the progress."""

    @abstractmethod
    def snapshot(self) -> dict[str, torch.Tensor]:
        """What the next frame goes on from; none of it is changed in place."""

    @abstractmethod
    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Goes back to a `snapshot`."""

    def constants(self) -> dict[str, tuple[ArrayLike, str]]:
        """What is kept beside the frames, with units."""
        return {}


def pack(state: State) -> dict[str, torch.Tensor]:
    """A state as tensors by name."""
    back = {} if state.previous is None else dict(zip(("previous_q", "previous_v"), state.previous, strict=True))
    return {"q": state.q, "v": state.v, **back}


def unpack(tensors: Mapping[str, torch.Tensor], like: torch.Tensor) -> State:
    """The state that `pack` took apart, on the device of a tensor."""
    found = {name: tensors[name].to(like) for name in ("q", "v", "previous_q", "previous_v") if name in tensors}
    previous = (found["previous_q"], found["previous_v"]) if "previous_q" in found else None
    return State(found["q"], found["v"], previous)


def march(
    path: Path,
    kind: str,
    fingerprint: str,
    motion: March,
    advance: Advance,
    each: int = 1,
    attributes: Mapping[str, Any] | None = None,
    constants: Mapping[str, tuple[ArrayLike, str]] | None = None,
) -> None:
    """Writes the file of a march, from where an interrupted one was.

    Args:
        path: the file.
        kind: of its content.
        fingerprint: of all that it depends on.
        motion: the march.
        advance: told of frames that are done.
        each: times that a frame counts.
        attributes: of the file.
        constants: arrays with units that do not depend on the frame.
    """
    checkpoint = path.with_name(f"{path.stem}.state.safetensors")
    with ResumableHDF5(path, kind, fingerprint, motion.frames, motion.fields) as file:
        if file.done < file.steps:
            found = resume_checkpoint(checkpoint, "state", fingerprint)
            done = 0 if found is None else int(found[1]["done"])
            file.rewind(done if found is not None and done <= file.done else 0)
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
                    arrays, shown = motion.frame(file.done)
                    following = (motion.snapshot(), file.done + 1)
                    file.append(**arrays)
                    kept = following
                    if time.monotonic() - saved > _KEEP_SECONDS:
                        keep()
                        saved = time.monotonic()
                    advance(each, **shown)
            finally:
                keep()
        file.finish(attributes, motion.constants() if constants is None else constants)
    forget_checkpoint(checkpoint)


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

    def march(self, motion: March, advance: Advance) -> None:
        """Writes the part's file."""
        march(self.path, self.context.name, self.context.fingerprint, motion, advance, len(self.names))

    @property
    def done(self) -> bool:
        """Whether its file was made from the same settings."""
        if not self.path.is_file():
            return False
        with read_hdf5(self.path, self.context.name) as file:
            return str(file.attrs.get("fingerprint")) == self.context.fingerprint


def split_into_parts(
    context: StageContext, names: Sequence[str], batch: int | None, frames: int, label: str = "part", more: Any = None
) -> list[Part]:
    """Parts of at most so many trials.

    Args:
        context: of the stage.
        names: of the trials.
        batch: most trials of a part; None for one part.
        frames: of a trial.
        label: that the files' names begin with.
        more: see `Part`.
    """
    folder, size = _folder(context), len(names) if batch is None else batch
    return [
        Part(context, tuple(names[first : first + size]), folder / f"{label}_{first:03d}.h5", frames, more)
        for first in range(0, len(names), size)
    ]


def _folder(context: StageContext) -> Path:
    """Where a stage keeps its parts until it is done."""
    return context.run_dir / f"{context.name}_parts"


def processes_for(settings: Mapping[str, Any]) -> int:
    """Worker processes: as many as configured; one a core, but one for all where a GPU simulates."""
    wanted = settings["parallel"]["processes"]
    if wanted is not None:
        return int(wanted)
    device = "cpu" if settings["device"] == "auto" else settings["device"]
    return available_cores() if choose_device(device).type == "cpu" else 1


def work_on(parts: Sequence[Part], function: Callable[[Part, Advance], None], processes: int) -> None:
    """Works on those parts that are not done yet.

    Args:
        parts: each with its own file.
        function: of a part, and of what it calls with the frames that are done; defined at the top of a module.
        processes: at most so many at once.

    Raises:
        WorkerError: a part could not be done.
        DataFileError: a part could not be written.
    """
    left = [part for part in parts if not part.done]
    total, missing = (sum(part.frames * len(part.names) for part in some) for some in (parts, left))
    with Progress(parts[0].context.name, total, "frames", total - missing) as progress:
        if processes == 1 or len(parts) == 1:
            with threadpool_limits(1):  # As in a worker process: the same numbers, however many there are.
                for part in left:
                    function(part, progress.advance)
            return
        crew, memory = max(min(processes, len(left)), 1), parts[0].context.memory
        work = partial(_quietly, function)
        with closing(in_processes(work, left, crew, progress.advance, memory)) as results:
            for _ in results:
                pass


def _quietly(function: Callable[[Part, Advance], None], part: Part, advance: Advance) -> None:
    function(part, lambda count=1, **shown: advance(count))


def read_parts(parts: Sequence[Part], name: str) -> NDArray[Any]:
    """The arrays of that name of all parts, one after the other."""
    found = []
    for part in parts:
        with read_hdf5(part.path, part.context.name) as file:
            found.append(read_array(file, name))
    return np.concatenate(found)


def remove_parts(context: StageContext) -> None:
    """Removes what is no longer needed when a stage is done."""
    shutil.rmtree(_folder(context), ignore_errors=True)
