"""Conclusions of a run: which step reduced the error significantly, coverage of intervals, and what to try next."""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any, Final

from ..learning.metrics import Gain, PublishedError, paired_gain, published_errors
from ..settings.learning import IdentifySettings
from ..settings.run import RunSettings
from .page import MINUS

# By model: its name in sentences, and the models that it may extend, of which the first available one is compared.
_STEPS: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "sysid_elastic": ("identification of E and nu", ("simulation",)),
    "sysid": ("identification (SysID)", ("simulation",)),
    "law": ("the identified law of the material", ("sysid", "simulation")),
    "simfree": ("the network in place of the simulator (SimFree)", ("law", "sysid", "simulation")),
    "resphys_uncorrected": ("the learned force on the data sheet's simulator", ("simulation",)),
    "resphys": ("the learned force (ResPhys)", ("law", "sysid", "simulation")),
}
_BASES: Final = {"simulation": "the uncorrected simulation", "sysid": "SysID", "law": "the law"}
_GROUPS: Final = {"sysid": "parameters", "sysid_elastic": "elastic"}  # Keys of the ranges in the group `identify`.
_LEARNED: Final = ("simfree", "resphys")  # With published gains; the published identification has other parameters.
_CLOSE: Final = 1e-4  # Distance from a bound or the first guess that counts as none, over a parameter's range.
_REFINED: Final = "_refined"  # Suffix of a network refined through the simulator.
_CALIBRATED: Final[Mapping[str, str]] = {  # Source of prediction intervals.
    "validation": "its errors on the validation trials",
    "training": "its errors on the training trials, which tend to be too small",
    "folds": "the errors of the other folds",
}


@dataclass(frozen=True)
class Identified:
    """One identified parameter, in SI units."""

    key: str  # Dotted key of its range, such as ``identify.parameters.density``.
    value: float
    lower: float  # End of its range.
    upper: float
    start: float  # First guess.
    has_prior: bool = False  # Then it may stay at its first guess.


def conclusions(metrics: Mapping[str, Any], settings: RunSettings) -> list[str]:
    """Return sentences on a run, from metrics.json of a split or of folds, and its settings."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    rows = held_out(metrics)
    errors = {model: [row.get(model) for row in rows] for model in (rows[0] if rows else ())}
    sentences = gains(errors, epochs_kept(metrics), published_errors(settings.name))
    return sentences + intervals_text(metrics) + advice([_identified(fold, settings.identify) for fold in folds])


def held_out(metrics: Mapping[str, Any]) -> list[Mapping[str, float | None]]:
    """Return the errors of all models on each held-out trial [mm]."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    return [row["errors_mm"] for fold in folds for row in fold.get("per_trajectory", ())]


def intervals_text(metrics: Mapping[str, Any]) -> list[str]:
    """Return a sentence on half-width and coverage of the prediction intervals of the best model."""
    intervals = metrics.get("intervals") or {}
    for model, name in (("resphys", "ResPhys"), ("sysid", "SysID")):
        if (of_model := intervals.get("models", {}).get(model)) is not None:
            return [
                f"Prediction intervals of {name}, from {_CALIBRATED[intervals['calibrated_on']]}: "
                f"{100.0 * intervals['level']:.0f} % of the measured coordinates should lie within ± "
                f"{of_model['half_width_mm']:.2g} mm, on average, of the prediction; "
                f"{100.0 * of_model['coverage']:.0f} % do."
            ]
    return []


def epochs_kept(metrics: Mapping[str, Any]) -> dict[str, list[int]]:
    """Return the number of epochs of training and refinement of the kept weights, by model and fold."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    networks: list[Mapping[str, Any]] = [fold.get("networks", {}) for fold in folds]
    models = dict.fromkeys(model for fold in networks for model in fold if not model.endswith(_REFINED))
    return {
        model: [n[model]["epoch"] + n.get(f"{model}{_REFINED}", {}).get("epoch", 0) for n in networks if model in n]
        for model in models
    }


def untrained(epochs: Mapping[str, Sequence[int]]) -> set[str]:
    """Return the models of which no fold kept an epoch, so that their learned force is zero."""
    return {model for model, counts in epochs.items() if counts and not any(counts)}


def best(errors: Mapping[str, Any], without: Collection[str] = ()) -> str:
    """Return our model of least mean error, the simplest of equal ones, without those in `without`."""
    means = {m: errors[m]["mean"] for m in ("simulation", *_STEPS) if m in errors and m not in without}
    defined = {m: mean for m, mean in means.items() if mean is not None}
    return min(defined, key=lambda m: defined[m], default="")


def gains(
    errors: Mapping[str, Sequence[float | None]],
    epochs: Mapping[str, Sequence[int]],
    published: Mapping[str, PublishedError] | None = None,
) -> list[str]:
    """Return a sentence on each step: its gain on held-out trials, and whether it is significant.

    The gain is the share of the mean error that a step removes, with its 90 % interval, by
    `learning.metrics.paired_gain`.

    Args:
        errors: Of each model on the same held-out trials [mm], None where its roll-out diverged.
        epochs: Kept by the learned models, in each fold.
        published: Published errors [mm]; the gains of learned models are compared with theirs.
    """
    sentences, theirs = [], published or {}
    for model, (name, bases) in _STEPS.items():
        base = next((candidate for candidate in bases if candidate in errors), None)
        if model not in errors or base is None:
            continue
        compared = model in _LEARNED and {model, base} <= theirs.keys()
        beside = ""
        if compared:
            ratio = theirs[model].mean / theirs[base].mean
            beside = f"; published: {100.0 * abs(1.0 - ratio):.1f} % {'less' if ratio <= 1.0 else 'more'}"
        sentence = _gain(name, _BASES[base], errors[model], errors[base], list(epochs.get(model, ())), beside)
        sentences.append(sentence[0].upper() + sentence[1:])
    if sentences and all(len(values) == 1 for values in errors.values()):
        sentences.append("These gains rest on one held-out trial, and others may differ: test on more.")
    return sentences


def _gain(
    name: str,
    base: str,
    after: Sequence[float | None],
    before: Sequence[float | None],
    epochs: Sequence[int],
    published: str,
) -> str:
    if epochs and not any(epochs):
        return f"{name} adds nothing to {base}: no epoch of its training improved held-out trials, so none was kept."
    idle = f" In {epochs.count(0)} of {len(epochs)} folds no epoch of its training was kept." if 0 in epochs else ""
    if lost := sum(error is None for error in after):
        return f"{name} fails: {lost} of {len(after)} held-out roll-outs diverged.{idle}"
    pairs = [(a, b) for a, b in zip(after, before, strict=True) if a is not None and b]
    if len(pairs) < len(before):
        return f"{name} cannot be compared with {base}, which diverged or has no error on held-out trials.{idle}"
    gain = paired_gain([b for _, b in pairs], [a for a, _ in pairs])
    means = f"mean {fmean(b for _, b in pairs):.3g} to {fmean(a for a, _ in pairs):.3g} mm{published}"
    which = "less" if gain.share >= 0.0 else "more"
    text = f"{name} leaves {_percent(gain)} {which} error than {base}"
    if gain.trials == 1:
        return f"{text} ({means}).{idle}"
    text += f" on {gain.trials} trials ({means}): "
    if gain.lower <= 0.0 <= gain.upper:
        return f"{text}other trials may show the opposite.{idle}"
    return f"{text}it {'helps' if gain.share > 0.0 else 'does harm'}.{idle}"


def _percent(gain: Gain) -> str:
    """The size of a gain or loss, with its 90 % interval over draws of the trials."""
    digits = 2 if 0.99 < gain.share < 1.0 else 0
    ends = (gain.lower, gain.upper) if gain.share >= 0.0 else (-gain.upper, -gain.lower)
    interval = " to ".join(f"{100.0 * end:.{digits}f}".replace("-", MINUS) for end in ends)
    return f"{100.0 * abs(gain.share):.{digits}f} %" + (f" (90 %: {interval})" if gain.trials > 1 else "")


def advice(folds: Sequence[Sequence[Identified]]) -> list[str]:
    """Return advice on identified values at a bound or at the first guess, with the number of folds."""
    counted = Counter(text for fold in folds for identified in fold if (text := _advice(identified)))
    return [f"In {n} of {len(folds)} folds, {text}" if len(folds) > 1 else text for text, n in counted.items()]


def _advice(identified: Identified) -> str:
    close, name = _CLOSE * (identified.upper - identified.lower), identified.key.rpartition(".")[2]
    for end, bound in (("lower", identified.lower), ("upper", identified.upper)):
        if abs(identified.value - bound) <= close:
            widen = (
                f"widen {identified.key}.{end} if such values are plausible"
                if bound
                else f"take it out (~{identified.key})"
            )
            return (
                f"{name} was identified at its {end} bound, {bound:g}: {widen}, or look for an error that it "
                "compensates, such as a wrong weight, mesh or registration."
            )
    if identified.has_prior or not abs(identified.value - identified.start) <= close:
        return ""
    return (
        f"{name} stayed at its first guess, {identified.start:g}: raise identify.max_evaluations or identify.starts, "
        f"or take it out (~{identified.key}) if the trials do not determine it."
    )


def _identified(metrics: Mapping[str, Any], settings: IdentifySettings | None) -> list[Identified]:
    """The identified parameters of a fold, with their configured ranges."""
    identified = []
    for model, group in _GROUPS.items():
        ranges = (None if settings is None else getattr(settings, group)) or {}
        for name, value in metrics.get("parameters", {}).get(model, {}).items():
            if name in ranges:
                bounds = ranges[name]
                start = metrics.get("first_guesses", {}).get(model, {}).get(name, math.nan)
                key, has_prior = f"identify.{group}.{name}", bounds.prior is not None
                identified.append(Identified(key, value, bounds.lower, bounds.upper, start, has_prior))
    return identified
