"""Inputs, base and obstacles that act on bodies during trials, and the phases of driven trials."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..io.arrays import FloatArray
from .trials import STATIC, Trials

PHASES: Final = ("rise", "hold", "release")  # of driven trials, see `phases`
_SAME: Final = 0.02  # change of an input that counts as none, over its largest size
_RISE: Final = 0.5  # s after inputs grew


def time_since_change(times: FloatArray, inputs: Sequence[FloatArray]) -> FloatArray:
    """Returns the times since the last change of the inputs of B trials [s]; infinite for poses.

    An input changes where it leaves the value that it took at its last change by more than 2 % of
    its largest size in the trial, so that noise is no change. The first frame counts as one.

    Args:
        times: (T, B) [s]; a trial of one frame is a pose.
        inputs: (T, B, C) of each kind; none for bodies that are let go.
    """
    if len(times) == 1:
        return np.full_like(times, np.inf)
    last = np.broadcast_to(times[0], times.shape).copy()
    for values in inputs:
        limit = _SAME * np.abs(values).max(0)
        kept, changed = values[0].copy(), times[0].copy()
        for frame in range(1, len(times)):
            leaves = np.abs(values[frame] - kept) > limit
            kept = np.where(leaves, values[frame], kept)
            changed = np.where(leaves.any(-1), times[frame], changed)
            last[frame] = np.maximum(last[frame], changed)
    return np.asarray(times - last)


def phases(
    since: NDArray[np.float64], sizes: NDArray[np.float64], before: float = 0.0
) -> NDArray[np.str_]:
    """Returns the phase of each frame of a driven trial: ``rise``, ``hold`` or ``release``.

    Empty before any.

    After its inputs grew, a trial rises for half a second and then holds; after they fell, it is
    released until they grow again. Differences of up to 2 % of the largest size are noise.

    Args:
        since: (T,) since the last change of the norm [s], see `time_since_change`.
        sizes: (T,) norm of the inputs.
        before: the norm before the first frame.
    """
    changes = np.flatnonzero(since == 0.0)
    grew = np.diff(sizes[changes], prepend=before)
    grew[np.abs(grew) <= _SAME * sizes.max()] = 0.0
    last = np.searchsorted(changes, np.arange(len(since)), side="right") - 1
    rests = (last == 0) & (grew[0] == 0.0)
    return np.select([rests, grew[last] < 0.0, since <= _RISE], ["", "release", "rise"], "hold")


def driving(trials: Trials, names: Sequence[str]) -> dict[str, FloatArray]:
    """Returns what acts during each frame, (R, T, C) by input, base and obstacle.

    A pose has the last values.
    """
    rows = trials.rows(names)
    series = {name: values[rows] for name, values in trials.inputs.items()}
    series |= {} if trials.base is None else {"base": trials.base[rows]}
    series |= {f"obstacle {name}": poses[rows] for name, poses in trials.obstacles.items()}
    steps = (trials.times[rows] / trials.time_step + 1e-6).astype(np.int64)
    posed = np.array([trials.begins[row] == STATIC for row in rows], dtype=bool)
    steps[posed] = np.iinfo(np.int64).max
    return {
        name: np.take_along_axis(values, np.minimum(steps, values.shape[1] - 1)[..., None], 1)
        for name, values in series.items()
    }


def since_change(trials: Trials, names: Sequence[str]) -> FloatArray:
    """Returns the times (R, T) since the last change of the inputs [s], see `time_since_change`."""
    rows = trials.rows(names)
    acting = [np.moveaxis(values, 0, 1) for values in driving(trials, names).values()]
    since = time_since_change(trials.times[rows].T, acting).T
    since[[trials.begins[row] == STATIC for row in rows]] = np.inf
    return since


def first_change(trials: Trials, name: str) -> float:
    """Returns the time at which the inputs of a trial begin to change by more than noise [s].

    Zero if none does.
    """
    # The first frame counts as one.
    changes = np.flatnonzero(since_change(trials, [name])[0] == 0.0)
    return float(trials.times[trials.rows([name])[0], changes[1]]) if len(changes) > 1 else 0.0


def phases_of(trials: Trials, names: Sequence[str]) -> NDArray[np.str_]:
    """Returns the phases (R, T) of driven trials, see `phases`.

    Empty words for others and for poses.

    The size of the inputs is their norm, each kind over its largest value.
    """
    rows, acting = trials.rows(names), driving(trials, names)
    largest = {
        name: float(np.abs(values).max(initial=0.0)) for name, values in trials.inputs.items()
    }
    kinds = {name: acting[name] / size for name, size in largest.items() if size}
    found = np.full(trials.times[rows].shape, "", dtype="<U7")
    if not kinds:
        return found
    sizes = np.linalg.norm(np.concatenate([*kinds.values()], 2), axis=2)  # (R, T)
    since = time_since_change(trials.times[rows].T, [sizes.T[..., None]]).T
    for k, row in enumerate(rows):
        if trials.begins[row] != STATIC:
            before = [
                trials.resting[name][row] / largest[name]
                for name in kinds
                if name in trials.resting
            ]
            found[k] = phases(
                since[k], sizes[k], float(np.linalg.norm(np.concatenate([[0.0], *before])))
            )
    return found
