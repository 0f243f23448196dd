"""Observations of trials, interpolated from their frames to a simulator's steps,
and readings of force sensors in a step.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.dynamics.simulator import Simulator
from ..core.stepping.inputs import Inputs
from ..core.stepping.rollout import sample
from ..core.stepping.state import Constants, State
from ..data.force_sensors import ForceSensor
from ..io.errors import InputError, naming
from .trial_batch import TrialBatch

_NEAR = 1.5  # frames from a step to the nearest one in which something was seen


def readings(
    simulator: Simulator,
    sensors: Sequence[ForceSensor],
    after: State,
    before: State | None,
    inputs: Inputs,
    constants: Constants,
) -> torch.Tensor:
    """Returns readings (B, S, 6) of force sensors at the end of a step, differentiable [N, N m].

    Args:
        simulator: of the step.
        sensors: the S sensors.
        after: state at the end.
        before: state at the start; None for an equilibrium.
        inputs: during the step.
        constants: of the simulator.

    Raises:
        InputError: a sensor is on nothing that holds or touches the body.
    """
    if sensors and len(simulator.body.coordinates.sliding):
        raise InputError(
            "a force sensor reads the whole robot, and symmetry planes cut it: simulate all of it."
        )
    found = list[torch.Tensor]()
    for sensor in sensors:
        stands = isinstance(sensor.at, str) and sensor.at in simulator.energies.obstacle_names
        at = simulator.fixed if sensor.at is None else sensor.at
        with naming("a force sensor: "):
            reaction = simulator.reaction(after, at, before, inputs, constants)
        found.append(
            sensor(reaction, None if stands else simulator.rest_positions[reaction.vertices])
        )
    return torch.stack(found, 1) if found else after.q.new_zeros(after.batch, 0, 6)


def later(series: torch.Tensor, delay: torch.Tensor, step: float) -> torch.Tensor:
    """Values (B, K + 1, ...) at the times k h after delays (B,) [s], from those at k h.

    Before the series, its first value holds; after its end, values are NaN.
    """
    last = series.shape[1] - 1
    times = step * torch.arange(last + 1).to(delay) + delay[:, None]
    over = times > (last + 1e-6) * step
    return sample(series, times, step).masked_fill(
        over.view(*over.shape, *[1] * (series.ndim - 2)), torch.nan
    )


def at_steps(
    trials: TrialBatch, step: float, delay: torch.Tensor | None = None
) -> NDArray[np.float64]:
    """(R, K + 1, M, 3) markers at the steps of a simulation [m],
    NaN after a motion's end and in long occlusions.

    Interpolates with cubic splines through the frames in which a marker was seen, starting from the
    held position at time zero. A marker counts as not seen at steps that are more than 1.5 frames
    away from its nearest frame.

    Args:
        trials: observed trials.
        step: time step h [s].
        delay: (R,) delay of the release after time zero of the frames [s]; zero by default.
    """
    from scipy.interpolate import CubicSpline

    since = trials.times if delay is None else (trials.times - delay[:, None]).clamp_min(0.0)
    times = since.cpu().numpy()
    markers, held = trials.observed.cpu().numpy(), trials.held.cpu().numpy()
    steps = step * np.arange(int(times.max() / step + 1e-6) + 1)
    positions = np.full((len(times), len(steps), *markers.shape[2:]), np.nan)
    for r, m in np.ndindex(len(times), markers.shape[2]):
        seen = np.isfinite(markers[r, :, m]).all(1)
        t, y = times[r, seen], markers[r, seen, m]
        t, first = np.unique(t, return_index=True)
        y = y[first]
        if np.isfinite(held[r, m]).all() and (not len(t) or t[0] > 1e-9):
            t, y = np.concatenate([[0.0], t]), np.concatenate([held[r, m][None], y])
        if len(t) < min(4, len(times[r])):
            continue
        nearest = np.abs(steps[:, None] - t).min(1)
        near = (nearest <= _NEAR * np.median(np.diff(t))) & (steps <= t[-1] + 1e-9)
        positions[r, near, m] = CubicSpline(t, y)(steps[near])
    return positions


def loads_at_steps(
    trials: TrialBatch, step: float, delay: torch.Tensor, count: int
) -> torch.Tensor:
    """(R, count, S, 6) readings at the steps of a simulator [N, N m], linear between frames.

    NaN before and after the frames, and at steps that are more than 1.5 frames away from the
    nearest reading.

    Args:
        trials: observed trials.
        step: time step h [s].
        delay: (R,) delay of the release after time zero of the frames [s].
        count: number of steps, the start among them.
    """
    since, loads = (trials.times - delay[:, None]).cpu().numpy(), trials.loads.cpu().numpy()
    steps = step * np.arange(count)
    series = np.full((len(since), count, *loads.shape[2:]), np.nan)
    for row, sensor, axis in np.ndindex(len(since), *loads.shape[2:]):
        values = loads[row, :, sensor, axis]
        known = np.isfinite(values)
        if known.any():
            times, frame = since[row, known], np.diff(since[row]).max(initial=step)
            near = np.abs(steps[:, None] - times).min(1) <= _NEAR * frame
            read = np.interp(steps, times, values[known], np.nan, np.nan)
            series[row, near, sensor, axis] = read[near]
    return trials.loads.new_tensor(series)
