"""Prediction intervals of roll-outs: how far markers will be from where a model has them.

Posteriors of parameters and ensembles of networks know nothing of the physics that a model lacks, which is most of its
error. So intervals come from how far the model was off in trials that did not train it (split conformal prediction:
Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005; scaled as by Lei et al. 2018): whatever the
model, they hold as often as they say for trials like those.

The half-width of a marker's coordinates is a quantile times a scale, of the two scales that which leaves the narrower
intervals on the calibrating trials: the same at all times, or larger where the marker has moved further.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEVEL = 0.9
_STANDING = 0.1  # of the mean displacement of a marker, that its scale has where it stands still
_LEVELS = 11  # quantiles that are tried, from the level asked for to the largest value
_SCALES = ("constant", "displacement")


@dataclass(frozen=True)
class Intervals:
    """Half-widths of the intervals of M markers."""

    scale: str  # ``constant`` or ``displacement``
    factor: tuple[float, ...]  # (M,) of the scale: half-widths [m], or shares of how far a marker has moved
    standing: tuple[float, ...]  # (M,) added to how far it has moved [m]

    @classmethod
    def calibrated(
        cls, simulated: Sequence[FloatArray], observed: Sequence[FloatArray], rest: FloatArray, level: float = LEVEL
    ) -> "Intervals | None":
        """From trials that did not train the model; None where one has diverged.

        The quantile is the lowest with which intervals from all calibrating trials but one hold often enough in that
        one, on average; the largest deviation of all, if none does or there is one trial. All trials weigh the same.
        Markers that none of them shows get the largest quantile of those that are shown: nothing says that these hold.

        Args:
            simulated: (T, M, 3) of each trial [m], by the model.
            observed: (T, M, 3) [m], NaN where a marker was not seen.
            rest: (M, 3) the markers on the undeformed body [m].
            level: share of the coordinates that the intervals are to cover.
        """
        seen = [_seen(each) for each in observed]  # (T, M)
        if not all(np.isfinite(each[at]).all() for each, at in zip(simulated, seen, strict=True)):
            return None
        known = np.any([at.any(0) for at in seen], axis=0)
        if not known.any():
            return None
        counted = [at | ~known for at in seen]
        pairs = zip(simulated, counted, strict=True)
        moved = [np.where(at, np.linalg.norm(x - rest, axis=-1), np.nan) for x, at in pairs]
        standing = tuple((_STANDING * np.nanmean(np.concatenate(moved), axis=0)).tolist())
        found = []
        for scale in _SCALES:
            widths = [cls(scale, tuple(np.ones(len(rest))), standing).half_widths(each, rest) for each in simulated]
            scores = [np.abs(x - y) / w[..., None] for x, y, w in zip(simulated, observed, widths, strict=True)]
            factor = _factor(scores, level)
            factor[~known] = factor[known].max()
            mean = float(np.mean([(w * factor)[at].mean() for w, at in zip(widths, seen, strict=True) if at.any()]))
            found.append((mean, cls(scale, tuple(factor.tolist()), standing)))
        return min(found, key=lambda pair: pair[0])[1]

    def half_widths(self, simulated: FloatArray, rest: FloatArray) -> FloatArray:
        """(..., M) of the coordinates of (..., M, 3) simulated markers [m]."""
        moved = np.linalg.norm(simulated - rest, axis=-1)
        scale = np.ones_like(moved) if self.scale == "constant" else moved + np.array(self.standing)
        return np.asarray(scale * np.array(self.factor))

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {key: list(each) if isinstance(each, tuple) else each for key, each in asdict(self).items()}

    @classmethod
    def from_plain(cls, found: Mapping[str, Any]) -> "Intervals":
        """From `plain`."""
        return cls(found["scale"], tuple(found["factor"]), tuple(found["standing"]))

    def holds(
        self, simulated: Sequence[FloatArray], observed: Sequence[FloatArray], rest: FloatArray
    ) -> dict[str, Any]:
        """How often they do in trials that calibrated nothing, all of which weigh the same, and how wide they are.

        Args:
            simulated: (T, M, 3) of each trial [m].
            observed: (T, M, 3) [m], NaN where a marker was not seen.
            rest: (M, 3) [m].

        Returns:
            ``coverage``, the share of the coordinates that were seen that lie inside, and ``half_width_mm``, a mean.
        """
        inside, widths = [], []
        for x, y in zip(simulated, observed, strict=True):
            at, width = _seen(y), self.half_widths(x, rest)
            if at.any():
                with np.errstate(invalid="ignore"):
                    inside.append(float((np.abs(x - y) <= width[..., None])[at].mean()))
                widths.append(float(width[at].mean()))
        return {"coverage": float(np.mean(inside)), "half_width_mm": 1e3 * float(np.mean(widths))}


def _seen(observed: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(observed).all(-1))


def _factor(scores: Sequence[FloatArray], level: float) -> FloatArray:
    """(M,) the factors with which intervals hold at that level, of (T, M, 3) deviations over their scale by trial."""
    for asked in np.linspace(level, 1.0, _LEVELS) if len(scores) > 1 else ():
        held = []
        for out, left in enumerate(scores):
            factor = _quantiles([each for row, each in enumerate(scores) if row != out], float(asked))
            known = np.isfinite(left)
            if known.any():
                held.append(float((left <= factor[:, None])[known].mean()))
        if np.mean(held) >= level:
            return _quantiles(scores, float(asked))
    return _quantiles(scores, 1.0)


def _quantiles(scores: Sequence[FloatArray], level: float) -> FloatArray:
    """(M,) quantiles of (T, M, 3) values by trial, NaN left out, each trial weighing the same; infinite of none."""
    found = np.full(scores[0].shape[1], np.inf)
    for m in range(len(found)):
        used = [values[np.isfinite(values)] for values in (each[:, m].ravel() for each in scores)]
        used = [each for each in used if len(each)]
        if used:
            weights = np.concatenate([np.full(len(each), 1.0 / (len(each) * len(used))) for each in used])
            values = np.concatenate(used)
            order = np.argsort(values)
            reached = int(np.searchsorted(np.cumsum(weights[order]), level - 1e-9))
            found[m] = values[order[min(reached, len(values) - 1)]]
    return found
