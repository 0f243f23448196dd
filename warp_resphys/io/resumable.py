"""Finished files, and checkpoints from which interrupted work resumes (`files.write_checkpoint`)."""

import logging
from pathlib import Path
from typing import Any

import torch

from .errors import DataFileError
from .files import read_checkpoint, read_hdf5

log = logging.getLogger(__name__)


def is_final(path: Path, kind: str, fingerprint: str) -> bool:
    """Whether an HDF5 file with this fingerprint exists.

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
