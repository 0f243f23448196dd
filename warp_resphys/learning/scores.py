"""Errors of models on held-out motions, and whether one model is clearly closer to them
than the one that it corrects.

Nothing that is learned is used unless it is.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Final, NotRequired

import numpy as np
from typing_extensions import TypedDict

from ..io.arrays import FloatArray
from ..io.errors import InputError
from .metrics import redundancy

_CLEARLY, _CLOSER = 0.5, 0.95  # ratios of errors
_SIGNIFICANT: Final = 2.0  # standard errors by which a law must be closer
_SPREAD: Final = (
    1.0  # standard errors by which a network must be closer, of the frames and of the trials
)
_LEAST_GAIN: Final = 0.99  # ratio of errors below which a gain may count
_LEAST_SIZE: Final = 0.3  # of the largest amplitude, below which a trial counts as one of this size
_NAMED: Final = 5  # trials of a test at most, whose names a sentence has


@dataclass(frozen=True)
class Score:
    """Errors of a simulator on trials: in each frame the mean square
    over the squared amplitude of the trial.
    """

    frames: tuple[FloatArray, ...]  # (T,) of each trial

    @classmethod
    def of(cls, trials: Iterable[tuple[FloatArray, float]]) -> "Score":
        """Returns the score of trials, each with its mean distances (T,)
        by frame and its amplitude, in one unit.
        """
        return cls(
            tuple(
                np.square(np.nan_to_num(away, nan=math.inf) / amplitude)
                for away, amplitude in trials
            )
        )

    @property
    def error(self) -> float:
        """Root mean square over the amplitude, over all trials; infinite if one failed."""
        if not self.frames:
            return math.inf
        square = fmean(float(of_trial.mean()) for of_trial in self.frames)
        return math.sqrt(square) if math.isfinite(square) else math.inf

    def beats(self, other: "Score", standard_errors: float = _SIGNIFICANT) -> bool:
        """Whether the error is at most half, or its mean square smaller by some standard errors.

        Frames are correlated in time, so that a short trial may show no less than a large gain. Of
        static poses the standard error is that of the trials' mean; one pose has none, and its
        error must be smaller by 5 %.
        """
        if not math.isfinite(self.error) or self.error <= _CLEARLY * other.error:
            return self.error < other.error
        less = [theirs - ours for ours, theirs in zip(self.frames, other.frames, strict=True)]
        means = np.array([d.mean() for d in less])
        if max(len(d) for d in less) > 1:
            variance = [float(d.var()) * redundancy((d - d.mean())[:, None]) / len(d) for d in less]
            doubt = math.sqrt(sum(variance)) / len(less)
        elif len(less) > 1:
            doubt = float(means.std(ddof=1)) / math.sqrt(len(less))
        else:
            return self.error < _CLOSER * other.error
        return float(means.mean()) > standard_errors * doubt


class HeldOutTest(TypedDict):
    """Errors on held-out trials of a model that was learned, and of the simulator alone."""

    trials: list[str]
    split: str  # that they belong to
    error_mm: float | None  # mean over the trials of their means; None where one diverged
    below_mm: float | None  # of the simulator alone
    used: bool  # whether the model is clearly closer, see `Score.beats`, and not refused
    refused: NotRequired[list[str]]  # why it is refused although it is closer, see `acceptance`


def held_out_test(
    trials: Sequence[str],
    split: str,
    errors: Iterable[FloatArray],
    below: Iterable[FloatArray],
    sizes: Iterable[float],
) -> HeldOutTest:
    """Compares a model with the one below it on held-out trials.

    Besides `Score.beats`, its gain must be larger than its standard error over the trials.

    Args:
        trials: their names.
        split: that they belong to.
        errors: mean distances (T,) by frame of each trial [mm], NaN where the roll-out diverged.
        below: those of the model below.
        sizes: amplitudes of the trials [mm].

    Raises:
        InputError: no marker was seen in any of them.
    """
    seen = [of_trial for of_trial in zip(errors, below, sizes, strict=True) if len(of_trial[0])]
    if not seen:
        raise InputError(
            f"none of the {split} trials shows a marker: {', '.join(trials)}; take others."
        )
    rows, others, found = ([*column] for column in zip(*seen, strict=True))
    least = _LEAST_SIZE * float(np.nanmax(found, initial=0.0))
    # Trials that hardly move, or of which it is not known, count as ones of the least size.
    amplitudes = [size if size > least else least or 1.0 for size in found]
    scores = [Score.of(zip(some, amplitudes, strict=True)) for some in (rows, others)]
    means = [fmean(float(row.mean()) for row in some) for some in (rows, others)]
    error, alone = (mean if math.isfinite(mean) else None for mean in means)
    used = scores[0].beats(scores[1], _SPREAD) and scores[0].error < _LEAST_GAIN * scores[1].error
    if used and len(rows) > 1 and math.isfinite(scores[1].error):
        gains = [
            float(b.mean() - a.mean())
            for a, b in zip(scores[0].frames, scores[1].frames, strict=True)
        ]
        used = fmean(gains) > _SPREAD * float(np.std(gains, ddof=1)) / math.sqrt(len(gains))
    return HeldOutTest(trials=[*trials], split=split, error_mm=error, below_mm=alone, used=used)


def text_of(test: HeldOutTest) -> str:
    """Returns half a sentence on the errors of a learned model on held-out trials,
    and of the simulator without it.
    """
    error, below = (
        "diverges" if x is None else f"has {x:.3g} mm" for x in (test["error_mm"], test["below_mm"])
    )
    trials = (
        ", ".join(test["trials"]) if len(test["trials"]) <= _NAMED else str(len(test["trials"]))
    )
    refused = test.get("refused", [])
    clear = (
        f"; it is refused: {'; '.join(refused)}" if refused else ", which it does not clearly beat"
    )
    clear = "" if test["used"] else clear
    return (
        f"on the {test['split']} trials ({trials}) it {error}, "
        f"and the simulator without it {below}{clear}"
    )
