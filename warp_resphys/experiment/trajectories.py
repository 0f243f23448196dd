"""What the stages share: names and splits of trajectories, and the layout of the files between them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from ..dynamics.integrator import State
from ..io.errors import InputError
from ..io.files import digest, read_array, read_hdf5
from ..io.resumable import Field, ResumableHDF5

T = TypeVar("T")

SPLITS = ("train", "validation", "test")
STAGES = ("generate", "reconstruct", "train", "refine", "train_simfree", "evaluate", "time", "report")

_OF_CHAMBERS = ("chambers", "fibres", "pressure_coupling")

MODELS = ("resphys", "simfree")  # that are trained
_SIMULATED = ("mesh", "physics", "fixed", "gravity", "time_step", "integrator", "solver", "device", "dtype")

TRAJECTORIES = "trajectories.h5"
RECONSTRUCTION = "reconstruction.h5"
MODEL = "model.safetensors"
TRAINING = "training.json"
REFINED = "refined.safetensors"
REFINEMENT = "refinement.json"
SIMFREE = "simfree.safetensors"
SIMFREE_TRAINING = "simfree_training.json"
ROLLOUTS = "rollouts.h5"
ERRORS = "errors.json"
TIMES = "times.json"
METRICS = "metrics.json"
REPORT = "report.html"


def simulated(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that every simulation of an experiment depends on."""
    base = {key: config[key] for key in _SIMULATED}
    base |= {key: config[key] for key in _OF_CHAMBERS if key in config}
    if config["mesh"]["kind"] == "file":
        base["mesh_digest"] = digest(config["mesh"]["path"])
    return base


def shown(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration without what has no bearing on a run."""
    return {key: value for key, value in config.items() if key not in ("task", "tune")}


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


@dataclass(frozen=True)
class Variation:
    """What sets the trajectories of an experiment apart.

    Attributes:
        key: under ``data``, with a list for each split.
        unit: of the configured values.
        factor: from there to SI units.
    """

    key: str
    unit: str
    factor: float


VARIATIONS = {
    "release_from_load": Variation("weights_g", "g", 1e-3),
    "release_from_twist": Variation("angles_deg", "°", np.pi / 180.0),
}


def training_settings(config: Mapping[str, Any], model: str) -> dict[str, Any]:
    """The groups ``network`` and ``trainer`` and the seed that a model is trained with.

    Args:
        config: the whole configuration.
        model: ``resphys``; or ``simfree``, whose own settings replace the common ones.
    """
    own = config["simfree"] if model == "simfree" else {}
    groups = {key: {**config[key], **own.get(key, {})} for key in ("network", "trainer")}
    return {**groups, "seed": config["seed"]}


def variation_of(data: Mapping[str, Any]) -> Variation:
    """What sets the trajectories of this kind of data apart.

    Raises:
        InputError: an unknown kind.
    """
    if data["kind"] not in VARIATIONS:
        raise InputError(f"data.kind is {data['kind']!r}: choose one of {', '.join(VARIATIONS)}.")
    return VARIATIONS[data["kind"]]


def split_of(data: Mapping[str, Any]) -> tuple[Split, NDArray[np.float64]]:
    """The trajectories of an experiment and the value (B,) that sets each apart, in SI units.

    Raises:
        InputError: an empty split, a value that is not positive, or one in two splits.
    """
    kind = variation_of(data)
    values = {name: [float(x) for x in data[kind.key][name]] for name in SPLITS}
    for name, row in values.items():
        if not row:
            raise InputError(f"data.{kind.key}.{name} is empty: give the split at least one value.")
        if not all(np.isfinite(x) and x > 0.0 for x in row):
            raise InputError(f"data.{kind.key}.{name} holds a value that is not positive: {row}.")
    everything = [x for row in values.values() for x in row]
    twice = sorted({x for x in everything if everything.count(x) > 1})
    if twice:
        raise InputError(f"data.{kind.key} names {twice[0]:g} {kind.unit} twice: every trajectory is in one split.")
    space = "" if kind.unit == "°" else " "
    if data["limit"] is not None:
        values = {name: evenly(row, data["limit"][name]) for name, row in values.items()}
    split = Split(*(tuple(f"{x:g}{space}{kind.unit}" for x in values[name]) for name in SPLITS))
    return split, kind.factor * np.concatenate([values[name] for name in SPLITS])


def evenly(row: list[T], limit: int) -> list[T]:
    """At most that many values of a row, spread over it.

    Raises:
        InputError: the limit is below one.
    """
    if limit < 1:
        raise InputError(f"data.limit is {limit} for a split: it must be at least 1.")
    places = np.linspace(0, len(row) - 1, min(limit, len(row))).round().astype(int)
    return [row[i] for i in places]


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
