"""Files of control in a run folder: reduced models, plans, baselines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, TypeVar

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
_DRIVEN: Final = DRIVEN.removesuffix(".h5")
_UNITS: Final = {"path": "m", "points": "m", "markers": "m", "errors_mm": "mm", "seconds": "s"}
_PLAIN: Final = ("time_step", "validation_mm")  # of a linear model


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
    arrays, plain = model.checkpoint()
    tensors = {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in arrays.items()}
    write_checkpoint(path, _REDUCED, tensors, plain)


def read_reduced(path: Path, learned: Learned | None) -> ReducedModel:
    """From the file, and what its robot has learned."""
    tensors, plain = read_checkpoint(path, _REDUCED)
    return ReducedModel.restored({name: each.numpy() for name, each in tensors.items()}, plain, learned)


def read_quality(path: Path) -> Mapping[str, Any]:
    """Errors of a reduced model, and counts of the samples from which it was made."""
    quality: Mapping[str, Any] = read_checkpoint(path, _REDUCED)[1]["quality"]
    return quality


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


AnyMotion = TypeVar("AnyMotion", PlannedMotion, DrivenMotion)


def write_plans(path: Path, motions: Mapping[str, PlannedMotion]) -> None:
    """Writes planned motions by name, for `read_plan`."""
    _write_motions(path, _PLANS, {}, motions)


def read_plan(path: Path, motion: str) -> PlannedMotion:
    """One of the planned motions."""
    return _read_motion(path, _PLANS, motion, PlannedMotion)


def write_driven(path: Path, controllers: Sequence[str], time_step: float, motions: Mapping[str, DrivenMotion]) -> None:
    """Writes driven motions by name, for `read_driven` and for the report."""
    _write_motions(path, _DRIVEN, {"controllers": list(controllers), "time_step": time_step}, motions)


def read_driven(path: Path, motion: str) -> DrivenMotion:
    """One of the driven motions."""
    return _read_motion(path, _DRIVEN, motion, DrivenMotion)


def _write_motions(path: Path, kind: str, more: Mapping[str, Any], motions: Mapping[str, AnyMotion]) -> None:
    with atomic_hdf5(path, kind, {"names": list(motions), **more}) as file:
        for name, motion in motions.items():
            group = file.create_group(name)
            for each in fields(motion):
                time_axis = int(isinstance(motion, DrivenMotion) and each.name != "path")
                create(group, each.name, getattr(motion, each.name), _UNITS.get(each.name, "1"), time_axis)


def _read_motion(path: Path, kind: str, motion: str, made: type[AnyMotion]) -> AnyMotion:
    with read_hdf5(path, kind) as file:
        return made(*(read_array(file, f"{motion}/{each.name}").astype(np.float64) for each in fields(made)))


def plain_plans(motions: Mapping[str, PlannedMotion]) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and plain data of planned motions, for a checkpoint; see `plans_from_plain`."""
    pairs = ((f"{name}/{key}", each) for name, motion in motions.items() for key, each in vars(motion).items())
    return {key: torch.from_numpy(np.ascontiguousarray(each)) for key, each in pairs}, {"names": list(motions)}


def plans_from_plain(tensors: Mapping[str, torch.Tensor], plain: Mapping[str, Any]) -> dict[str, PlannedMotion]:
    """The planned motions of `plain_plans`."""
    keys = [each.name for each in fields(PlannedMotion)]
    return {name: PlannedMotion(*(tensors[f"{name}/{key}"].numpy() for key in keys)) for name in plain["names"]}


def write_baselines(path: Path, linear: LinearModel, jacobian: FloatArray) -> None:
    """Writes the linear model and the measured Jacobian (d, n)."""
    known = {**vars(linear), "jacobian": jacobian}
    plain = {key: known.pop(key) for key in _PLAIN}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(each)) for name, each in known.items()}
    write_checkpoint(path, _BASELINES, tensors, plain)


def read_baselines(path: Path) -> tuple[LinearModel, FloatArray]:
    """The linear model and the Jacobian from the file of `write_baselines`."""
    tensors, plain = read_checkpoint(path, _BASELINES)
    known: dict[str, Any] = {name: each.numpy() for name, each in tensors.items()} | plain
    jacobian = known.pop("jacobian")
    return LinearModel(**known), jacobian
