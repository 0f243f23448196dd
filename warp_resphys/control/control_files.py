"""Files of the control stages in a run folder: reduced models, plans, driven motions, baselines."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ..data.input_network import InputNetwork
from ..experiment.files import DRIVEN
from ..io.arrays import FloatArray
from ..io.errors import DataFileError, InputError
from ..io.safe_files import (
    atomic_hdf5,
    create,
    read_array,
    read_checkpoint,
    read_hdf5,
    write_checkpoint,
)
from ..learning.residuals.correction import Learned
from ..report.data import ReducedErrors
from .linear_model import LinearModel
from .polynomials import Polynomial, SquaredPolynomial
from .reduced_force import ReducedForce
from .reduced_model import ReducedModel

BASELINES: Final = "baselines.safetensors"
_REDUCED: Final = "reduced model"
# Of a learned force without network.
_FORCE: Final = ("places", "seen", "conditions", "conditions_by", "usual", "push")
_KINDS: Final = {"damping": SquaredPolynomial, "branches": SquaredPolynomial}
_BASELINES: Final = "baselines"
_UNITS: Final = {"path": "m", "points": "m", "markers": "m", "errors_mm": "mm", "seconds": "s"}
_PLAIN: Final = ("time_step", "validation_mm")  # of a linear model
PLANNED: Final = "plans"  # kinds of files
PLAYED: Final = DRIVEN.removesuffix(".h5")

Arrays = Mapping[str, FloatArray]


def reduced_file(model: str) -> str:
    """Name of the file with the reduced form of a model."""
    return f"reduced_{model}.safetensors"


def plans_file(model: str) -> str:
    """Name of the file with the motions planned on a model."""
    return f"plans_{model}.h5"


def plan_table(model: str, motion: str) -> str:
    """Name of the table with one planned motion, to be played on a robot."""
    return f"plans/{model}_{motion}.csv"


def write_reduced(path: Path, model: ReducedModel) -> None:
    """Writes a reduced model without its network."""
    values = {field.name: getattr(model, field.name) for field in fields(model)}
    force = values.pop("force")
    if force is not None:
        values |= {name: getattr(force, name) for name in _FORCE}
    acts = values["acts"].items()
    values["acts"] = {
        word: value.plain() if isinstance(value, InputNetwork) else value for word, value in acts
    }
    polynomials = {name: value for name, value in values.items() if isinstance(value, Polynomial)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    plain = {name: value for name, value in values.items() if name not in {*polynomials, *arrays}}
    plain["orders"] = {name: polynomial.order for name, polynomial in polynomials.items()}
    arrays |= {name: polynomial.coefficients for name, polynomial in polynomials.items()}
    write_checkpoint(path, _REDUCED, _tensors(arrays), plain)


def read_reduced(path: Path, learned: Learned | None) -> ReducedModel:
    """Reads a reduced model, to which the learned force of its robot is added.

    Raises:
        DataFileError: the file is missing, damaged, or of an earlier version.
        InputError: the model has a learned force, and ``learned`` is None.
    """
    tensors, values = read_checkpoint(path, _REDUCED)
    try:
        orders = values.pop("orders")
        arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
        values |= arrays | {
            name: _KINDS.get(name, Polynomial)(arrays[name], order)
            for name, order in orders.items()
        }
        arguments = {
            field.name: values[field.name]
            for field in fields(ReducedModel)
            if field.name != "force"
        }
        arguments |= {key: tuple(arguments[key]) for key in ("labels", "filters", "times")}
        acts = arguments["acts"].items()
        arguments["acts"] = {
            word: np.array(value) if isinstance(value, list) else value for word, value in acts
        }
        if "network" in arguments["acts"]:
            arguments["acts"]["network"] = InputNetwork.of_plain(arguments["acts"]["network"])
        if "push" not in orders:
            return ReducedModel(**arguments)
        if learned is None:
            raise InputError(
                "the reduced model has a learned force: pass `robot.description.learned`."
            )
        force = ReducedForce(
            learned.network, learned.range_, **{name: values[name] for name in _FORCE}
        )
        return ReducedModel(**arguments, force=force)
    except KeyError as error:
        raise DataFileError(
            f"{path} is of an earlier version: delete it and run the same command again."
        ) from error


def read_quality(path: Path) -> ReducedErrors:
    """Reads the errors of a reduced model, and the counts of samples that it was fitted to."""
    quality: ReducedErrors = read_checkpoint(path, _REDUCED)[1]["quality"]
    return quality


def write_motions(path: Path, kind: str, motions: Mapping[str, Arrays], **more: Any) -> None:
    """Writes motions by name, and what they have in common.

    Args:
        path: path of the file.
        kind: ``plans``, or ``driven`` by C controllers.
        motions: arrays by name. Of every motion: ``path`` (T, d), reference of the point after each
            step [m]. Of plans: ``inputs`` (T, n) during each step; ``points`` (T, d) and
            ``markers`` (T + 1, 3 M) predicted by the model [m]; ``errors_mm``, mean distances of
            points and path, of the first plan and after each correction by the robot. Of driven
            motions: ``points`` (C, T, d) measured [m], ``inputs`` (C, T, n), and ``seconds``
            (C, T), computing time of the commands.
        more: attributes of the file.
    """
    with atomic_hdf5(path, kind, {"names": list(motions), **more}) as file:
        for name, motion in motions.items():
            group = file.create_group(name)
            for key, values in motion.items():
                create(
                    group, key, values, _UNITS.get(key, "1"), int(kind == PLAYED and key != "path")
                )


def read_motion(path: Path, kind: str, motion: str) -> dict[str, FloatArray]:
    """Reads the arrays of one motion by name (`write_motions`)."""
    with read_hdf5(path, kind) as file:
        return {key: read_array(file, f"{motion}/{key}").astype(np.float64) for key in file[motion]}


def write_baselines(path: Path, linear: LinearModel, jacobian: FloatArray) -> None:
    """Writes the linear model and the measured Jacobian (d, n)."""
    arrays = {**vars(linear), "jacobian": jacobian}
    plain = {key: arrays.pop(key) for key in _PLAIN}
    write_checkpoint(path, _BASELINES, _tensors(arrays), plain)


def read_baselines(path: Path) -> tuple[LinearModel, FloatArray]:
    """Reads the linear model and the measured Jacobian (d, n)."""
    tensors, plain = read_checkpoint(path, _BASELINES)
    values: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()} | plain
    jacobian = values.pop("jacobian")
    return LinearModel(**values), jacobian


def _tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}
