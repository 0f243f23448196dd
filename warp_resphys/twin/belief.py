"""The estimate of a robot's state with its covariance,
and what a frame of markers has changed in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..io.arrays import BoolArray, FloatArray

JUMPS: Final = "jumps of the whole body"


@dataclass(frozen=True)
class Correction:
    """The result of a frame of M markers."""

    seen: BoolArray  # (M,) markers in the frame
    refused: BoolArray  # (M,) markers that were left out, since they jumped
    moved: BoolArray  # (M,) markers that moved on the body: from now on, looked for there
    restarted: (
        bool  # whether the body has moved to where markers stayed, so that its state was unknown
    )
    off: FloatArray  # (M,) distances from the corrected simulator's [m], NaN where not seen
    free: (
        FloatArray  # (M, 3) offsets from the simulator that sees no markers [m], NaN where not seen
    )
    worse: bool  # whether these have been much smaller for a while, so that it went on from there

    def faults(self, labels: Sequence[str]) -> list[str]:
        """Returns what was wrong with the markers, whose names are empty
        where all vertices are observed.
        """
        words = (("jumps", self.refused), ("has moved on the body", self.moved))
        names = labels or ["a vertex"] * len(self.seen)
        faults = [
            f"{names[number]} {word}"
            for word, chosen in words
            for number in map(int, np.flatnonzero(chosen))
        ]
        faults += [JUMPS] if self.restarted else []
        return faults + (
            ["it went on from the simulator without markers, which was closer"]
            if self.worse
            else []
        )


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Estimate of a robot's state after a step, with its covariance."""

    parameters: FloatArray  # (P,) refined values
    bias: FloatArray  # (r,) shift of the equilibrium
    places: FloatArray  # (M, 3) markers from where they are bound [m]
    covariance: FloatArray  # (n, n) of the errors of z, w, b, parameters and places
    since: FloatArray  # (M,) for how long markers have been left out [s]
    left: FloatArray  # (M, 3) rest of the distance of markers when last believed [m]; NaN: never
    # (2,) mean squared distances of markers from where they were expected, and from the simulator
    # without markers, over the last frames [m^2]
    squares: FloatArray
    # factor of the variance that a step adds, by which past frames would have been as far off as
    # expected
    shaken: float = 1.0
