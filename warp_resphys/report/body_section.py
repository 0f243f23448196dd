"""The sections on the body and the inputs that drive it, and on its markers over time."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..io.arrays import FloatArray
from ..learning.baselines import BASELINES
from . import figures
from .body_picture import MeshSummary, mesh_picture
from .data import Driven, RunReport, TrialResults, best_and_worst, shown_markers, spread
from .page import Block, Canvas, Drawn, Part
from .wording import TONES, mm_text, unbroken

# Models whose coordinates are drawn, as more would overlap.
_DRAWN: Final = (*BASELINES, "simulation", "sysid", "law", "actuator", "simfree", "resphys")
_CALIBRATED: Final = {  # Source of prediction intervals.
    "validation": "the errors in the validation trials",
    "training": "the errors in the training trials, which tend to be too small",
    "left_out": "the errors in the training trials, with the parameters, but no network, learned "
    "without each of them",
    "folds": "the errors of the other folds",
}
_MOST_MARKERS: Final = 6  # Markers whose coordinates are drawn.
_STILL: Final = 0.01  # Largest motion along an axis that is not drawn, over that along the others.
_LOWEST: Final = 2.2  # Least height of all panels [in].
_MOST_DOTS: Final = 75  # Dots along a time axis.
_BAND: Final = 0.16  # Opacity of prediction intervals.
_LEAST_SPAN: Final = (
    0.08  # Least span of a coordinate's axis, over the largest motion of the trial.
)
_LEGEND_ROW: Final = 4  # Largest number of names of chambers in one row.
_BARS: Final = 0.8  # Height of a pose's bars, over the distance of poses.
_SEQUENCES: Final = 3  # Trials whose inputs are drawn over time.
# Line of the largest allowed input.
_LIMIT: Final[dict[str, Any]] = {"linewidth": 1.0, "linestyle": (0, (4, 3))}


def body_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns the picture of the body with its chambers or tendons, and the inputs."""
    trials, driven = data.trials, data.driven
    if trials is None or driven is None:
        return None
    quantity, markers = driven.quantity, len(trials.labels)
    parts = f"{len(driven.channels)} {quantity.per}{'s' if len(driven.channels) > 1 else ''}"
    dots = (
        f", and the {f'{markers} markers' if markers > 1 else 'marker'} as dots" if markers else ""
    )
    dark = " Dark: clamped." if len(data.fixed) else ""
    caption = (
        f"The simulated body: {len(data.mesh.vertices)} vertices, {parts} under "
        f"{quantity.words}{dots}.{dark}"
    )
    alt = f"The body at rest from outside, cut open and translucent, with {parts} in colours."

    summary = MeshSummary(
        data.mesh,
        data.fixed,
        data.chambers,
        data.tendons,
        f"{quantity.per}s".capitalize(),
        data.obstacles,
    )
    picture = mesh_picture(summary, trials.bound if trials.labels else None)
    blocks: list[Block] = [
        canvas.rendered(
            "body.png",
            picture.draw,
            lambda path, drawn: Drawn.of(picture.save(path, drawn), alt, caption),
        )
    ]
    rule = "" if not driven.limit else f"; dashed, the limit of {quantity.shown(driven.limit)}"
    left_out = f"; unused {quantity.per}s are left out" * (len(driven.used) < len(driven.channels))
    what, words = f"{quantity.plural.capitalize()} of {parts}", quantity.plural.capitalize()
    over_time = input_sequences(driven, trials)
    if over_time:
        figure = _sequences(driven, trials.time_step, over_time)
        shown = f"{what} over time: {', '.join(over_time)}."
        whose = "a few trials" if len(driven.values) > 1 else "the trial"
        blocks.append(
            canvas.figure("inputs", figure, shown, unbroken(f"{words} of {whose}{left_out}{rule}."))
        )
    if driven.poses:
        said = f"{words} of the poses; unused {quantity.per}s are left out{rule}."
        figure, shown = _poses(driven, trials.names), f"{what} by pose: {', '.join(driven.poses)}."
        blocks.append(canvas.figure("pose_inputs", figure, shown, unbroken(said)))
    return Part(f"The body and its {quantity.plural}", blocks)


def input_sequences(driven: Driven, trials: TrialResults) -> dict[str, FloatArray]:
    """Returns inputs of a few trials by the titles of their panels:
    test, training, and highest inputs.
    """
    values = {name: inputs for name, inputs in driven.values.items() if name not in driven.poses}
    test = [name for name in trials.names if name in values]
    others = [name for name in values if name not in test and name not in driven.scaled][:1]
    highest = sorted(driven.scaled, key=lambda name: float(values[name].max()))[-1:]
    many = _SEQUENCES - len(others) - len(highest)
    picked = [test[at] for at in spread(np.arange(len(test)), many)]
    titles = {name: f"{name}, a trial of the training" for name in others}
    titles |= {name: f"{name}, a test trial" for name in picked}
    titles |= {name: f"{name}, a test trial at higher {driven.quantity.words}" for name in highest}
    return {title: values[name] for name, title in titles.items()}


def _sequences(driven: Driven, time_step: float, sequences: Mapping[str, FloatArray]) -> Figure:
    """Draws inputs over time, with a panel for each trial."""
    figure = figures.new_figure(0.9 + 1.35 * len(sequences))
    panels = figure.subplots(len(sequences), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, (title, rows) in zip(panels, sequences.items(), strict=True):
        _inputs(axes, time_step * np.arange(len(rows) + 1, dtype=np.float64), rows, driven)
        _input_label(axes, driven)
        axes.set_title(title)
    panels[-1].set(xlabel="time [s]", xlim=(0.0, time_step * max(map(len, sequences.values()))))
    _part_legend(figure, driven, driven.used)
    return figure


def _inputs(axes: Axes, times: FloatArray, rows: FloatArray, driven: Driven) -> None:
    """Draws steps of the inputs (K, C) of used parts between K + 1 times [s],
    and the limit as a dashed line.
    """
    colours = figures.CHAMBER_COLOURS
    for part in driven.used:
        values, colour = driven.quantity.shown_factor * rows[:, part], colours[part % len(colours)]
        axes.stairs(values, times, baseline=None, color=colour, linewidth=1.2)
    if driven.limit is not None:
        axes.axhline(
            driven.quantity.shown_factor * driven.limit, color=TONES["muted"].light, **_LIMIT
        )
    figures.few_ticks(axes.yaxis, 4)


def _input_label(axes: Axes, driven: Driven) -> None:
    axes.set_ylabel(f"{driven.quantity.words} [{driven.quantity.shown_unit}]")


def _poses(driven: Driven, tested: Sequence[str]) -> Figure:
    """Draws the last inputs of each pose as bars beside its name.

    Parts without inputs are left out.
    """
    quantity = driven.quantity
    names = [f"{name} (test)" if name in tested else name for name in driven.poses]
    values = quantity.shown_factor * np.stack([driven.values[name][-1] for name in driven.poses])
    used: Sequence[int] = np.flatnonzero(values.any(axis=0)).tolist() or driven.used
    count = len(used)
    figure = figures.new_figure(0.9 + len(names) * max(0.25, 0.1 * count))
    axes = figure.subplots()
    for place, part in enumerate(used):
        middle = np.arange(len(names)) + _BARS * ((place + 0.5) / count - 0.5)
        colour = figures.CHAMBER_COLOURS[part % len(figures.CHAMBER_COLOURS)]
        axes.barh(middle, values[:, part], 0.9 * _BARS / count, color=colour)
    if driven.limit is not None:
        axes.axvline(quantity.shown_factor * driven.limit, color=TONES["muted"].light, **_LIMIT)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0, labelcolor=TONES["ink"].light)
    axes.set(xlabel=f"{quantity.words} [{quantity.shown_unit}]", ylim=(len(names) - 0.5, -0.5))
    figures.few_ticks(axes.xaxis, 6)
    axes.grid(visible=False, axis="y")
    _part_legend(figure, driven, used)
    return figure


def _part_legend(figure: Figure, driven: Driven, used: Sequence[int]) -> None:
    """Draws a legend of the used parts below the figure."""
    colours = figures.CHAMBER_COLOURS
    handles: list[Any] = [
        Line2D(
            [], [], color=colours[at % len(colours)], label=driven.channels[at].replace("_", " ")
        )
        for at in used
    ]
    if driven.limit is not None:
        handles.append(Line2D([], [], color=TONES["muted"].light, label="limit", **_LIMIT))
    figure.legend(handles=handles, loc="outside lower left", ncols=_LEGEND_ROW, columnspacing=1.4)


def paths_section(data: RunReport, canvas: Canvas) -> Part | None:
    """Returns coordinates of the markers or the tip,
    in the trials of largest and least error, over the inputs.
    """
    trials, driven = data.trials, data.driven
    if trials is None or not trials.moves or not (trials.labels or len(data.tip)):
        return None
    trials, of = (trials, "markers") if trials.labels else (trials.of_tip(data.tip), "tip")
    rows, blocks = best_and_worst(trials), []
    which = (
        ("worst", "the last model of the table", "largest"),
        ("best", "the same model", "least"),
    )
    for row, (place, model, error) in zip(rows, which, strict=False):
        name = trials.names[row]
        target = trials.target[row]
        shown = shown_markers(trials.target[row])
        reach = np.nanmax(np.linalg.norm(target - trials.bound, axis=2), axis=0, initial=0.0)
        kept = np.sort(shown[np.argsort(-reach[shown])[:_MOST_MARKERS]]).tolist()
        models, start = [m for m in _DRAWN if m in trials.positions], trials.bound
        caption = (
            f"Trial {name}{f', in which {model} has its {error} error' if len(rows) > 1 else ''}: "
        )
        alt = (
            f"Coordinates of the {of} over time in the trial {name}: "
            "observed as dots, the models as lines"
        )
        if driven is None:
            caption += f"displacement of the {of} from the undeformed body."
        else:
            words = driven.quantity.plural
            start = np.where(np.isfinite(target[0]), target[0], trials.bound)
            models = [m for m in models if m != "simulation"] or models
            caption += f"displacement of the markers from rest, and the {words} that drive it."
            alt += f"; below them the {words} of the {driven.quantity.per}s"
        order = (data.metrics.get("recommended", ""), "resphys", "actuator", "law", "sysid")
        banded = [model for model in order if model in trials.half_widths][:1]
        bands = {model: trials.half_widths[model][row][:, kept] for model in banded}
        hidden = len(shown) - len(kept)
        caption += _band_note(data, bands)
        caption += f" The {hidden} markers that move least are not drawn." if hidden else ""
        figure = marker_paths(trials, row, kept, models, start, bands, driven)
        blocks.append(canvas.figure(f"paths_{place}", figure, f"{alt}.", caption))
    return Part("Marker by marker" if of == "markers" else "The tip over time", blocks)


def marker_paths(
    trials: TrialResults,
    row: int,
    kept: Sequence[int],
    models: Sequence[str],
    start: FloatArray,
    bands: Mapping[str, FloatArray],
    driven: Driven | None = None,
) -> Figure:
    """Draws coordinates of some markers of a trial, measured as dots,
    simulated as lines, and below them the inputs.

    Args:
        trials: Measured and simulated positions.
        row: Of the trial.
        kept: Numbers of the markers.
        models: Whose positions are drawn.
        start: (M, 3) positions from which all are measured [m].
        bands: (T, kept) half-widths of prediction intervals [m], by model.
        driven: Inputs.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        measured_and_simulated = [trials.target, *(trials.positions[model] for model in models)]
        target, *paths = (1e3 * (q[row] - start)[:, kept] for q in measured_and_simulated)  # [mm]
    times, ratios = trials.times[row], [1.0] * len(kept) + [1.3] * (driven is not None)
    drawn = (np.where(np.abs(q) < figures.LARGEST_SHOWN, q, 0.0) for q in (target, *paths))
    reach = np.max([np.ptp(q, axis=0).max(axis=0) for q in drawn], axis=0)  # (3,) [mm]
    shown = [axis for axis in trials.axes if reach[axis] > _STILL * reach.max()] or [*trials.axes]
    figure = figures.new_figure(0.9 + max(1.25 * sum(ratios), _LOWEST))
    panels = figure.subplots(
        len(ratios), len(shown), sharex=True, squeeze=False, height_ratios=ratios
    )
    least = _LEAST_SPAN * float(np.ptp(np.nan_to_num(target), axis=0).max())
    every = -(-len(times) // _MOST_DOTS)
    dots: dict[str, Any] = {
        "color": TONES["ink"].light,
        "markersize": 3.2,
        "zorder": 1.5,
        "label": "Observed",
    }
    for marker, of_marker in enumerate(panels[: len(kept)]):
        for axes, axis in zip(of_marker, shown, strict=True):
            seen = target[:, marker, axis]
            axes.plot(times[::every], seen[::every], ".", **dots)
            for model, path in zip(models, paths, strict=True):
                moved = np.where(
                    np.abs(path[:, marker, axis]) < figures.LARGEST_SHOWN,
                    path[:, marker, axis],
                    np.nan,
                )
                axes.plot(times, moved, **figures.model_line(model, 1.1))
                if model in bands:
                    ends = [moved + sign * 1e3 * bands[model][:, marker] for sign in (-1.0, 1.0)]
                    axes.fill_between(
                        times,
                        *ends,
                        color=TONES[model].light,
                        alpha=_BAND,
                        linewidth=0.0,
                        zorder=0.5,
                    )
            figures.keep_in_view(axes, seen, 0.6, least)
            figures.few_ticks(axes.yaxis, 4)
        of_marker[0].set_ylabel(f"{trials.labels[kept[marker]]} [mm]")
    for axes, axis in zip(panels[0], shown, strict=True):
        axes.set_title("xyz"[axis])
    if driven is not None:
        for axes in panels[-1]:
            _inputs(axes, times, driven.values[trials.names[row]], driven)
        _input_label(panels[-1, 0], driven)
        _part_legend(figure, driven, driven.used)
    for axes in panels[-1]:
        axes.set(xlabel="time [s]", xlim=(0.0, times[-1]))
    figure.align_ylabels(panels[:, 0])
    figures.legend_above(figure, panels[0, 0])
    return figure


def _band_note(data: RunReport, bands: Mapping[str, FloatArray]) -> str:
    """Sentence on the drawn band: its intended coverage,
    and its coverage and width in all test trials.
    """
    if not bands:
        return ""
    intervals = data.metrics["intervals"]
    (kept,) = (intervals["models"][model] for model in bands)
    return (
        f" The band should contain {100.0 * intervals['level']:.0f} % of the measured "
        f"coordinates, and contains {100.0 * kept['coverage']:.0f} % of them; it is ± "
        f"{mm_text(kept['half_width_mm'])} wide on average, from "
        f"{_CALIBRATED[intervals['calibrated_on']]}."
    )
