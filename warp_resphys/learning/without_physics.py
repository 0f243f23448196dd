"""Predictions without physics of observed trials."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from ..core.stepping.rollout import sample
from ..data.driving import driving
from ..data.trials import GIVEN, RESTING, Trials
from ..io.arrays import BoolArray, FloatArray
from .baselines import BASELINES, REST, at_rest, predictions
from .evaluation import used_frames
from .observed_motions import ObservedMotions
from .plain_trials import PlainTrials
from .release import least_delays
from .sensing import at_steps
from .trial_batch import TrialBatch

_SETTLED: Final = 0.2  # share of a motion at its end, in which a released body is about at rest

_LACKING: Final = {  # why a model is missing although trials were learned from
    "regression": "needs three training trials that differ in inputs or loads",
    "linear": "is for motions, and poses have none",
}


def without_physics(
    motions: ObservedMotions,
    names: Sequence[str],
    train: Sequence[str],
    first_frames: Mapping[str, Mapping[str, float]] | None = None,
    *,
    left_out: bool = False,
) -> tuple[dict[str, FloatArray], dict[str, str], dict[str, str]]:
    """Predicts trials with `learning.baselines`, from the training trials
    that begin in the same way.

    Coordinates that no training trial shows stay at rest. Released bodies are compared at the time
    steps, as each recording has its own frames. Where simulators estimate the delay of a trial's
    inputs from its first frames (`learning.release.begin_inputs`), so do these; where simulators
    estimate values of a session, these predictions are shifted by their mean error in the same
    frames of its trials.

    Args:
        motions: observed motions.
        names: names of the R trials.
        train: names of the training trials.
        first_frames: from which values of simulators were estimated, see `Identified`.
        left_out: whether a trial is predicted without itself if it is a training trial.

    Returns:
        By model: the observed points (R, T, M, 3) [m], the settings in words, and of models that
        cannot predict all trials, the reason.
    """
    trials = motions.trials
    shape = (len(names), *trials.observed.shape[1:])
    values: dict[str, FloatArray] = {}
    settings: dict[str, str] = {}
    missing: dict[str, str] = {}
    for batch in _batches(trials, names, train if left_out else ()):
        begins, without = _kind(trials.begin_of(batch[0])), batch if left_out else ()
        alike = [
            name for name in train if name not in without and _kind(trials.begin_of(name)) == begins
        ]
        shown = _at_steps(trials, alike, batch) if begins == "released" else trials
        plain, asked = _motions(motions, shown, alike, batch)
        plain = plain.select(np.asarray(np.isfinite(plain.values).any((1, 2))))
        made = predictions(plain, asked) if len(plain.values) else {REST: at_rest(asked)}
        rows = [names.index(name) for name in batch]
        for model, prediction in made.items():
            seen = np.isfinite(prediction.values).any(1, keepdims=True)
            known = np.where(seen, prediction.values, made[REST].values).reshape(
                len(batch), -1, *shape[2:]
            )
            if begins == "released":
                times = torch.from_numpy(trials.times[trials.rows(batch)])
                known = sample(torch.from_numpy(known), times, trials.time_step).numpy()
            elif begins == RESTING[0] and motions.release.delay > 0.0:
                known = _on_time(motions, batch, known)
            values.setdefault(model, np.full(shape, np.nan))[rows] = known
            settings[model] = "; ".join(
                dict.fromkeys(filter(None, (settings.get(model), prediction.settings)))
            )
        for model in (model for model in BASELINES if model not in made):
            reason = (
                _LACKING[model]
                if len(plain.values)
                else f"no other training trial begins like {batch[0]}"
            )
            missing.setdefault(model, reason)
    whole = [model for model in BASELINES if model in values and model not in missing]
    for model in whole:
        values[model] = _shifted(trials, names, values[model], first_frames or {})
    return (
        {model: values[model] for model in whole},
        {model: settings[model] for model in whole},
        missing,
    )


def _shifted(
    trials: Trials,
    names: Sequence[str],
    predicted: FloatArray,
    first_frames: Mapping[str, Mapping[str, float]],
) -> FloatArray:
    """Predictions (R, T, M, 3), those of a session less their mean error
    in the first frames of its trials [m].
    """
    shifted, observed = predicted.copy(), trials.observed[trials.rows(names)]
    errors = np.where(
        used_frames(trials, names, first_frames)[..., None, None], observed - predicted, np.nan
    )
    # Of sessions.
    for shown in (shown for owner, shown in first_frames.items() if owner not in shown):
        rows = [row for row, name in enumerate(names) if name in shown]
        seen = np.isfinite(errors[rows])
        shifted[rows] += np.where(seen, errors[rows], 0.0).sum((0, 1)) / np.maximum(
            seen.sum((0, 1)), 1
        )
    return shifted


def _at_steps(trials: Trials, learned: Sequence[str], asked: Sequence[str]) -> Trials:
    """Trials with observations of some at the time steps, as far as these and others last."""
    rows, step = trials.rows(learned), trials.time_step
    last = float(trials.times[[*rows, *trials.rows(asked)]].max())
    times = step * np.arange(int(np.ceil(last / step - 1e-6)) + 1)
    observed = np.full((len(trials.names), len(times), *trials.observed.shape[2:]), np.nan)
    if rows:
        batch = TrialBatch(
            tuple(learned),
            torch.from_numpy(trials.times[rows]),
            torch.from_numpy(trials.observed[rows]),
            torch.from_numpy(trials.held[rows]),
        )
        positions = at_steps(batch, step)
        observed[rows, : positions.shape[1]] = positions
    return replace(
        trials, times=np.broadcast_to(times, (len(trials.names), len(times))), observed=observed
    )


def _kind(begins: str) -> str:
    """Ways of beginning from which trials can be predicted from each other."""
    return RESTING[0] if begins in RESTING else begins


def _on_time(motions: ObservedMotions, names: Sequence[str], predicted: FloatArray) -> FloatArray:
    """(R, T, M, 3) predicted motions with the delay
    that the first frames of each trial show [m].
    """
    trials, settings = motions.trials, motions.release
    rows = trials.rows(names)
    shown: BoolArray = np.asarray(np.isfinite(predicted).all(axis=(2, 3)))
    # Held after the prediction.
    last = np.maximum.accumulate(np.where(shown, np.arange(shown.shape[1]), 0), axis=1)
    series = torch.from_numpy(np.take_along_axis(predicted, last[..., None, None], 1))
    times, observed = torch.from_numpy(trials.times[rows]), torch.from_numpy(trials.observed[rows])
    first = times[:, : int((times <= settings.window + 1e-9).any(0).sum())]

    def delayed(times: torch.Tensor, delay: torch.Tensor) -> torch.Tensor:
        return sample(series, (times - delay).clamp_min(0.0), float(times[0, 1]))

    def errors(delay: torch.Tensor) -> torch.Tensor:
        return (delayed(first, delay) - observed[:, : first.shape[1]]).nan_to_num()

    moved = delayed(times, least_delays(errors, settings, first)[:, None]).numpy()
    return np.where(shown[..., None, None], moved, np.nan)


def _batches(trials: Trials, names: Sequence[str], alone: Sequence[str]) -> Iterator[Sequence[str]]:
    """Trials that begin in the same way; some by themselves."""
    for batch in trials.batches(names):
        yield from ([name] for name in batch if name in alone)
        others = [name for name in batch if name not in alone]
        if others:
            yield others


def _motions(
    motions: ObservedMotions, trials: Trials, learned: Sequence[str], asked: Sequence[str]
) -> tuple[PlainTrials, PlainTrials]:
    """The training trials, as far as they are learned from, and others.

    What drives them has the size of one.
    """
    made = list[PlainTrials]()
    interval = float(np.diff(trials.times[trials.rows(asked)], axis=1).max(initial=0.0))
    for names in (learned, asked):
        rows = trials.rows(names)
        values, first = (
            x[rows].reshape(len(rows), *x.shape[1:-2], 3 * x.shape[-2])
            for x in (trials.observed, trials.held)
        )
        acting, loads = driving(trials, names), trials.payload[rows][:, None]
        if not made:
            values[:, motions.learned_steps(values.shape[1] - 1) + 1 :] = np.nan
            sizes, load = {name: _size(series) for name, series in acting.items()}, _size(loads)
            ends = np.array([_end(series) for series in values]).reshape(-1, first.shape[1])
            rest = np.array([_mean(column) for column in ends.T])
        # At rest where the training ends.
        settles = trials.begin_of(asked[0]) in ("released", GIVEN)
        origin = np.where(np.isfinite(rest), rest, first) if settles else first
        parts = [np.zeros((len(rows), 1 + values.shape[1], 0))]  # with a frame before time zero
        for name, size in sizes.items():
            before = (
                trials.resting[name][rows] if name in trials.resting else 0.0 * acting[name][:, 0]
            )
            parts.append(np.concatenate([before[:, None], acting[name]], 1) / size)
        inputs = np.concatenate(parts, 2)
        made.append(
            PlainTrials(values, origin, first, inputs[:, 1:], loads / load, inputs[:, 0], interval)
        )
    return made[0], made[1]


def _end(values: FloatArray) -> FloatArray:
    """(P,) means of the last part of the frames (T, P) in which a coordinate was seen.

    NaN where it never was.
    """
    seen = (column[np.isfinite(column)] for column in values.T)
    return np.array([_mean(series[-max(round(_SETTLED * len(series)), 1) :]) for series in seen])


def _mean(values: FloatArray) -> float:
    """The mean of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else np.nan


def _size(values: FloatArray) -> float:
    """The root of the mean over trials and frames of the squared norm, or one if all are zero."""
    return float(np.sqrt(np.square(values).sum(-1).mean())) or 1.0 if len(values) else 1.0
