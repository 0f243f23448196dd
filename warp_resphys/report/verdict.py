"""The verdict on a run: which model is best, which corrections help, which do not, and what to do next.

Everything is made from one list of comparisons, each of a model with another on the same held-out trials, by a paired
bootstrap over these trials. With fewer than five trials there is no interval, and nothing is said to help.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any, Final, Literal

from ..learning.baselines import BASELINES
from ..learning.metrics import Gain, mean_interval, paired_gain
from ..settings.learning import IdentifySettings
from ..settings.run import RunSettings
from .data import MODELS, Errors, folds_in, other_trials, trial_errors, untrained
from .page import MINUS, mm_text, number_text, unbroken

LEAST_TRIALS: Final = 5  # with which an interval over trials is given
CORRECTED: Final = ("sysid_elastic", "sysid", "law", "resphys_uncorrected", "resphys")
# By model: the models that it may extend, of which the first available one is compared.
_BASES: Final[Mapping[str, tuple[str, ...]]] = {
    "sysid_elastic": ("simulation",),
    "sysid": ("simulation",),
    "law": ("sysid", "simulation"),
    "simfree": ("law", "sysid", "simulation"),
    "resphys_uncorrected": ("simulation",),
    "resphys": ("law", "sysid", "simulation"),
}
_RANKED: Final = (*BASELINES, "simulation", "sysid_elastic", "sysid", "law", "simfree", *CORRECTED[-2:])
_BETWEEN: Final = ("interpolation", "regression")  # good only at trials between those of the training
_NAMES: Final = {
    "rest": "a body that does not move",
    "interpolation": "interpolation without physics",
    "regression": "kernel regression without physics",
    "linear": "a linear model without physics",
    "simulation": "the uncorrected simulation",
    "sysid_elastic": "identification of E and nu",
    "law": "the law",
    "resphys_uncorrected": "the learned force on the uncorrected simulation",
}
_NUMBERS: Final = ("no", "one", "two", "three", "four")
_TIMES: Final = 10.0  # ratio of errors from which on it is written in place of a percentage
_CLOSE: Final = 1e-4  # distance from a bound or the first guess that counts as none, over a parameter's range
_GROUPS: Final = {"sysid": "parameters", "sysid_elastic": "elastic"}  # keys of the ranges in the group `identify`

Known = Mapping[str, Sequence[float]]  # errors of the models whose roll-outs are all defined [mm]


@dataclass(frozen=True)
class ModelComparison:
    """A model beside another one, on the same held-out trials."""

    model: str
    other: str  # With which it is compared.
    errors: Sequence[float | None]  # Of the model on each trial [mm]; None where its roll-out diverged.
    others: Sequence[float | None]  # Of the other model.
    where: str = ""  # Which trials these are, such as "with other loads".
    idle: bool = False  # Whether no epoch of its training was kept, so that its learned force is zero.

    @cached_property
    def gain(self) -> Gain | None:
        """Share of the other model's error that the model removes; None where a roll-out diverged."""
        pairs = [(b, a) for b, a in zip(self.others, self.errors, strict=True) if a is not None and b]
        return paired_gain(*zip(*pairs, strict=True)) if pairs and len(pairs) == len(self.errors) else None

    @property
    def outcome(self) -> Literal["helps", "harms", "same", "few", "unknown"]:
        """Outcome by the 90 % interval of the gain; ``few`` with fewer than five trials."""
        if self.idle or self.gain is None:
            return "unknown"
        if self.gain.trials < LEAST_TRIALS:
            return "few"
        return "helps" if self.gain.lower > 0.0 else "harms" if self.gain.upper < 0.0 else "same"

    @property
    def improves(self) -> bool:
        """Whether the model has less error, significantly so where there are enough trials for an interval."""
        return self.outcome == "helps" or (self.outcome == "few" and self.gain is not None and self.gain.share > 0.0)

    @property
    def text(self) -> str:
        """The comparison as what follows the model's name: "has 48 % less error than SysID (90 % interval ...)"."""
        base, at = model_name(self.other), f" {self.where}" if self.where else ""
        if self.idle:
            return f"adds nothing to {base}{at}, as no epoch of its training improved the validation trials"
        if lost := sum(error is None for error in self.errors):
            return f"diverged in {lost} of {len(self.errors)} trials{at}"
        if self.gain is None:
            return f"cannot be compared with {base}{at}, which diverged or has no error"
        if self.outcome == "few":
            known = [(a, b) for a, b in zip(self.errors, self.others, strict=True) if a is not None and b is not None]
            sign = 1 if self.improves else -1
            word, count = "lower" if self.improves else "higher", len(known)
            shown = sum(sign * a < sign * b for a, b in known)
            before, after = (number_text(fmean(own)) for own in list(zip(*known, strict=True))[::-1])
            return f"has a {word} error than {base} on {shown} of {count} trials{at} ({before} to {after} mm)"
        if self.outcome == "same":
            return f"shows no significant difference from {base} on {self.gain.trials} trials{at}"
        return f"{accuracy(self.gain, base)}{at}"


def accuracy(gain: Gain, base: str) -> str:
    """Returns the size of a gain over a model or of a loss, with its interval where there are enough trials for one."""
    better = gain.share >= 0.0
    ends = (gain.lower, gain.upper) if better else (-gain.upper, -gain.lower)
    ratios = [(1.0 - min(own, 1.0 - 1e-12)) ** (-1 if better else 1) for own in (gain.share, gain.lower, gain.upper)]
    if ratios[0] >= _TIMES:
        text, unit = f"is {_times(ratios[0])} times more accurate than {base}", ""
        text = text if better else f"has {_times(ratios[0])} times the error of {base}"
        shown = [_times(ratio) for ratio in sorted(ratios[1:])]
    else:
        text = f"has {100.0 * abs(gain.share):.0f} % {'less' if better else 'more'} error than {base}"
        shown, unit = [f"{100.0 * end:.0f}".replace("-", MINUS) for end in ends], " %"
    return text if gain.trials < LEAST_TRIALS else f"{text} (90 % interval {' to '.join(shown)}{unit})"


def _times(ratio: float) -> str:
    return f"{float(f'{ratio:.2g}'):,.0f}" if ratio >= _TIMES else f"{ratio:.1f}"


def model_name(model: str) -> str:
    """Returns the name of a model in a sentence."""
    return _NAMES.get(model, MODELS[model][0])


def known_errors(errors: Errors, without: Collection[str] = ()) -> Known:
    """Returns the errors of the models whose roll-outs are all defined, without some models."""
    finite = {m: [x for x in own if x is not None] for m, own in errors.items() if m in _RANKED and m not in without}
    return {model: own for model, own in finite.items() if own and len(own) == len(errors[model])}


def best_pair(known: Known) -> tuple[str, str]:
    """Returns the corrected model of least mean error, and the best of all others; empty where there is none."""
    return _least(known, CORRECTED), _least(known, [model for model in _RANKED if model not in CORRECTED])


def recommended(known: Known) -> str:
    """Returns the simplest model that is not significantly worse than the one of least mean error; empty without any.

    With fewer than five trials it is the one of least mean error. Where that one knows only what lies between the
    training trials, the split cannot judge a simulator, and none is recommended.
    """
    best = _least(known, _RANKED)
    if best in _BETWEEN:
        return ""
    others = {m: ModelComparison(best, m, known[best], own) for m, own in known.items() if m != best}
    worse = {model for model, own in others.items() if own.outcome in ("helps", "few")}
    return next((model for model in _RANKED if model in known and model not in worse), "")


def _least(known: Known, models: Collection[str]) -> str:
    """The model of least mean error, the simplest of equal ones; empty without one."""
    return min((m for m in _RANKED if m in known and m in models), key=lambda m: fmean(known[m]), default="")


def standings(known: Known) -> dict[str, tuple[tuple[float, float] | None, float | None]]:
    """Returns by model the 90 % interval of its mean error over the trials [mm], and the ratio to the best other model.

    With fewer than five trials there is no interval.
    """
    means = {model: fmean(own) for model, own in known.items()}
    best = {m: min((mean for other, mean in means.items() if other != m), default=0.0) for m in means}
    return {
        m: (mean_interval(own) if len(own) >= LEAST_TRIALS else None, means[m] / best[m] if best[m] else None)
        for m, own in known.items()
    }


def comparisons(errors: Errors, without: Collection[str] = (), where: str = "") -> list[ModelComparison]:
    """Returns each correction beside the model that it corrects.

    Args:
        errors: on held-out trials.
        without: models of which no epoch of training was kept.
        where: which trials these are; may be empty.
    """
    pairs = {m: next((base for base in bases if base in errors), "") for m, bases in _BASES.items() if m in errors}
    return [ModelComparison(m, b, errors[m], errors[b], where, m in without) for m, b in pairs.items() if b]


def verdict(metrics: Mapping[str, Any], settings: RunSettings) -> list[str]:
    """Returns at most four sentences on a run: what is best, what helps, what does not, and what to do next.

    Args:
        metrics: metrics.json of a split or of folds.
        settings: of the run.
    """
    others, idle = other_trials(settings), untrained(metrics)
    inside, outside = (trial_errors(metrics, others, out) for out in (False, True))
    steps = comparisons(inside or outside, idle, "with loads as in training" if inside and outside else "")
    if inside and outside:
        steps += [step for step in comparisons(outside, idle, "with other loads") if not step.idle]
    known = known_errors(outside or inside, idle)
    helping = [step for step in steps if step.improves]
    sentences = (
        _best_text(known, "with other loads" if outside else ""),
        _listed(helping),
        _listed([step for step in steps if step not in helping], _unused_law(metrics)),
        _to_do(metrics, settings.identify, known),
    )
    return [unbroken(f"{text[0].upper()}{text[1:]}.") for text in sentences if text]


def _listed(steps: Sequence[ModelComparison], *more: str) -> str:
    return "; ".join([*(f"{model_name(step.model)} {step.text}" for step in steps), *filter(None, more)])


def _best_text(known: Known, where: str) -> str:
    """Returns the sentence on the best model: its error, and its gain over the best model of the other kind."""
    corrected, other = best_pair(known)
    best = _least(known, (corrected, other))
    if not best:
        return ""
    count = len(known[best])
    at = f" on {count} trial{'s' if count > 1 else ''}{' ' if where else ''}{where}"
    means = {model: f"with a mean error of {mm_text(fmean(known[model]))}{at}" for model in known}
    if not corrected or not other:
        return f"{model_name(best)} is best, {means[best]}"
    second = other if best == corrected else corrected
    beside = ModelComparison(best, second, known[best], known[second])
    if best in _BETWEEN:
        return (
            f"{model_name(corrected)} is the best simulator, {means[corrected]}, but {model_name(best)} {beside.text}: "
            "the test trials lie between those of the training, so this split cannot judge a simulator"
        )
    if beside.outcome == "few":
        return f"{model_name(best)} is best, {means[best]}; {model_name(second)} has {mm_text(fmean(known[second]))}"
    place = "is best" if beside.improves else "has the lowest error"
    return f"{model_name(best)} {place}, {means[best]}: it {beside.text}"


def _unused_law(metrics: Mapping[str, Any]) -> str:
    laws = [fold["law"] for fold in folds_in(metrics) if fold.get("law")]
    unused = sum(not law["accepted"] for law in laws)
    where = f" in {unused} of {len(laws)} folds" if len(laws) > 1 else ""
    return f"the identified law is not used{where}, as it did not help on the validation trials" if unused else ""


def _to_do(metrics: Mapping[str, Any], settings: IdentifySettings | None, known: Known) -> str:
    """Returns the advice: use a model, choose another split, or correct the identification."""
    best, chosen, parts = _least(known, _RANKED), recommended(known), list[str]()
    count = len(known[best]) if best else 0
    if best in _BETWEEN:
        parts.append("to judge the simulator, test it on trials unlike those of the training")
    elif 0 < count < LEAST_TRIALS:
        few = f"{_NUMBERS[count]} trial{'s are' if count > 1 else ' is'}"
        parts.append(f"{few} too few for an interval; use at least five")
    elif best:
        parts.append(f"use {model_name(chosen)}")
        parts[0] += f", which is simpler than {model_name(best)} and not significantly worse" * (chosen != best)
    folds = folds_in(metrics)
    counted = Counter(text for fold in folds for text in _bounds(fold, settings))
    parts += [f"in {n} of {len(folds)} folds, {text}" if len(folds) > 1 else text for text, n in counted.items()]
    return "; ".join(parts)


def _bounds(metrics: Mapping[str, Any], settings: IdentifySettings | None) -> Iterator[str]:
    """Yields advice on identified parameters at a bound or at their first guess."""
    for model, group in _GROUPS.items():
        ranges = (None if settings is None else getattr(settings, group)) or {}
        start, values = (metrics.get(key, {}).get(model, {}) for key in ("first_guesses", "parameters"))
        for name, own in ((name, own) for name, own in ranges.items() if name in values):
            key, close = f"identify.{group}.{name}", _CLOSE * (own.upper - own.lower)
            ends = {end: getattr(own, end) for end in ("lower", "upper")}
            if end := next((end for end, bound in ends.items() if abs(values[name] - bound) <= close), ""):
                mend = f"widen {key}.{end}" if ends[end] else f"remove it from the fit (~{key})"
                yield f"{name} is at its {end} bound, {ends[end]:g}: {mend}"
            elif own.prior is None and abs(values[name] - start.get(name, math.nan)) <= close:
                yield f"{name} stayed at its first guess, {values[name]:g}: raise identify.starts"
