"""Results of a run in one form, for the terminal and the page:
a table of mean errors, and a verdict.

An error is the mean over the trials of the mean over the frames of a trial; every trial counts
alike. What speaks against relying on the verdict are its `conditions`.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from statistics import fmean
from typing import Final

from ..learning.baselines import BASELINES
from ..learning.metrics import mean_interval
from ..settings.run import RunSettings
from .conditions import conditions
from .data import Metrics, folds_in, force_errors, grouped_errors, missing_baselines
from .identification_section import first_frames_text
from .page import Cell, PageTable, Row
from .ranking import (
    CORRECTED,
    EQUAL,
    LEAST_EVIDENCE,
    LEAST_TRIALS,
    RANKED,
    SIMULATORS,
    Known,
    best_of,
    best_pair,
    compared,
    is_clear,
    known_errors,
    simplest,
    unused,
)
from .wording import in_a_row, mm_text, model_words, number_text, share_text, unbroken

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


def results_table(metrics: Metrics, settings: RunSettings) -> PageTable:
    """Returns the mean errors, with a column for each group of test trials,
    factor of the inputs and force sensor.

    Of the models without physics, the best one of each column is shown. The metrics are of a split
    or of folds.
    """
    groups, idle = grouped_errors(metrics, settings), unused(metrics)
    columns = {
        title: {model: error_cell(by_model) for model, by_model in errors.items()}
        for title, errors in groups.items()
    }
    plain = {title: best_of(known_errors(errors), BASELINES) for title, errors in groups.items()}
    for scale, errors in sorted(metrics.get("scales", {}).items(), key=lambda item: float(item[0])):
        if float(scale) != 1.0:
            title = f"inputs \N{MULTIPLICATION SIGN} {float(scale):g}"
            columns[title] = {
                model: Cell(number_text(summary["mean"])) for model, summary in errors.items()
            }
            means = {
                m: mean
                for m in BASELINES
                if m in errors and (mean := errors[m]["mean"]) is not None
            }
            plain[title] = min(means, key=means.__getitem__, default="")
    for name, (unit, _, of_models) in force_errors(metrics).items():
        title = f"{name} [{unit}]"
        columns[title] = {
            m: Cell("diverged" if x is None else number_text(x)) for m, x in of_models.items()
        }
        known_means = {m: mean for m in BASELINES if (mean := of_models.get(m)) is not None}
        plain[title] = min(known_means, key=known_means.__getitem__, default="")
    last = next(reversed(groups.values()), {})
    best = best_of(known_errors(last, idle), RANKED)
    mark = "best beyond the training" if len(groups) > 1 else "best"
    rows = []
    named = [model_words(model) for model in dict.fromkeys(plain.values()) if model]
    if named:
        cells = [columns[title].get(model, Cell("")) for title, model in plain.items()]
        rows.append(Row(f"without physics ({', '.join(named)})", cells, mark * (best in BASELINES)))
    shown = set[str]().union(*columns.values())
    for model, text in _ROWS.items():
        if model in shown:
            cells = [by_model.get(model, Cell("")) for by_model in columns.values()]
            rows.append(Row(text, cells, mark * (model == best)))
    of = "vertices" if settings.markers is None else "markers"
    lacking = [f"{model_words(model)} ({why})" for model, why in missing_baselines(metrics).items()]
    note = f"Missing: {'; '.join(lacking)}." if lacking else ""
    of_folds = (fold.get("first_frames", {}) for fold in folds_in(metrics))
    first = dict(chain.from_iterable(frames.items() for frames in of_folds))
    note = " ".join(filter(None, (note, first_frames_text(first))))
    return PageTable(f"{settings.heading}: mean error of the {of} [mm]", list(columns), rows, note)


def error_cell(errors: Sequence[float | None], with_interval: bool = False) -> Cell:
    """Returns the mean error over trials [mm], with its interval below,
    or how many roll-outs diverged.
    """
    known = [error for error in errors if error is not None]
    lost = len(errors) - len(known)
    if lost:
        return Cell(f"{lost} of {len(errors)} diverged")
    return Cell(number_text(fmean(known)), interval_text(errors) if with_interval else "")


def interval_text(errors: Sequence[float | None]) -> str:
    """Returns the 90 % interval of a mean error [mm].

    Empty with fewer than five trials, or where one diverged.
    """
    known = [error for error in errors if error is not None]
    whole = LEAST_TRIALS <= len(known) == len(errors)
    return " to ".join(map(number_text, mean_interval(known))) if whole else ""


def less_error(best: str, second: str, share: float) -> str:
    """Returns the first half of a sentence on the best model,
    such as "ResPhys has 63 % less error than SimFree".

    Args:
        best: model of less error.
        second: best model of the other kind; the kinds are the corrected simulators, and all other
            models.
        share: of the error of the second one that the best one removes.
    """
    other = "anything without physics" if second in BASELINES else model_words(second)
    other = "any corrected simulator" if best not in CORRECTED else other
    name = f"{model_words(best)}, without physics," if best in BASELINES else model_words(best)
    return f"{name} has {share_text(share)} less error than {other}"


def verdict(metrics: Metrics, settings: RunSettings) -> list[str]:
    """Returns a sentence on what is best, by how much and on how many trials,
    and sentences of advice.
    """
    groups, idle = [*grouped_errors(metrics, settings).values()], unused(metrics)
    if not groups or not {*RANKED} & groups[-1].keys():
        return []
    every = [known_errors(errors, idle) for errors in groups]
    known = every[-1]
    played = f"on a simulated {' and '.join(settings.targets)}, " if settings.targets else ""
    beyond = "beyond the training loads, " if len(groups) > 1 else ""
    texts = [
        f"{played}{beyond}{_best_text(known)}{_at_rest(every)}" if known else "all models diverged"
    ]
    inside = every[0] if len(groups) > 1 else {}
    best = best_of(inside, RANKED)
    if best and len(inside[best]) >= LEAST_EVIDENCE:
        texts.append(
            f"within them, {model_words(best)} is {'enough' if best in BASELINES else 'best'}"
        )
    texts += _use(known, bool(conditions(metrics, settings)))
    return [unbroken(f"{text[0].upper()}{text[1:]}.") for text in texts]


def _best_text(known: Known) -> str:
    """Which model is best; less error is claimed with three trials or more, and on most of them."""
    corrected, other = best_pair(known)
    best = best_of(known, (corrected, other))
    count, error = len(known[best]), mm_text(fmean(known[best]))
    trials = f"{count} trial{'s' * (count > 1)}"
    second = other if best == corrected else corrected
    beside = f", {model_words(second)} {mm_text(fmean(known[second]))}" if second else ""
    if count < LEAST_EVIDENCE:
        return f"no evidence either way: {trials} ({model_words(best)} {error}{beside})"
    if not second:
        return f"{model_words(best)} has the lowest error, {error} on {trials}"
    gain = compared(known[second], known[best])
    if gain.share < EQUAL or not is_clear(gain):
        word = "no" if gain.share < EQUAL else "no significant"
        return (
            f"{model_words(best)} and {model_words(second)} show {word} difference "
            f"on {trials}, {error}"
        )
    lower = sum(a < b for a, b in zip(known[best], known[second], strict=True))
    on = counted(lower, count, "trial")
    if 2 * lower <= count:
        return (
            f"no evidence either way: {model_words(best)} has less error {on} alone "
            f"({error}{beside})"
        )
    return f"{less_error(best, second, gain.share)} ({on})"


def _at_rest(groups: Sequence[Known]) -> str:
    """Returns what a body at rest has in each group of trials,
    where the uncorrected simulator is no better.
    """
    both = [known for known in groups if {"rest", "simulation"} <= known.keys()]
    if not any(fmean(known["rest"]) < fmean(known["simulation"]) for known in both):
        return ""
    rest = in_a_row([number_text(fmean(known["rest"])) for known in both])
    plain = in_a_row([number_text(fmean(known["simulation"])) for known in both])
    return f"; {model_words('rest')} has {rest} mm, {model_words('simulation')} {plain} mm"


def counted(lower: int, count: int, noun: str) -> str:
    """Returns on how many trials, or poses, an error is lower: "on 5 of 6 trials", "on 1 trial"."""
    return f"on {lower} of {count} {noun}s" if count > 1 else f"on {count} {noun}"


def _use(known: Known, conditional: bool) -> Iterator[str]:
    """Yields that a prediction without physics is enough,
    or the simulator that `recommended` recommends.
    """
    best, chosen = best_of(known, RANKED), simplest(known, SIMULATORS)
    if best in BASELINES and len(known[best]) >= LEAST_EVIDENCE:
        yield (
            f"{model_words(best)} is enough for trials like these; "
            "to judge the simulator, test it on others"
        )
    elif chosen:
        better = best_of(known, SIMULATORS)
        simpler = f", which is simpler than {model_words(better)} and not significantly worse"
        use = "recommended, under the conditions below:" if conditional else "use"
        yield f"{use} {model_words(chosen)}{simpler * (chosen != better)}"
