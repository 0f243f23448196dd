"""Samples of a test that cannot be of its specimen: after it broke,
and readings of a load cell that drop out.

Both are found on the curve itself, in the order of its samples, before any law is fitted.

A break: the stress falls to 0.15 of what it was, or less, within four samples in which the strain
does not fall, and stays there to the end; or the strain falls, as the machine returns, to one at
which half of that stress was reached before, where that was half of the largest or more. The
samples from the fall on are strays. Elastomers relax by less, and have more stress where they are
unloaded.

A dropout: a run of up to ten samples whose strains lie between those of the samples before and
after it, while their stresses lie below half of the least of those, if they are positive, or above
twice the largest; by more than 2 % of the largest stress of the test, 5 % above, and twelve times
the usual roughness of the curve there. At a turn of the strain, as in cycles, the strain lies
outside, too; after a step of the strain, stresses may pass at once, and are no strays.
"""

from typing import Final

import numpy as np

from ...io.arrays import BoolArray, FloatArray

_BROKEN: Final = 0.15  # of the stress before, at most, that is left after a break
_LOADED: Final = 0.2  # of the largest stress, at least, before a break
_RETURNS: Final = (
    0.5  # of the stress before a break, that is at a strain to which the machine returns at once
)
_FALL: Final = 4  # samples in which a specimen tears
# Of the range of strains, by which a strain falls that counts as constant; of a dropout a fifth.
_STILL: Final = 0.05
_LONGEST: Final = 10  # samples of a dropout
_BESIDE: Final = 2  # samples before and after it that it is compared with
_NEAR: Final = 10  # samples on each side that show how rough the curve is
_AWAY: Final = (0.5, 1.0)  # of the least stress beside a dropout below, and of the largest above
_STEP: Final = 3.0  # ratio of a step of the strain to the usual one beside it
_LEAST: Final = (0.02, 0.05)  # of the largest stress of the test, likewise
_QUANTA: Final = 3.0  # steps of the resolution of the load cell
_ROUGH: Final = 12.0  # ratio to the roughness; 5 standard deviations or more of normal noise


def strays(strain: FloatArray, stress: FloatArray) -> dict[str, BoolArray]:
    """Returns samples (N,) in dropouts and after a break,
    by a few words on them, of those that there are.

    Args:
        strain: (N,) in the order of the test.
        stress: (N,) at these [Pa].
    """
    dropped = np.zeros(len(strain), bool)
    new = _dropout(strain, stress)
    while new is not None:
        dropped[np.flatnonzero(~dropped)[new]] = True
        new = _dropout(strain[~dropped], stress[~dropped])
    kept, broken = np.flatnonzero(~dropped), np.zeros(len(strain), bool)
    broken[kept[_end(strain[kept], stress[kept]) :]] = True
    found = {"where the load cell dropped out": dropped, "after the specimen broke": broken}
    return {words: rows for words, rows in found.items() if rows.any()}


def _end(strain: FloatArray, stress: FloatArray) -> int:
    """Returns the number of samples before a break, or of all."""
    count, still = len(strain), _STILL * float(np.ptp(strain)) if len(strain) else 0.0
    highest_after = np.maximum.accumulate(np.abs(stress)[::-1])[::-1]
    before_it = np.maximum.accumulate(stress)
    for first in (np.flatnonzero(highest_after[1:] <= _BROKEN * before_it[:-1]) + 1).tolist():
        start = max(first - _FALL, 0)
        last = start + int(np.argmax(stress[start:first]))
        before = float(stress[last])
        least = max(_LOADED * highest_after[0], _QUANTA * _quantum(stress))
        if before <= least or highest_after[first] > _BROKEN * before:
            continue
        reached = np.maximum.accumulate(strain[: last + 1])
        # At the same strain before.
        loaded = float(np.interp(strain[first], reached, stress[: last + 1]))
        returns = loaded >= _RETURNS * before >= _RETURNS**2 * highest_after[0]
        if strain[last : first + 1].min() >= strain[last] - still or returns:
            return last + 1
    return count


def _quantum(stress: FloatArray) -> float:
    """Returns the least difference of successive stresses that differ,
    the resolution of a coarse load cell.
    """
    steps = np.abs(np.diff(stress))
    return float(steps[steps > 0.0].min(initial=np.inf)) if steps.any() else 0.0


def _dropout(strain: FloatArray, stress: FloatArray) -> slice | None:
    """Returns the shortest run of samples that is a dropout, None without one."""
    strain, stress = (
        np.pad(values, 1, "edge") if len(values) else values for values in (strain, stress)
    )
    count = len(strain)
    size = float(np.abs(stress).max(initial=0.0))
    slack = 0.2 * _STILL * float(np.ptp(strain))
    rough = np.abs(stress[1:-1] - 0.5 * (stress[:-2] + stress[2:]))
    usual = float(np.median(rough)) if len(rough) else 0.0
    for length in range(1, min(_LONGEST, count - 2 * _BESIDE) + 1):
        windows = [
            np.lib.stride_tricks.sliding_window_view(values, length + 2 * _BESIDE)
            for values in (strain, stress)
        ]
        run = slice(_BESIDE, _BESIDE + length)
        strains, stresses = (np.delete(window, np.r_[run], axis=1) for window in windows)
        below = (stresses.min(1)[:, None] - windows[1][:, run]).min(1)
        above = (windows[1][:, run] - stresses.max(1)[:, None]).min(1)
        largest = np.abs(stresses).max(1)
        least = np.where(stresses.min(1) > 0.0, stresses.min(1), largest)
        changes = np.diff(windows[0], axis=1)
        steps, turns = np.abs(changes), changes[:, 0] * changes[:, -1] < -(slack**2)
        away = np.maximum(below, above)
        drops = (below > _AWAY[0] * least) & (below > _LEAST[0] * size)
        spikes = (above > _AWAY[1] * largest) & (above > _LEAST[1] * size)
        between = (windows[0][:, run] >= strains.min(1)[:, None] - slack) & (
            windows[0][:, run] <= strains.max(1)[:, None] + slack
        )
        even = steps.max(1) <= np.maximum(_STEP * np.median(steps, 1), 5.0 * slack)
        for start in np.flatnonzero((drops | spikes) & between.all(1) & even & ~turns):
            first = start + _BESIDE
            before = rough[max(first - 2 - _NEAR, 0) : max(first - 2, 0)]
            after = rough[first + length :][:_NEAR]
            near = float(np.median(np.append(before, after))) if len(before) + len(after) else 0.0
            if away[start] > max(_ROUGH * max(near, 0.5 * usual), _QUANTA * _quantum(stress)):
                return slice(first - 1, first - 1 + length)
    return None
