"""Measured and simulated forces over time, for the report."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ..data.force_sensors import AXES, UNITS
from ..data.trials import Trials
from ..io.safe_files import read_array, read_hdf5
from ..report.data import ForceCurve
from ..settings.run import RunSettings
from .build import force_sensor
from .files import ROLLOUTS


def force_curves(
    folder: Path, run: RunSettings, trials: Trials, names: Sequence[str], models: Sequence[str]
) -> dict[str, ForceCurve]:
    """Returns the component of each sensor that varies most in a test trial.

    Args:
        folder: run folder.
        run: settings of the run.
        trials: of the run.
        names: of the test trials.
        models: that are shown.
    """
    rows, found = trials.rows(names), dict[str, ForceCurve]()
    if not trials.loads or trials.times.shape[1] < 2 or not trials.moving(names):
        return found
    with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
        shown = {
            model: read_array(file, f"{model}_loads")
            for model in models
            if f"{model}_loads" in file
        }
    for number, (name, readings) in enumerate(trials.loads.items()):
        sensor = force_sensor(run.sensors[name])
        measured = np.where([axis in sensor.axes for axis in AXES], readings[rows], np.nan)
        known = {model: values[: len(rows), :, number] for model, values in shown.items()}
        known = {model: values for model, values in known.items() if np.isfinite(values).any()}
        ranges = np.where(np.isfinite(measured), measured, 0.0)
        ranges = ranges.max(axis=1) - ranges.min(axis=1)
        same = [UNITS[axis] == sensor.unit for axis in AXES]
        row, axis = divmod(int(np.argmax(np.where(same, ranges, -1.0))), len(AXES))
        times = trials.times[rows[row]]
        read = measured[row, :, axis]
        off = np.zeros(())
        if known and (sensor.zero or sensor.drift):
            last = torch.from_numpy(known[next(reversed(known))][row])
            pair = torch.from_numpy(measured[row])[None], torch.from_numpy(times)[None]
            error = (
                sensor.deviations[axis]
                * sensor.errors(last[None, None], *pair)[0, 0, :, axis].numpy()
            )
            off = read - (last[:, axis].numpy() - error)
        curves = {model: values[row, :, axis] for model, values in known.items()}
        found[name] = ForceCurve(names[row], AXES[axis], sensor.unit, times, read - off, curves)
    return found
