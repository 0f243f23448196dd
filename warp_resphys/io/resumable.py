"""Work that goes on where it was interrupted, however it ended.

`keep_checkpoint` is for work that goes on from one state: each checkpoint takes the place of the one before.
`ResumableHDF5` is for work that goes on frame by frame and keeps all of them: every ten seconds, it adds a checkpoint
with the frames since the last one and the state after them; the last frame turns all of them into one HDF5 file.
"""

import glob
import logging
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from .errors import DataFileError
from .files import atomic_hdf5, create, read_checkpoint, read_hdf5, write_checkpoint

log = logging.getLogger(__name__)

KEEP_SECONDS = 10.0  # between two checkpoints
_LAYOUT = 2  # of the content of checkpoints


@dataclass(frozen=True)
class Field:
    """One array of every frame."""

    shape: tuple[int, ...]  # of one frame; () for a number
    units: str  # SI units, stored beside the dataset; "1" for numbers without a unit
    dtype: str = "float64"  # NumPy's name of its type
    # Number of its axes that stand before the one of the frames in the file: with 1, frames of (B, N, 3) become
    # (B, T, N, 3), with 0 they become (T, B, N, 3)
    batch_axes: int = 0


class ResumableHDF5:
    """An HDF5 file that is computed frame by frame, and the state that the next frame goes on from.

    Use it as a context manager, which keeps on leaving what was appended. `done` is the number of frames that an
    earlier run left, `state` the state after them::

        with ResumableHDF5(path, "forces", fingerprint, frames, fields) as file:
            while file.done < file.frames:
                ...
                file.append(state, force=...)
            file.finish()

    Frames of another fingerprint are discarded. An older file at `path` stays there until `finish` replaces it.

    Args:
        path: of the HDF5 file.
        kind: of the file, see `files.atomic_hdf5`.
        fingerprint: identifies all that the frames depend on.
        frames: how many there are.
        fields: the arrays of one frame by name.
    """

    def __init__(self, path: Path, kind: str, fingerprint: str, frames: int, fields: Mapping[str, Field]) -> None:
        self.path, self.kind, self.fingerprint = path, kind, fingerprint
        self.frames, self.fields = frames, dict(fields)
        self._arrays = {
            name: np.empty((*f.shape[: f.batch_axes], frames, *f.shape[f.batch_axes :]), f.dtype)
            for name, f in self.fields.items()
        }
        self._last: tuple[int, Mapping[str, torch.Tensor]] = (0, {})  # frames that are done, state after them
        self._kept = 0  # frames that are in checkpoints
        self._next = 0.0  # time of the next checkpoint

    @property
    def done(self) -> int:
        """Number of frames that are done."""
        return self._last[0]

    @property
    def state(self) -> Mapping[str, torch.Tensor]:
        """The state after these frames; empty before the first one."""
        return self._last[1]

    def __enter__(self) -> "ResumableHDF5":
        """Reads the checkpoints of an earlier run, up to the first one that is damaged or of another fingerprint."""
        for path in self._checkpoints():
            try:
                tensors, metadata = read_checkpoint(path, "frames")
            except DataFileError as error:
                log.warning("not going on from a checkpoint: %s", error)
                break
            done = metadata.pop("done")
            if metadata != self._metadata(self.done):
                log.warning("not going on from %s: it belongs to other settings", path)
                break
            for name in self.fields:
                self._arrays[name][self._at(name, slice(self.done, done))] = tensors[f"frames.{name}"].numpy()
            self._last = done, {key[6:]: tensor for key, tensor in tensors.items() if key.startswith("state.")}
        self._kept = self.done
        for path in self._checkpoints():
            if path >= self._checkpoint(self.done):
                path.unlink()
        return self

    def __exit__(self, *_: object) -> None:
        """Keeps what was computed, whatever the block ended with."""
        self._keep()

    def append(self, state: Mapping[str, torch.Tensor], **arrays: npt.ArrayLike) -> None:
        """Adds the arrays of the next frame and the state after it, which is not to be changed in place.

        Raises:
            DataFileError: a checkpoint cannot be written.
        """
        for name, field in self.fields.items():
            values = np.asarray(arrays[name], dtype=field.dtype)
            if values.shape != field.shape:
                raise ValueError(f"'{name}' has the shape {values.shape} where {field.shape} is needed")
            self._arrays[name][self._at(name, self.done)] = values
        self._last = self.done + 1, state  # in one assignment, for a Ctrl-C in between
        if time.monotonic() >= self._next:  # After the first frame, too: a place that cannot be written shows at once.
            self._keep()
            self._next = time.monotonic() + KEEP_SECONDS

    def finish(self, constants: Mapping[str, tuple[npt.ArrayLike, str]] | None = None) -> None:
        """Writes the HDF5 file and removes the checkpoints.

        Args:
            constants: arrays that do not depend on the frame, with their units.

        Raises:
            DataFileError: the file cannot be written; the frames are kept in checkpoints.
        """
        if self.done != self.frames:
            raise ValueError(f"{self.path} cannot be finished: {self.done} of {self.frames} frames are done")
        with atomic_hdf5(self.path, self.kind, {"fingerprint": self.fingerprint}) as file:
            for name, (array, units) in (constants or {}).items():
                create(file, name, array, units)
            for name, field in self.fields.items():
                create(file, name, self._arrays[name], field.units, time_axis=field.batch_axes)
        self._kept = self.done
        for path in self._checkpoints():
            path.unlink()

    def _keep(self) -> None:
        """Writes a checkpoint of the frames since the last one."""
        done, state = self._last
        if done == self._kept:
            return
        frames = slice(self._kept, done)
        tensors = {
            f"frames.{name}": torch.from_numpy(self._arrays[name][self._at(name, frames)].copy())
            for name in self.fields
        }
        tensors |= {f"state.{name}": tensor for name, tensor in state.items()}
        metadata = {**self._metadata(self._kept), "done": done}
        write_checkpoint(self._checkpoint(self._kept), "frames", tensors, metadata)
        self._kept = done

    def _metadata(self, first: int) -> dict[str, Any]:
        layout = {name: [*field.shape, field.dtype, field.batch_axes] for name, field in self.fields.items()}
        return {"fingerprint": self.fingerprint, "frames": self.frames, "fields": layout, "first": first}

    def _at(self, name: str, frames: int | slice) -> tuple[int | slice, ...]:
        """The index of some frames in an array."""
        return (*(slice(None),) * self.fields[name].batch_axes, frames)

    def _checkpoint(self, first: int) -> Path:
        return self.path.with_name(f"{self.path.stem}.frames_{first:07d}.safetensors")

    def _checkpoints(self) -> list[Path]:
        return sorted(self.path.parent.glob(f"{glob.escape(self.path.stem)}.frames_*.safetensors"))


def is_final(path: Path, kind: str, fingerprint: str) -> bool:
    """Whether a file of `ResumableHDF5` is there that was made from the same settings.

    Raises:
        DataFileError: the file is damaged, or another program's.
    """
    if not path.is_file():
        return False
    with read_hdf5(path, kind) as file:
        return str(file.attrs.get("fingerprint")) == fingerprint


def keep_checkpoint(path: Path, kind: str, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
    """Writes a checkpoint to go on from; the one before stays beside it, in case this one gets damaged.

    Raises:
        DataFileError: the file cannot be written.
    """
    if path.exists():
        os.replace(path, _before(path))
    write_checkpoint(path, kind, tensors, {**metadata, "layout": _LAYOUT})


def resume_checkpoint(path: Path, kind: str, fingerprint: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """The last checkpoint of `keep_checkpoint` that is whole and has this fingerprint; None if there is none."""
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
    """Removes the checkpoints that `keep_checkpoint` wrote."""
    path.unlink(missing_ok=True)
    _before(path).unlink(missing_ok=True)


def _before(path: Path) -> Path:
    return path.with_suffix(f".before{path.suffix}")
