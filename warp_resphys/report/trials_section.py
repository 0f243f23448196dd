"""The section on single trials: which model is best, which is worse than a simpler one, and where the error sits."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import mean
from typing import Any, Final

from ..learning.baselines import BASELINES
from ..stepping.quantity import Quantity
from .data import MODELS, RunReport, models_in_figures
from .page import NONE, Canvas, Cell, PageTable, Part, Row, number_text

_CHAIN: Final = ("simulation", "sysid", "law", "resphys")  # each builds on the one before
_NOTE: Final = (
    "Amplitude: root mean square displacement of the observed points. Worse than a simpler one: models whose error is "
    "larger than that of the model that they build on, or of the best one without physics."
)
_FREE: Final = {
    "scale": "Own scale of its inputs",
    "zero": "Own zero",
    "delay": "Own delay",
    "places": "Own marker places",
    "session": "Marker places of its session",
}
_FIT: Final = (
    "and what a free fit to the trial itself would leave, linearised about the identified simulator. These are no "
    "predictions: what a scale, a zero or a delay takes away is due to the actuator or its log, and what places take "
    "away to the markers; a law of the material cannot mend either."
)


def trials_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Return a table with a line for each held-out trial."""
    folds = list(data.metrics.get("folds", {}).values()) or [data.metrics]
    rows = [row for fold in folds for row in fold.get("per_trajectory", ()) if "amplitude_mm" in row]
    plain = next((model for model in models_in_figures(data.metrics["errors_mm"]) if model in BASELINES), "")
    table = trial_table(rows, plain, data.metrics.get("intervals", {}).get("models", {}))
    fits = [fold["free_fits"] for fold in folds if "free_fits" in fold]
    merged = {model: [row for own in fits for row in own.get(model, ())] for model in _CHAIN}
    blocks = [] if table is None else [table]
    blocks += rest_table(merged, None if data.driven is None else data.driven.quantity)
    return Part("Trial by trial", blocks) if blocks else None


def rest_table(fits: Mapping[str, Sequence[Mapping[str, Any]]], quantity: Quantity | None) -> list[PageTable]:
    """Return a table of what would remain of a model's errors if something were free; empty without fits.

    Args:
        fits: Of metrics.json, by model; the model with the smallest error is shown.
        quantity: Of the inputs that drive the trials.
    """
    means = {model: mean(row["as_is_mm"] for row in rows) for model, rows in fits.items() if rows}
    if not means:
        return []
    model = min(means, key=lambda name: means[name])
    rows = fits[model]
    shown = [key for key in _FREE if any(key in row["left_mm"] for row in rows)]
    if not shown:
        return []
    body = [
        Row(row["name"], [Cell(number_text(row["as_is_mm"])), *(_left(row, key, quantity) for key in shown)])
        for row in rows
    ]
    averages = [_mean_left(rows, key) for key in shown]
    body.append(Row("Mean", [Cell(number_text(means[model])), *map(Cell, averages)]))
    note = f"Mean error of {MODELS[model][0]} [mm] as it is, {_FIT}"
    return [PageTable("Where the rest comes from", ["As it is [mm]", *(_FREE[key] for key in shown)], body, note)]


def _left(row: Mapping[str, Any], key: str, quantity: Quantity | None) -> Cell:
    """Error that a free quantity would leave, with its value."""
    if key not in row["left_mm"]:
        return Cell(NONE)
    value = row["values"].get(key)
    if value is None:
        return Cell(number_text(row["left_mm"][key]))
    words = {"scale": f"{100.0 * value:+.1f} %", "delay": f"{1e3 * value:+.0f} ms"}
    zero = "" if quantity is None else quantity.shown(value)
    return Cell(number_text(row["left_mm"][key]), words.get(key, zero))


def _mean_left(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    """Mean over the trials; a trial without the fit counts as it is."""
    return number_text(mean(row["left_mm"].get(key, row["as_is_mm"]) for row in rows))


def trial_table(
    rows: Sequence[Mapping[str, Any]], plain: str, intervals: Mapping[str, Mapping[str, Any]]
) -> PageTable | None:
    """Return a table of the held-out trials; None if there are none.

    Args:
        rows: Entries of `per_trajectory`, with `amplitude_mm` and, for motions, `thirds_mm`.
        plain: The best model without physics; may be empty.
        intervals: Of metrics.json, by model, with `by_trial`.
    """
    if not rows:
        return None
    covered = next((intervals[m] for m in reversed(_CHAIN) if "by_trial" in intervals.get(m, {})), {})
    by_trial = covered.get("by_trial", {})
    with_thirds = any("thirds_mm" in row for row in rows)
    columns = ["Amplitude [mm]", "Best [mm]", "Worse than a simpler one [mm]"]
    columns += [*(["Thirds of the time [mm]"] if with_thirds else []), *(["Coverage"] if by_trial else [])]
    body = []
    for row in rows:
        errors = {m: e for m, e in row["errors_mm"].items() if e is not None and m != "reconstruction"}
        best = min(errors, key=lambda model: errors[model], default="")
        cells = [Cell(number_text(row["amplitude_mm"]))]
        cells += [Cell(MODELS[best][0], number_text(errors[best])) if best else Cell(NONE)]
        cells += [Cell("; ".join(worse(errors, plain)) or NONE)]
        if with_thirds:
            shown = next((m for m in reversed(_CHAIN) if m in row.get("thirds_mm", {})), "")
            thirds = row["thirds_mm"][shown] if shown else []
            cells.append(
                Cell(" / ".join(f"{value:.3g}" for value in thirds) or NONE, MODELS[shown][0] if shown else "")
            )
        if by_trial:
            cells.append(Cell(f"{100.0 * by_trial[row['name']]:.0f} %" if row["name"] in by_trial else NONE))
        body.append(Row(row["name"], cells))
    note = _NOTE
    note += " Thirds: mean error in the first, second and last third of the frames." if with_thirds else ""
    note += " Coverage: share of the coordinates within the 90 % prediction intervals." if by_trial else ""
    return PageTable("Test trial", columns, body, note)


def worse(errors: Mapping[str, float], plain: str = "") -> list[str]:
    """Return the models that are worse than one that is simpler, with both errors [mm].

    Args:
        errors: Of a trial [mm], by model.
        plain: The model without physics with which the most complex one is compared as well; may be empty.
    """
    chain = [model for model in _CHAIN if model in errors]
    pairs = [*pairwise(chain)]
    pairs += [(plain, chain[-1])] if chain and plain in errors else []
    return [
        f"{MODELS[model][0]} than {MODELS[simple][0]} ({errors[model]:.3g} of {errors[simple]:.3g})"
        for simple, model in pairs
        if errors[model] > errors[simple]
    ]
