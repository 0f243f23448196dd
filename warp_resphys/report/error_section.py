"""The sections on errors over time, of each marker and of each rigid body,
and on the training of the networks.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from ..io.arrays import BoolArray, FloatArray
from ..io.errors import listed, number_of
from ..learning.metrics import median_filter
from . import figures
from .data import ForceCurve, MeshCheck, RunReport, force_errors, grouped_errors
from .page import Canvas, Part, Text
from .sections import model_table, numbers
from .wording import MODELS, TONES, largest_text, mm_text, number_text, unbroken

_FILTER: Final = 1.0  # Window of the median filter [s], as published.
_LENGTHS: Final = 4.0  # Least length of a roll-out that is filtered, in windows.
_TRAINED: Final = (
    "Losses, and the roll-out error on the trials by which the weights are chosen; "
    "the dot marks the lowest."
)
_BETWEEN: Final = 0.07  # Space between panels, so that labels of their ends do not meet.


def error_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the errors over time, of each trial and of each marker."""
    trials, metrics = data.trials, data.metrics
    if trials is None:
        return None
    blocks: list[Any] = []
    if trials.moves:
        times = np.nanmean(trials.times, axis=0)
        window = _FILTER if times[-1] >= _LENGTHS * _FILTER - 1e-9 else None
        of = "marker" if data.sees_markers else "vertex"
        reached = "; ".join(
            f"{MODELS[model].name} reaches {largest_text(e)}"
            for model, e in trials.errors_mm.items()
        )
        alt = f"Mean {of} error of the models over time, on a logarithmic axis. {reached}."
        panels: dict[str, BoolArray | slice] = {"": slice(None)}
        if len(grouped_errors(metrics, data.settings)) > 1:
            inside = np.array([name not in data.others for name in trials.names])
            by_load = zip(data.settings.test_titles, (inside, ~inside), strict=True)
            panels = {f"{kind} ({number_of(rows.sum(), 'trial')})": rows for kind, rows in by_load}
        figure = error_over_time(trials.errors_mm, times, of, window, panels)
        blocks.append(canvas.figure("error_over_time", figure, alt, _error_caption(data, window)))
    by_model = metrics.get("per_marker")
    if by_model:
        known = set[str]().union(*by_model.values())
        shown = [label for label in trials.labels if label in known]
        by_label = {
            label: {m: markers.get(label) for m, markers in by_model.items()} for label in shown
        }
        blocks.append(model_table("Each marker [mm]", numbers(by_label), metrics["errors_mm"]))
    forces = force_errors(metrics)
    if forces:
        for name, curve in data.forces.items():
            alt = (
                f"{curve.axis} of {name} over time in the test trial {curve.trial}, "
                "measured and of the models."
            )
            blocks.append(
                canvas.figure(
                    f"force_{name}", force_over_time(name, curve), alt, f"Test trial {curve.trial}."
                )
            )
        by_sensor = {
            f"{name} [{unit}], of {size:.3g} {unit}": {**known}
            for name, (unit, size, known) in forces.items()
        }
        note = (
            "Mean error of the force, beside its mean size; "
            "without zero and drift, where the sensor has them."
        )
        blocks.append(model_table("Force", numbers(by_sensor), metrics["errors_mm"], note))
    by_phase = metrics.get("phases")
    if by_phase:
        rows = {
            phase.capitalize(): {m: summary["mean"] for m, summary in models.items()}
            for phase, models in by_phase.items()
        }
        note = (
            "Rise: the first half second after the inputs grew. "
            "Hold: after that. Release: after they fell."
        )
        blocks.append(
            model_table("Phase; mean error [mm]", numbers(rows), metrics["errors_mm"], note)
        )
    turned = metrics.get("orientations_deg")
    if turned:
        bodies = next(iter(turned.values()))
        by_body = {name: {m: angles[name] for m, angles in turned.items()} for name in bodies}
        blocks.append(
            model_table(
                "Orientation of each rigid body [degrees]", numbers(by_body), metrics["errors_mm"]
            )
        )
    check = metrics.get("mesh_check")
    if check:
        blocks += [Text("Error of the mesh", heading=True), Text(mesh_text(check))]
    return Part("Error over time" if trials.moves else "Each marker", blocks) if blocks else None


def mesh_text(check: MeshCheck) -> str:
    """Returns sentences on what a finer mesh changes, from `mesh_check.json`."""
    if "failed" in check:
        return f"The error of the mesh is not known: {check['failed']}"
    cells, finer = check["cells"]
    vertices = "{:,} instead of {:,} vertices".format(*check["vertices"][::-1])
    mesh = (
        f"quadratic cells ({vertices})"
        if cells == finer
        else f"{finer:,} instead of {cells:,} cells"
    )
    model, (before, after) = MODELS[check["model"]].name, map(mm_text, check["errors_mm"])
    return unbroken(
        f"With {mesh} and the same parameters, {model} moves the markers by "
        f"{mm_text(check['moved_mm'])}, and its error is {after} instead of {before}, at the "
        f"beginning of {listed(check['trials'])}. "
        "Parameters that are identified on a finer mesh differ."
    )


def error_over_time(
    errors: Mapping[str, FloatArray],
    times: FloatArray,
    of: str = "vertex",
    window: float | None = None,
    panels: Mapping[str, BoolArray | slice] | None = None,
) -> Figure:
    """Draws each model's mean error over time and, for the main models, the range of the trials.

    Args:
        errors: (R, T) errors [mm] of R trials by model; NaN where nothing was seen, infinite where
            it diverged.
        times: (T,) [s].
        of: What is observed: "vertex" or "marker".
        window: Of a median filter [s], for long trials: the filtered error is drawn instead of the
            range, and the unfiltered one as a thin line. None for no filter.
        panels: Rows of the trials of each panel, by title; by default one panel has all trials.
    """
    groups = panels or {"": slice(None)}
    figure, lowest = figures.new_figure(3.5), list[float]()
    every = figure.subplots(1, len(groups), sharex=True, sharey=True, squeeze=False)
    for axes, (title, rows) in zip(every.flat, groups.items(), strict=True):
        for model, values in errors.items():
            seen, line = ~np.isnan(values[rows]), figures.model_line(model)
            count = seen.sum(axis=0)
            mean = np.where(
                count > 0,
                np.where(seen, values[rows], 0.0).sum(axis=0) / np.maximum(count, 1),
                np.nan,
            )
            shown = figures.positive(mean)
            if window is not None:
                axes.plot(times, shown, color=line["color"], linewidth=0.6, alpha=0.45)
                shown = figures.positive(median_filter(mean, float(times[1] - times[0]), window))
                settled = shown[len(shown) // 10 :]
                lowest += [float(np.nanmin(settled))] if np.isfinite(settled).any() else []
            elif len(values[rows]) > 1 and (model == "sysid" or line["linestyle"] == "-"):
                low, high = (
                    figures.positive(extreme.reduce(values[rows], axis=0))
                    for extreme in (np.fmin, np.fmax)
                )
                axes.fill_between(times, low, high, color=line["color"], alpha=0.15, linewidth=0)
            axes.plot(times, shown, **line)
        axes.set(title=title, xlabel="time [s]", xlim=(0.0, times[-1]))
    if len(groups) > 1:
        figure.set_layout_engine("constrained", wspace=_BETWEEN)
        figures.few_ticks(every[0, 0].xaxis, 5)
    for axes in every.flat:  # Once everything is drawn, as they share their axis.
        # Cuts off the small errors at the start.
        figures.use_logarithm(axes, 0.4 * min(lowest, default=0.0))
    every[0, 0].set_ylabel(f"mean {of} error [mm]")
    figures.legend_above(figure, every[0, 0])
    return figure


def force_over_time(name: str, curve: ForceCurve) -> Figure:
    """Draws a measured component of a force, and those of the models."""
    figure = figures.new_figure(3.0)
    axes = figure.subplots()
    for model, values in curve.models.items():
        axes.plot(curve.times, values, **figures.model_line(model))
    axes.plot(curve.times, curve.measured, color="black", linewidth=0.9, label="measured", zorder=3)
    axes.set(
        xlabel="time [s]",
        ylabel=f"{name}.{curve.axis} [{curve.unit}]",
        xlim=(curve.times[0], curve.times[-1]),
    )
    figures.legend_above(figure, axes)
    return figure


def _error_caption(data: RunReport, window: float | None) -> str:
    count = len(data.metrics["per_trajectory"])
    text = (
        "Mean over the "
        f"{'visible markers' if data.sees_markers else 'vertices, against the target'}"
    )
    if window is not None:
        text += (
            f" and {number_of(count, 'test trial')}, after a median filter of 1 s; the thin "
            "lines are not filtered."
        )
    elif count > 1:
        parted = len(grouped_errors(data.metrics, data.settings)) > 1
        text += (
            f": the line is the mean of the {'' if parted else f'{count} '}test trials, the band"
        )
        text += " of a solid line" if data.sees_markers else ""
        text += " spans the smallest to the largest of them."
    else:
        text += "."
    if any(summary["diverged"] for summary in data.metrics["errors_mm"].values()):
        text += " A line ends where the first roll-out has diverged."
    return unbroken(text)


def training_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the curves of the trainings, and which weights were kept."""
    blocks: list[Any] = []
    for model, (name, *_) in MODELS.items():
        records = data.training.get(model)
        if records:
            alt = (
                f"Losses and validation roll-out error of the training of {name}, "
                f"{len(records)} epochs."
            )
            figure = canvas.figure(f"training_{model}", training_curves(records), alt, _TRAINED)
            blocks += [Text(name, heading=True), figure]
    return Part("Training", blocks) if blocks else None


def training_curves(records: Sequence[Mapping[str, float | None]]) -> Figure:
    """Draws the losses and, where they were recorded,
    the validation roll-out error and the learning rate.

    Args:
        records: One for each epoch, with `epoch`, `train_loss`, `validation_loss`, and in some or
            all epochs `rollout_error_mm` and `learning_rate`; values that were not measured are
            None or absent.
    """

    def measured(key: str) -> tuple[FloatArray, FloatArray]:  # Epochs and values.
        known = [
            (record["epoch"], record[key]) for record in records if record.get(key) is not None
        ]
        epochs, values = np.asarray(known, dtype=np.float64).reshape(-1, 2).T
        return epochs, figures.positive(values)

    heights = {"losses": 3, "rollout_error_mm": 3, "learning_rate": 1}
    heights = {
        key: height for key, height in heights.items() if key == "losses" or len(measured(key)[0])
    }
    muted, strong = TONES["muted"].light, TONES["resphys"].light
    thin: dict[str, Any] = {"linewidth": 1.1, "marker": "." if len(records) == 1 else ""}
    figure = figures.new_figure(0.6 + 0.57 * sum(heights.values()))
    rows = figure.subplots(
        len(heights), 1, sharex=True, squeeze=False, height_ratios=[*heights.values()]
    )[:, 0]
    axes = dict(zip(heights, rows, strict=True))
    for key, label, colour in (
        ("train_loss", "Training loss", muted),
        ("validation_loss", "Validation loss", strong),
    ):
        epochs, losses = measured(key)
        if len(epochs):
            axes["losses"].plot(epochs, losses, color=colour, label=label, **thin)
    axes["losses"].set_ylabel("loss")
    axes["losses"].legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=2)
    curve = axes.get("rollout_error_mm")
    if curve is not None:
        epochs, errors = measured("rollout_error_mm")
        curve.plot(epochs, errors, color=strong)
        curve.set_ylabel("roll-out\nerror [mm]")
        if np.isfinite(errors).any():
            best = int(np.nanargmin(errors))
            curve.plot(
                epochs[best], errors[best], "o", color=TONES["simulation"].light, markersize=5
            )
            curve.set_title(
                f"lowest: {number_text(errors[best])} mm, epoch {epochs[best]:.0f}", loc="right"
            )
    if "learning_rate" in axes:
        axes["learning_rate"].plot(
            *measured("learning_rate"), color=muted, drawstyle="steps-mid", **thin
        )
        axes["learning_rate"].set_ylabel("learning\nrate")
    for row in rows:
        figures.use_logarithm(row)
    rows[-1].set_xlabel("epoch")
    figures.count(rows[-1].xaxis, 6)
    figure.align_ylabels()
    return figure
