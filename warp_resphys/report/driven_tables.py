"""What the reports of motions that pressure drives say in words and in tables."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from ..learning.metrics import PublishedError
from .measured_tables import MODELS, NONE, against, per_cent, verdict
from .page import NO_BREAK_SPACE, error_parts, number_text, published_parts

# As in reports without actuation, but for what is identified.
DRIVEN_MODELS: Final[Mapping[str, tuple[str, str]]] = {
    **MODELS,
    "sysid": ("SysID", "the simulator with the parameters that fit best"),
}


class Comparison(NamedTuple):
    """A table of errors: what its columns are, and rows of texts by their heads, each with what stands below it."""

    columns: list[str]
    rows: dict[str, list[tuple[str, str]]]


def driven_verdict(
    metrics: Mapping[str, Any],
    trials: Sequence[str],
    published: Mapping[str, PublishedError],
    published_windows: Mapping[str, Mapping[str, PublishedError]],
    extrapolated: bool,
) -> str:
    """Say how far the models are from what was measured, and how that stands to SysID, time and pressure.

    Args:
        metrics: What errors.json holds.
        trials: Names of the test trials.
        published: Published errors, empty where there are none.
        published_windows: The same by length of the roll-out [s].
        extrapolated: Whether roll-outs are longer than what was trained on.
    """
    errors = metrics["errors_mm"]
    said = [verdict(errors, trials, None), _reduction_text(errors, published)]
    if extrapolated:
        said.append(_growth_text(metrics.get("growth", {}), list(metrics.get("windows", {})), published_windows))
    said.append(_factor_text(metrics.get("overpressure", {})))
    return re.sub(r"(?<=\d) (?=(?:mm|s|%)\b|%)", NO_BREAK_SPACE, " ".join(each for each in said if each))


def reduction(means: Mapping[str, float | None]) -> float | None:
    """Return by which share the mean error of ResPhys is below that of SysID; None where one is not known.

    Args:
        means: Mean errors by model; None where a roll-out diverged.
    """
    before, after = means.get("sysid"), means.get("resphys")
    return None if before is None or after is None or before <= 0.0 else 1.0 - after / before


def _reduction_text(errors: Mapping[str, Any], published: Mapping[str, PublishedError]) -> str:
    found = reduction({model: each["mean"] for model, each in errors.items()})
    if found is None:
        return ""
    theirs = reduction({model: each.mean for model, each in published.items()})
    beside = "" if theirs is None else f" (published: {100.0 * theirs:.1f} % smaller)"
    if found < -1.0:
        return f"The error of ResPhys is {1.0 - found:.1f} times that of SysID{beside}."
    which = "smaller" if found >= 0.0 else "larger"
    return f"The error of ResPhys is {100.0 * abs(found):.1f} % {which} than that of SysID{beside}."


def _growth_text(
    growth: Mapping[str, float | None],
    windows: Sequence[str],
    published: Mapping[str, Mapping[str, PublishedError]],
) -> str:
    found = growth.get("resphys")
    if found is None or len(windows) < 2:
        return ""
    first, *_, last = sorted(windows, key=float)
    theirs = published_growth(published, first, last).get("resphys")
    beside = "" if theirs is None else f" (published: {100.0 * theirs:.1f} %)"
    which = "grows" if found >= 0.0 else "falls"
    by = f"{which} by {100.0 * abs(found):.1f} %{beside}"
    return f"From {float(first):g} s to {float(last):g} s the error of ResPhys {by}."


def _factor_text(errors: Mapping[str, Mapping[str, Any]]) -> str:
    if not errors:
        return ""
    largest = max(errors, key=float)
    parts = [
        f"{number_text(mean)}{'' if mean is None else ' mm'} with {DRIVEN_MODELS[model][0]}"
        for model in ("resphys", "sysid", "simfree")
        if model in errors[largest]
        for mean in [errors[largest][model]["mean"]]
    ]
    return (
        f"At {float(largest):g} times the pressures of the training the error is {', '.join(parts)}." if parts else ""
    )


def published_growth(published: Mapping[str, Mapping[str, PublishedError]], first: str, last: str) -> dict[str, float]:
    """Return by which share each published error grows from one length of the roll-outs [s] to another."""
    before, after = published.get(first, {}), published.get(last, {})
    return {model: after[model].mean / before[model].mean - 1.0 for model in before if model in after}


def window_table(
    metrics: Mapping[str, Any], published: Mapping[str, Mapping[str, PublishedError]]
) -> Comparison | None:
    """Return the errors over the first seconds of the roll-outs and their growth, with the published ones below them.

    Args:
        metrics: With `windows` (a summary by seconds and model) and `growth`.
        published: Published errors by seconds and model.

    Returns:
        The table; None where there are no such errors.
    """
    windows = sorted(metrics.get("windows", {}), key=float)
    if not windows:
        return None
    growth = metrics.get("growth", {}) if len(windows) > 1 else {}
    models = _ordered(metrics["windows"][windows[0]])
    rows = {}
    for window in windows:
        theirs = {model: " ".join(published_parts(each)) for model, each in published.get(window, {}).items()}
        found = metrics["windows"][window]
        rows[f"First {float(window):g} s"] = [(_whole(found[model]), theirs.get(model, "")) for model in models]
    if growth:
        their_growth = published_growth(published, windows[0], windows[-1])
        rows["Growth"] = [
            (_share(growth.get(model)), _share(their_growth[model]) if model in their_growth else "")
            for model in models
        ]
    return Comparison([DRIVEN_MODELS[model][0] for model in models], rows)


def factor_table(metrics: Mapping[str, Any]) -> Comparison | None:
    """Return the errors at multiples of the pressure, with how they stand to SysID; None where there are none.

    Args:
        metrics: With `overpressure` (a summary by factor and model).
    """
    over = metrics.get("overpressure", {})
    factors = sorted(over, key=float)
    if not factors:
        return None
    models = _ordered(over[factors[0]])
    rows = {}
    for factor in factors:
        shares = against(over[factor])[1]
        row = []
        for model in models:
            share = shares.get(model, NONE)
            row.append((_whole(over[factor][model]), "" if share == NONE else share))
        rows[f"\N{MULTIPLICATION SIGN} {float(factor):g}"] = row
    return Comparison([DRIVEN_MODELS[model][0] for model in models], rows)


def range_texts(metrics: Mapping[str, Any], trials: Sequence[str]) -> list[str]:
    """Say of each model how many of its roll-outs left the states that it was trained on, and when.

    Args:
        metrics: With `range`, by model `first_s`: when a trial left [s]; and `overpressure_range`, the same by factor
            of the pressure.
        trials: Names of the test trials.
    """
    said = []
    found, beyond = metrics.get("range", {}), metrics.get("overpressure_range", {})
    for model in _ordered(found):
        first = found[model]["first_s"]
        count = f"{len(first) or 'none'} of {len(trials)} roll-outs" if len(trials) > 1 else "the roll-out"
        never = " never" * (len(trials) == 1 and not first)
        text = f"{DRIVEN_MODELS[model][0]}: {count}{never} left the states of the training{_when(first)}."
        factors = [factor for factor in sorted(beyond, key=float) if float(factor) != 1.0]
        left = {factor: beyond[factor][model]["first_s"] for factor in factors}
        if any(left.values()):
            each = [f"{len(left[factor]) or 'none'} of {len(trials)} ({float(factor):g} times)" for factor in factors]
            earliest = _when({trial: when for some in left.values() for trial, when in some.items()})
            text += f" At higher pressures it is {', '.join(each)}{earliest}."
        said.append(re.sub(r"(?<=\d) (?=s\b)", NO_BREAK_SPACE, text))
    return said


def _when(first: Mapping[str, float]) -> str:
    if not first:
        return ""
    earliest = min(first, key=lambda trial: first[trial])
    return f", the first after {first[earliest]:.2f} s ({earliest})"


def largest_filtered(metrics: Mapping[str, Any]) -> str:
    """Say how large the error of a single trial becomes with each model that did not diverge; empty where not known."""
    found = {model: each for model, each in metrics.get("median_filtered", {}).items() if each is not None}
    parts = [f"{number_text(found[m])}{NO_BREAK_SPACE}mm ({DRIVEN_MODELS[m][0]})" for m in _ordered(found)]
    return f"In single trials the filtered error reaches {', '.join(parts)}." if parts else ""


def _ordered(models: Mapping[str, Any]) -> list[str]:
    return [model for model in DRIVEN_MODELS if model in models]


def _whole(summary: Mapping[str, Any]) -> str:
    """A mean with its deviation."""
    return " ".join(error_parts(summary)).strip()


def _share(ratio: float | None) -> str:
    return NONE if ratio is None else per_cent(ratio, 1)
