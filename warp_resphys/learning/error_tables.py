"""Errors of models on tested trials: in tables, by trial,
marker, phase, horizon and scale of the inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Final, TypedDict

import numpy as np
import torch

from ..data.driving import PHASES, driving, phases_of
from ..data.rigid_bodies import angles, as_markers, corners_of, owners
from ..data.trials import STATIC, Trials
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..io.errors import InputError
from .evaluation import first_frame, used_frames
from .identification.sensitivity import FreeFit
from .intervals import IntervalTable
from .metrics import (
    ErrorSummary,
    TrialErrors,
    errors_per_marker,
    marker_errors,
    summarise,
    summarise_trajectories,
)
from .observed_motions import ObservedMotions

# Of `beyond_training`, over the largest value of the training: up to there, a trial is within it.
_EXCESS: Final = {"inputs": 0.05, "loads": 0.05, "displacements": 0.1}


class RangeExits(TypedDict):
    """Roll-outs of a model that left the training range."""

    left: int  # their number
    first_s: dict[str, float]  # time at which each left, by trial


class ForceErrors(TypedDict):
    """Errors of the readings of a force sensor."""

    unit: str
    size: float  # mean size of the force in the same frames, without its zero
    models: dict[str, ErrorSummary]


class ErrorTables(TypedDict, total=False):
    """Content of errors.json."""

    errors_mm: dict[str, ErrorSummary]  # by model
    per_trajectory: list[TrialErrors]
    errors_vs_reconstruction_mm: dict[str, ErrorSummary]  # by model
    per_marker: dict[str, dict[str, float | None]]  # mean [mm] by model and marker; None: diverged
    orientations_deg: dict[str, dict[str, float | None]]  # mean by model and rigid body
    horizons: dict[str, dict[str, ErrorSummary]]  # by duration [s] and model
    phases: dict[str, dict[str, ErrorSummary]]  # by phase of the inputs and model
    forces: dict[str, ForceErrors]  # by sensor
    range: dict[str, RangeExits]  # by model with a network
    beyond: dict[str, dict[str, float]]  # by trial beyond the training, see `beyond_training`
    scales: dict[str, dict[str, ErrorSummary]]  # by scale of the inputs and model
    scales_range: dict[str, dict[str, RangeExits]]
    baselines: dict[str, str]  # settings of the models without physics, in words
    missing_baselines: dict[str, str]  # why one is missing
    sideways_mm: dict[str, float]  # of the markers at first, by trial
    free_fits: dict[str, list[FreeFit]]  # by model
    first_frames: Mapping[str, Mapping[str, float]]  # see `Identified`
    intervals: IntervalTable


@dataclass(frozen=True)
class ComparedModels:
    """Roll-outs of the tested trials by several models; a rigid body counts as one marker.

    Attributes:
        motions: observed trials.
        train: names of the trials that were learned from, of which only the rest is tested.
        groups: names of the R tested trials by input scale; ``1``, the original inputs, is first.
        simulated: (R, T, M, 3) observed points of the roll-outs by model [m], NaN where a roll-out
            diverged.
        left: (R,) steps at which trials left the training range, or -1, by model with a network.
        reconstructed: (R, T, M, 3) reconstructed points of the trials with the original inputs [m];
            None without any.
        horizons: durations of whose errors there is a table [s].
        first_frames: that do not count, see `Identified`.
        loads: (R, T, S, 6) readings of force sensors by model [N, N m].
    """

    motions: ObservedMotions
    train: Sequence[str]
    groups: Mapping[str, Sequence[str]]
    simulated: Mapping[str, FloatArray]
    left: Mapping[str, IntArray] = field(default_factory=dict)
    reconstructed: FloatArray | None = None
    horizons: Sequence[float] = ()
    first_frames: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    loads: Mapping[str, FloatArray] = field(default_factory=dict)

    def errors(self) -> ErrorTables:
        """Returns the tables that depend on the roll-outs alone."""
        trials, names = self.motions.trials, self.groups["1"]
        every, count = [*chain.from_iterable(self.groups.values())], len(names)
        points = counted(self.motions, self.train, every, self.first_frames)
        observed = as_markers(points, trials.labels)
        first = [first_frame(trials, [name]) for name in every]
        models = {
            model: as_markers(values, trials.labels) for model, values in self.simulated.items()
        }
        test = {model: values[:count] for model, values in models.items()}
        if self.reconstructed is not None:
            test["reconstruction"] = self.reconstructed
        errors = {model: _errors(x, observed, first) for model, x in test.items()}
        sizes = {name: 1e3 * size for name, size in amplitudes(trials, names).items()}
        content: ErrorTables = {
            "errors_mm": {model: summarise(rows) for model, rows in errors.items()},
            "per_trajectory": [
                {**row, "amplitude_mm": sizes[row["name"]]}
                for row in summarise_trajectories(tuple(names), errors)
            ],
        }
        if self.reconstructed is not None:
            against = {
                m: _errors(x, self.reconstructed, first)
                for m, x in test.items()
                if m != "reconstruction"
            }
            content["errors_vs_reconstruction_mm"] = {
                model: summarise(rows) for model, rows in against.items()
            }
        if trials.bound is not None:
            labels = owners(trials.labels)
            seen = observed[:count]
            content["per_marker"] = {
                model: errors_per_marker(x, seen, labels) for model, x in test.items()
            }
        bodies = corners_of(trials.labels)
        if bodies:
            content["orientations_deg"] = {
                model: {
                    name: _mean_angle(x[:count, :, at], points[:count, :, at])
                    for name, at in bodies.items()
                }
                for model, x in self.simulated.items()
            }
        horizons = self._by_horizon(test, observed)
        if horizons:
            content["horizons"] = horizons
        phases = self._by_phase(test, observed)
        if phases:
            content["phases"] = phases
        beyond = beyond_training(self.motions, self.train, names, self.first_frames)
        if beyond:
            content["beyond"] = beyond
        if self.loads:
            content["forces"] = self._by_sensor()
        return content | self._by_scale(models, observed)

    def _by_sensor(self) -> dict[str, ForceErrors]:
        """Returns the errors of forces by sensor and model, in the frames that count."""
        motions, names = self.motions, self.groups["1"]
        counts = counting(motions, self.train, names, self.first_frames)
        rows_of = motions.trials.rows(names)
        times, found = torch.from_numpy(motions.trials.times[rows_of]), dict[str, ForceErrors]()
        for number, (name, readings) in enumerate(motions.trials.loads.items()):
            sensor, read = motions.sensors[name], torch.from_numpy(readings[rows_of])
            models = dict[str, ErrorSummary]()
            for model, loads in self.loads.items():
                away = sensor.distances(
                    torch.from_numpy(loads[: len(names), :, number]), read, times
                ).numpy()
                known = [row[at & ~np.isnan(row)] for row, at in zip(away, counts, strict=True)]
                if any(map(len, known)):
                    models[model] = summarise(row for row in known if len(row))
            if not (np.isfinite(read.numpy()).any(-1) & counts).any():
                continue
            size = sensor.distances(torch.zeros_like(read), read, times).numpy()
            found[name] = {
                "unit": sensor.unit,
                "size": float(np.nanmean(np.where(counts, size, np.nan))),
                "models": models,
            }
        return found

    def _by_horizon(
        self, test: Mapping[str, FloatArray], observed: FloatArray
    ) -> dict[str, dict[str, ErrorSummary]]:
        """Returns the errors of the first seconds by duration and model,
        if frames of all trials count in them.
        """
        found = {}
        for seconds in self.horizons:
            frames = slice(round(seconds / self.motions.trials.time_step) + 1)
            errors = {
                m: _errors(x[:, frames], observed[:, frames], [0] * len(observed))
                for m, x in test.items()
            }
            if all(map(len, chain.from_iterable(errors.values()))):
                found[f"{seconds:g}"] = {model: summarise(rows) for model, rows in errors.items()}
        return found

    def _by_phase(
        self, test: Mapping[str, FloatArray], observed: FloatArray
    ) -> dict[str, dict[str, ErrorSummary]]:
        """Returns the errors by phase of the inputs and model; empty without inputs."""
        names = self.groups["1"]
        at = phases_of(self.motions.trials, names)
        seen = np.isfinite(observed[: len(names)]).all(-1).any(-1)
        frames = {phase: (at == phase) & seen for phase in PHASES}

        def mean(x: FloatArray, rows: BoolArray) -> ErrorSummary:
            shown = [k for k, at in enumerate(rows) if at.any()]
            return summarise(marker_errors(x[k, rows[k]], observed[k, rows[k]]) for k in shown)

        return {
            phase: {model: mean(x, rows) for model, x in test.items()}
            for phase, rows in frames.items()
            if rows.any()
        }

    def _by_scale(self, models: Mapping[str, FloatArray], observed: FloatArray) -> ErrorTables:
        """Returns the entries on trials that left the training range, and on scaled inputs."""
        trials, count = self.motions.trials, len(self.groups["1"])
        content: ErrorTables = {}
        at = {scale: slice(i * count, (i + 1) * count) for i, scale in enumerate(self.groups)}
        ranges = {
            scale: {
                m: _range(steps[rows], self.groups[scale], trials.time_step)
                for m, steps in self.left.items()
            }
            for scale, rows in at.items()
        }
        if self.left:
            content["range"] = ranges["1"]
        if len(self.groups) > 1:
            first = [first_frame(trials, [name]) for name in self.groups["1"]]
            content["scales"] = {
                scale: {
                    m: summarise(_errors(x[rows], observed[rows], first)) for m, x in models.items()
                }
                for scale, rows in at.items()
            }
            if self.left:
                content["scales_range"] = ranges
        return content


def counted(
    motions: ObservedMotions,
    train: Sequence[str],
    names: Sequence[str],
    first_frames: Mapping[str, Mapping[str, float]],
) -> FloatArray:
    """(R, T, M, 3) observed points of tested trials [m],
    NaN in frames that were used for training or first values.

    Raises:
        InputError: nothing is left of a trial after the frames from which values were estimated.
    """
    observed = motions.trials.observed[motions.trials.rows(names)]
    for name, frames in zip(names, used_frames(motions.trials, names, first_frames), strict=True):
        if frames.all():
            raise InputError(
                f"values of {name!r} are estimated from all of it, so that nothing is left to "
                "test: shorten release.window."
            )
    observed[~counting(motions, train, names, first_frames)] = np.nan
    return observed


def counting(
    motions: ObservedMotions,
    train: Sequence[str],
    names: Sequence[str],
    first_frames: Mapping[str, Mapping[str, float]],
) -> BoolArray:
    """(R, T) whether frames of tested trials count,
    as nothing was learned or estimated from them.
    """
    counts = ~used_frames(motions.trials, names, first_frames)
    for row, name in enumerate(names):
        if name in train:
            counts[row, : motions.learned_steps(counts.shape[1] - 1) + 1] = False
    return counts


def beyond_training(
    motions: ObservedMotions,
    train: Sequence[str],
    names: Sequence[str],
    first_frames: Mapping[str, Mapping[str, float]],
) -> dict[str, dict[str, float]]:
    """Returns by how much tested trials leave the range of the training trials,
    over its largest value there.

    A trial leaves it where one of its inputs, its payload or a coordinate of a displacement is
    outside of the least and the largest one of the training, or the norm of all inputs is larger.
    Excesses of up to 5 % of the inputs and loads, and 10 % of the displacements, are left out.

    Args:
        motions: observed trials.
        train: names of the trials that were learned from.
        names: names of the tested trials.
        first_frames: that do not count, see `Identified`.

    Returns:
        By trial that leaves it, the excess of its `inputs`, its `loads` and its `displacements`.
    """
    if not train:
        return {}
    trials, every = motions.trials, [*dict.fromkeys([*train, *names])]
    rows, tested = trials.rows(every), counting(motions, train, names, first_frames)
    rest = trials.held[rows] if trials.bound is None else trials.bound[None]
    moved = trials.observed[rows] - rest[:, None]
    frames = moved.shape[1]
    kinds = [("displacements", moved.reshape(len(rows), frames, -1))]
    kinds.append(("loads", np.tile(trials.payload[rows][:, None, None], (1, frames, 1))))
    kinds += [
        ("inputs", values)
        for name, values in driving(trials, every).items()
        if name in trials.inputs
    ]
    found = dict[str, dict[str, float]]()
    for kind, values in kinds:
        learned = values[: len(train), : motions.learned_steps(frames - 1) + 1]
        for name, counts in zip(names, tested, strict=True):
            excess = _excess(
                learned.reshape(-1, values.shape[2]), values[every.index(name)][counts]
            )
            if excess > _EXCESS[kind]:
                of_trial = found.setdefault(name, {})
                of_trial[kind] = max(excess, of_trial.get(kind, 0.0))
    return found


def _excess(inside: FloatArray, tested: FloatArray) -> float:
    """Largest distance of values (K, C) from the range of others (L, C), over the largest of these.

    The norms of rows without NaN are compared as well.
    """
    seen = np.isfinite(inside).any(axis=0) & np.isfinite(tested).any(axis=0)
    if not seen.any():
        return 0.0
    known, new = inside[:, seen], tested[:, seen]
    outside = np.maximum(new - np.nanmax(known, axis=0), np.nanmin(known, axis=0) - new)
    furthest, largest = float(np.nanmax(outside, initial=0.0)), float(np.nanmax(np.abs(known)))
    if largest == 0.0:
        return float(furthest > 0.0)
    before, after = (float(np.nanmax(np.linalg.norm(x, axis=1), initial=0.0)) for x in (known, new))
    return max(furthest / largest, after / before - 1.0 if before > 0.0 else 0.0)


def amplitudes(trials: Trials, names: Sequence[str]) -> dict[str, float]:
    """Root mean square displacement of the observed points [m], by trial."""
    sizes = dict[str, float]()
    for name, row in zip(names, trials.rows(names), strict=True):
        frames = slice(1 if trials.begin_of(name) == STATIC else None)
        places = (trials.observed[row, frames], trials.held[row])
        moved, before = (as_markers(x, trials.labels) for x in places)
        sizes[name] = float(np.sqrt(np.nanmean(np.square(moved - before).sum(-1))))
    return sizes


def _mean_angle(simulated: FloatArray, observed: FloatArray) -> float | None:
    """Mean over trials of the error of a rigid body's orientation, where seen [degrees].

    None if a roll-out diverged.

    Args:
        simulated: (R, T, 4, 3) its points [m].
        observed: (R, T, 4, 3) [m], NaN where it was not seen.
    """
    seen = np.asarray(np.isfinite(observed).all(axis=(-2, -1)))
    off = np.degrees(angles(observed, simulated))
    means = [angle[at].mean() for angle, at in zip(off, seen, strict=True) if at.any()]
    return float(np.mean(means)) if means and np.isfinite(means).all() else None


def _errors(simulated: FloatArray, observed: FloatArray, first: Sequence[int]) -> list[FloatArray]:
    trials = zip(simulated, observed, first, strict=False)
    return [marker_errors(x[start:], y[start:]) for x, y, start in trials]


def _range(left: IntArray, names: Sequence[str], step: float) -> RangeExits:
    gone = {name: float(step * at) for name, at in zip(names, left, strict=True) if at >= 0}
    return {"left": len(gone), "first_s": gone}
