"""Results of a run in one form, for the terminal and the page: a table of mean errors, a verdict and advice.

An error is the mean over the trials of the mean over the frames of a trial; every trial counts alike. Models are
compared by a paired bootstrap over the trials, which gives an interval from five trials on.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from statistics import fmean
from typing import Final, NamedTuple

from ..learning.baselines import BASELINES
from ..learning.metrics import Gain, mean_interval, paired_gain
from ..settings.learning import IdentifySettings
from ..settings.run import RunSettings
from .data import Errors, Metrics, folds_in, force_errors, grouped_errors, missing_baselines, unused
from .identification_section import first_frames_text, in_sentence, with_unit
from .page import Cell, PageTable, Row
from .wording import mm_text, model_words, number_text, share_text, unbroken

LEAST_TRIALS: Final = 5  # with which an interval over trials is given
CORRECTED: Final = ("sysid_elastic", "sysid", "law", "actuator", "resphys_uncorrected", "resphys")
_RANKED: Final = (  # from the simplest one on
    *BASELINES,
    "simulation",
    "sysid_elastic",
    "sysid",
    "law",
    "actuator",
    "simfree",
    *CORRECTED[-2:],
)
_ROWS: Final[Mapping[str, str]] = {  # Below that of the best model without physics.
    "simfree": "network in place of the simulator (SimFree)",
    "simulation": "uncorrected simulator",
    "sysid_elastic": "+ identified E and \N{GREEK SMALL LETTER NU}",
    "sysid": "+ identified parameters (SysID)",
    "law": "+ law of its material",
    "actuator": "+ learned actuator",
    "resphys": "+ learned force (ResPhys)",
    "resphys_uncorrected": "learned force on the uncorrected simulator",
}
_NUMBERS: Final = ("no", "one", "two", "three", "four")
_EQUAL: Final = 0.005  # share of an error below which there is no difference
_CLOSE: Final = 1e-4  # distance from a bound or the first guess that counts as none, over a parameter's range
_SIMPLER: Final = 0.1  # share of an error that a simpler model may add, where the difference is not significant
_COVERED: Final = 0.75  # share of the measurements within 90 % intervals, below which these are too narrow
_TURNED: Final = 3.0  # degrees by which identification rotates the markers, from which on their registration is wrong
_MOST_DOUBTS: Final = 3  # in the verdict
_GROUPS: Final = {"sysid": "parameters", "sysid_elastic": "elastic"}  # keys of the ranges in the group `identify`

Known = Mapping[str, Sequence[float]]  # errors of the models whose roll-outs are all defined [mm]


class Doubt(NamedTuple):
    """A reason not to rely on a result yet."""

    fact: str
    remedy: str  # A sentence.


def known_errors(errors: Errors, without: Collection[str] = ()) -> Known:
    """Returns the errors of the models whose roll-outs are all defined, without some models."""
    finite = {
        m: [x for x in values if x is not None] for m, values in errors.items() if m in _RANKED and m not in without
    }
    return {model: values for model, values in finite.items() if values and len(values) == len(errors[model])}


def best_of(known: Known, models: Collection[str]) -> str:
    """Returns the model of least mean error among some, the simplest of equal ones; empty without one."""
    return min((m for m in _RANKED if m in known and m in models), key=lambda m: fmean(known[m]), default="")


def best_pair(known: Known) -> tuple[str, str]:
    """Returns the corrected model of least mean error, and the best of all others; empty where there is none."""
    return best_of(known, CORRECTED), best_of(known, [model for model in _RANKED if model not in CORRECTED])


def results_table(metrics: Metrics, settings: RunSettings) -> PageTable:
    """Returns the mean errors, with a column for each group of test trials, factor of the inputs and force sensor.

    Of the models without physics, the best one of each column is shown. The metrics are of a split or of folds.
    """
    groups, idle = grouped_errors(metrics, settings), unused(metrics)
    columns = {
        title: {model: error_cell(by_model) for model, by_model in errors.items()} for title, errors in groups.items()
    }
    plain = {title: best_of(known_errors(errors), BASELINES) for title, errors in groups.items()}
    for scale, errors in sorted(metrics.get("scales", {}).items(), key=lambda item: float(item[0])):
        if float(scale) != 1.0:
            title = f"inputs \N{MULTIPLICATION SIGN} {float(scale):g}"
            columns[title] = {model: Cell(number_text(summary["mean"])) for model, summary in errors.items()}
            means = {m: mean for m in BASELINES if m in errors and (mean := errors[m]["mean"]) is not None}
            plain[title] = min(means, key=means.__getitem__, default="")
    for name, (unit, _, of_models) in force_errors(metrics).items():
        title = f"{name} [{unit}]"
        columns[title] = {m: Cell("diverged" if x is None else number_text(x)) for m, x in of_models.items()}
        known_means = {m: mean for m in BASELINES if (mean := of_models.get(m)) is not None}
        plain[title] = min(known_means, key=known_means.__getitem__, default="")
    last = next(reversed(groups.values()), {})
    best, mark = best_of(known_errors(last, idle), _RANKED), "best beyond the training" if len(groups) > 1 else "best"
    rows = []
    if named := [model_words(model) for model in dict.fromkeys(plain.values()) if model]:
        cells = [columns[title].get(model, Cell("")) for title, model in plain.items()]
        rows.append(Row(f"without physics ({', '.join(named)})", cells, mark * (best in BASELINES)))
    rows += [
        Row(text, [by_model.get(model, Cell("")) for by_model in columns.values()], mark * (model == best))
        for model, text in _ROWS.items()
        if any(model in by_model for by_model in columns.values())
    ]
    of = "vertices" if settings.markers is None else "markers"
    lacking = [f"{model_words(model)} ({why})" for model, why in missing_baselines(metrics).items()]
    note = f"Missing: {'; '.join(lacking)}." if lacking else ""
    first = {owner: shown for fold in folds_in(metrics) for owner, shown in fold.get("first_frames", {}).items()}
    note = " ".join(filter(None, (note, first_frames_text(first))))
    return PageTable(f"{settings.heading}: mean error of the {of} [mm]", list(columns), rows, note)


def error_cell(errors: Sequence[float | None], with_interval: bool = False) -> Cell:
    """Returns the mean error over trials [mm], with its interval below, or how many roll-outs diverged."""
    known = [error for error in errors if error is not None]
    if lost := len(errors) - len(known):
        return Cell(f"{lost} of {len(errors)} diverged")
    return Cell(number_text(fmean(known)), interval_text(errors) if with_interval else "")


def interval_text(errors: Sequence[float | None]) -> str:
    """Returns the 90 % interval of a mean error [mm]; empty with fewer than five trials, or where one diverged."""
    known = [error for error in errors if error is not None]
    whole = LEAST_TRIALS <= len(known) == len(errors)
    return " to ".join(map(number_text, mean_interval(known))) if whole else ""


def less_error(best: str, second: str, share: float) -> str:
    """Returns the first half of a sentence on the best model, such as "ResPhys has 63 % less error than SimFree".

    Args:
        best: model of less error.
        second: best model of the other kind; the kinds are the corrected simulators, and all other models.
        share: of the error of the second one that the best one removes.
    """
    other = "anything without physics" if second in BASELINES else model_words(second)
    other = "any corrected simulator" if best not in CORRECTED else other
    name = f"{model_words(best)}, without physics," if best in BASELINES else model_words(best)
    return f"{name} has {share_text(share)} less error than {other}"


def verdict(metrics: Metrics, settings: RunSettings) -> list[str]:
    """Returns a sentence on what is best, by how much and on how many trials, and at most two sentences of advice."""
    groups, idle = [*grouped_errors(metrics, settings).values()], unused(metrics)
    if not groups or not {*_RANKED} & groups[-1].keys():
        return []
    known = known_errors(groups[-1], idle)
    beyond = "beyond the training loads, " if len(groups) > 1 else ""
    texts = [f"{beyond}{_best_text(known)}"] if known else ["all models diverged"]
    texts += [f"{model_words(model)} is not used: {idle[model]}" for model in idle]
    inside = best_of(known_errors(groups[0], idle), _RANKED) if len(groups) > 1 else ""
    advice = [f"within them, {model_words(inside)} is {'enough' if inside in BASELINES else 'best'}"] if inside else []
    if doubts := [*_failed(groups[-1], known), *_doubts(metrics, settings, known, len(groups))]:
        advice += [f"check before use: {'; '.join(doubt.fact for doubt in doubts[:_MOST_DOUBTS])}", doubts[0].remedy]
    elif not inside:
        advice += _use(known)
    return [unbroken(f"{text[0].upper()}{text[1:]}.") for text in [*texts, *advice[:2]] if text]


def _best_text(known: Known) -> str:
    corrected, other = best_pair(known)
    best = best_of(known, (corrected, other))
    count = len(known[best])
    on = f"on {count} trial{'s' * (count > 1)}"
    if not corrected or not other:
        return f"{model_words(best)} has the lowest error, {mm_text(fmean(known[best]))} {on}"
    second = other if best == corrected else corrected
    gain = compared(known[second], known[best])
    if gain.share < _EQUAL or not is_clear(gain):
        word = "no" if gain.share < _EQUAL else "no significant"
        return (
            f"{model_words(best)} and {model_words(second)} show {word} difference {on}, {mm_text(fmean(known[best]))}"
        )
    lower = sum(a < b for a, b in zip(known[best], known[second], strict=True))
    return f"{less_error(best, second, gain.share)} ({counted(lower, count, 'trial')})"


def counted(lower: int, count: int, noun: str) -> str:
    """Returns on how many trials, or poses, an error is lower: "on 5 of 6 trials", "on 1 trial"."""
    return f"on {lower} of {count} {noun}s" if count > 1 else f"on {count} {noun}"


def compared(before: Sequence[float], after: Sequence[float]) -> Gain:
    """Returns the share of the error of one model that another one removes, on the same trials."""
    return paired_gain([max(error, 1e-300) for error in before], after)


def is_clear(gain: Gain) -> bool:
    """Returns whether the 90 % interval of a gain excludes zero, or there are too few trials for an interval."""
    return gain.trials < LEAST_TRIALS or gain.lower > 0.0


def _use(known: Known) -> Iterator[str]:
    """Yields which model to use: of those that are not clearly worse than the best one, the simplest simulator."""
    best = best_of(known, _RANKED)
    if best in BASELINES:
        yield f"{model_words(best)} is enough for trials like these; to judge the simulator, test it on others"
    elif best:
        chosen = next(m for m in _RANKED if m in known and m not in BASELINES and _as_good(known[m], known[best]))
        simpler = f", which is simpler than {model_words(best)} and not significantly worse"
        yield f"use {model_words(chosen)}{simpler * (chosen != best)}"


def _as_good(errors: Sequence[float], best: Sequence[float]) -> bool:
    gain = compared(errors, best)
    return gain.share < _EQUAL or (gain.share < _SIMPLER and not is_clear(gain))


def _failed(errors: Errors, known: Known) -> Iterator[Doubt]:
    """Yields corrections that diverged."""
    best = best_of(known, ("simulation", *CORRECTED))
    use = f"use {model_words(best)}" if best else ""
    for model in (model for model in CORRECTED if model in errors):
        if lost := sum(error is None for error in errors[model]):
            yield Doubt(f"{model_words(model)} diverged in {lost} of {len(errors[model])} trials", use)


def _doubts(metrics: Metrics, settings: RunSettings, known: Known, groups: int) -> Iterator[Doubt]:
    """Yields reasons not to rely on the best corrected simulator yet, the worst one first."""
    model, _ = best_pair(known)
    folds, count = folds_in(metrics), len(next(iter(known.values()), ()))
    error = fmean(known[model]) if model else math.inf
    placed = [fold["placement"] for fold in folds if "placement" in fold]
    if (turned := max((placement["turned_deg"] for placement in placed), default=0.0)) > _TURNED:
        text = f"the markers are rotated by {turned:.1f}° from their registration"
        yield Doubt(text, "check the positions and axes of the markers")
    if (rms := max((placement["rms_mm"] for placement in placed), default=0.0)) > error:
        yield Doubt(f"the markers at rest fit their positions to {mm_text(rms)} only", "measure the positions again")
    checks = [fold["mesh_check"] for fold in folds if "mesh_check" in fold]
    moves = [moved for check in checks if (moved := check.get("moved_mm")) is not None]
    improves = moves and model in ("law", "actuator", "resphys")
    base = checks[0]["model"] if improves else "simulation"  # that the model improves
    if moves and model in known and base in known:
        moved, gained = fmean(moves), fmean(known[base]) - error
        if moved > gained:
            text = f"a finer mesh moves the markers by {mm_text(moved)}"
            yield Doubt(f"{text}, but {model_words(model)} gains {mm_text(gained)}", "refine the mesh first")
    if 0 < count < LEAST_TRIALS:
        few = f"{_NUMBERS[count]} trial{'s are' if count > 1 else ' is'}"
        yield Doubt(f"{few} too few for an interval", "test on five trials or more")
    left = sum(len(fold["range"][model]["first_s"]) for fold in folds if model in fold.get("range", {}))
    if groups == 1 and 2 * left > count:
        trials = f"{left} of {count} trials leave" if count > 1 else "the trial leaves"
        yield Doubt(f"{trials} the training range", "train on trials that reach as far")
    covered = metrics.get("intervals", {}).get("models", {}).get(model, {}).get("coverage", 1.0)
    if covered < _COVERED:
        text = f"90 % of the measurements should lie within the 90 % intervals, {100.0 * covered:.0f} % do"
        yield Doubt(text, "validate on trials like those of the test")
    bounds = Counter(doubt for fold in folds for doubt in _bounds(fold, settings.identify))
    for doubt, found in bounds.items():
        where = f"in {found} of {len(folds)} folds, " if len(folds) > 1 else ""
        yield Doubt(f"{where}{doubt.fact}", doubt.remedy)


def _bounds(metrics: Metrics, settings: IdentifySettings | None) -> Iterator[Doubt]:
    """Yields identified parameters at a bound or at their first guess."""
    for model, group in _GROUPS.items():
        ranges = (None if settings is None else getattr(settings, group)) or {}
        start, values = (metrics.get("first_guesses", {}).get(model, {}), metrics.get("parameters", {}).get(model, {}))
        keys = {name: settings.key_of(name) if group == "parameters" and settings else name for name in values}
        for name, limits in ((name, ranges[key]) for name, key in keys.items() if key in ranges):
            key, close = f"identify.{group}.{keys[name]}", _CLOSE * (limits.upper - limits.lower)
            ends = {end: getattr(limits, end) for end in ("lower", "upper")}
            if end := next((end for end, bound in ends.items() if abs(values[name] - bound) <= close), ""):
                mend = f"widen {key}.{end}" if ends[end] else f"remove it from the fit (~{key})"
                yield Doubt(f"{in_sentence(name)} is at its {end} bound, {with_unit(name, ends[end])}", mend)
            elif limits.prior is None and abs(values[name] - start.get(name, math.nan)) <= close:
                fact = f"{in_sentence(name)} stayed at its first guess, {with_unit(name, values[name])}"
                yield Doubt(fact, "raise identify.starts")
