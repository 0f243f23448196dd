"""Conclusions of a run: which step helped, by more than chance, how far its intervals hold, and what to try next."""

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

# By model: what it is called, and what it adds to the first of these models that there is.
_STEPS: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "sysid_elastic": ("identification of E and nu", ("simulation",)),
    "sysid": ("identification (SysID)", ("simulation",)),
    "simfree": ("the network in place of the simulator (SimFree)", ("sysid", "simulation")),
    "resphys_uncorrected": ("the learned force on the data sheet's simulator", ("simulation",)),
    "resphys": ("the learned force (ResPhys)", ("sysid", "simulation")),
}
_BASES: Final = {"simulation": "the uncorrected simulation", "sysid": "SysID"}
_GROUPS: Final = {"sysid": "parameters", "sysid_elastic": "elastic"}  # Keys of the ranges in the group `identify`.
_LEARNED: Final = ("simfree", "resphys")  # Whose gains are published; what was identified differs.
_CLOSE: Final = 1e-4  # Of a parameter's range.
_REFINED: Final = "_refined"  # What a network refined through the simulator is called, after its model.
_CALIBRATED: Final[Mapping[str, str]] = {  # Where prediction intervals come from.
    "validation": "its errors in the validation trials",
    "training": "its errors in what it was trained on, which tend to be too small",
    "folds": "the errors of the other folds",
}


@dataclass(frozen=True)
class Identified:
    """One identified parameter, in SI units."""

    key: str  # Where its range is configured, such as ``identify.parameters.density``.
    value: float
    lower: float  # End of its range.
    upper: float
    start: float  # The first guess.
    has_prior: bool = False  # So that it may stay there.


def conclusions(metrics: Mapping[str, Any], settings: RunSettings) -> list[str]:
    """Return sentences on a run, from what metrics.json has of a split or of folds, and its configuration."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    rows = held_out(metrics)
    errors = {model: [row.get(model) for row in rows] for model in (rows[0] if rows else ())}
    said = gains(errors, epochs_kept(metrics), published_errors(settings.name))
    return said + intervals_text(metrics) + advice([_identified(fold, settings.identify) for fold in folds])


def held_out(metrics: Mapping[str, Any]) -> list[Mapping[str, float | None]]:
    """Return the errors of all models on each held-out trial [mm]."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    return [row["errors_mm"] for fold in folds for row in fold.get("per_trajectory", ())]


def intervals_text(metrics: Mapping[str, Any]) -> list[str]:
    """Say how wide the prediction intervals of the best model are, and how often they held in the test."""
    intervals = metrics.get("intervals") or {}
    for model, name in (("resphys", "ResPhys"), ("sysid", "SysID")):
        if (own := intervals.get("models", {}).get(model)) is not None:
            return [
                f"Of the measured coordinates {100.0 * intervals['level']:.0f} % should lie within ± "
                f"{own['half_width_mm']:.2g} mm, on average, of where {name} has them, by "
                f"{_CALIBRATED[intervals['calibrated_on']]}: {100.0 * own['coverage']:.0f} % do."
            ]
    return []


def epochs_kept(metrics: Mapping[str, Any]) -> dict[str, list[int]]:
    """Return how many epochs the kept weights have been trained and refined, by model and fold."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    networks: list[Mapping[str, Any]] = [fold.get("networks", {}) for fold in folds]
    models = dict.fromkeys(model for each in networks for model in each if not model.endswith(_REFINED))
    return {
        model: [n[model]["epoch"] + n.get(f"{model}{_REFINED}", {}).get("epoch", 0) for n in networks if model in n]
        for model in models
    }


def untrained(epochs: Mapping[str, Sequence[int]]) -> set[str]:
    """Return the models of which no fold kept an epoch: their learned force is zero."""
    return {model for model, each in epochs.items() if each and not any(each)}


def best(errors: Mapping[str, Any], without: Collection[str] = ()) -> str:
    """Return the model of least mean error, the simplest of equal ones; no published one and none of `without`."""
    means = {m: errors[m]["mean"] for m in ("simulation", *_STEPS) if m in errors and m not in without}
    defined = {m: mean for m, mean in means.items() if mean is not None}
    return min(defined, key=lambda m: defined[m], default="")


def gains(
    errors: Mapping[str, Sequence[float | None]],
    epochs: Mapping[str, Sequence[int]],
    published: Mapping[str, PublishedError] | None = None,
) -> list[str]:
    """Say of every step whether it helped on held-out trials, by how much, and whether other trials would show it.

    The gain is the share of the mean error that a step takes away, see `learning.metrics.paired_gain`.

    Args:
        errors: of each model on the same held-out trials [mm], None where its roll-out diverged.
        epochs: kept by the learned models, in each fold.
        published: errors [mm], of which the gains of learned models are named beside ours.
    """
    said, theirs = [], published or {}
    for model, (name, bases) in _STEPS.items():
        base = next((each for each in bases if each in errors), None)
        if model not in errors or base is None:
            continue
        compared = model in _LEARNED and {model, base} <= theirs.keys()
        beside = _beside(theirs[base].mean, theirs[model].mean) if compared else ""
        sentence = _gain(name, _BASES[base], errors[model], errors[base], list(epochs.get(model, ())), beside)
        said.append(sentence[0].upper() + sentence[1:])
    if said and all(len(each) == 1 for each in errors.values()):
        said.append("All this is on one held-out trial: nothing tells whether another shows the same; test on more.")
    return said


def _beside(before: float, after: float) -> str:
    """The published gain."""
    return f"; published: {100.0 * abs(1.0 - after / before):.1f} % {'less' if after <= before else 'more'}"


def _gain(
    name: str,
    base: str,
    after: Sequence[float | None],
    before: Sequence[float | None],
    epochs: Sequence[int],
    published: str,
) -> str:
    if epochs and not any(epochs):
        return f"{name} adds nothing to {base}: none of its training served held-out trials, and no epoch was kept."
    idle = f" In {epochs.count(0)} of {len(epochs)} folds none of its training was kept." if 0 in epochs else ""
    if lost := sum(each is None for each in after):
        return f"{name} fails: {lost} of {len(after)} held-out roll-outs diverged.{idle}"
    pairs = [(a, b) for a, b in zip(after, before, strict=True) if a is not None and b]
    if len(pairs) < len(before):
        return f"{name} cannot be compared with {base}, which diverged on held-out trials or has no error there.{idle}"
    gain = paired_gain([b for _, b in pairs], [a for a, _ in pairs])
    means = f"mean {fmean(b for _, b in pairs):.3g} to {fmean(a for a, _ in pairs):.3g} mm{published}"
    which = "less" if gain.share >= 0.0 else "more"
    said = f"{name} leaves {_percent(gain)} {which} error than {base}"
    if gain.trials == 1:
        return f"{said} ({means}).{idle}"
    said += f" on {gain.trials} trials ({means}): "
    if gain.lower <= 0.0 <= gain.upper:
        return f"{said}other trials may show the opposite.{idle}"
    return f"{said}it {'helps' if gain.share > 0.0 else 'does harm'}.{idle}"


def _percent(gain: Gain) -> str:
    """The size of a gain or loss, with the interval in which nine of ten other draws of the trials have it."""
    digits = 2 if 0.99 < gain.share < 1.0 else 0  # Where nearly everything is gone.
    ends = (gain.lower, gain.upper) if gain.share >= 0.0 else (-gain.upper, -gain.lower)
    interval = " to ".join(f"{100.0 * end:.{digits}f}".replace("-", MINUS) for end in ends)
    return f"{100.0 * abs(gain.share):.{digits}f} %" + (f" (90 %: {interval})" if gain.trials > 1 else "")


def advice(folds: Sequence[Sequence[Identified]]) -> list[str]:
    """Say which identified values of each fold are at a bound or at the first guess, and what to do about it."""
    counted = Counter(said for fold in folds for each in fold if (said := _advice(each)))
    return [f"In {n} of {len(folds)} folds, {said}" if len(folds) > 1 else said for said, n in counted.items()]


def _advice(identified: Identified) -> str:
    close, name = _CLOSE * (identified.upper - identified.lower), identified.key.rpartition(".")[2]
    for end, bound in (("lower", identified.lower), ("upper", identified.upper)):
        if abs(identified.value - bound) <= close:
            widen = (
                f"widen {identified.key}.{end} if the body can be so" if bound else f"take it out (~{identified.key})"
            )
            return (
                f"{name} was identified at its {end} bound, {bound:g}: {widen}, or look for what it makes up for, "
                "such as a wrong weight, mesh or registration."
            )
    if identified.has_prior or not abs(identified.value - identified.start) <= close:
        return ""
    return (
        f"{name} stayed at its first guess, {identified.start:g}: raise identify.max_evaluations or identify.starts, "
        f"or take it out (~{identified.key}) if the trials do not tell about it."
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
