"""Trials as predictions without physics see them, and terms in which their inputs drive a body."""

import math
from dataclasses import dataclass, replace
from itertools import chain, combinations_with_replacement
from typing import Final

import numpy as np

from ..io.arrays import BoolArray, FloatArray, IntArray

_DEGREES: Final = (1, 2, 3)  # of powers and products of the inputs
_MOST_TERMS: Final = 100


@dataclass(frozen=True)
class PlainTrials:
    """R trials of which T frames of P coordinates were observed.

    A static pose is a trial of one frame.

    Attributes:
        values: (R, T, P) [m], NaN where a coordinate was not seen.
        origin: (R, P) where the body is at rest [m].
        first: (R, P) before time zero [m].
        inputs: (R, T, C) during each frame, of the size of one.
        known: (R, F) what else distinguishes trials, such as a load, of the size of one.
        before: (R, C) inputs before time zero, of the size of one.
        interval: between frames [s].
    """

    values: FloatArray
    origin: FloatArray
    first: FloatArray
    inputs: FloatArray
    known: FloatArray
    before: FloatArray
    interval: float

    def select(self, rows: BoolArray) -> "PlainTrials":
        """Returns some of the trials."""
        names = ("values", "origin", "first", "inputs", "known", "before")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def moved(self) -> FloatArray:
        """(R, T, P) displacements [m]."""
        return self.values - self.origin[:, None]

    def features(self, like: "PlainTrials") -> FloatArray:
        """(R, T' C + F + P) what distinguishes trials:
        inputs, loads, and displacements before time zero.

        Args:
            like: the training trials, whose mean displacement before time zero is the unit of
                displacements. Inputs count in the T' frames up to their end.
        """
        frames = int(np.flatnonzero(np.isfinite(like.values).any((0, 2)))[-1]) + 1
        parts = [
            self.inputs[:, :frames].reshape(len(self.inputs), -1) / np.sqrt(frames),
            self.known,
        ]
        size = np.linalg.norm(like.displaced, axis=1).mean()
        return np.concatenate([*parts, *([self.displaced / size] if size > 0.0 else [])], 1)

    @property
    def displaced(self) -> FloatArray:
        """(R, P) displacements before time zero [m], zero where they are not known."""
        return np.nan_to_num(self.first - self.origin)


@dataclass(frozen=True)
class Prediction:
    """Predicted motions (Q, T, P) [m], and the settings that were chosen, in words."""

    values: FloatArray
    settings: str = ""


def degrees(trials: PlainTrials) -> list[int]:
    """Degrees of a linear model in the inputs, fewer than trials,
    among which leaving trials out can choose.
    """
    count = len(acting_columns(trials))
    few = [degree for degree in _DEGREES if math.comb(count + degree, degree) <= _MOST_TERMS + 1]
    return [1, *(degree for degree in few if 1 < degree < len(trials.values) and count)]


def acting_columns(trials: PlainTrials) -> IntArray:
    """(A,) columns of inputs and loads that act in any trial."""
    return np.flatnonzero(np.concatenate([trials.inputs.any((0, 1)), trials.known.any(0)]))


def driving_terms(motions: PlainTrials, trials: PlainTrials, degree: int) -> FloatArray:
    """(R, T, D) powers and products of the inputs and loads of motions
    that act in training trials, and a constant.
    """
    frames = motions.inputs.shape[1]
    known = np.broadcast_to(
        motions.known[:, None], (len(motions.known), frames, motions.known.shape[1])
    )
    inputs = np.concatenate([motions.inputs, known], 2)
    acting = acting_columns(trials).tolist()
    terms = (combinations_with_replacement(acting, d) for d in range(1, degree + 1))
    columns = [inputs[..., list(term)].prod(-1) for term in chain.from_iterable(terms)]
    return np.stack([*columns, np.ones(inputs.shape[:2])], 2)
