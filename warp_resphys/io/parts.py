"""Work on trials in parts, in one process or several.

Interrupted work keeps its finished parts, each in a file.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from pickle import PicklingError
from typing import Any

import numpy as np
import torch
from joblib.hashing import NumpyHasher
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from .errors import DataFileError, InputError
from .fan_out import ALONE, Workers, fan_out
from .progress import Progress
from .safe_files import (
    atomic_hdf5,
    create,
    is_final,
    read_array,
    read_hdf5,
    resume_checkpoint,
    write_checkpoint,
)

Report = Callable[..., None]
Arrays = Mapping[str, tuple[NDArray[Any], str]]  # with their units
# Computes the arrays (R, ...) of a part; the argument is to be called after each frame, with named
# values that are displayed beside the progress bar. It is pickled for other processes.
Work = Callable[[Report], Arrays]


@dataclass(frozen=True)
class TrialPart:
    """Some trials of a piece of work.

    Attributes:
        label: name of the file.
        names: names of the R trials.
        frames: number of frames per trial that the progress bar expects; there may be a few more or
            less.
        work: computes the arrays.
    """

    label: str
    names: tuple[str, ...]
    frames: int
    work: Work

    def compute(self, advance: Callable[..., None]) -> Arrays:
        """Computes the arrays; `advance` counts the frames."""
        count, rolled = len(self.names), 0

        def report(**shown: object) -> None:
            nonlocal rolled
            rolled += 1
            advance(count if rolled <= self.frames else 0, **shown)

        with torch.no_grad():
            arrays = self.work(report)
        advance(count * max(self.frames - rolled, 0))
        return arrays


def cut(names: Sequence[str], most: int | None) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yields trials, at most some at a time, with the number of the first; None for all at once."""
    size = most or max(len(names), 1)
    for first in range(0, len(names), size):
        yield first, tuple(names[first : first + size])


class Parts:
    """The parts of a piece of work, with their arrays.

    Args:
        name: of the work, displayed beside the progress bar.
        workers: share the parts.
        folder: of the files of the parts; None keeps the arrays in memory.
        fingerprint: of all that the arrays depend on; files with another one are written again.
        batch: most trials of a part; None for no limit.
    """

    def __init__(
        self,
        name: str,
        workers: Workers = ALONE,
        folder: Path | None = None,
        fingerprint: str = "",
        batch: int | None = None,
    ) -> None:
        self.name, self.workers = name, workers
        self.folder, self.fingerprint = folder, fingerprint
        self.batch = batch
        self._kept: dict[TrialPart, Arrays] = {}

    def run(self, parts: Sequence[TrialPart]) -> None:
        """Computes the parts that are not done.

        Raises:
            ConvergenceError, WorkerError: a part could not be computed.
            DataFileError: a file could not be written.
        """
        left, workers = [part for part in parts if not self._is_done(part)], self.workers
        frames = [part.frames * len(part.names) for part in left]
        total = sum(part.frames * len(part.names) for part in parts)
        with Progress(self.name, total, "frames", total - sum(frames)) as progress:
            if workers.alone or (workers.address is None and len(parts) == 1):
                with threadpool_limits(1):  # As in worker processes, for the same results.
                    for part in left:
                        self._keep(part, part.compute(progress.advance))
                return
            if self.folder is not None:
                self.folder.mkdir(parents=True, exist_ok=True)
            shared, crew = self.folder or Path.cwd(), workers.at_most(len(left))
            # Without arrays.
            keeps = Parts(self.name, folder=self.folder, fingerprint=self.fingerprint)
            results = fan_out(
                partial(_compute, keeps),
                left,
                crew,
                shared,
                lambda at: progress.advance(frames[at]),
            )
            if self.folder is None:
                self._kept |= dict(zip(left, results, strict=True))

    def _is_done(self, part: TrialPart) -> bool:
        if self.folder is None:
            return part in self._kept
        return is_final(self._path(part), self.name, self.fingerprint)

    def _keep(self, part: TrialPart, arrays: Arrays) -> None:
        if self.folder is None:
            self._kept[part] = arrays
            return
        with atomic_hdf5(self._path(part), self.name, {"fingerprint": self.fingerprint}) as file:
            for name, (values, unit) in arrays.items():
                create(file, name, values, unit)

    def _path(self, part: TrialPart) -> Path:
        assert self.folder is not None
        return self.folder / f"{part.label}.h5"

    def read(self, part: TrialPart, name: str) -> NDArray[Any]:
        """Returns an array of a part.

        Raises:
            DataFileError: the file or the array is missing or damaged.
        """
        if self.folder is None:
            return self._kept[part][name][0]
        with read_hdf5(self._path(part), self.name) as file:
            return read_array(file, name)

    def joined(self, parts: Sequence[TrialPart], name: str, frames: int = 0) -> NDArray[Any]:
        """Returns an array of all parts, (R, T, ...), see `padded`."""
        return padded([self.read(part, name) for part in parts], frames)

    def remove(self) -> None:
        """Deletes the files of the parts."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


def _compute(parts: Parts, part: TrialPart) -> Arrays | None:
    """Computes a part in a worker process; returns its arrays where they have no file."""
    arrays = part.compute(lambda count=1, **shown: None)
    if parts.folder is None:
        return arrays
    parts._keep(part, arrays)
    return None


class Checkpoint:
    """Finished parts of some work, as JSON data in a file that is ignored if the work has changed.

    Args:
        path: of the file; None keeps the parts in memory.
        depends_on: all that the results depend on; objects are compared by their content.

    Attributes:
        parts: results of the finished parts by key.

    Raises:
        DataFileError: the path is that of a folder.
        InputError: the work depends on a class or function that is defined within a function.
    """

    def __init__(self, path: str | Path | None, *depends_on: object) -> None:
        self.parts: dict[str, Any] = {}
        self._path = None if path is None else Path(path)
        if self._path is not None:
            if self._path.is_dir():
                raise DataFileError(
                    f"{path} is a folder: give the path of a file for the finished searches."
                )
            try:
                self._fingerprint = _Hasher("md5").hash(depends_on)
            except PicklingError as error:
                raise InputError(
                    f"{path} cannot keep searches with a class or function that is no part of a "
                    f"module ({error.args[0]}): define it "
                    "at the top of a file, or leave kept out."
                ) from error
            checkpoint = resume_checkpoint(self._path, "parts", self._fingerprint)
            self.parts = {} if checkpoint is None else checkpoint[1]["parts"]

    def once(self, key: str, work: Callable[[], Any]) -> Any:
        """Returns the result of a part, which is worked on unless it was finished before."""
        if key not in self.parts:
            self.parts[key] = work()
            if self._path is not None:
                write_checkpoint(
                    self._path, "parts", {}, {"fingerprint": self._fingerprint, "parts": self.parts}
                )
        return self.parts[key]


class _Hasher(NumpyHasher):
    """Hashes objects by their content: tensors as arrays,
    and without what `cached_property` has kept.
    """

    def save(self, obj: Any) -> None:
        super().save(obj.numpy(force=True) if isinstance(obj, torch.Tensor) else obj)

    def reducer_override(self, obj: Any) -> Any:
        kept = [
            x
            for x in getattr(obj, "__dict__", ())
            if isinstance(getattr(type(obj), x, None), cached_property)
        ]
        if not kept:
            return NotImplemented
        return (
            object.__new__,
            (type(obj),),
            {name: x for name, x in obj.__getstate__().items() if name not in kept},
        )


def padded(arrays: Sequence[NDArray[Any]], frames: int = 0) -> NDArray[Any]:
    """Joins arrays (R, T, ...) along R, with at least `frames` frames:
    NaN past the end of shorter arrays.
    """
    frames = max(frames, *(array.shape[1] for array in arrays))

    def extended(array: NDArray[Any]) -> NDArray[Any]:
        missing = frames - array.shape[1]  # Integer arrays of full length keep their type.
        widths = [(0, 0), (0, missing), *[(0, 0)] * (array.ndim - 2)]
        return np.pad(array, widths, constant_values=np.nan) if missing else array

    return np.concatenate([extended(array) for array in arrays])
