"""What drives the trials of a dataset at their frames, and since when it has not changed."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..learning.intervals import time_since_change
from .files import STATIC, Dataset

FloatArray = NDArray[np.float64]


def driving(dataset: Dataset, names: Sequence[str]) -> dict[str, FloatArray]:
    """Returns what acts during each frame, (R, T, C) by input, base and obstacle; a pose has the last values."""
    rows = dataset.rows(names)
    series = {name: values[rows] for name, values in dataset.inputs.items()}
    series |= {} if dataset.base is None else {"base": dataset.base[rows]}
    series |= {f"obstacle {name}": poses[rows] for name, poses in dataset.obstacles.items()}
    steps = (dataset.times[rows] / dataset.time_step + 1e-6).astype(np.int64)
    posed = np.array([dataset.begins[row] == STATIC for row in rows])
    steps[posed] = np.iinfo(np.int64).max
    return {
        name: np.take_along_axis(values, np.minimum(steps, values.shape[1] - 1)[..., None], 1)
        for name, values in series.items()
    }


def since_change(dataset: Dataset, names: Sequence[str]) -> FloatArray:
    """Returns the times (R, T) since the last change of the inputs [s], see `learning.intervals.time_since_change`."""
    rows = dataset.rows(names)
    acting = [np.moveaxis(values, 0, 1) for values in driving(dataset, names).values()]
    since = time_since_change(dataset.times[rows].T, acting).T
    since[[dataset.begins[row] == STATIC for row in rows]] = np.inf
    return since
