"""Files of control in a run folder: reduced models, plans, baselines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from ..experiment.files import DRIVEN
from ..experiment.models import Learned
from ..io.files import atomic_hdf5, create, read_array, read_checkpoint, read_hdf5, write_checkpoint
from .baselines import LinearModel
from .reduced import ReducedModel

FloatArray = NDArray[np.float64]

BASELINES: Final = "baselines.safetensors"
_REDUCED: Final = "reduced model"
_BASELINES: Final = "baselines"
_PLANS: Final = "plans"


def reduced_file(model: str) -> str:
    """The reduced model of a model."""
    return f"reduced_{model}.safetensors"


def plans_file(model: str) -> str:
    """Inputs that were planned on a model."""
    return f"plans_{model}.h5"


def plan_table(model: str, motion: str) -> str:
    """The same of one motion as a table, to be played on a robot."""
    return f"plans/{model}_{motion}.csv"


def write_reduced(path: Path, model: ReducedModel) -> None:
    """Writes a reduced model without its network, for `read_reduced`."""
    tensors = {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in model.arrays().items()}
    write_checkpoint(path, _REDUCED, tensors, model.plain())


def read_reduced(path: Path, learned: Learned | None) -> ReducedModel:
    """From the file, and what its robot has learned."""
    tensors, plain = read_checkpoint(path, _REDUCED)
    return ReducedModel.restored({name: each.numpy() for name, each in tensors.items()}, plain, learned)


def read_told(path: Path) -> Mapping[str, Any]:
    """What was found when a reduced model was made."""
    told: Mapping[str, Any] = read_checkpoint(path, _REDUCED)[1]["told"]
    return told


@dataclass(frozen=True)
class PlannedMotion:
    """A motion that was planned on a model.

    Attributes:
        path: (T, d) where the point is to be after each step [m].
        inputs: (T, n) during each step.
        points: (T, d) where the model has it [m].
        markers: (T + 1, 3 M) where it has the markers, at the beginning and after each step [m].
        errors_mm: mean distances, of the first plan and after each correction by the robot.
    """

    path: FloatArray
    inputs: FloatArray
    points: FloatArray
    markers: FloatArray
    errors_mm: FloatArray


_PLANNED: Final = tuple(each.name for each in fields(PlannedMotion))


def write_plans(path: Path, motions: Mapping[str, PlannedMotion]) -> None:
    """Writes planned motions by name, for `read_plan`."""
    with atomic_hdf5(path, _PLANS, {"names": list(motions)}) as file:
        for name, each in motions.items():
            group = file.create_group(name)
            create(group, "path", each.path, "m")
            create(group, "inputs", each.inputs)
            create(group, "points", each.points, "m")
            create(group, "markers", each.markers, "m")
            create(group, "errors_mm", each.errors_mm, "mm")


def read_plan(path: Path, motion: str) -> PlannedMotion:
    """One of the motions."""
    with read_hdf5(path, _PLANS) as file:
        return PlannedMotion(*(read_array(file, f"{motion}/{name}").astype(np.float64) for name in _PLANNED))


def plain_plans(motions: Mapping[str, PlannedMotion]) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and plain data of planned motions, for a checkpoint; see `plans_from_plain`."""
    tensors = {
        f"{name}/{key}": torch.from_numpy(np.ascontiguousarray(getattr(each, key)))
        for name, each in motions.items()
        for key in _PLANNED
    }
    return tensors, {"names": list(motions)}


def plans_from_plain(tensors: Mapping[str, torch.Tensor], plain: Mapping[str, Any]) -> dict[str, PlannedMotion]:
    """From `plain_plans`."""
    return {name: PlannedMotion(*(tensors[f"{name}/{key}"].numpy() for key in _PLANNED)) for name in plain["names"]}


def write_baselines(path: Path, linear: LinearModel, jacobian: FloatArray) -> None:
    """Writes the linear model and the measured Jacobian (d, n)."""
    arrays = {**linear.arrays(), "jacobian": jacobian}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in arrays.items()}
    write_checkpoint(path, _BASELINES, tensors, linear.plain())


def read_baselines(path: Path) -> tuple[LinearModel, FloatArray]:
    """From the file of `write_baselines`."""
    tensors, plain = read_checkpoint(path, _BASELINES)
    arrays = {name: each.numpy() for name, each in tensors.items()}
    return LinearModel.restored(arrays, plain), arrays["jacobian"]


@dataclass(frozen=True)
class DrivenMotion:
    """A motion as C controllers drove it.

    Attributes:
        path: (T, d) where the point was to be after each step [m].
        points: (C, T, d) where it was [m].
        inputs: (C, T, n).
        seconds: (C, T) that the commands took.
    """

    path: FloatArray
    points: FloatArray
    inputs: FloatArray
    seconds: FloatArray


_DRIVEN: Final = tuple(each.name for each in fields(DrivenMotion))


def write_driven(path: Path, controllers: Sequence[str], time_step: float, motions: Mapping[str, DrivenMotion]) -> None:
    """Writes driven motions by name, for `read_driven`; the report reads it, too."""
    attributes: dict[str, Any] = {"names": list(motions), "controllers": list(controllers), "time_step": time_step}
    with atomic_hdf5(path, DRIVEN.removesuffix(".h5"), attributes) as file:
        for name, each in motions.items():
            group = file.create_group(name)
            create(group, "path", each.path, "m")
            create(group, "points", each.points, "m", time_axis=1)
            create(group, "inputs", each.inputs, time_axis=1)
            create(group, "seconds", each.seconds, "s", time_axis=1)


def read_driven(path: Path, motion: str) -> DrivenMotion:
    """One of the motions."""
    with read_hdf5(path, DRIVEN.removesuffix(".h5")) as file:
        return DrivenMotion(*(read_array(file, f"{motion}/{name}").astype(np.float64) for name in _DRIVEN))
