"""The conditions of a result: all that speaks against relying on it,
as short lines in a fixed order.

The order is that of `CONDITIONS`: coverage of the prediction intervals, parameters at bounds,
trials beyond the training, the mesh, the registration, too few trials, and what was learned and is
not used. Each line has a fact and what to do about it. None is left out because there are others.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Final

from ..settings.run import RunSettings
from .data import Errors, Metrics, folds_in, grouped_errors, other_trials
from .identification_section import in_sentence, with_unit
from .ranking import (
    CORRECTED,
    LEAST_EVIDENCE,
    LEAST_TRIALS,
    SIMULATORS,
    Known,
    best_of,
    known_errors,
    recommended,
    unused,
)
from .wording import in_a_row, mm_text, model_words, unbroken

_NUMBERS: Final = ("no", "one", "two", "three", "four")
_COVERED: Final = (
    0.75  # share of the measurements within 90 % intervals, below which these are too narrow
)
_WORSE: Final = 0.1  # by which the share of a trial is much worse than that of all
_CLOSE: Final = 1e-4  # distance from the first guess that counts as none, over a parameter's range
# Degrees by which identification rotates the markers, from which on their registration is wrong.
_TURNED: Final = 3.0
_NAMED: Final = 4  # trials at most that a line names
# Keys of the ranges in the group `identify`.
_GROUPS: Final = {"sysid": "parameters", "sysid_elastic": "elastic"}
CAUSES: Final = "check names (exchanged ones too), nominal positions, and the unit"
_KINDS: Final = ("inputs", "loads", "displacements")  # keys of `beyond` in the metrics


@dataclass(frozen=True)
class Judged:
    """A run whose result is judged.

    Attributes:
        metrics: of a split or of folds.
        settings: of the run.
    """

    metrics: Metrics
    settings: RunSettings

    @cached_property
    def errors(self) -> Errors:
        """Errors of the last group of test trials [mm], by model."""
        return next(reversed(grouped_errors(self.metrics, self.settings).values()), {})

    @cached_property
    def known(self) -> Known:
        """Errors of the models that are used and did not diverge [mm], by model."""
        return known_errors(self.errors, unused(self.metrics))

    @cached_property
    def model(self) -> str:
        """The simulator that would be used; empty without one."""
        return recommended(self.metrics, self.settings)

    @property
    def count(self) -> int:
        """Number of the trials that decide."""
        return len(next(iter(self.known.values()), ()))

    @property
    def folds(self) -> list[Metrics]:
        """Metrics of each fold, or of the split."""
        return folds_in(self.metrics)


def conditions(metrics: Metrics, settings: RunSettings) -> list[str]:
    """Returns the conditions that hold, one line each, see `CONDITIONS`."""
    run, found = Judged(metrics, settings), list[str]()
    for lines in CONDITIONS:
        found += lines(run)
    return [unbroken(f"{line[0].upper()}{line[1:]}.") for line in found]


def _coverage(run: Judged) -> Iterator[str]:
    """Yields prediction intervals that hold fewer measurements than they should,
    in all trials or in some.
    """
    found = run.metrics.get("intervals", {}).get("models", {}).get(run.model, {})
    if "coverage" not in found:
        return
    share, by_trial = found["coverage"], found.get("by_trial", {})
    poor = {name: x for name, x in by_trial.items() if x < min(_COVERED, share - _WORSE)}
    if share >= _COVERED and not poor:
        return
    worst = sorted(poor, key=poor.__getitem__)[:_NAMED]
    trials = in_a_row([f"{_percent(poor[name])} in {name}" for name in worst])
    text = f"coverage: the 90 % band holds {_percent(share)} of the measurements"
    yield f"{text}{f' ({trials})' if trials else ''}; validate on trials like those of the test"


def _bounds(run: Judged) -> Iterator[str]:
    """Yields identified parameters at a bound, and those that stayed at their first guess."""
    bounds, guesses = dict[str, list[int]](), dict[str, list[int]]()
    for number, fold in enumerate(run.folds):
        for text in _at_bounds(fold):
            bounds.setdefault(text, []).append(number)
        for text in _at_first_guess(fold, run.settings):
            guesses.setdefault(text, []).append(number)
    remedies = {
        "at a bound": (
            bounds,
            "widen such a range in identify.parameters, "
            "or add the physics that the simulator lacks",
        ),
        "at the first guess": (guesses, "raise identify.starts"),
    }
    for where, (found, remedy) in remedies.items():
        share = {
            text: f" in {len(of)} of {len(run.folds)} folds" * (len(run.folds) > 1)
            for text, of in found.items()
        }
        if found:
            yield f"{where}: {in_a_row([f'{text}{share[text]}' for text in found])}; {remedy}"


def _at_bounds(metrics: Metrics) -> Iterator[str]:
    """Yields the parameters of a split at a bound, of the simulators and of a law
    that is used, with their values.
    """
    seen = set[str]()
    for of_model in metrics.get("at_bounds", {}).values():
        for name, value in of_model.items():
            if name not in seen:
                yield f"{in_sentence(name)} {with_unit(name, value)}"
            seen.add(name)
    law = metrics.get("law")
    if law is None or not law.get("accepted", True):
        return
    values, units = {**law["parameters"], **law.get("others", {})}, law.get("units", {})
    for name in (name for name in law.get("at_bounds", ()) if name in values and name not in seen):
        known = (
            f"{values[name]:.3g} {units[name]}".rstrip()
            if name in units
            else with_unit(name, values[name])
        )
        yield f"{in_sentence(name)} of the law {known}"


def _at_first_guess(metrics: Metrics, settings: RunSettings) -> Iterator[str]:
    """Yields the identified parameters of a split that stayed where their search began."""
    identify, guesses = settings.identify, metrics.get("first_guesses", {})
    for model, group in _GROUPS.items() if identify is not None else ():
        ranges = getattr(identify, group) or {}
        start, values = guesses.get(model, {}), metrics.get("parameters", {}).get(model, {})
        for name, value in values.items():
            assert identify is not None
            limits = ranges.get(identify.key_of(name) if group == "parameters" else name)
            if limits is None or limits.prior is not None:
                continue
            if abs(value - start.get(name, math.nan)) <= _CLOSE * (limits.upper - limits.lower):
                yield f"{in_sentence(name)} {with_unit(name, value)}"


def _beyond(run: Judged) -> Iterator[str]:
    """Yields test trials whose loads, inputs or displacements lie beyond those
    of the training, and models there.
    """
    tests = list[str]()
    excess = dict[str, Mapping[str, float]]()
    left = dict[str, float]()
    for fold in run.folds:
        tests += [row["name"] for row in fold.get("per_trajectory", ())]
        excess |= fold.get("beyond", {})
        if run.model in fold.get("range", {}):
            left |= fold["range"][run.model]["first_s"]
    others = [name for name in tests if name in excess or name in other_trials(run.settings)]
    facts = list[str]()
    if others:
        largest = dict.fromkeys(_KINDS, 0.0)
        for of_trial in excess.values():
            largest |= {kind: max(share, largest[kind]) for kind, share in of_trial.items()}
        shares = in_a_row(
            [f"{_percent(share)} in {kind}" for kind, share in largest.items() if share > 0.0]
        )
        facts.append(_of_tests(others, tests) + (f", by up to {shares}" if shares else ""))
    if left:
        words = "these" if [*left] == others else _of_tests([*left], tests)
        facts.append(f"{model_words(run.model)} leaves the range of its training in {words}")
    if facts:
        yield f"beyond the training: {'; '.join(facts)}; train on trials that reach as far"


def _of_tests(some: list[str], tests: list[str]) -> str:
    """How many of the tests these are, with their names if they are few: "1 of 3 tests (a)"."""
    named = f" ({', '.join(some)})" if len(some) <= _NAMED else ""
    return f"{len(some)} of {len(tests)} tests{named}" if len(tests) > 1 else f"the test{named}"


def _mesh(run: Judged) -> Iterator[str]:
    """Yields an error of the mesh that is larger than what the model gains, or is not known."""
    checks = [fold["mesh_check"] for fold in run.folds if "mesh_check" in fold]
    moves = [moved for check in checks if (moved := check.get("moved_mm")) is not None]
    if checks and not moves:
        yield (
            "mesh: its error is not known, as "
            f"{_within(checks[0].get('failed', 'nothing was simulated'))}"
        )
    base = (
        checks[0]["model"]
        if moves and run.model in ("law", "actuator", "resphys")
        else "simulation"
    )
    if moves and run.model != base and run.model in run.known and base in run.known:
        moved, gained = fmean(moves), fmean(run.known[base]) - fmean(run.known[run.model])
        if moved > gained:
            text = (
                f"mesh: a finer one moves the markers by {mm_text(moved)}, and "
                f"{model_words(run.model)} gains"
            )
            yield (
                f"{text} {mm_text(max(gained, 0.0))} over {model_words(base)}; "
                "refine the mesh first"
            )


def _registration(run: Judged) -> Iterator[str]:
    """Yields markers that do not fit their nominal positions."""
    placed = [fold["placement"] for fold in run.folds if "placement" in fold]
    off = dict[str, float]()
    for placement in placed:
        for label, away in placement.get("left_out_mm", {}).items():
            off[label] = max(away, off.get(label, 0.0))
    if off:
        named = in_a_row([f"{label} ({mm_text(away)})" for label, away in off.items()])
        yield f"registration: {named} left out, as far from the nominal position; {CAUSES}"
    turned = max((placement["turned_deg"] for placement in placed), default=0.0)
    if turned > _TURNED:
        text = f"registration: the markers are rotated by {turned:.1f}° from it"
        yield f"{text}; check the positions of the markers, and the axes of recordings and mesh"
    error = fmean(run.known[run.model]) if run.model in run.known else math.inf
    rms = max((placement["rms_mm"] for placement in placed), default=0.0)
    if rms > error:
        text = (
            f"registration: the markers at rest fit their nominal positions to {mm_text(rms)} only"
        )
        yield f"{text}; {CAUSES}, and whether the body at rest is bent or sags"


def _few_trials(run: Judged) -> Iterator[str]:
    """Yields that there are fewer trials than an interval needs."""
    if 0 < run.count < LEAST_TRIALS:
        trials = f"{_NUMBERS[run.count]} trial{'s are' if run.count > 1 else ' is'}"
        few = "no evidence" if run.count < LEAST_EVIDENCE else "too few for an interval"
        yield f"trials: {trials} {few}; test on five or more"


def _refused(run: Judged) -> Iterator[str]:
    """Yields the learned models that are not used, and corrections that diverged."""
    for model, why in unused(run.metrics).items():
        yield f"not used: {model_words(model)}, as {why}"
    laws = [fold["law"] for fold in run.folds if "law" in fold]
    if laws and not any(law.get("accepted", True) for law in laws):
        against = model_words(laws[0]["against"])
        yield (
            "not used: the law of the material, "
            f"as it is not clearly closer to the trials than {against}"
        )
    for model in (model for model in CORRECTED if model in run.errors):
        lost = sum(error is None for error in run.errors[model])
        if lost:
            best = best_of(run.known, SIMULATORS)
            use = f"; use {model_words(best)}" if best else ""
            yield (
                f"not used: {model_words(model)} diverged in {lost} "
                f"of {len(run.errors[model])} trials{use}"
            )


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _within(sentence: str) -> str:
    """Returns a sentence as part of another one."""
    return sentence.rstrip(".")[:1].lower() + sentence.rstrip(".")[1:]


CONDITIONS: Final[tuple[Callable[[Judged], Iterator[str]], ...]] = (
    _coverage,
    _bounds,
    _beyond,
    _mesh,
    _registration,
    _few_trials,
    _refused,
)
