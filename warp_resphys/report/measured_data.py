"""What the reports of measured motions show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.registration import Registration
from ..learning.metrics import PublishedError
from ..mesh.mesh import Mesh
from .measured_tables import MODELS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Recordings:
    """How the recordings are, and how they were registered.

    Attributes:
        quality: By trial, as `warp_resphys.data.recordings.quality.Quality.to_plain` gives it.
        residuals: By trial: `rms_mm`, `residual_mm` and `shift_mm` by label, `outliers`.
        registration: Of the trial that fits worst, for the picture.
        drawn: That trial's name.
        nominal: (M, 3) [m] where its markers should be.
        feet: (M, 3) [m] the closest points of the body.
        mesh: The body as it is at rest.
    """

    quality: Mapping[str, Any]
    residuals: Mapping[str, Any]
    registration: Registration
    drawn: str
    nominal: FloatArray
    feet: FloatArray
    mesh: Mesh


@dataclass(frozen=True, eq=False)
class Trials:
    """What was measured in the R test trials, and what the models made of them.

    Attributes:
        names: Of the trials.
        labels: Of the M markers.
        times: (R, T) of the frames since the release [s]; those that count.
        measured: (R, T, M, 3) [m], NaN where a marker was not seen.
        bound: (M, 3) [m] the markers on the body at rest.
        gravity: (3,) [m/s^2].
        markers: (R, T, M, 3) [m] by model.
        positions: (R, K + 1, N, 3) [m] by model, at multiples of the time step.
        time_step: [s].
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    times: FloatArray
    measured: FloatArray
    bound: FloatArray
    gravity: FloatArray
    markers: Mapping[str, FloatArray]
    positions: Mapping[str, FloatArray]
    time_step: float

    def errors_mm(self) -> dict[str, FloatArray]:
        """Return (R, T) mean distances [mm] of the markers by model; see `mean_distance`."""
        return {model: mean_distance(markers, self.measured) for model, markers in self.markers.items()}


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """What every page on recordings shows.

    Attributes:
        experiment: Its name.
        title: The page's heading.
        metrics: `errors_mm`, `versions` and `device`, and what else the page asks for.
        settings: The run's configuration, nested.
        published: Published errors, empty where there are none.
        published_note: Why they are not measured on the same data.
        notes: Sentences on the errors of this run.
        mesh: The body at rest.
        fixed: Vertices of the clamped region.
        recordings: Quality and registration of all trials.
        synthetic: Whether what is called measured was simulated, as there are no recordings.
    """

    experiment: str
    title: str
    metrics: Mapping[str, Any]
    settings: Mapping[str, Any]
    published: Mapping[str, PublishedError]
    published_note: str
    notes: Sequence[str]
    mesh: Mesh
    fixed: IntArray
    recordings: Recordings
    synthetic: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitReport(RunReport):
    """Besides, what every page of a split shows.

    Attributes:
        trials: The test trials.
        identification: What identification.json holds.
        start: The values of the data sheet, by parameter.
        truth: Those of the simulated reality, where there is one.
        training: Records of the epochs, by learned model.
    """

    trials: Trials
    identification: Mapping[str, Any]
    start: Mapping[str, float]
    truth: Mapping[str, Any]
    training: Mapping[str, Sequence[Mapping[str, Any]]]


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredReport(SplitReport):
    """Everything that the page of a split of motions without actuation shows.

    Its metrics have `per_trajectory`, `per_marker`, `seconds` and `peak_memory_gib` too.

    Attributes:
        seconds: How much of each trial counts; None for all of it.
    """

    seconds: float | None


@dataclass(frozen=True, eq=False, kw_only=True)
class FoldsReport(RunReport):
    """Everything that the page over the folds shows.

    Its metrics are `folds` (a fold's metrics by its test trial) and `errors_mm` over all of them.

    Attributes:
        pages: Address of each fold's page, by its test trial.
        seconds: How much of each trial counts; None for all of it.
    """

    pages: Mapping[str, str]
    seconds: float | None


def mean_distance(markers: FloatArray, measured: FloatArray) -> FloatArray:
    """Return (R, T) mean distances [mm] of the markers that were seen.

    Where none was seen it is NaN, where a simulated one has diverged infinite.

    Args:
        markers: (R, T, M, 3) [m].
        measured: (R, T, M, 3) [m], NaN where a marker was not seen.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        distance = 1e3 * np.linalg.norm(markers - measured, axis=3)
        seen = np.isfinite(measured).all(axis=3)
        distance = np.where(seen, np.where(np.isfinite(distance), distance, np.inf), 0.0)
        count = seen.sum(axis=2)
        mean: FloatArray = np.where(count > 0, distance.sum(axis=2) / np.maximum(count, 1), np.nan)
    return mean


def best_and_worst(trials: Trials) -> list[int]:
    """Return the trials in which the best model of all is farthest off, and closest; one where there is one only."""
    errors = trials.errors_mm()
    model = next(m for m in reversed(list(MODELS)) if m in errors)
    each = np.array([row[~np.isnan(row)].mean() if (~np.isnan(row)).any() else np.inf for row in errors[model]])
    worst, best = int(np.argmax(each)), int(np.argmin(each))
    return [worst] if worst == best else [worst, best]


def shown_models(markers: Mapping[str, FloatArray]) -> list[str]:
    """Return the models that are drawn as bodies: the uncorrected one, and last the best that there is."""
    plain = next((m for m in ("simulation", "published") if m in markers), None)
    solid = next((m for m in ("resphys", "resphys_uncorrected", "sysid", "sysid_elastic") if m in markers), None)
    return [m for m in (plain, solid) if m is not None]


def at_times(positions: FloatArray, time_step: float, times: FloatArray) -> FloatArray:
    """Return (T, N, 3) positions at some times, linear between those that are known.

    Args:
        positions: (K + 1, N, 3) at multiples of the time step, from zero on.
        time_step: [s].
        times: (T,) [s].
    """
    at = np.clip(times / time_step, 0.0, len(positions) - 1.0)
    low = np.minimum(at.astype(int), max(len(positions) - 2, 0))
    share = (at - low)[:, None, None]
    with np.errstate(invalid="ignore", over="ignore"):
        between: FloatArray = (1.0 - share) * positions[low] + share * positions[
            np.minimum(low + 1, len(positions) - 1)
        ]
    return between
