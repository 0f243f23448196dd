"""Names of the files of an experiment on recordings, and the reader of the imported markers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...body import Body
from ...errors import InputError
from ...files import read_array, read_hdf5, read_json
from ...mesh import select_vertices
from ...replay import Motions
from ..trajectories import ERRORS, METRICS, REPORT, ROLLOUTS

__all__ = (
    "ERRORS",
    "IDENTIFICATION",
    "MARKERS",
    "METRICS",
    "MODELS",
    "QUALITY",
    "REGISTRATION",
    "REPORT",
    "ROLLOUTS",
    "TRAINED",
    "TRUTH",
    "attached_mass",
    "fold_folder",
    "learned",
    "read_motions",
    "recording_file",
    "training_file",
    "weights_file",
)

FloatArray = NDArray[np.float64]

TRUTH = "truth.json"
MARKERS = "markers.h5"
QUALITY = "quality.json"
REGISTRATION = "registration.json"
IDENTIFICATION = "identification.json"

MODELS = (
    "published",
    "simulation",
    "sysid_elastic",
    "sysid",
    "simfree",
    "resphys_uncorrected",
    "resphys",
)
TRAINED = ("simfree", "resphys_uncorrected", "resphys")


def recording_file(trial: str) -> str:
    """Where the simulated recording of a trial is, in the run folder."""
    return f"recordings/{trial}.h5"


def training_file(model: str) -> str:
    """How the training of a model went."""
    return f"training_{model}.json"


def weights_file(model: str) -> str:
    """What a model has learned."""
    return f"{model}.safetensors"


def learned(folder: Path) -> dict[str, Any]:
    """Which weights were kept and what was identified, as metrics.json has them, of the stages that are done."""
    found = read_json(folder / IDENTIFICATION) if (folder / IDENTIFICATION).is_file() else {}
    histories = {model: folder / training_file(model) for model in TRAINED}
    return {
        "networks": {model: read_json(path)["kept"] for model, path in histories.items() if path.is_file()},
        "parameters": {name: each["parameters"] for name, each in found.items() if "parameters" in each},
    }


def fold_folder(trial: str) -> str:
    """The folder of the fold that is tested on a trial, in the run folder."""
    return f"fold_{trial}"


def attached_mass(body: Body, hung_on: Mapping[str, float] | None, loads: FloatArray) -> FloatArray:
    """(R, N) weights in equal shares on the vertices that carry them [kg].

    Args:
        body: that they hang on.
        hung_on: its vertices, such as ``{"x": 0.1, "z": 0.03}`` [m]; None where nothing ever hangs.
        loads: (R,) [kg].

    Raises:
        InputError: a load without a place, or a place where nothing can move.
        MeshError: no vertex lies there.
    """
    masses = np.zeros((len(loads), body.n_vertices))
    if not np.any(loads):
        return masses
    if hung_on is None:
        raise InputError("a trial has a load, but data.hung_on is not set: name the vertices that carry it.")
    carrying = select_vertices(body.mesh, **hung_on)
    if np.isin(carrying, body.fixed_vertices).all():
        raise InputError("data.hung_on names fixed vertices alone: hang the loads on vertices that can move.")
    masses[:, carrying] = loads[:, None] / len(carrying)
    return masses


def read_motions(
    path: Path, body: Body, hung_on: Mapping[str, float] | None
) -> tuple[Motions, FloatArray, tuple[str, ...], FloatArray]:
    """Reads markers.h5.

    Args:
        path: the file.
        body: that the loads hang on.
        hung_on: see `attached_mass`.

    Returns:
        The motions, in float64 on the CPU; (M, 3) where their markers are on the body at rest [m]; the markers' names;
        and gravity (3,) in the frame of the body [m/s^2].

    Raises:
        DataFileError: the file is missing, damaged or of another kind.
        InputError: see `attached_mass`.
    """
    with read_hdf5(path, "markers") as file:
        names = tuple(str(name) for name in file.attrs["names"])
        labels = tuple(str(label) for label in file.attrs["labels"])
        gravity = np.asarray(file.attrs["gravity"], dtype=np.float64)
        r, m = len(names), len(labels)
        times = read_array(file, "times", (r, None))
        markers = read_array(file, "markers", (r, times.shape[1], m, 3))
        held, bound = read_array(file, "held", (r, m, 3)), read_array(file, "bound", (m, 3))
        masses = attached_mass(body, hung_on, read_array(file, "load", (r,)))
    motions = Motions(names, *(torch.from_numpy(array) for array in (times, markers, held, masses)))
    return motions, bound, labels, gravity
