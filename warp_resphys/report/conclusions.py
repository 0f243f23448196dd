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
from .data import other_trials
from .notes import in_a_row
from .page import significant
from .recommendation import LEAST_TRIALS, compared, means_text, outcome, recommendation

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
INSIDE, OUTSIDE = "Loads as in training", "Other loads"  # Of test trials.
_CALIBRATED: Final[Mapping[str, str]] = {  # Source of prediction intervals.
    "validation": "its errors on the validation trials",
    "training": "its errors on the training trials, which tend to be too small",
    "left_out": "its errors on the training trials, with the parameters identified without each of them",
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
    inside, outside = _errors_by_load(metrics, other_trials(settings))
    sentences = gains(
        inside or outside, epochs_kept(metrics), published_errors(settings.name), outside if inside else {}
    )
    sentences = laws_unused(folds) + sentences + intervals_text(metrics)
    return sentences + advice([_identified(fold, settings.identify) for fold in folds])


def headline(metrics: Mapping[str, Any], settings: RunSettings) -> list[str]:
    """Return sentences on the best corrected model beside the best of all others, and on the recommended one."""
    idle = untrained(epochs_kept(metrics))
    inside, outside = _errors_by_load(metrics, other_trials(settings))
    sentences = recommendation(inside or outside, idle)
    return sentences + (recommendation(outside, idle, "outside of the training loads") if inside and outside else [])


def laws_unused(folds: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence on identified laws that are not used; none if all are used, or there are none."""
    laws = [fold["law"] for fold in folds if fold.get("law")]
    unused = [law for law in laws if not law["accepted"]]
    if not unused:
        return []
    if len(folds) == 1:
        return [law_text(unused[0])]
    return [
        f"In {len(unused)} of {len(folds)} folds the identified law of the material is not used, as it does not reduce "
        "the error on the validation trials."
    ]


def law_text(law: Mapping[str, Any]) -> str:
    """Return a sentence on whether the identified law is used, and why.

    Args:
        law: From metrics.json, with `accepted`, `validation` and the model `against` which it was tested.
    """
    checked = law["validation"]
    trials = checked["trials"]
    kind = checked.get("split", "validation")
    where = f"{kind} trial{'s' if len(trials) > 1 else ''} {in_a_row(trials)}"
    base = _BASES[law.get("against", "simulation")]
    own, below = (_of_amplitude(checked[key]) for key in ("law", "below"))
    verdict = "is used" if law["accepted"] else "is not used, and no model builds on it"
    head, tail = f"The identified law of the material {verdict}", ""
    if law.get("file"):
        head = f"The law of {law['file']} is used as it was given"
        closer = checked["below"] is None or (checked["law"] is not None and checked["law"] < checked["below"])
        tail = (
            ""
            if law.get("accepted_there", True)
            else " The run that identified it did not use it: it was not clearly closer there."
        )
        tail += "" if closer else " It does not help here: leave law out."
    return (
        f"{head}: on the {where}, its root mean square error is {own} of the motion's amplitude, and that of {base} is "
        f"{below}.{tail}"
    )


def _of_amplitude(value: float | None) -> str:
    return "not defined, as a roll-out failed," if value is None else f"{significant(100.0 * value)} %"


def errors_by_load(metrics: Mapping[str, Any], others: Collection[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return summaries of the errors by kind of load and model; empty if there are no two kinds.

    The means are over trials, and have no deviations.

    Args:
        metrics: Of a split.
        others: Names of the test trials outside of the training loads.
    """
    groups = dict(zip((INSIDE, OUTSIDE), _errors_by_load(metrics, others), strict=True))
    if not all(groups.values()):
        return {}
    return {kind: {model: _summary(values) for model, values in errors.items()} for kind, errors in groups.items()}


def _summary(values: Sequence[float | None]) -> dict[str, Any]:
    finite = [value for value in values if value is not None]
    lost = len(values) - len(finite)
    return {"mean": None if lost else fmean(finite), "std": None, "trajectories": len(values), "diverged": lost}


def _errors_by_load(
    metrics: Mapping[str, Any], others: Collection[str]
) -> tuple[dict[str, list[float | None]], dict[str, list[float | None]]]:
    """Errors of the models that all folds have [mm], by model: with loads as in training, and with other loads."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    rows = [row for fold in folds for row in fold.get("per_trajectory", ())]
    models = [model for model in (rows[0]["errors_mm"] if rows else ()) if all(model in r["errors_mm"] for r in rows)]
    kinds = ([row for row in rows if (row["name"] in others) is outside] for outside in (False, True))
    inside, outside = ({m: [row["errors_mm"][m] for row in own] for m in models} if own else {} for own in kinds)
    return inside, outside


def trial_errors(metrics: Mapping[str, Any]) -> dict[str, list[float | None]]:
    """Return the errors on each held-out trial [mm], by model that all folds have; None where a roll-out diverged."""
    return _errors_by_load(metrics, ())[0]


def intervals_text(metrics: Mapping[str, Any]) -> list[str]:
    """Return a sentence on half-width and coverage of the prediction intervals of the best model."""
    intervals = metrics.get("intervals") or {}
    for model, name in (("resphys", "ResPhys"), ("law", "the law"), ("sysid", "SysID")):
        if (of_model := intervals.get("models", {}).get(model)) is not None:
            return [
                f"Prediction intervals of {name}, from {_CALIBRATED[intervals['calibrated_on']]}: "
                f"{100.0 * intervals['level']:.0f} % of the measured coordinates should lie within ± "
                f"{of_model['half_width_mm']:.2g} mm, on average, of the prediction; "
                f"{100.0 * of_model['coverage']:.0f} % do{_by_amplitude(of_model.get('by_amplitude', ()))}."
            ]
    return []


def _by_amplitude(shares: Sequence[float | None]) -> str:
    known = [f"{100.0 * share:.0f}" for share in shares if share is not None]
    return f" ({in_a_row(known)} % from the smallest to the largest third of the displacements)" if known else ""


def epochs_kept(metrics: Mapping[str, Any]) -> dict[str, list[int]]:
    """Return the number of epochs of training of the kept weights, by model and fold."""
    folds = list(metrics.get("folds", {}).values()) or [metrics]
    networks: list[Mapping[str, Any]] = [fold.get("networks", {}) for fold in folds]
    models = dict.fromkeys(model for fold in networks for model in fold)
    return {model: [n[model]["epoch"] for n in networks if model in n] for model in models}


def untrained(epochs: Mapping[str, Sequence[int]]) -> set[str]:
    """Return the models of which no fold kept an epoch, so that their learned force is zero."""
    return {model for model, counts in epochs.items() if counts and not any(counts)}


def gains(
    errors: Mapping[str, Sequence[float | None]],
    epochs: Mapping[str, Sequence[int]],
    published: Mapping[str, PublishedError] | None = None,
    outside: Mapping[str, Sequence[float | None]] | None = None,
) -> list[str]:
    """Return a sentence on each step: its gain on held-out trials, and whether it is significant.

    The gain is the share of the mean error that a step removes, with its 90 % interval, by
    `learning.metrics.paired_gain`; with fewer than five trials their errors stand in its place.

    Args:
        errors: Of each model on the same held-out trials [mm], None where its roll-out diverged.
        epochs: Kept by the learned models, in each fold.
        published: Published errors [mm]; the gains of learned models are compared with theirs.
        outside: Of each model on the same trials outside of the training loads [mm], if there are any.
    """
    sentences, theirs = [], published or {}
    for model, (name, bases) in _STEPS.items():
        base = next((candidate for candidate in bases if candidate in errors), None)
        if model not in errors or base is None:
            continue
        beside = ""
        if model in _LEARNED and {model, base} <= theirs.keys():
            ratio = theirs[model].mean / theirs[base].mean
            beside = f"; published: {100.0 * abs(1.0 - ratio):.1f} % {'less' if ratio <= 1.0 else 'more'}"
        kept = list(epochs.get(model, ()))
        sentence = _gain(name, _BASES[base], errors[model], errors[base], kept, beside)
        if outside and not (kept and not any(kept)):
            sentence += _gain_outside(_BASES[base], outside[model], outside[base])
        sentences.append(sentence[0].upper() + sentence[1:])
    if sentences and (count := max(map(len, errors.values()))) < LEAST_TRIALS:
        few = f"{count} held-out trials" if count > 1 else "one held-out trial"
        sentences.append(f"These gains rest on {few}, and others may differ: test on {LEAST_TRIALS} or more.")
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
    gain, means = _gain_and_means(pairs, published)
    many = f" on {gain.trials} trials" if gain.trials > 1 else ""
    return f"{name} {compared(gain, base)}{many} ({means}){outcome(gain)}.{idle}"


def _gain_outside(base: str, after: Sequence[float | None], before: Sequence[float | None]) -> str:
    """A sentence on the gain outside of the training loads, after the one on trials with loads as in training."""
    count = len(after)
    where = f" On {count} trial{'s' if count > 1 else ''} outside of the training loads"
    pairs = [(a, b) for a, b in zip(after, before, strict=True) if a is not None and b]
    if lost := sum(error is None for error in after):
        return f"{where}, {lost} of {count} roll-outs diverged."
    if len(pairs) < count:
        return f"{where}, it cannot be compared with {base}."
    gain, means = _gain_and_means(pairs)
    return f"{where} it {compared(gain, base)} ({means}){outcome(gain)}."


def _gain_and_means(pairs: Sequence[tuple[float, float]], published: str = "") -> tuple[Gain, str]:
    before, after = ([pair[which] for pair in pairs] for which in (1, 0))
    return paired_gain(before, after), f"{means_text(before, after)}{published}"


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
