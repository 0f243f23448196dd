"""Checkpoints, from which interrupted work resumes.

Work with a single state writes one file, which a new checkpoint replaces (`files.write_checkpoint`). `ResumableHDF5` is
for frames that are computed one by one and all kept: every ten seconds it writes a checkpoint with the new frames and
the state after them, and finally one HDF5 file of all frames.
"""

import glob
import logging
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


@dataclass(frozen=True)
class Field:
    """An array that every frame has."""

    shape: tuple[int, ...]  # of one frame; () for a number
    units: str  # SI units, stored with the dataset; "1" for numbers without a unit
    dtype: str = "float64"  # NumPy's name of the type
    # Number of axes before the time axis in the file: frames (B, N, 3) become (B, T, N, 3) with 1, (T, B, N, 3) with 0
    batch_axes: int = 0


class ResumableHDF5:
    """An HDF5 file that is computed frame by frame, with the state from which the next frame is computed.

    Use it as a context manager, which writes a checkpoint when it is left. `done` is the number of frames from an
    interrupted run, `state` the state after them::

        with ResumableHDF5(path, "forces", fingerprint, frames, fields) as file:
            while file.done < file.frames:
                ...
                file.append(state, force=...)
            file.finish()

    Frames of another fingerprint are discarded. An older file at `path` stays until `finish` replaces it.

    Args:
        path: of the HDF5 file.
        kind: of the file, see `files.atomic_hdf5`.
        fingerprint: identifies everything that the frames depend on.
        frames: total number of frames.
        fields: the arrays of one frame by name.
    """

    def __init__(self, path: Path, kind: str, fingerprint: str, frames: int, fields: Mapping[str, Field]) -> None:
        self.path, self.kind, self.fingerprint = path, kind, fingerprint
        self.frames, self.fields = frames, dict(fields)
        self._arrays = {
            name: np.empty((*f.shape[: f.batch_axes], frames, *f.shape[f.batch_axes :]), f.dtype)
            for name, f in self.fields.items()
        }
        self._last: tuple[int, Mapping[str, torch.Tensor]] = (0, {})  # number of frames, state after them
        self._kept = 0  # number of frames in checkpoints
        self._next = 0.0  # time of the next checkpoint

    @property
    def done(self) -> int:
        """Number of computed frames."""
        return self._last[0]

    @property
    def state(self) -> Mapping[str, torch.Tensor]:
        """State after the last frame; empty before the first one."""
        return self._last[1]

    def __enter__(self) -> "ResumableHDF5":
        """Reads the checkpoints of an interrupted run, up to the first one that is damaged or of other settings."""
        for path in self._checkpoints():
            try:
                tensors, metadata = read_checkpoint(path, "frames")
            except DataFileError as error:
                log.warning("a checkpoint cannot be used: %s", error)
                break
            done = metadata.pop("done")
            if metadata != self._metadata(self.done):
                log.warning("%s is not used: it belongs to other settings", path)
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
        """Writes a checkpoint, also after an error."""
        self._keep()

    def append(self, state: Mapping[str, torch.Tensor], **arrays: npt.ArrayLike) -> None:
        """Adds the arrays of the next frame and the state after it, which must not be changed in place later.

        Raises:
            DataFileError: a checkpoint cannot be written.
        """
        for name, field in self.fields.items():
            values = np.asarray(arrays[name], dtype=field.dtype)
            if values.shape != field.shape:
                raise ValueError(f"'{name}' has the shape {values.shape} where {field.shape} is needed")
            self._arrays[name][self._at(name, self.done)] = values
        self._last = self.done + 1, state  # one assignment, so that Ctrl-C cannot separate the two
        if time.monotonic() >= self._next:  # also after the first frame, so that a write error shows early
            self._keep()
            self._next = time.monotonic() + KEEP_SECONDS

    def finish(self, constants: Mapping[str, tuple[npt.ArrayLike, str]] | None = None) -> None:
        """Writes the HDF5 file and removes the checkpoints.

        Args:
            constants: arrays without a time axis, with their units.

        Raises:
            DataFileError: the file cannot be written; the frames stay in checkpoints.
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
        """Writes a checkpoint with the new frames."""
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
        """Index of frames in an array."""
        return (*(slice(None),) * self.fields[name].batch_axes, frames)

    def _checkpoint(self, first: int) -> Path:
        return self.path.with_name(f"{self.path.stem}.frames_{first:07d}.safetensors")

    def _checkpoints(self) -> list[Path]:
        return sorted(self.path.parent.glob(f"{glob.escape(self.path.stem)}.frames_*.safetensors"))


def is_final(path: Path, kind: str, fingerprint: str) -> bool:
    """Whether a finished file of `ResumableHDF5` with this fingerprint exists.

    Raises:
        DataFileError: the file is damaged, or of another program.
    """
    if not path.is_file():
        return False
    with read_hdf5(path, kind) as file:
        return str(file.attrs.get("fingerprint")) == fingerprint


def resume_checkpoint(path: Path, kind: str, fingerprint: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """Reads a checkpoint of work with this fingerprint; None if there is none that can be used."""
    if not path.exists():
        return None
    try:
        tensors, metadata = read_checkpoint(path, kind)
    except DataFileError as error:
        log.warning("a checkpoint cannot be used: %s", error)
        return None
    if metadata.get("fingerprint") != fingerprint:
        log.warning("%s is not used: it belongs to other settings", path)
        return None
    return tensors, metadata
