"""Data of the page of a run."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from statistics import fmean
from typing import NotRequired, TypedDict

import numpy as np

from ..core.energies.catalogue import LawContent
from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.mesh.chambers import Chamber
from ..core.mesh.volume_mesh import Mesh
from ..core.stepping.quantity import Quantity
from ..data.input_network import InputNetwork
from ..data.input_response import NO_INPUT
from ..data.recordings.marker_quality import Quality
from ..data.registration import RegistrationSummary
from ..io.arrays import FloatArray, IntArray
from ..learning.baselines import BASELINES
from ..learning.error_tables import ErrorTables
from ..learning.identification.search import Identification
from ..learning.metrics import PublishedError, mean_distance, published_errors
from ..learning.scores import HeldOutTest
from ..settings.data_kinds import ReleaseFromLoad
from ..settings.run import RunSettings
from .page import Usage
from .wording import MODELS

# Of each model on the same held-out trials [mm]; None: it diverged.
Errors = Mapping[str, Sequence[float | None]]


class KeptWeights(TypedDict):
    """The weights of a network that were kept."""

    selection: str
    epoch: int
    validation_rollout_error_mm: float | None
    test: HeldOutTest | None  # None: of a network in place of the simulator


class UsedLaw(LawContent):
    """The law of a run in metrics.json."""

    against: str  # model that it is compared with


class Placed(TypedDict):
    """Marker places of all trials."""

    rms_mm: float  # largest residual of the registration of a trial
    turned_deg: float  # identified rotation of the markers
    left_out_mm: NotRequired[dict[str, float]]  # residuals of left-out markers, by label


class MeshCheck(TypedDict, total=False):
    """Content of mesh_check.json, where two values are without and with the finer mesh."""

    model: str
    cells: list[int]
    vertices: list[int]
    trials: list[str]
    errors_mm: list[float | None]
    moved_mm: float | None  # distance between the two simulations
    failed: str  # why nothing is known


class ShapeErrors(TypedDict):
    """Errors on another body, in shapes.json."""

    vertices: int
    moved_mm: float
    errors_mm: dict[str, float | None]  # by model
    outside: NotRequired[float]  # share of cells and states outside of the law's training stretches


class TrackingErrors(TypedDict):
    """Distances of a controlled point from its paths."""

    mean_mm: float
    max_mm: float
    motions_mm: dict[str, float]  # mean by motion


class ReducedErrors(TypedDict, total=False):
    """Errors of a reduced model."""

    modes: int
    window_s: float
    window_error_mm: float
    window_motion_mm: float
    window_relative: float
    whole_error_mm: float


class ControlResults(TypedDict):
    """Content of control.json."""

    tracking: dict[str, dict[str, TrackingErrors]]  # by duration of the paths [s] and controller
    command_ms: dict[str, dict[str, float]]  # `median`, `largest_of_20` of times, by controller
    planned_mm: dict[str, dict[str, list[float]]]  # before, after corrections, by model, motion
    reduced: dict[str, ReducedErrors]  # by model
    linear_validation_mm: float


class Metrics(ErrorTables, Usage, total=False):
    """Content of metrics.json, of a split or of all folds."""

    networks: dict[str, KeptWeights]  # by model
    recommended: str  # model, see `ranking.recommended`; empty for none
    without_forces: bool  # whether no force is learned, as no forces are reconstructed
    parameters: dict[str, Mapping[str, float]]  # identified values, by model
    first_guesses: dict[str, Mapping[str, float]]
    at_bounds: dict[str, dict[str, float]]  # identified values on a bound of their range, by model
    law: UsedLaw
    # `mean_mm` and `max_mm`, distances between reconstructed and observed points of the training
    # trials, by model
    reconstruction: dict[str, dict[str, float]]
    control: ControlResults
    shapes: dict[str, ShapeErrors]
    placement: Placed
    mesh_check: MeshCheck
    noise_mm: float  # mean distance by which noise moves the markers of a simulated laboratory
    folds: dict[str, "Metrics"]  # by the trial that a fold leaves out


@dataclass(frozen=True, eq=False)
class TrialResults:
    """Observations of the R test trials, and the roll-outs of the models in them."""

    names: tuple[str, ...]
    labels: tuple[str, ...]  # Of the M markers; empty where all vertices are observed: M = N.
    begins: tuple[str, ...]  # Of each trial: given (the state is known), released, rest, static.
    times: FloatArray  # (R, T) of the evaluated frames [s].
    target: FloatArray  # (R, T, M, 3) [m] observed, NaN where a marker was not seen.
    # (R, T, M, 3) [m] by model, of those without physics the best one; not finite after it
    # diverged.
    positions: Mapping[str, FloatArray]
    bound: FloatArray  # (M, 3) [m] the markers on the undeformed body, or its vertices.
    gravity: FloatArray  # (3,) [m/s^2]
    time_step: float  # Of the simulation [s].
    axes: tuple[int, ...] = (0, 1, 2)  # Observed axes of the body.
    # (R, T, M) half-widths of the markers' prediction intervals [m], by model.
    half_widths: Mapping[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def errors_mm(self) -> dict[str, FloatArray]:
        """Mean distances (R, T) [mm] from `mean_distance`, by model."""
        return {model: mean_distance(q, self.target) for model, q in self.positions.items()}

    @property
    def plain_errors_mm(self) -> FloatArray:
        """Errors (R, T) [mm] of the uncorrected simulation or, without it, of the first model."""
        errors = self.errors_mm
        order = ("simulation", *(model for model in errors if model not in BASELINES), *errors)
        return errors[next(model for model in order if model in errors)]

    @cached_property
    def worst(self) -> int:
        """Index of the trial with the largest mean of `plain_errors_mm`."""
        means = [
            row[np.isfinite(row)].mean() if np.isfinite(row).any() else np.inf
            for row in self.plain_errors_mm
        ]
        return int(np.argmax(means))

    @property
    def moves(self) -> bool:
        """Whether there are motions, rather than poses alone."""
        return self.target.shape[1] > 1

    def of_tip(self, tip: IntArray) -> "TrialResults":
        """Returns the same trials with the mean of some vertices (P,) as the only marker."""

        def mean(q: FloatArray) -> FloatArray:
            return np.asarray(q[..., tip, :].mean(-2, keepdims=True))

        positions = {model: mean(q) for model, q in self.positions.items()}
        target, bound = mean(self.target), mean(self.bound)
        return replace(self, labels=("tip",), target=target, bound=bound, positions=positions)


@dataclass(frozen=True, eq=False)
class ForceCurve:
    """A component of the force of a sensor in the test trial in which it is largest."""

    trial: str
    axis: str  # Such as fz.
    unit: str
    times: FloatArray  # (T,) [s].
    measured: FloatArray  # (T,) without the zero and drift that the last model leaves.
    models: Mapping[str, FloatArray]  # (T,) by model.


@dataclass(frozen=True, eq=False)
class Film:
    """Motion of the bodies in one test trial."""

    trial: str  # Its name.
    times: FloatArray  # (F,) of the frames [s].
    positions: Mapping[str, FloatArray]  # (F, N, 3) [m] by model, NaN after it diverged.


@dataclass(frozen=True, eq=False)
class Driven:
    """Inputs that drive trials, such as pressures."""

    quantity: Quantity
    channels: tuple[str, ...]  # Names of the C parts, such as chambers.
    values: Mapping[str, FloatArray]  # (K, C) during each step, by trial, in the quantity's unit.
    limit: float | None = None  # Largest allowed value.
    scaled: tuple[str, ...] = ()  # Names of the trials with higher inputs than in training.
    poses: tuple[str, ...] = ()  # Names of the poses, which the last inputs hold.

    @cached_property
    def used(self) -> tuple[int, ...]:
        """Numbers of the parts that some trial drives by more than the noise of a gauge.

        All where none does.
        """
        largest = np.max([np.abs(values).max(axis=0) for values in self.values.values()], axis=0)
        driven = np.flatnonzero(largest > NO_INPUT * largest.max())
        return tuple(driven.tolist()) or tuple(range(len(self.channels)))


@dataclass(frozen=True, eq=False)
class Recordings:
    """Quality of the recordings, and their registration on the body, by trial."""

    quality: Mapping[str, Quality]
    registered: Mapping[str, RegistrationSummary]
    nominal: Mapping[str, FloatArray]  # (3,) [m] nominal positions at rest, by label.
    beside: Collection[str]  # Labels of markers that stand beside the body.
    mesh: Mesh  # The body at rest.

    @property
    def worst(self) -> str:
        """Name of the trial that fits worst, which is drawn."""
        return max(self.registered, key=lambda trial: self.registered[trial]["rms_mm"])


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowedPath:
    """A path, and the paths of the controlled point."""

    name: str  # Of the shape.
    seconds: float  # Duration [s].
    path: FloatArray  # (T, 3) [m].
    points: Mapping[str, FloatArray]  # (T, 3) [m] controlled point, by controller.


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """Data of the page of a run, of a fold, or over the folds."""

    metrics: Metrics  # Of a split or of all folds.
    settings: RunSettings
    mesh: Mesh  # The undeformed body.
    fixed: IntArray  # Clamped vertices.
    tip: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # If all are seen.
    chambers: tuple[Chamber, ...] = ()  # Chambers under pressure.
    tendons: Mapping[str, FloatArray] = field(default_factory=dict)  # (G, 3) guides [m], by name.
    obstacles: ObstacleSurface = field(default_factory=ObstacleSurface)  # That the body touches.
    # (K + 1, O) inputs of contact by name, in the test trials by name: poses of the obstacles at
    # the steps.
    moved: Mapping[str, Mapping[str, FloatArray]] = field(default_factory=dict)
    trials: TrialResults | None = None  # Test trials; None over the folds.
    film: Film | None = None  # Motion of the bodies in one of them.
    driven: Driven | None = None  # Inputs of all trials.
    recordings: Recordings | None = None  # Quality and registration of all trials.
    forces: Mapping[str, ForceCurve] = field(default_factory=dict)  # By sensor.
    identification: Mapping[str, Identification] = field(default_factory=dict)  # By model.
    actuator: Mapping[str, InputNetwork] = field(default_factory=dict)  # Learned ones, by input.
    stretches: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # By kind of trial.
    outside: float | None = (
        None  # Share of cells and states of the test trials outside of the law's training.
    )
    start: Mapping[str, float] = field(default_factory=dict)  # Of the data sheet, by parameter.
    truth: Mapping[str, float] = field(default_factory=dict)  # Of the laboratory, by parameter.
    true_material: str = "corotated"  # Model of its material.
    # Records of `learning.residuals.training.EpochTrainer.history`, by learned model; None: not
    # finite.
    training: Mapping[str, Sequence[Mapping[str, float | None]]] = field(default_factory=dict)
    followed: Sequence[FollowedPath] = ()  # Driven paths of the group `control`.
    pages: Mapping[str, str] = field(default_factory=dict)  # Of each fold, by its test trial.

    @property
    def published(self) -> Mapping[str, PublishedError]:
        """Published errors of this experiment by model; may be empty."""
        return published_errors(self.settings.name)

    def obstacles_at(self, trial: str, times: FloatArray) -> ObstacleSurface:
        """Returns the obstacles at times (T,) [s] of a test trial."""
        inputs = self.moved.get(trial, {})
        if not inputs or self.trials is None:
            return self.obstacles
        steps = self.trials.time_step * np.arange(len(next(iter(inputs.values()))))
        return self.obstacles.moved(
            {
                name: np.stack([np.interp(times, steps, x) for x in values.T], axis=1)
                for name, values in inputs.items()
            }
        )

    @property
    def sees_markers(self) -> bool:
        """Whether markers are observed, rather than every vertex."""
        return self.trials is None or bool(self.trials.labels)

    @property
    def others(self) -> tuple[str, ...]:
        """Names of the test trials outside of the training loads."""
        return other_trials(self.settings)


def other_trials(settings: RunSettings) -> tuple[str, ...]:
    """Returns the names of the test trials outside of the training loads.

    Empty for most experiments.
    """
    return tuple(settings.data.others) if isinstance(settings.data, ReleaseFromLoad) else ()


def folds_in(metrics: Metrics) -> list[Metrics]:
    """Returns the metrics of each fold, or those of a split alone."""
    return [*metrics.get("folds", {}).values()] or [metrics]


def force_errors(metrics: Metrics) -> dict[str, tuple[str, float, dict[str, float | None]]]:
    """Unit, mean size of the force and mean errors by model of each force sensor.

    None for a model that diverged.
    """
    found = dict[str, tuple[str, float, dict[str, float | None]]]()
    folds = [fold["forces"] for fold in folds_in(metrics) if "forces" in fold]
    for name in dict.fromkeys(chain.from_iterable(folds)):
        tables = [fold[name] for fold in folds if name in fold]
        errors = dict[str, float | None]()
        for model in tables[0]["models"]:
            if all(model in table["models"] for table in tables):
                means = [table["models"][model]["mean"] for table in tables]
                known = [mean for mean in means if mean is not None]
                errors[model] = fmean(known) if len(known) == len(means) else None
        found[name] = tables[0]["unit"], fmean(table["size"] for table in tables), errors
    return found


def trial_errors(metrics: Metrics, others: Collection[str] = (), outside: bool = False) -> Errors:
    """Returns the errors on each held-out trial [mm], by model that all folds have.

    None where a roll-out diverged.

    Args:
        metrics: of a split or of folds.
        others: names of the test trials outside of the training loads.
        outside: whether the errors are those on these trials, or on all that are not among them.
    """
    folds = folds_in(metrics)
    every = [*chain.from_iterable(fold.get("per_trajectory", ()) for fold in folds)]
    rows = [row for row in every if (row["name"] in others) is outside]
    models = [
        model
        for model in (rows[0]["errors_mm"] if rows else ())
        if all(model in r["errors_mm"] for r in every)
    ]
    return {model: [row["errors_mm"][model] for row in rows] for model in models}


def grouped_errors(metrics: Metrics, settings: RunSettings) -> dict[str, Errors]:
    """Returns the errors on the held-out trials by the title of their group:
    as in training, then with other loads.
    """
    others = other_trials(settings)
    groups = {
        title: trial_errors(metrics, others, at > 0)
        for at, title in enumerate(settings.test_titles)
    }
    if all(groups.values()):
        return groups
    errors = next(filter(None, groups.values()), {})
    count = len(next(iter(errors.values()), ()))
    return {f"{count} test trial{'s' * (count != 1)}": errors} if errors else {}


def missing_baselines(metrics: Metrics) -> dict[str, str]:
    """Returns why predictions without physics are missing, by model."""
    reasons = (fold.get("missing_baselines", {}) for fold in folds_in(metrics))
    return dict(chain.from_iterable(of_fold.items() for of_fold in reasons))


def best_and_worst(trials: TrialResults) -> list[int]:
    """Returns the motions with the largest and the least error of the last model of the table.

    One if there is one.
    """
    moving = [row for row, begins in enumerate(trials.begins) if begins != "static"]
    errors = trials.errors_mm[next(m for m in reversed(list(MODELS)) if m in trials.positions)]
    errors = errors[moving]
    means = np.array(
        [row[~np.isnan(row)].mean() if (~np.isnan(row)).any() else np.inf for row in errors]
    )
    worst, best = moving[int(np.argmax(means))], moving[int(np.argmin(means))]
    return [worst] if worst == best else [worst, best]


def at_times(positions: FloatArray, frames: FloatArray, times: FloatArray) -> FloatArray:
    """Returns positions (T, N, 3) at given times, interpolated linearly between the frames.

    Args:
        positions: (F, N, 3) [m]; values that are not finite are ignored where their weight is zero.
        frames: (F,) increasing times of the positions [s].
        times: (T,) [s]; positions are constant before the first and after the last frame.
    """
    at = np.interp(times, frames, np.arange(len(frames), dtype=np.float64))
    low = np.floor(at + 1e-9).astype(int)
    share = np.maximum(at - low, 0.0)[:, None, None]
    after = positions[np.minimum(low + 1, len(positions) - 1)]
    with np.errstate(invalid="ignore", over="ignore"):
        between: FloatArray = np.where(
            share > 1e-9, (1.0 - share) * positions[low] + share * after, positions[low]
        )
    return between


def spread(values: IntArray, most: int) -> IntArray:
    """Returns the values (N,), or some of them that are spread evenly,
    the first and the last one among them.
    """
    return (
        values[np.unique(np.linspace(0, len(values) - 1, most).round().astype(int))]
        if len(values) > most
        else values
    )


def shown_markers(target: FloatArray) -> IntArray:
    """Returns the indices of the markers (T, M, 3) of a trial that were seen in a frame.

    NaN where one was not.
    """
    return np.flatnonzero(np.isfinite(target).all(axis=2).any(axis=0))
