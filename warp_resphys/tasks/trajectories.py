"""What the stages share: names and splits of trajectories, and the layout of the files between them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_array, read_hdf5
from ..integrator import State
from ..resumable import Field, ResumableHDF5

SPLITS = ("train", "validation", "test")
STAGES = ("generate", "reconstruct", "train", "evaluate", "report")

TRAJECTORIES = "trajectories.h5"
RECONSTRUCTION = "reconstruction.h5"
MODEL = "model.safetensors"
TRAINING = "training.json"
ROLLOUTS = "rollouts.h5"
ERRORS = "errors.json"
METRICS = "metrics.json"
REPORT = "report.html"


@dataclass(frozen=True)
class Split:
    """Names of the trajectories of each split; their order is that of the batch."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return self.train + self.validation + self.test

    def indices(self, name: str) -> slice:
        """Where a split lies in the batch."""
        start = {"train": 0, "validation": len(self.train), "test": len(self.train) + len(self.validation)}
        return slice(start[name], start[name] + len(getattr(self, name)))


def weight_split(data: Mapping[str, Any]) -> tuple[Split, NDArray[np.float64]]:
    """The trajectories of an experiment with one weight each, and the weights (B,) [kg].

    Raises:
        InputError: an empty split, a weight that is not positive, or one in two splits.
    """
    weights = {name: [float(w) for w in data["weights_g"][name]] for name in SPLITS}
    for name, values in weights.items():
        if not values:
            raise InputError(f"data.weights_g.{name} is empty: give the split at least one weight.")
        if not all(np.isfinite(w) and w > 0.0 for w in values):
            raise InputError(f"data.weights_g.{name} holds a weight that is not positive, in grams: {values}.")
    everything = [w for values in weights.values() for w in values]
    twice = sorted({w for w in everything if everything.count(w) > 1})
    if twice:
        raise InputError(f"data.weights_g names {twice[0]:g} g twice: every trajectory belongs to one split.")
    split = Split(*(tuple(f"{w:g} g" for w in weights[name]) for name in SPLITS))
    return split, 1e-3 * np.array(everything)


def state_fields(batch: int, vertices: int) -> dict[str, Field]:
    """Positions and velocities of a batch at one time."""
    shape = (batch, vertices, 3)
    return {"q": Field(shape, "m", batch_axes=1), "v": Field(shape, "m/s", batch_axes=1)}


def last_state(file: ResumableHDF5, like: torch.Tensor) -> State:
    """The state that a file's last written step holds, with the one before for methods that look back."""
    now = file.read(file.done - 1)
    previous = None
    if file.done > 1:
        back = file.read(file.done - 2)
        previous = (like.new_tensor(back["q"]), like.new_tensor(back["v"]))
    return State(like.new_tensor(now["q"]), like.new_tensor(now["v"]), previous)


def read_fields(path: Path, kind: str, *names: str) -> list[NDArray[np.float64]]:
    """The named datasets of a file."""
    with read_hdf5(path, kind) as file:
        return [read_array(file, name) for name in names]
