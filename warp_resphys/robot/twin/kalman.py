"""Steps of a Kalman filter that the estimators share: conditioning on markers, and the gate for wrong ones."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_JITTER = 1e-12  # of a correlation matrix, which is singular where a quantity is known exactly


def conditioned(
    covariance: FloatArray, slopes: FloatArray, residual: FloatArray, deviation: float
) -> tuple[FloatArray, FloatArray]:
    """Conditions n jointly normal errors on m observations with independent noise.

    In the square-root form of Bierman (1977), which stays positive definite, and costs n^3 however many observations.

    Args:
        covariance: (n, n).
        slopes: (m, n) of the observations.
        residual: (m,) observed minus expected.
        deviation: standard deviation of the noise.

    Returns:
        The change of the mean (n,), and the covariance (n, n) after it.
    """
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0.0, size, 1.0)
    scaled = covariance / size / size[:, None]
    root = size[:, None] * np.linalg.cholesky(scaled + _JITTER * np.eye(len(size)))
    seen = (slopes @ root).T / deviation
    gained = scipy.linalg.solve(np.eye(len(size)) + seen @ seen.T, root.T, assume_a="pos").T
    after = gained @ root.T
    return gained @ (seen @ residual) / deviation, 0.5 * (after + after.T)


def distances(covariance: FloatArray, slopes: FloatArray, residual: FloatArray, deviation: float) -> FloatArray:
    """Distances (M,) of markers from where they are expected, in standard deviations (Mahalanobis).

    Args:
        covariance: (n, n) of the errors.
        slopes: (M, 3, n) of the markers.
        residual: (M, 3) observed minus expected [m].
        deviation: of a coordinate [m].
    """
    spread = slopes @ covariance @ slopes.mT + deviation**2 * np.eye(3)
    return np.sqrt(np.einsum("mi,mi->m", residual, np.linalg.solve(spread, residual[..., None])[..., 0]))


@dataclass(frozen=True)
class Correction:
    """The result of a frame of M markers.

    Attributes:
        seen: (M,) markers in the frame.
        refused: (M,) markers that were left out, since they jumped.
        moved: (M,) markers that have moved on the body, to where they are looked for from now on.
        restarted: whether the body has moved to where markers stayed, so that its state was unknown.
        off: (M,) distances from where the corrected simulator expected them [m], NaN where not seen.
        free: (M, 3) offsets from the simulator that sees no markers [m], NaN where not seen.
        worse: whether these have been much smaller for a while, so that it went on from there.
    """

    seen: BoolArray
    refused: BoolArray
    moved: BoolArray
    restarted: bool
    off: FloatArray
    free: FloatArray
    worse: bool


@dataclass(frozen=True)
class Gate:
    """Which markers of a frame are believed.

    A marker that jumps away from where it is expected is left out until it has stayed away for `grace`.

    Attributes:
        limit: distance from where it is expected, in standard deviations.
        least: jump below which no marker is left out [m].
        grace: [s].
    """

    limit: float = 6.0
    least: float = 2e-3
    grace: float = 0.1

    def judged(
        self, away: FloatArray, jump: FloatArray, since: FloatArray, passed: float
    ) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Judges the markers of a frame.

        Args:
            away: (M,) `distances`, NaN where a marker is not seen.
            jump: (M,) how far it has jumped beside what was expected, since it was last believed [m].
            since: (M,) how long each has been left out [s].
            passed: time since the last frame [s].

        Returns:
            Which are left out, which of these have stayed away, and the new `since`.
        """
        out = (away > self.limit) & (jump > self.least)
        later = np.where(out, since + passed, np.where(np.isnan(away), since, 0.0))
        return out, out & (since > 0.0) & (later >= self.grace), later
