"""The verdict on the page of a run: errors of its models, and how they compare with published ones."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from ..io.errors import number_of
from ..learning.metrics import PUBLISHED_WINDOWS_MM, PublishedError
from ..settings.run import RunSettings
from .conclusions import INSIDE, OUTSIDE, epochs_kept, errors_by_load, headline, untrained
from .data import MODELS, PLAIN_NAMES, RunReport, models_in_figures
from .notes import in_a_row
from .page import MOST_PERCENT, NO_BREAK_SPACE, mm_text, published_parts
from .recommendation import model_name


def verdict(data: RunReport) -> str:
    """Return sentences on the errors of the models, compared with published ones."""
    metrics = data.metrics
    without = untrained(epochs_kept(metrics))
    errors = {model: summary for model, summary in metrics["errors_mm"].items() if model not in without}
    by_load = errors_by_load(metrics, data.others)
    if not data.sees_markers:
        shown = by_load.get(INSIDE, metrics["errors_mm"])
        sentences = [vertex_verdict(shown, data.published, data.simulator, data.target)]
        sentences.append(outside_text(by_load.get(OUTSIDE, {}), data.others))
    else:
        trials = tuple(data.pages) if data.trials is None else data.trials.names
        parted = learned_in_part(data.settings, trials)
        seconds = data.settings.trial_seconds
        sentences = [marker_verdict(errors, trials, seconds, folds=data.trials is None, parted=parted)]
    if data.settings.train_fraction < 1.0:
        published = PUBLISHED_WINDOWS_MM.get(data.experiment, {})
        sentences.append(growth_text(metrics.get("growth", {}), list(metrics.get("horizons", {})), published))
    sentences.append(scale_text(metrics.get("scales", {})))
    return unbroken(" ".join(filter(None, [*headline(metrics, data.settings), *sentences])))


def learned_in_part(settings: RunSettings, tested: Collection[str]) -> bool:
    """Whether the first part of each test trial was used for training, and the test is the rest of it."""
    train = None if settings.recorded is None else settings.recorded.train
    return settings.train_fraction < 1.0 and isinstance(train, tuple) and {*tested} <= {*train}


def unbroken(text: str) -> str:
    """Return a text with no-break spaces between numbers and their units or symbols."""
    return re.sub(r"(?<=\d) (?=(?:mm|kPa|s)\b|%)|(?<=\b[Eν]) (?=\d)", NO_BREAK_SPACE, text)  # noqa: RUF001


def left_text(metrics: Mapping[str, Any], trial: str | None = None) -> Markup | None:
    """Return a bold sentence on test trials in which the body left the training range; None if it did not.

    Args:
        metrics: With `range`, as for `range_texts`; of folds, each has its own.
        trial: The only trial that counts; all if omitted.
    """
    first: dict[str, float] = {}
    for own in [*metrics.get("folds", {}).values(), metrics]:
        ranges = own.get("range", {})
        model = next((model for model in ("resphys", "resphys_uncorrected") if model in ranges), "simfree")
        first |= ranges.get(model, {}).get("first_s", {})
    left = {name: time for name, time in first.items() if trial in (None, name)}
    if not left:
        return None
    where = f"In the test trial {trial}" if trial is not None else f"In {number_of(len(left), 'test trial')}"
    said = unbroken(f"{where} the body left the training range{when_text(left)}: there, the network extrapolates.")
    return Markup("<strong>{}</strong>").format(said)


def when_text(first: Mapping[str, float]) -> str:
    """Return when the first of some trials left the training range, in words; empty without any.

    Args:
        first: Times [s] by trial.
    """
    if not first:
        return ""
    if not any(first.values()):
        return f", from the start ({', '.join(first)})"
    earliest = min(first, key=lambda trial: first[trial])
    return f", the first after {first[earliest]:.2f} s ({earliest})"


def vertex_verdict(
    errors: Mapping[str, Any], published: Mapping[str, PublishedError], simulator: str, target: str
) -> str:
    """Return a sentence or two on the error of the simulator with and without the learned force.

    Args:
        errors: Summaries [mm] by model.
        published: Published errors [mm] by model.
        simulator: The corrected simulator in words.
        target: Its target in words.
    """
    if not {"simulation", "resphys"} <= errors.keys():
        means = (f"{mm_text(errors[m]['mean'])} with {MODELS[m][0]}" for m in MODELS if m in errors)
        return f"Mean vertex error: {', '.join(means)}."
    before, after = errors["simulation"]["mean"], errors["resphys"]["mean"]
    count = errors["resphys"]["trajectories"]
    trials, old, new = f"{count} test trial{'s' if count > 1 else ''}", mm_text(before), mm_text(after)
    if after is None:
        text = (
            f"With the learned residual force, {errors['resphys']['diverged']} of {count} test roll-outs diverged, so "
            f"there is no mean error to report. Without it: {old}."
        )
    elif before is None:
        text = (
            f"Uncorrected, {errors['simulation']['diverged']} of {count} test roll-outs diverge; with the learned "
            f"residual force, the mean vertex error is {new}."
        )
    elif after >= before:
        text = (
            f"The learned residual force does not help: the mean vertex error on {trials} is {new} with it and {old} "
            "without."
        )
    else:
        who = "identified law and the learned force on it bring" if "law" in errors else "learned residual force brings"
        text = (
            f"The {who} the simulator ({simulator}) {_closer(before, after)} to its target "
            f"({target}): on {trials} held out from training, the mean vertex error falls from {old} to {new}."
        )
    between = [(name, errors[model]) for model, name in (("sysid", "SysID"), ("law", "the law")) if model in errors]
    if between:
        text += f" It is {' and '.join(f'{_mean_of(own)} with {name} alone' for name, own in between)}."
    if "resphys" in published:
        text += f" The published result is {published_parts(published['resphys'])[0]} mm."
    return text


def outside_text(errors: Mapping[str, Any], trials: Collection[str]) -> str:
    """Return a sentence on the errors of the models outside of the training loads; empty without such trials."""
    shown = [m for m in ("simulation", "sysid", "law", "simfree", "resphys") if m in errors]
    if not shown:
        return ""
    means = [f"{_mean_of(errors[m])} {_with(m)}" for m in shown]
    one = len(trials) == 1
    return (
        f"On {len(trials)} further trial{'' if one else 's'}, whose load{' is' if one else 's are'} outside of the "
        f"training loads ({', '.join(trials)}), it is {in_a_row(means)}."
    )


def _with(model: str) -> str:
    """Which model simulated, as in "2 mm with SysID"."""
    return "uncorrected" if model == "simulation" else f"with {model_name(model)}"


def _mean_of(summary: Mapping[str, Any]) -> str:
    """A mean error with its unit, or the number of roll-outs that diverged."""
    if summary["mean"] is None:
        return f"not defined ({summary['diverged']} of {summary['trajectories']} diverged)"
    return mm_text(summary["mean"])


def _closer(before: float, after: float) -> str:
    """The ratio of errors with two significant digits, which is all that a few trials justify."""
    if after == 0.0:
        return "all the way"
    digits = 1 - math.floor(math.log10(before / after))
    return f"{round(before / after, digits):,.{max(0, digits)}f} times closer"


def marker_verdict(
    errors: Mapping[str, Any],
    trials: Sequence[str],
    seconds: float | None,
    *,
    folds: bool = False,
    parted: bool = False,
) -> str:
    """Return a sentence on the errors of the best model and of those that it extends.

    Args:
        errors: Summaries [mm] by model.
        trials: Names of the test trials.
        seconds: Evaluated duration after the release [s]; None for whole trials.
        folds: Whether each trial was the test of its own fold.
        parted: Whether the first part of each trial was used for training, and the rest is the test.
    """
    who = f"trial {trials[0]}" if len(trials) == 1 else f"{len(trials)} trials"
    held = "each held out once" if folds and len(trials) > 1 else "held out from training and identification"
    held = "in the part held out from training and identification" if parted else held
    span = "" if seconds is None else f" over the first {seconds:g} s"
    ranked = ("resphys", "resphys_uncorrected", "law", "sysid", "sysid_elastic", "simulation")
    main = next((m for m in ranked if m in errors), "")
    if not main:
        return f"There are no errors to report on {who}."
    if errors[main]["mean"] is None:
        return (
            f"On {who}, {held}, {MODELS[main][0]} diverged in {errors[main]['diverged']} of "
            f"{errors[main]['trajectories']} roll-outs, so there is no mean error to report."
        )
    plain = [m for m in models_in_figures(errors) if m in PLAIN_NAMES]
    beside = "".join(
        f", {mm_text(errors[m]['mean'])} {_with(m)}"
        for m in ("law", "sysid", "sysid_elastic", "simulation", *plain)
        if m in errors and m != main
    )
    return (
        f"On {who}, {held}, the simulated markers are {mm_text(errors[main]['mean'])} from the measured ones{span} "
        f"{_with(main)}{beside.replace(',', ';', 1)}."
    )


def growth_text(
    growth: Mapping[str, float | None],
    horizons: Sequence[str],
    published: Mapping[str, Mapping[str, PublishedError]],
) -> str:
    """Return a sentence on the growth of ResPhys' error with the length of the roll-outs; empty if it is not known."""
    ours = growth.get("resphys")
    if ours is None or len(horizons) < 2:
        return ""
    first, *_, last = sorted(horizons, key=float)
    theirs = published_growth(published, first, last).get("resphys")
    beside = "" if theirs is None else f" (published: {100.0 * theirs:.1f} %)"
    by = f"{'grows' if ours >= 0.0 else 'falls'} by {100.0 * abs(ours):.1f} %{beside}"
    by = f"grows to {1.0 + ours:,.0f} times{beside}" if ours > MOST_PERCENT else by
    return f"From {float(first):g} s to {float(last):g} s the error of ResPhys {by}."


def published_growth(published: Mapping[str, Mapping[str, PublishedError]], first: str, last: str) -> dict[str, float]:
    """Return the relative growth of published errors from one length of the roll-outs [s] to another, by model."""
    before, after = published.get(first, {}), published.get(last, {})
    return {model: after[model].mean / before[model].mean - 1.0 for model in before if model in after}


def scale_text(errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a sentence on the errors at the highest inputs; empty if none exceed those of the training."""
    if not errors:
        return ""
    largest = max(errors, key=float)
    shown = [m for m in models_in_figures(errors[largest]) if m not in ("published", "simulation", "sysid_elastic")]
    means = {m: errors[largest][m]["mean"] for m in reversed(shown)}
    parts = ", ".join(f"{mm_text(mean)} {_with(model)}" for model, mean in means.items())
    return f"At {float(largest):g} times the training inputs the error is {parts}." if parts else ""
