"""Prediction intervals of roll-outs: how far observed markers will be from the predicted ones.

Posteriors of parameters and ensembles of networks do not contain the physics that a model lacks, which is most of its
error. So intervals are calibrated on the model's errors in trials that it was not trained on (split conformal
prediction: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005; scaled as by Lei et al. 2018).
For trials of the same distribution they have the stated coverage, whatever the model.

The half-width of a marker's coordinates is a quantile times a scale. The scale is either constant or grows with the
marker's displacement, whichever gives the narrower intervals on the calibration trials.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEVEL = 0.9
_STANDING = 0.1  # scale of a marker at rest, relative to its mean displacement
_LEVELS = 11  # number of quantiles that are tried, from the wanted level to the largest value
_SCALES = ("constant", "displacement")


@dataclass(frozen=True)
class Intervals:
    """Half-widths of the intervals of M markers."""

    scale: str  # ``constant`` or ``displacement``
    factor: tuple[float, ...]  # (M,) half-width [m] of a constant scale, or half-width over displacement
    standing: tuple[float, ...]  # (M,) added to the displacement [m]

    @classmethod
    def calibrated(
        cls, simulated: Sequence[FloatArray], observed: Sequence[FloatArray], rest: FloatArray, level: float = LEVEL
    ) -> "Intervals | None":
        """Calibrates intervals on trials that the model was not trained on; None if a roll-out diverged.

        The quantile is the lowest for which intervals from all trials but one have the wanted mean coverage on the
        trial left out; the largest deviation if there is no such quantile or only one trial. All trials have equal
        weight. Markers that are seen in no trial get the largest quantile of the others, without a guarantee.

        Args:
            simulated: (T, M, 3) of each trial, by the model [m].
            observed: (T, M, 3) [m], NaN where a marker was not seen.
            rest: (M, 3) markers on the undeformed body [m].
            level: wanted coverage, a share of the coordinates.
        """
        seen = [_seen(y) for y in observed]  # (T, M)
        if not all(np.isfinite(x[visible]).all() for x, visible in zip(simulated, seen, strict=True)):
            return None
        ever_seen = np.any([visible.any(0) for visible in seen], axis=0)
        if not ever_seen.any():
            return None
        pairs = zip(simulated, seen, strict=True)
        moved = [np.where(visible | ~ever_seen, np.linalg.norm(x - rest, axis=-1), np.nan) for x, visible in pairs]
        standing = tuple((_STANDING * np.nanmean(np.concatenate(moved), axis=0)).tolist())
        candidates = []
        for scale in _SCALES:
            widths = [cls(scale, tuple(np.ones(len(rest))), standing).half_widths(x, rest) for x in simulated]
            scores = [np.abs(x - y) / w[..., None] for x, y, w in zip(simulated, observed, widths, strict=True)]
            factor = _factor(scores, level)
            factor[~ever_seen] = factor[ever_seen].max()
            means = [(w * factor)[visible].mean() for w, visible in zip(widths, seen, strict=True) if visible.any()]
            candidates.append((float(np.mean(means)), cls(scale, tuple(factor.tolist()), standing)))
        return min(candidates, key=lambda candidate: candidate[0])[1]

    def half_widths(self, simulated: FloatArray, rest: FloatArray) -> FloatArray:
        """Half-widths (..., M) for the coordinates of simulated markers (..., M, 3) [m]."""
        moved = np.linalg.norm(simulated - rest, axis=-1)
        scale = np.ones_like(moved) if self.scale == "constant" else moved + np.array(self.standing)
        return np.asarray(scale * np.array(self.factor))

    def plain(self) -> dict[str, Any]:
        """Returns the intervals as JSON data."""
        return {"scale": self.scale, "factor": list(self.factor), "standing": list(self.standing)}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> "Intervals":
        """Returns the intervals that `plain` wrote."""
        return cls(plain["scale"], tuple(plain["factor"]), tuple(plain["standing"]))

    def coverage(
        self, simulated: Sequence[FloatArray], observed: Sequence[FloatArray], rest: FloatArray
    ) -> dict[str, Any]:
        """Measures coverage and width on trials that were not used for calibration, all with equal weight.

        Args:
            simulated: (T, M, 3) of each trial [m].
            observed: (T, M, 3) [m], NaN where a marker was not seen.
            rest: (M, 3) [m].

        Returns:
            ``coverage``, the share of the seen coordinates inside their interval, and the mean ``half_width_mm``.
        """
        inside, widths = [], []
        for x, y in zip(simulated, observed, strict=True):
            visible, width = _seen(y), self.half_widths(x, rest)
            if visible.any():
                with np.errstate(invalid="ignore"):
                    inside.append(float((np.abs(x - y) <= width[..., None])[visible].mean()))
                widths.append(float(width[visible].mean()))
        return {"coverage": float(np.mean(inside)), "half_width_mm": 1e3 * float(np.mean(widths))}


def _seen(observed: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(observed).all(-1))


def _factor(scores: Sequence[FloatArray], level: float) -> FloatArray:
    """(M,) factors with which intervals have the wanted coverage, from scaled deviations (T, M, 3) of each trial."""
    for quantile in np.linspace(level, 1.0, _LEVELS) if len(scores) > 1 else ():
        covered = []
        for number, left_out in enumerate(scores):
            factor = _quantiles([*scores[:number], *scores[number + 1 :]], float(quantile))
            seen = np.isfinite(left_out)
            if seen.any():
                covered.append(float((left_out <= factor[:, None])[seen].mean()))
        if np.mean(covered) >= level:
            return _quantiles(scores, float(quantile))
    return _quantiles(scores, 1.0)


def _quantiles(scores: Sequence[FloatArray], level: float) -> FloatArray:
    """(M,) quantiles of the finite values (T, M, 3), all trials with equal weight; infinite where there are none."""
    quantiles = np.full(scores[0].shape[1], np.inf)
    for m in range(len(quantiles)):
        used = [trial[np.isfinite(trial)] for trial in (score[:, m].ravel() for score in scores)]
        used = [trial for trial in used if len(trial)]
        if used:
            weights = np.concatenate([np.full(len(trial), 1.0 / (len(trial) * len(used))) for trial in used])
            values = np.concatenate(used)
            order = np.argsort(values)
            reached = int(np.searchsorted(np.cumsum(weights[order]), level - 1e-9))
            quantiles[m] = values[order[min(reached, len(values) - 1)]]
    return quantiles
