"""Models ranked by their errors [mm] on the same held-out trials:
the best, the simplest as good, the recommended.

Errors are means over the trials, of which every one counts alike. Two models are compared by a
paired bootstrap over the trials, which gives an interval from five trials on (`LEAST_TRIALS`); less
error is claimed from three on.
"""

from collections.abc import Collection, Mapping, Sequence
from statistics import fmean
from typing import Any, Final

from ..learning.baselines import BASELINES
from ..learning.metrics import Gain, paired_gain
from ..learning.scores import HeldOutTest, text_of
from ..settings.run import RunSettings
from .data import Errors, Metrics, folds_in, grouped_errors

LEAST_TRIALS: Final = 5  # with which an interval over trials is given
LEAST_EVIDENCE: Final = 3  # trials with which less error is claimed
CORRECTED: Final = ("sysid_elastic", "sysid", "law", "actuator", "resphys_uncorrected", "resphys")
SIMULATORS: Final = ("simulation", *CORRECTED)
# From the simplest one on.
RANKED: Final = (*BASELINES, *SIMULATORS[:-2], "simfree", *SIMULATORS[-2:])
EQUAL: Final = 0.005  # share of an error below which there is no difference
_SIMPLER: Final = (
    0.1  # share of an error that a simpler model may add, where the difference is not significant
)

Known = Mapping[str, Sequence[float]]  # errors of the models whose roll-outs are all defined [mm]


def known_errors(errors: Errors, without: Collection[str] = ()) -> Known:
    """Returns the errors of the models whose roll-outs are all defined, without some models."""
    finite = {
        m: [x for x in values if x is not None]
        for m, values in errors.items()
        if m in RANKED and m not in without
    }
    return {
        model: values
        for model, values in finite.items()
        if values and len(values) == len(errors[model])
    }


def best_of(known: Known, models: Collection[str]) -> str:
    """Returns the model of least mean error among some, the simplest of equal ones.

    Empty without one.
    """
    return min(
        (m for m in RANKED if m in known and m in models), key=lambda m: fmean(known[m]), default=""
    )


def best_pair(known: Known) -> tuple[str, str]:
    """Returns the corrected model of least mean error, and the best of all others.

    Empty where there is none.
    """
    return best_of(known, CORRECTED), best_of(
        known, [model for model in RANKED if model not in CORRECTED]
    )


def compared(before: Sequence[float], after: Sequence[float]) -> Gain:
    """Returns the share of the error of one model that another one removes, on the same trials."""
    return paired_gain([max(error, 1e-300) for error in before], after)


def is_clear(gain: Gain) -> bool:
    """Returns whether the 90 % interval of a gain excludes zero,
    or there are too few trials for an interval.
    """
    return gain.trials < LEAST_TRIALS or gain.lower > 0.0


def simplest(known: Known, models: Collection[str] = RANKED) -> str:
    """Returns the simplest of some models that is not clearly worse than the best of them.

    Empty without one.
    """
    best = best_of(known, models)
    among = [model for model in RANKED if model in known and model in models]
    return next(
        (model for model in among if model == best or _as_good(known[model], known[best])), ""
    )


def _as_good(errors: Sequence[float], best: Sequence[float]) -> bool:
    gain = compared(errors, best)
    return gain.share < EQUAL or (gain.share < _SIMPLER and not is_clear(gain))


def unused(metrics: Metrics) -> dict[str, str]:
    """Returns why learned models are not used, by model:
    in no fold are they clearly closer to held-out trials.
    """
    tests: dict[str, list[HeldOutTest]] = {}
    for fold in folds_in(metrics):
        for model, kept in fold.get("networks", {}).items():
            test = kept.get("test")
            if test is not None:
                tests.setdefault(model, []).append(test)
    return {
        model: text_of(found[0])
        if len(found) == 1
        else f"it is clearly closer in none of the {len(found)} folds"
        for model, found in tests.items()
        if not any(test["used"] for test in found)
    }


def shown_metrics(metrics: Metrics) -> Metrics:
    """Returns the metrics without ResPhys where no force is learned,
    as it then is the simulator below it.
    """
    if not any(fold.get("without_forces") for fold in folds_in(metrics)):
        return metrics
    shown: Metrics = _without(metrics, "resphys")
    return shown


def _without(content: Any, key: str) -> Any:
    """Returns JSON data without the entries of a key, at any depth."""
    if isinstance(content, dict):
        return {name: _without(value, key) for name, value in content.items() if name != key}
    return [_without(value, key) for value in content] if isinstance(content, list) else content


def recommended(metrics: Metrics, settings: RunSettings) -> str:
    """Returns the simulator that a run recommends: the simplest one
    that is not clearly worse than the best.

    The test trials beyond the training loads decide, where there are some. What was learned and is
    not used, and what diverged, is not recommended.

    Args:
        metrics: of a split or of folds.
        settings: of the run.

    Returns:
        Its name, such as ``sysid``; empty where no simulator ran through.
    """
    groups = [*grouped_errors(metrics, settings).values()]
    return simplest(known_errors(groups[-1], unused(metrics)), SIMULATORS) if groups else ""
