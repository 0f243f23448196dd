"""Names of the files in a run folder, and what acts during the trials of a dataset."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..data.trials import STATIC, Trials
from ..io.arrays import FloatArray
from ..io.files import read_json
from ..learning.intervals import time_since_change
from ..learning.metrics import phases

DATASET: Final = "dataset.h5"
SCALED_DATASET: Final = "dataset_scaled.h5"
TRUTH: Final = "truth.json"
QUALITY: Final = "quality.json"
REGISTRATION: Final = "registration.json"
IDENTIFICATION: Final = "identification.json"
LAW_FILE: Final = "law.json"
SHAPES: Final = "shapes.json"
RECONSTRUCTION: Final = "reconstruction.json"
ROLLOUTS: Final = "rollouts.h5"
ERRORS: Final = "errors.json"
TIMES: Final = "times.json"
MESH_CHECK: Final = "mesh_check.json"
CONTROL: Final = "control.json"
DRIVEN: Final = "driven.h5"
# Prefixes of the names of controllers; the rest of a name is the planning model or the gain.
OPEN: Final = "open_"
RECEDING: Final = "receding_"
LINEAR: Final = "linear"
FEEDBACK: Final = "feedback_"
METRICS: Final = "metrics.json"
COMPARE: Final = "compare"  # stage of runs with pictures
REPORT: Final = "report.html"


def reconstruction_file(model: str) -> str:
    """File of the states and residual forces reconstructed with a model's simulator."""
    return f"reconstruction_{model}.h5"


def weights_file(model: str) -> str:
    """File of a model's trained weights."""
    return f"{model}.safetensors"


def training_file(model: str) -> str:
    """File of a model's training history."""
    return f"training_{model}.json"


def fold_folder(trial: str) -> str:
    """Subfolder of the fold that is tested on a trial."""
    return f"fold_{trial}"


def read_if_there(path: Path) -> dict[str, Any]:
    """Contents of a JSON file, or an empty dictionary if the file does not exist."""
    content: dict[str, Any] = read_json(path) if path.is_file() else {}
    return content


def driving(dataset: Trials, names: Sequence[str]) -> dict[str, FloatArray]:
    """Returns what acts during each frame, (R, T, C) by input, base and obstacle; a pose has the last values."""
    rows = dataset.rows(names)
    series = {name: values[rows] for name, values in dataset.inputs.items()}
    series |= {} if dataset.base is None else {"base": dataset.base[rows]}
    series |= {f"obstacle {name}": poses[rows] for name, poses in dataset.obstacles.items()}
    steps = (dataset.times[rows] / dataset.time_step + 1e-6).astype(np.int64)
    posed = np.array([dataset.begins[row] == STATIC for row in rows], dtype=bool)
    steps[posed] = np.iinfo(np.int64).max
    return {
        name: np.take_along_axis(values, np.minimum(steps, values.shape[1] - 1)[..., None], 1)
        for name, values in series.items()
    }


def since_change(dataset: Trials, names: Sequence[str]) -> FloatArray:
    """Returns the times (R, T) since the last change of the inputs [s], see `learning.intervals.time_since_change`."""
    rows = dataset.rows(names)
    acting = [np.moveaxis(values, 0, 1) for values in driving(dataset, names).values()]
    since = time_since_change(dataset.times[rows].T, acting).T
    since[[dataset.begins[row] == STATIC for row in rows]] = np.inf
    return since


def first_change(dataset: Trials, name: str) -> float:
    """Returns the time at which the inputs of a trial begin to change by more than noise [s]; zero if none does."""
    changes = np.flatnonzero(since_change(dataset, [name])[0] == 0.0)  # The first frame counts as one.
    return float(dataset.times[dataset.rows([name])[0], changes[1]]) if len(changes) > 1 else 0.0


def phases_of(dataset: Trials, names: Sequence[str]) -> NDArray[np.str_]:
    """Returns the phases (R, T) of driven trials, see `learning.metrics.phases`; empty words for others and for poses.

    The size of the inputs is their norm, each kind over its largest value.
    """
    rows, acting = dataset.rows(names), driving(dataset, names)
    largest = {name: float(np.abs(values).max(initial=0.0)) for name, values in dataset.inputs.items()}
    kinds = {name: acting[name] / size for name, size in largest.items() if size}
    found = np.full(dataset.times[rows].shape, "", dtype="<U7")
    if not kinds:
        return found
    sizes = np.linalg.norm(np.concatenate([*kinds.values()], 2), axis=2)  # (R, T)
    since = time_since_change(dataset.times[rows].T, [sizes.T[..., None]]).T
    for k, row in enumerate(rows):
        if dataset.begins[row] != STATIC:
            before = [dataset.resting[name][row] / largest[name] for name in kinds if name in dataset.resting]
            found[k] = phases(since[k], sizes[k], float(np.linalg.norm(np.concatenate([[0.0], *before]))))
    return found
