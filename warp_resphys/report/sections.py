"""Sections of the page of a run: errors by trial, horizon and input, and its recordings."""

from collections.abc import Mapping, Sequence
from itertools import chain, product
from statistics import fmean
from typing import Final

import numpy as np

from ..data.recordings.marker_quality import QUALITY_COLUMNS, quality_table
from ..data.registration import RegistrationSummary
from ..learning.baselines import BASELINES
from ..learning.identification.sensitivity import FreeFit
from ..learning.metrics import PUBLISHED_WINDOWS_MM, ErrorSummary, PublishedError, published_errors
from ..settings.run import RunSettings
from .body_picture import registration_picture
from .data import (
    Driven,
    Errors,
    Metrics,
    RunReport,
    ShapeErrors,
    folds_in,
    grouped_errors,
    missing_baselines,
)
from .page import Canvas, Cell, Drawn, Items, PageTable, Part, Row, Text
from .ranking import unused
from .verdict import error_cell, interval_text
from .wording import (
    MODELS,
    NONE,
    error_parts,
    in_a_row,
    models_in_figures,
    number_text,
    published_parts,
    share_text,
    unbroken,
)

BEYOND: Final = 0.01  # Share of cells and times above which a law is said to extrapolate.
# Our models: names as published.
_PUBLISHED_BESIDE: Final = {"published": "simulation", "sysid_elastic": "sysid"}
_MOST_WIDE: Final = 8  # Markers in columns of a table; more are in rows.
# Each builds on the one before.
_CHAIN: Final = ("simulation", "sysid", "law", "actuator", "resphys")
# Least number of different inputs; largest share of the error that a helpful gain leaves.
_LEVELS, _HELPS = 3, 0.9
# Range of gains that are alike, over their mean; least rank correlation with the inputs.
_ALIKE, _STEADY = 0.3, 0.9
_REFITTED: Final = {
    "scale": "Refitted gain",
    "zero": "Refitted offset",
    "places": "Refitted marker positions",
}


def details_table(metrics: Metrics, settings: RunSettings) -> PageTable:
    """Returns the errors of all models with their deviations and intervals,
    beside those that were published.

    With two groups of test trials, each has a column; published errors are of trials as in
    training.
    """
    errors = metrics["errors_mm"]
    groups = grouped_errors(metrics, settings)
    idle = unused(metrics)
    published = published_beside(published_errors(settings.name), list(errors))
    beside = {"Published": {model: Cell.of(error) for model, error in published.items()}}
    columns: dict[str, dict[str, Cell]] = {}
    if len(groups) > 1:
        parts = {
            title: {m: error_cell(x, with_interval=True) for m, x in by_model.items()}
            for title, by_model in groups.items()
        }
        first, last = parts.items()
        columns = dict([first, *beside.items(), last])
    else:
        reconstructed = metrics.get("errors_vs_reconstruction_mm", {})
        by_model: Errors = next(iter(groups.values()), {})
        columns = {
            "Mean error": {
                model: Cell.of(error_parts(summary)) for model, summary in errors.items()
            },
            "90 % interval": {
                m: Cell(text) for m, x in by_model.items() if (text := interval_text(x))
            },
            "Against the reconstruction": {
                m: Cell.of(error_parts(summary)) for m, summary in reconstructed.items()
            },
            **beside,
        }
    columns = {title: cells for title, cells in columns.items() if cells}
    rows, missing = [], missing_baselines(metrics)
    for model, (name, meaning, _) in MODELS.items():
        if model in errors or model in published or model in missing:
            small = f"not used: {idle[model]}" if model in idle else missing.get(model, meaning)
            rows.append(
                Row(
                    name,
                    [by_model.get(model, Cell(NONE)) for by_model in columns.values()],
                    small=small,
                )
            )
    return PageTable("All models [mm]", list(columns), rows)


def published_beside(
    published: Mapping[str, PublishedError], models: Sequence[str]
) -> dict[str, tuple[str, str]]:
    """Returns the published errors by our model with which they are compared."""
    renamed = {theirs: ours for ours, theirs in _PUBLISHED_BESIDE.items() if ours in models}
    return {renamed.get(model, model): published_parts(error) for model, error in published.items()}


def model_table(
    head: str,
    rows: Mapping[str, Mapping[str, Cell]],
    errors: Mapping[str, ErrorSummary],
    note: str = "",
    pages: Mapping[str, str] | None = None,
    small: Mapping[str, str] | None = None,
) -> PageTable:
    """Returns a table of cells by row and model.

    Args:
        head: Above the first column.
        rows: Cells by row and model.
        errors: Summaries by model; of the models without physics, the one of least error is shown.
        note: Below the table.
        pages: Links of rows.
        small: Printed below the heads of rows.
    """
    others = [model for model in BASELINES if model not in models_in_figures(errors)]
    known = set[str]().union(*rows.values()).difference(others)
    models = [model for model in MODELS if model in known]
    addresses, below = pages or {}, small or {}
    body = []
    for name, row in rows.items():
        cells = [row.get(model, Cell(NONE)) for model in models]
        body.append(Row(name, cells, small=below.get(name, ""), address=addresses.get(name, "")))
    return PageTable(head, [MODELS[model].name for model in models], body, note)


def numbers(rows: Mapping[str, Mapping[str, float | None]]) -> dict[str, dict[str, Cell]]:
    """Returns the cells of numbers by row and model."""
    return {
        name: {m: Cell(number_text(value)) for m, value in row.items()}
        for name, row in rows.items()
    }


def trials_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the errors on each held-out trial, and what could explain the errors that remain."""
    folds = folds_in(data.metrics)
    of_folds = chain.from_iterable(fold.get("per_trajectory", ()) for fold in folds)
    trials = {row["name"]: row for row in of_folds}
    covered = data.metrics.get("intervals", {}).get("models", {})
    order = (data.metrics.get("recommended", ""), *reversed(_CHAIN))
    by_trial: Mapping[str, float] = next(
        (covered[m]["by_trial"] for m in order if "by_trial" in covered.get(m, {})), {}
    )
    small = {}
    for name, row in trials.items():
        words = [f"amplitude {row['amplitude_mm']:.3g} mm"] if "amplitude_mm" in row else []
        words += [f"coverage {100.0 * by_trial[name]:.0f} %"] if name in by_trial else []
        small[name] = ", ".join(
            [*words, *([data.settings.test_titles[1]] if name in data.others else [])]
        )
    rows = numbers({name: row["errors_mm"] for name, row in trials.items()})
    note = "Amplitude: root mean square displacement of the observed points."
    note += (
        " Coverage: share of the coordinates within the 90 % prediction intervals."
        if by_trial
        else ""
    )
    note += (
        " Each trial links to the page of the fold in which it is the test." if data.pages else ""
    )
    tables = (
        [model_table("Test trial [mm]", rows, data.metrics["errors_mm"], note, data.pages, small)]
        if rows
        else []
    )
    fits = [fold["free_fits"] for fold in folds if "free_fits" in fold]
    merged = {
        model: [*chain.from_iterable(by_model.get(model, ()) for by_model in fits)]
        for model in _CHAIN
    }
    tables += rest_table(merged, data.driven)
    return Part("Trial by trial", tables) if tables else None


def rest_table(fits: Mapping[str, Sequence[FreeFit]], driven: Driven | None) -> list[PageTable]:
    """Returns a table of what could explain the remaining error of the model that has the least.

    Empty without fits.
    """
    means = {model: fmean(row["as_is_mm"] for row in rows) for model, rows in fits.items() if rows}
    model = min(means, key=lambda name: means[name], default="")
    known = set[str]().union(*(row["left_mm"] for row in fits.get(model, ())))
    shown = [key for key in _REFITTED if key in known]
    if not shown:
        return []

    def left(row: FreeFit, key: str) -> Cell:
        if key not in row["left_mm"]:
            return Cell(NONE)
        value = row["values"].get(key)
        words = "" if value is None else f"{100.0 * value:+.1f} %" if key == "scale" else ""
        words = (
            driven.quantity.shown(value)
            if key == "zero" and value is not None and driven is not None
            else words
        )
        return Cell(number_text(row["left_mm"][key]), words)

    body = [
        Row(r["name"], [Cell(number_text(r["as_is_mm"])), *(left(r, key) for key in shown)])
        for r in fits[model]
    ]
    averages = [
        fmean(row["left_mm"].get(key, row["as_is_mm"]) for row in fits[model]) for key in shown
    ]
    body.append(Row("Mean", [Cell(number_text(mean)) for mean in (means[model], *averages)]))
    note = (
        f"Mean error of {MODELS[model].name} [mm], and what it would be with the inputs or the "
        "marker positions refitted to the test trials, linearised about the identified "
        "simulator; below it, the refitted value. An improvement by gain or offset may come "
        "from the calibration of the actuator, from physics that the simulator lacks, or from "
        "the mesh; one by marker positions suggests a placement error."
    )
    note += gain_text(fits[model], driven) if driven is not None else ""
    columns = ["As it is", *(_REFITTED[key] for key in shown)]
    return [PageTable("What could explain the remaining error", columns, body, note)]


def gain_text(fits: Sequence[FreeFit], driven: Driven) -> str:
    """Returns what refitted gains suggest.

    Empty with fewer than three inputs, or where they remove little error.
    """
    known = [row for row in fits if "scale" in row["values"] and row["name"] in driven.values]
    sizes = np.array([float(np.abs(driven.values[row["name"]]).max()) for row in known])
    gains = np.array([100.0 * row["values"]["scale"] for row in known])
    left = sum(row["left_mm"]["scale"] for row in known)
    if len({*sizes.tolist()}) < _LEVELS or left > _HELPS * sum(row["as_is_mm"] for row in known):
        return ""
    if np.ptp(gains) <= _ALIKE * abs(gains.mean()):
        return (
            f" The refitted gain is much the same in all trials ({gains.mean():+.1f} %), as "
            "after a wrong calibration."
        )
    if abs(np.corrcoef(sizes.argsort().argsort(), gains.argsort().argsort())[0, 1]) < _STEADY:
        return ""
    low, high = int(sizes.argmin()), int(sizes.argmax())
    return (
        f" The refitted gain changes steadily with the inputs, from {gains[low]:+.1f} % at "
        f"{driven.quantity.shown(sizes[low])} to {gains[high]:+.1f} % at "
        f"{driven.quantity.shown(sizes[high])}, which a wrong calibration would not do: the "
        "simulator may lack physics, or its mesh may be too coarse."
    )


def horizons_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the errors by length of the roll-out."""
    table = horizon_table(data.metrics, PUBLISHED_WINDOWS_MM.get(data.settings.name, {}))
    title = (
        "Longer than the training"
        if data.settings.train_fraction < 1.0
        else "By length of the roll-out"
    )
    return None if table is None else Part(title, [table])


def horizon_table(
    metrics: Metrics, published: Mapping[str, Mapping[str, PublishedError]]
) -> PageTable | None:
    """Returns the errors over the first seconds of the roll-outs, with published ones below.

    None without any.

    Both the metrics' `horizons` and the published errors are by seconds and model.
    """
    horizons, rows = metrics.get("horizons", {}), {}
    for horizon in sorted(horizons, key=float):
        theirs = {
            model: " ".join(published_parts(error))
            for model, error in published.get(horizon, {}).items()
        }
        errors = horizons[horizon]
        rows[f"First {float(horizon):g} s"] = {
            m: Cell(error_parts(e)[0], theirs.get(m, "")) for m, e in errors.items()
        }
    note = "Small: published." if published else ""
    return (
        model_table("Mean error [mm]", rows, metrics.get("errors_mm", {}), note) if rows else None
    )


def registration_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the picture of the registered markers on the body at rest, and the residuals."""
    recordings, markers = data.recordings, data.settings.markers
    if recordings is None or (markers is not None and markers.register_with == ()):
        return None
    shown = f"The body at rest with the registered markers of the trial {recordings.worst}"

    caption = (
        f"{shown}, which fits worst. Rings are nominal positions; a line leads to a marker "
        "outside of its ring."
    )
    picture = registration_picture(recordings, data.fixed)
    drawn = canvas.rendered(
        "registration.png",
        picture.draw,
        lambda path, pixels: Drawn.of(
            picture.save(path, pixels), f"{shown}, from two sides.", caption
        ),
    )
    mountings = mounting_table(recordings.registered)
    return Part(
        "Registration",
        [drawn, residual_table(recordings.registered), *([mountings] if mountings else [])],
    )


def mounting_table(residuals: Mapping[str, RegistrationSummary]) -> PageTable | None:
    """Returns how the mountings of rigid bodies differ between the trials that show them at rest.

    None without any.
    """
    mounted = {trial: fit["mounting"] for trial, fit in residuals.items() if "mounting" in fit}
    if not mounted:
        return None
    names = list(dict.fromkeys(chain.from_iterable(mounted.values())))
    rows = []
    for trial, poses in mounted.items():
        known = [poses.get(name) for name in names]
        cells = [
            (f"{x['distance_mm']:.2f}", f"{x['angle_deg']:.2f}") if x else (NONE, NONE)
            for x in known
        ]
        rows.append(Row(trial, [Cell(text) for text in chain.from_iterable(cells)]))
    columns = [f"{name} [{unit}]" for name, unit in product(names, ("mm", "degrees"))]
    note = (
        "Distance and angle of a rigid body at rest from its mounting, which is the mean over "
        "the training trials."
    )
    return PageTable("Mounting", columns, rows, note)


def residual_table(residuals: Mapping[str, RegistrationSummary]) -> PageTable:
    """Returns the residuals of the registration [mm] by trial and marker,
    or the largest of many markers and trials.
    """
    by_marker = [fit["residual_mm"] for fit in residuals.values()]
    labels = list(dict.fromkeys(chain.from_iterable(by_marker)))
    head, last = "Residual [mm]", "Root mean square"
    note = (
        "Distance of each marker at rest "
        "from its nominal position after the rigid motion that fits best."
    )

    def cell(fit: RegistrationSummary, label: str) -> Cell:
        value = fit["residual_mm"].get(label)
        return Cell(
            NONE if value is None else f"{value:.2f}",
            "left out" if label in fit["outliers"] else "",
        )

    rms = {trial: Cell(f"{fit['rms_mm']:.2f}") for trial, fit in residuals.items()}
    if len(labels) > _MOST_WIDE >= len(residuals):
        rows = [Row(label, [cell(fit, label) for fit in residuals.values()]) for label in labels]
        return PageTable(head, list(residuals), [*rows, Row(last, list(rms.values()))], note)
    if len(labels) <= _MOST_WIDE:
        rows = []
        for trial, fit in residuals.items():
            cells = [cell(fit, label) for label in labels]
            rows.append(Row(trial, [*cells, rms[trial]]))
        return PageTable(head, [*labels, last], rows, note)
    rows = []
    for trial, fit in residuals.items():
        known = {label: mm for label, mm in fit["residual_mm"].items() if mm is not None}
        worst = max(known, key=known.__getitem__)
        rows.append(Row(trial, [cell(fit, worst), Cell(worst), rms[trial]]))
    return PageTable(head, ["Largest", "Marker", last], rows, note)


def quality_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns tables of completeness and noise of the recordings."""
    if data.recordings is None:
        return None
    quality = data.recordings.quality
    warnings = [
        f"{trial}: {warning}" for trial, result in quality.items() for warning in result.warnings
    ]
    longest = next(iter(quality.values())).longest_gap_filled
    note = (
        f"Gaps of up to {longest} frames are filled. Longer ones, given in frames, are masked: "
        "they do not count in losses and errors."
    )
    tables = []
    for trial, result in quality.items():
        summary = f"{trial}: {result.frames} frames at {result.rate_hz:g} Hz"
        summary += (
            ""
            if result.release_frame is None
            else f", released in frame {result.release_frame:.1f}"
        )
        rows = [
            Row(label, [*map(Cell, cells)])
            for label, cells in quality_table(result.markers).items()
        ]
        tables.append(
            PageTable(
                "Marker", [*QUALITY_COLUMNS], rows, summary=summary, unfolded=len(quality) == 1
            )
        )
    listed = Items(warnings) if warnings else Text("No warnings.")
    return Part("Quality of the recordings", [listed, *tables, Text(note, note=True)])


def shapes_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the errors on other bodies, and where the law is outside of the stretches
    that it was learned at.
    """
    shapes = data.metrics.get("shapes", {})
    if not shapes:
        return None
    note = (
        "Mean distance of the vertices from a target of the same shape, whose motion begins in "
        "the same state; below it, the share of the uncorrected simulator's error that is "
        "removed. A learned force belongs to its mesh, and cannot be put on another one."
    )
    beyond = [
        f"{n} ({100.0 * r['outside']:.0f} %)"
        for n, r in shapes.items()
        if r.get("outside", 0.0) > BEYOND
    ]
    outside = (
        "Outside of the stretches that the law was learned at, with the share of cells and times: "
    )
    texts = [Text(unbroken(f"{outside}{in_a_row(beyond)}."))] if beyond else []
    return Part("Other bodies of the same material", [shapes_table(shapes, note), *texts])


def shapes_table(shapes: Mapping[str, ShapeErrors], note: str = "") -> PageTable:
    """Returns the errors by body and model, and the shares
    of the uncorrected simulator's error that are removed.
    """
    known = set[str]().union(*(result["errors_mm"] for result in shapes.values()))
    models = [model for model in MODELS if model in known]
    rows = []
    for name, result in shapes.items():
        errors, cells = result["errors_mm"], []
        for model in models:
            error, base = errors.get(model), errors["simulation"]
            removes = error is not None and base and model in ("sysid", "law")
            below = (
                f"removes {share_text(1.0 - error / base)}"
                if removes and error is not None and base
                else ""
            )
            cells.append(Cell(number_text(error) if model in errors else NONE, below))
        rows.append(
            Row(
                name,
                cells,
                small=f"{result['vertices']} vertices, moves by {result['moved_mm']:.3g} mm",
            )
        )
    return PageTable(
        "Error on other bodies [mm]", [MODELS[model].name for model in models], rows, note
    )
