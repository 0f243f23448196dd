"""Datasets that are computed step by step and survive any interruption.

The steps go to a journal beside the final file: a header that says what is being computed, then one record a
step, appended with a checksum. A record that was cut short by a kill, a crash or a full disk does not match
its checksum and is computed again; all whole ones are kept. The finished journal is turned into an HDF5 file
and removed.
"""

from __future__ import annotations

import json
import logging
import math
import os
import struct
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .errors import DataFileError
from .files import (
    atomic_hdf5,
    create,
    disk_full_error,
    is_disk_full,
    read_array,
    read_checkpoint,
    read_hdf5,
    write_checkpoint,
)

if TYPE_CHECKING:
    import h5py
    import torch

log = logging.getLogger(__name__)

_SYNC_SECONDS = 2.0
_CHECKSUM = struct.Struct("<I")


@dataclass(frozen=True)
class Field:
    """One array of every step.

    Attributes:
        shape: Its shape in one step; () for a number.
        units: SI units, stored beside the dataset; "1" for numbers without a unit.
        dtype: NumPy's name of its type.
        batch_axes: How many of its leading axes stand before the axes that count steps in the final dataset:
            with 1, steps of (B, N, 3) become (B, T, N, 3), with 0 they become (T, B, N, 3).
    """

    shape: tuple[int, ...]
    units: str
    dtype: str = "float64"
    batch_axes: int = 0


class ResumableHDF5:
    """An HDF5 file that is computed one step (a frame, a trajectory, ...) at a time.

    Use it as a context manager. `done` says how many steps an earlier, interrupted run left; go on from
    there::

        with ResumableHDF5(path, "forces", fingerprint, (trajectories, frames), fields) as file:
            for step in range(file.done, file.steps):
                trajectory, frame = divmod(step, frames)
                file.append(forces=...)
            file.finish()

    Work that belongs to another fingerprint, or to other fields, is discarded. An existing file at `path`
    stays in place until `finish` replaces it; if it is already the one asked for, all steps are done.
    """

    def __init__(
        self,
        path: str | Path,
        kind: str,
        fingerprint: str,
        steps: int | tuple[int, ...],
        fields: Mapping[str, Field],
    ) -> None:
        """Describes the file; nothing is opened before the `with` block.

        Args:
            path: Where the final HDF5 file is to appear.
            kind: What the file holds, as for `files.atomic_hdf5`.
            fingerprint: Identifies the inputs of the computation; steps of another fingerprint are not used.
            steps: Number of steps, or the lengths of nested loops over them, the last one running fastest.
            fields: The arrays of one step by name.
        """
        self.path = Path(path)
        self.kind = kind
        self.fingerprint = fingerprint
        self.step_axes = (steps,) if isinstance(steps, int) else tuple(steps)
        self.steps = math.prod(self.step_axes)
        self.fields = dict(fields)
        self.done = 0
        self.journal = self.path.with_name(self.path.name + ".journal")
        layout = {name: [f.shape, np.dtype(f.dtype).str, f.units, f.batch_axes] for name, f in self.fields.items()}
        header = {"format": "warp_resphys journal 1", "kind": kind, "fingerprint": fingerprint}
        self._header = (json.dumps({**header, "steps": self.step_axes, "fields": layout}) + "\n").encode()
        sizes = [math.prod(f.shape) * np.dtype(f.dtype).itemsize for f in self.fields.values()]
        self._record_size = sum(sizes) + _CHECKSUM.size
        self._descriptor: int | None = None
        self._finished = False
        self._synced = 0.0

    def __enter__(self) -> ResumableHDF5:
        """Opens the journal, or makes one, and counts the steps that are done.

        Raises:
            DataFileError: the disk is full, the place cannot be written to, or there is a file that is damaged or not
                ours.
        """
        if self._is_final():
            self.journal.unlink(missing_ok=True)
            self._finished, self.done = True, self.steps
            return self
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = os.open(self.journal, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise self._write_error(error) from error
        try:
            self.done = self._resume()
        except BaseException:
            self._close()
            raise
        self._synced = time.monotonic()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keeps what was computed, whatever the block ended with."""
        self._close()

    def append(self, **arrays: npt.ArrayLike) -> None:
        """Writes the arrays of the next step; once this returns, a killed process does not lose them.

        Raises:
            DataFileError: the disk is full; the steps before this one are kept.
        """
        if self._descriptor is None or self.done == self.steps:
            raise ValueError(f"{self.path} takes no further step: {self.done} of {self.steps} are written")
        if arrays.keys() != self.fields.keys():
            raise ValueError(f"a step of {self.path} consists of {[*self.fields]}, not of {[*arrays]}")
        parts = []
        for name, field in self.fields.items():
            values = np.asarray(arrays[name], dtype=field.dtype)
            if values.shape != field.shape:
                raise ValueError(f"'{name}' has the shape {values.shape} where {field.shape} is needed")
            parts.append(values.tobytes())
        payload = b"".join(parts)
        self._write(payload + _CHECKSUM.pack(zlib.crc32(payload, self.done)), self._offset(self.done))
        self.done += 1
        if time.monotonic() - self._synced > _SYNC_SECONDS:
            self._sync()

    def rewind(self, steps: int) -> None:
        """Forgets all but the first steps, which are written anew."""
        if not self._finished and steps < self.done:
            assert self._descriptor is not None
            os.ftruncate(self._descriptor, self._offset(steps))
            self.done = steps

    def read(self, step: int) -> dict[str, npt.NDArray[Any]]:
        """The arrays of a step that is done, for instance to start the next one from.

        Raises:
            DataFileError: the step cannot be read.
        """
        if not 0 <= step < self.done:
            raise ValueError(f"step {step} of {self.path} is not among the {self.done} that are done")
        if self._finished:
            index = np.unravel_index(step, self.step_axes)
            with read_hdf5(self.path, self.kind) as file:
                return {
                    name: read_array(file, name, index=(*(slice(None),) * field.batch_axes, *index))
                    for name, field in self.fields.items()
                }
        payload = self._record(step)
        if payload is None:
            raise DataFileError(f"{self.journal} is damaged: delete it and run the same command again")
        arrays, start = {}, 0
        for name, field in self.fields.items():
            count = math.prod(field.shape)
            values = np.frombuffer(payload, dtype=field.dtype, count=count, offset=start)
            arrays[name] = values.reshape(field.shape).copy()
            start += values.nbytes
        return arrays

    def finish(
        self,
        attributes: Mapping[str, Any] | None = None,
        constants: Mapping[str, tuple[npt.ArrayLike, str]] | None = None,
        order: Sequence[int] | None = None,
    ) -> None:
        """Writes the final file, replaces an older one by it, and removes the journal.

        Args:
            attributes: Attributes of the final file.
            constants: Arrays that do not depend on the step, each with its units.
            order: Where each step, as they were appended, stands in the final file; in that order if left out.

        Raises:
            DataFileError: the disk is full; all steps are kept in the journal.
        """
        if self._finished:
            return
        if self.done != self.steps:
            raise ValueError(f"{self.path} cannot be finished: {self.done} of {self.steps} steps are written")
        if order is not None and sorted(order) != [*range(self.steps)]:
            raise ValueError(f"{self.path} cannot be finished in the order {order}: each step has a place of its own")
        own = {**(attributes or {}), "fingerprint": self.fingerprint}
        try:
            with atomic_hdf5(self.path, self.kind, own) as file:
                for name, (array, units) in (constants or {}).items():
                    create(file, name, array, units)
                self._assemble(file, range(self.steps) if order is None else order)
        except DataFileError as error:
            if error.__cause__ is not None and is_disk_full(error.__cause__):
                raise disk_full_error(self.path, self.journal) from error
            raise
        self._finished = True
        self._close()
        self.journal.unlink()

    def _assemble(self, file: h5py.File, order: Sequence[int]) -> None:
        """Fills the final datasets, one field after the other."""
        collected = {
            name: np.empty((self.steps, *field.shape), dtype=field.dtype) for name, field in self.fields.items()
        }
        for step, place in enumerate(order):
            for name, values in self.read(step).items():
                collected[name][place] = values
        for name, field in self.fields.items():
            counted, ahead = len(self.step_axes), field.batch_axes
            values = collected.pop(name).reshape(*self.step_axes, *field.shape)
            values = np.moveaxis(values, range(counted), range(ahead, ahead + counted))
            create(file, name, values, field.units, time_axis=ahead + counted - 1)

    def _is_final(self) -> bool:
        """Whether the final file exists, belongs to the same computation and matches its checksums.

        Raises:
            DataFileError: there is a file that is damaged or not ours; it is not overwritten.
        """
        if not self.path.is_file():
            return False
        with read_hdf5(self.path, self.kind) as file:
            if str(file.attrs.get("fingerprint")) != self.fingerprint:
                return False
            for name in self.fields:
                read_array(file, name)
        return True

    def _resume(self) -> int:
        """Counts the whole records of the journal and cuts off the rest; starts it anew if it is not ours."""
        assert self._descriptor is not None
        found = os.pread(self._descriptor, len(self._header), 0)
        if found != self._header:
            if found:
                log.warning("discarding %s: it belongs to other settings or was cut short", self.journal.name)
            os.ftruncate(self._descriptor, 0)
            self._write(self._header, 0)
            return 0
        done = 0
        while done < self.steps and self._record(done) is not None:
            done += 1
        os.ftruncate(self._descriptor, self._offset(done))
        return done

    def _record(self, step: int) -> bytes | None:
        """The bytes of a step without their checksum, or None if they are incomplete or do not match it."""
        assert self._descriptor is not None
        record = os.pread(self._descriptor, self._record_size, self._offset(step))
        if len(record) != self._record_size:
            return None
        payload, checksum = record[: -_CHECKSUM.size], record[-_CHECKSUM.size :]
        return payload if checksum == _CHECKSUM.pack(zlib.crc32(payload, step)) else None

    def _offset(self, step: int) -> int:
        return len(self._header) + step * self._record_size

    def _write(self, data: bytes, offset: int) -> None:
        assert self._descriptor is not None
        rest = memoryview(data)
        try:
            while rest:
                written = os.pwrite(self._descriptor, rest, offset)
                rest, offset = rest[written:], offset + written
        except OSError as error:
            raise self._write_error(error) from error

    def _sync(self) -> None:
        """Brings the journal to the disk, so that a power cut loses a few seconds of work at most."""
        assert self._descriptor is not None
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise self._write_error(error) from error
        self._synced = time.monotonic()

    def _close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _write_error(self, error: OSError) -> DataFileError:
        if is_disk_full(error):
            return disk_full_error(self.journal, self.journal)
        return DataFileError(
            f"cannot write {self.journal} ({error.strerror}): make the place writable or choose another one"
        )


def keep_checkpoint(path: Path, kind: str, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
    """Writes a checkpoint to go on from; the one before stays beside it, in case this one gets damaged.

    Raises:
        DataFileError: the file cannot be written.
    """
    if path.exists():
        os.replace(path, _before(path))
    write_checkpoint(path, kind, tensors, metadata)


def resume_checkpoint(path: Path, kind: str, fingerprint: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """Reads the last checkpoint of `keep_checkpoint` that is whole; None if there is none, or none of this fingerprint.

    The fingerprint is the entry "fingerprint" of its metadata.
    """
    for candidate in (path, _before(path)):
        if not candidate.exists():
            continue
        try:
            tensors, metadata = read_checkpoint(candidate, kind)
        except DataFileError as error:
            log.warning("not going on from a checkpoint: %s", error)
            continue
        if metadata.get("fingerprint") == fingerprint:
            return tensors, metadata
        log.warning("not going on from %s: it belongs to other settings", candidate)
    return None


def forget_checkpoint(path: Path) -> None:
    """Removes what `keep_checkpoint` wrote."""
    path.unlink(missing_ok=True)
    _before(path).unlink(missing_ok=True)


def _before(path: Path) -> Path:
    return path.with_suffix(f".before{path.suffix}")
