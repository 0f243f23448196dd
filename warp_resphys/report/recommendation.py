"""The model that a run recommends, and how the best corrected simulator compares with everything simpler."""

import math
from collections.abc import Collection, Mapping, Sequence
from statistics import fmean
from typing import Final

from ..learning.baselines import BASELINES
from ..learning.metrics import Gain, paired_gain
from .data import MODELS, PLAIN_NAMES
from .notes import in_a_row
from .page import MINUS, MOST_PERCENT, number_text

LEAST_TRIALS: Final = 5  # with which an interval over trials is given
CORRECTED: Final = ("sysid_elastic", "sysid", "law", "resphys_uncorrected", "resphys")
_SOLID: Final = ("simulation", "sysid_elastic", "sysid", "law", "simfree", "resphys_uncorrected", "resphys")
_RANKED: Final = (*BASELINES, *_SOLID)  # from the simplest
_NAMES: Final = {**PLAIN_NAMES, "simulation": "the uncorrected simulation", "law": "the law"}
_TINY: Final = 1e-4  # errors [mm] below which Python writes an exponent

Errors = Mapping[str, Sequence[float | None]]  # of each model on the same held-out trials [mm]; None: it diverged


def recommended(errors: Errors, without: Collection[str] = ()) -> str:
    """Returns the simplest model that the trials do not show to be worse than the one of least mean error.

    With fewer than five trials it is the one of least mean error. Empty if no model is defined on all trials.

    Args:
        errors: errors of the models on held-out trials.
        without: models that are left out, such as those of which no training was kept.
    """
    known = _known(errors, without)
    best = _least(known, _RANKED)
    if not best or len(known[best]) < LEAST_TRIALS:
        return best
    return next(model for model in _RANKED if model in known and (model == best or not _is_worse(known, model, best)))


def _is_worse(known: Mapping[str, Sequence[float]], model: str, best: str) -> bool:
    return min(known[model]) > 0.0 and paired_gain(known[model], known[best]).lower > 0.0


def best_pair(errors: Errors, without: Collection[str] = ()) -> tuple[str, str]:
    """Returns the corrected model of least mean error, and the best of all others; empty where there is none."""
    known = _known(errors, without)
    return _least(known, CORRECTED), _least(known, [model for model in _RANKED if model not in CORRECTED])


def recommendation(errors: Errors, without: Collection[str] = (), where: str = "") -> list[str]:
    """Returns sentences: the best corrected simulator beside the best of all other models, and the recommended model.

    Args:
        errors: errors of the models on held-out trials.
        without: models that are left out.
        where: which trials these are, such as "outside of the training loads"; may be empty.
    """
    known = _known(errors, without)
    corrected, other = best_pair(errors, without)
    if not corrected or not other:
        return []
    own, theirs = known[corrected], known[other]
    sentences = [_compared(corrected, own, other, theirs, where)]
    chosen = recommended(errors, without)
    text = f"Recommended{f' {where}' if where else ''}: {model_name(chosen)}"
    best = _least(known, _RANKED)
    if chosen != best:
        text += f", the simplest model that these trials do not show to be worse than the best, {model_name(best)}"
    if chosen in PLAIN_NAMES:
        text += ". It is for trials like those of the training; test on others what a simulator is for"
    return [*sentences, f"{text}."]


def _compared(model: str, own: Sequence[float], other: str, theirs: Sequence[float], where: str) -> str:
    count = len(own)
    on = f"On {count} trial{'s' if count > 1 else ''}{f' {where}' if where else ''}"
    physics = ", which needs no physics" if other in PLAIN_NAMES else ""
    rival = f"{model_name(other)}{physics}"
    if not min(theirs) > 0.0:
        return f"{on} the best corrected model, {model_name(model)}, cannot be compared with {rival}: it has no error."
    gain = paired_gain(theirs, own)
    text = f"{on} the best corrected model, {model_name(model)}, {compared(gain, '{}')} ({means_text(theirs, own)})"
    needless = gain.upper < 0.0 and count >= LEAST_TRIALS and other in PLAIN_NAMES
    end = ": such trials need no simulator" if needless else outcome(gain)
    return f"{text.format(f'the best of all others, {rival}')}{end}."


def compared(gain: Gain, base: str) -> str:
    """The size of a gain over a model, or of a loss; a loss of more than 1000 % is written as a multiple."""
    interval = gain.trials >= LEAST_TRIALS
    if gain.share < -MOST_PERCENT:
        mean, low, high = (f"{float(f'{1.0 - x:.2g}'):,.0f}" for x in (gain.share, gain.upper, gain.lower))
        return f"has {mean} times{f' (90 %: {low} to {high})' if interval else ''} the error of {base}"
    return f"has {_percent(gain, interval)} {'less' if gain.share >= 0.0 else 'more'} error than {base}"


def _percent(gain: Gain, interval: bool) -> str:
    """The size of a gain or loss, with its 90 % interval over draws of the trials."""
    digits = max(2, math.floor(-math.log10(1.0 - gain.share)) - 1) if 0.99 < gain.share < 1.0 else 0
    ends = (gain.lower, gain.upper) if gain.share >= 0.0 else (-gain.upper, -gain.lower)
    shown = " to ".join(f"{100.0 * end:.{digits}f}".replace("-", MINUS) for end in ends)
    return f"{100.0 * abs(gain.share):.{digits}f} %" + (f" (90 %: {shown})" if interval else "")


def outcome(gain: Gain) -> str:
    """What the interval of a gain says; empty with too few trials for one."""
    if gain.trials < LEAST_TRIALS:
        return ""
    if gain.lower <= 0.0 <= gain.upper:
        return ": other trials may show the opposite"
    return f": it {'helps' if gain.share > 0.0 else 'does harm'}"


def means_text(before: Sequence[float], after: Sequence[float]) -> str:
    """The errors from one model to another [mm]: their means, or those of all trials if there are few."""
    if 1 < len(after) < LEAST_TRIALS:
        return " to ".join(in_a_row([_short(value) for value in own]) for own in (before, after)) + " mm"
    return f"mean {_short(fmean(before))} to {_short(fmean(after))} mm"


def model_name(model: str) -> str:
    """The name of a model in a sentence."""
    return _NAMES.get(model, MODELS[model][0])


def _known(errors: Errors, without: Collection[str]) -> dict[str, Sequence[float]]:
    """Errors of the models whose roll-outs are all defined."""
    known: dict[str, Sequence[float]] = {}
    for model, values in errors.items():
        finite = [value for value in values if value is not None]
        if model not in without and finite and len(finite) == len(values):
            known[model] = finite
    return known


def _least(known: Mapping[str, Sequence[float]], models: Collection[str]) -> str:
    """The model of least mean error, the simplest of equal ones; empty without one."""
    return min((m for m in models if m in known), key=lambda m: fmean(known[m]), default="")


def _short(value: float) -> str:
    """A number with three digits; a very small one with a power of ten."""
    return number_text(value) if 0.0 < value < _TINY else f"{value:.3g}"
