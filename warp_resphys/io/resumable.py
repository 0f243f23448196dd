"""Work that survives any interruption.

`ResumableHDF5` is for what is computed step by step. The steps go to a journal beside the final file: a header that
says what is being computed, then one record a step, appended with a checksum. A record that was cut short by a kill, a
crash or a full disk does not match its checksum and is computed again; all whole ones are kept. The finished journal is
turned into an HDF5 file and removed.

`keep_checkpoint` is for all else: what the work goes on from, as a whole, in place of what was kept before.
"""

from __future__ import annotations

import json
import logging
import os
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
    import torch

log = logging.getLogger(__name__)

_SYNC_SECONDS = 2.0
_LAYOUT = 2  # of what stages keep in checkpoints
_CHECKSUM = "CRC-32"


@dataclass(frozen=True)
class Field:
    """One array of every step."""

    shape: tuple[int, ...]  # Its shape in one step; () for a number
    units: str  # SI units, stored beside the dataset; "1" for numbers without a unit
    dtype: str = "float64"  # NumPy's name of its type
    # How many of its leading axes stand before the one that counts steps in the final dataset: with 1, steps of
    # (B, N, 3) become (B, T, N, 3), with 0 they become (T, B, N, 3)
    batch_axes: int = 0


class ResumableHDF5:
    """An HDF5 file that is computed one step (a frame, a trajectory, ...) at a time.

    Use it as a context manager. `done` says how many steps an earlier, interrupted run left; go on from
    there::

        with ResumableHDF5(path, "forces", fingerprint, frames, fields) as file:
            for step in range(file.done, file.steps):
                file.append(forces=...)
            file.finish()

    Work that belongs to another fingerprint, or to other fields, is discarded. An existing file at `path`
    stays in place until `finish` replaces it; if it is already the one asked for, all steps are done.

    Args:
        path: Where the final HDF5 file is to appear.
        kind: What the file holds, as for `files.atomic_hdf5`.
        fingerprint: Identifies the inputs of the computation; steps of another fingerprint are not used.
        steps: How many there are.
        fields: The arrays of one step by name.
    """

    def __init__(self, path: str | Path, kind: str, fingerprint: str, steps: int, fields: Mapping[str, Field]) -> None:
        self.path, self.kind, self.fingerprint = Path(path), kind, fingerprint
        self.steps, self.done, self.fields = steps, 0, dict(fields)
        self.journal = self.path.with_name(self.path.name + ".journal")
        layout = {name: [f.shape, np.dtype(f.dtype).str, f.units, f.batch_axes] for name, f in self.fields.items()}
        header = {"format": "warp_resphys journal 1", "kind": kind, "fingerprint": fingerprint}
        self._header = (json.dumps({**header, "steps": steps, "fields": layout}) + "\n").encode()
        parts = [(name, field.dtype, field.shape) for name, field in self.fields.items()]
        self._record = np.dtype([*parts, (_CHECKSUM, "<u4")])
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
            self.done = self._resume()
        except BaseException as error:
            self._close()
            if isinstance(error, OSError):
                raise self._write_error(error) from error
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
        record = np.zeros(1, self._record)
        for name, field in self.fields.items():
            values = np.asarray(arrays[name], dtype=field.dtype)
            if values.shape != field.shape:
                raise ValueError(f"'{name}' has the shape {values.shape} where {field.shape} is needed")
            record[name] = values
        record[_CHECKSUM] = self._checksum(record, self.done)
        try:
            self._write(record.tobytes(), self._offset(self.done))
            self.done += 1
            if time.monotonic() - self._synced > _SYNC_SECONDS:  # A power cut loses a few seconds of work at most.
                os.fsync(self._descriptor)
                self._synced = time.monotonic()
        except OSError as error:
            raise self._write_error(error) from error

    def rewind(self, steps: int) -> None:
        """Forgets all but the first steps, which are written anew."""
        if not self._finished and steps < self.done:
            assert self._descriptor is not None
            os.ftruncate(self._descriptor, self._offset(steps))
            self.done = steps

    def read(self, step: int) -> dict[str, npt.NDArray[Any]]:
        """The arrays of a step that is done.

        Raises:
            DataFileError: the step cannot be read.
        """
        if not 0 <= step < self.done:
            raise ValueError(f"step {step} of {self.path} is not among the {self.done} that are done")
        if self._finished:
            with read_hdf5(self.path, self.kind) as file:
                places = {name: (*(slice(None),) * field.batch_axes, step) for name, field in self.fields.items()}
                return {name: read_array(file, name, index=place) for name, place in places.items()}
        record = self._whole(step)
        if record is None:
            raise DataFileError(f"{self.journal} is damaged: delete it and run the same command again")
        return {name: record[name][0].copy() for name in self.fields}

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
        places = np.arange(self.steps) if order is None else np.asarray(order)
        if not np.array_equal(np.sort(places), np.arange(self.steps)):
            raise ValueError(f"{self.path} cannot be finished in the order {order}: each step has a place of its own")
        own = {**(attributes or {}), "fingerprint": self.fingerprint}
        records = np.memmap(self.journal, self._record, "r", len(self._header), self.steps) if self.steps else None
        try:
            with atomic_hdf5(self.path, self.kind, own) as file:
                for name, (array, units) in (constants or {}).items():
                    create(file, name, array, units)
                for name, field in self.fields.items():
                    values = np.empty((self.steps, *field.shape), field.dtype)
                    if records is not None:
                        values[places] = records[name]
                    values = np.moveaxis(values, 0, field.batch_axes)
                    create(file, name, values, field.units, time_axis=field.batch_axes)
        except DataFileError as error:
            if error.__cause__ is not None and is_disk_full(error.__cause__):
                raise disk_full_error(self.path, self.journal) from error
            raise
        self._finished = True
        self._close()
        self.journal.unlink()

    def _is_final(self) -> bool:
        """Whether the final file is there, of the same computation; one that is damaged or not ours is an error."""
        if not self.path.is_file():
            return False
        with read_hdf5(self.path, self.kind) as file:  # Its checksum is looked at.
            return str(file.attrs.get("fingerprint")) == self.fingerprint

    def _resume(self) -> int:
        """Counts the whole records of the journal and cuts off the rest; starts it anew if it is not ours."""
        assert self._descriptor is not None
        found, done = os.pread(self._descriptor, len(self._header), 0), 0
        if found == self._header:
            while done < self.steps and self._whole(done) is not None:
                done += 1
            os.ftruncate(self._descriptor, self._offset(done))
            return done
        if found:
            log.warning("discarding %s: it belongs to other settings or was cut short", self.journal.name)
        os.ftruncate(self._descriptor, 0)
        self._write(self._header, 0)
        return 0

    def _whole(self, step: int) -> npt.NDArray[Any] | None:
        """The record of a step, (1,), or None if it is incomplete or does not match its checksum."""
        assert self._descriptor is not None
        content = os.pread(self._descriptor, self._record.itemsize, self._offset(step))
        if len(content) != self._record.itemsize:
            return None
        record = np.frombuffer(content, self._record)
        return record if record[_CHECKSUM] == self._checksum(record, step) else None

    def _checksum(self, record: npt.NDArray[Any], step: int) -> int:
        return zlib.crc32(memoryview(record.tobytes())[:-4], step)

    def _offset(self, step: int) -> int:
        return len(self._header) + step * self._record.itemsize

    def _write(self, data: bytes, offset: int) -> None:
        assert self._descriptor is not None
        rest = memoryview(data)
        while rest:
            written = os.pwrite(self._descriptor, rest, offset)
            rest, offset = rest[written:], offset + written

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
    write_checkpoint(path, kind, tensors, {**metadata, "layout": _LAYOUT})


def resume_checkpoint(path: Path, kind: str, fingerprint: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """The last checkpoint of `keep_checkpoint` that is whole and has this "fingerprint" in its metadata, if any."""
    for candidate in (path, _before(path)):
        if not candidate.exists():
            continue
        try:
            tensors, metadata = read_checkpoint(candidate, kind)
        except DataFileError as error:
            log.warning("not going on from a checkpoint: %s", error)
            continue
        if metadata.get("layout") != _LAYOUT:
            log.warning("not going on from %s: another version of warp_resphys wrote it", candidate)
        elif metadata.get("fingerprint") != fingerprint:
            log.warning("not going on from %s: it belongs to other settings", candidate)
        else:
            return tensors, metadata
    return None


def forget_checkpoint(path: Path) -> None:
    """Removes what `keep_checkpoint` wrote."""
    path.unlink(missing_ok=True)
    _before(path).unlink(missing_ok=True)


def _before(path: Path) -> Path:
    return path.with_suffix(f".before{path.suffix}")
