"""Figures of motion: markers and tips with models, deformed bodies, and inputs."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ..stepping.quantity import Quantity
from .data import Driven, FloatArray, FollowedPath
from .figures import (
    CHAMBER_COLOURS,
    LARGEST_SHOWN,
    ROUND_STEPS,
    STYLE,
    TONES,
    WIDE,
    in_style,
    legend_above,
    model_line,
    new_figure,
    positive,
    use_logarithm,
)
from .render import Pixels

_MILLI: Final = 1e3
_MOST_DOTS: Final = 75  # Dots along a time axis.
_BAND: Final = 0.16  # Opacity of prediction intervals.
_LEAST_SPAN: Final = 0.08  # Least span of a coordinate's axis, over the largest motion of the trial.
_LEGEND_ROW: Final = 4  # Largest number of names of chambers in one row.
_BARS: Final = 0.8  # Height of a pose's bars, over the distance of poses.
_LINES: Final[Mapping[str, Any]] = {"open": (0, (4, 2)), "receding": "-"}  # By beginning of a controller's name.
_COLUMNS: Final = 5  # Of followed paths.


@in_style()
def tip_displacement(displacements: Mapping[str, FloatArray], time_step: float) -> Figure:
    """Draw the displacement of the tip and, below it, the distance of each model's tip from the target's.

    Args:
        displacements: (T+1, 3) displacement [m] of the tip from rest, of the "target" and of the models.
        time_step: Time between two states [s].
    """
    target = displacements["target"]
    axis = int(np.argmax(np.ptp(target, axis=0)))
    time = np.arange(len(target)) * time_step
    figure = new_figure(3.9)
    motion, distance = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    motion.plot(time, _MILLI * target[:, axis], color=TONES["target"].light, linewidth=4.0, label="Target")
    for model in (name for name in displacements if name != "target"):
        moved = displacements[model]
        motion.plot(time, _MILLI * moved[:, axis], **model_line(model))
        with np.errstate(over="ignore", invalid="ignore"):
            gap = _MILLI * np.linalg.norm(moved - target, axis=1)
        distance.plot(time, positive(gap), **model_line(model))
    _keep_in_view(motion, _MILLI * target[:, axis], 0.8)
    motion.set_ylabel(f"tip displacement\nalong {'xyz'[axis]} [mm]")
    motion.yaxis.set_major_locator(MaxNLocator(5, steps=ROUND_STEPS))
    use_logarithm(distance)
    distance.set(xlabel="time [s]", ylabel="off target\n[mm]", xlim=(0.0, time[-1]))
    legend_above(figure, motion)
    return figure


def _keep_in_view(axes: Axes, seen: FloatArray, share: float, least: float = 0.0) -> None:
    """Limit an axis to a measured motion (T,) and a margin, a share of it, with a least span.

    A model that diverges then does not set the scale, and noise does not look like motion.
    """
    if np.isfinite(seen).any():
        low, high = np.nanmin(seen), np.nanmax(seen)
        margin = share * (high - low) + 0.02
        bottom, top = axes.get_ylim()
        bottom, top = max(low - margin, bottom), min(high + margin, top)
        more = max(0.0, 0.5 * (least - (top - bottom)))
        axes.set_ylim(bottom - more, top + more)


@in_style()
def marker_paths(
    times: FloatArray,
    target: FloatArray,
    models: Mapping[str, FloatArray],
    labels: Sequence[str],
    driven: Driven | None = None,
    *,
    coordinates: Sequence[int] = (0, 1, 2),
    bands: Mapping[str, FloatArray] | None = None,
) -> Figure:
    """Draw the coordinates of markers over time, measured as dots, simulated as lines, and below them the inputs.

    Args:
        times: (T,) [s].
        target: (T, M, 3) displacement [m] from where the markers were held, NaN where a marker was not seen.
        models: (T, M, 3) displacement [m] by model.
        labels: Of the M markers.
        driven: Inputs of this trial; all panels are then stacked.
        coordinates: Observed ones of x, y and z.
        bands: (T, M) half-widths of prediction intervals [m], by model.
    """
    many = len(coordinates)
    count, stacked = len(labels), driven is not None
    rows, columns = (many * count, 1) if stacked else (count, many)
    height = 0.9 + 1.25 * count if driven is None else 2.9 + 0.95 * many * count
    figure = new_figure(height)
    ratios = [1.0] * rows + [1.5] * (driven is not None)
    panels = figure.subplots(len(ratios), columns, sharex=True, squeeze=False, height_ratios=ratios)
    least = _LEAST_SPAN * float(np.ptp(np.nan_to_num(_MILLI * target), axis=0).max())
    every = -(-len(times) // _MOST_DOTS)
    dots: dict[str, Any] = {"color": TONES["ink"].light, "markersize": 3.2, "zorder": 1.5, "label": "Measured"}
    for place, axes in enumerate(panels[:rows].flat):
        marker, column = divmod(place, many)
        axis = coordinates[column]
        seen = _MILLI * target[:, marker, axis]
        axes.plot(times[::every], seen[::every], ".", **dots)
        for model, path in models.items():
            axes.plot(times, _shown(path[:, marker, axis]), **model_line(model, 1.1))
        for model, widths in (bands or {}).items():
            ends = [_shown(models[model][:, marker, axis] + sign * widths[:, marker]) for sign in (-1.0, 1.0)]
            axes.fill_between(times, *ends, color=TONES[model].light, alpha=_BAND, linewidth=0.0, zorder=0.5)
        _keep_in_view(axes, seen, 0.6, least)
        axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))
        if column == 0 or stacked:
            axes.set_ylabel(f"{'xyz'[axis] if stacked else labels[marker]} [mm]")
        if column == 0 if stacked else marker == 0:
            axes.set_title(f"Marker {labels[marker]}" if stacked else "xyz"[axis])
    if driven is not None:
        ((title, values),) = driven.values.items()
        _inputs(panels[-1, 0], times, values, driven)
        panels[-1, 0].set_title(title)
        _part_legend(figure, driven)
    for axes in panels[-1]:
        axes.set(xlabel="time [s]", xlim=(0.0, times[-1]))
    figure.align_ylabels(panels[:, 0])
    legend_above(figure, panels[0, 0])
    return figure


def _shown(path: FloatArray) -> FloatArray:
    """A path [mm], with NaN where it diverged."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.abs(_MILLI * path) < LARGEST_SHOWN, _MILLI * path, np.nan)


@in_style()
def input_sequences(time_step: float, driven: Driven) -> Figure:
    """Draw inputs over time, with a panel for each trial; the time step is in [s]."""
    height = 0.9 + 1.35 * len(driven.values)
    figure = new_figure(height)
    panels = figure.subplots(len(driven.values), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    longest = 0.0
    for (title, rows), axes in zip(driven.values.items(), panels, strict=True):
        times = time_step * np.arange(len(rows) + 1, dtype=np.float64)
        longest = max(longest, times[-1])
        _inputs(axes, times, rows, driven)
        axes.set_title(title)
    panels[-1].set(xlabel="time [s]", xlim=(0.0, longest))
    _part_legend(figure, driven)
    return figure


def _axis_label(quantity: Quantity) -> str:
    return f"{quantity.words} [{quantity.shown_unit}]"


def _inputs(axes: Axes, times: FloatArray, rows: FloatArray, driven: Driven) -> None:
    """Draw steps of the inputs (K, C) between K + 1 times [s], and the limit as a dashed line."""
    factor = driven.quantity.shown_factor
    for values, colour in zip(rows.T, cycle(CHAMBER_COLOURS), strict=False):
        axes.stairs(factor * values, times, baseline=None, color=colour, linewidth=1.2)
    if driven.limit is not None:
        axes.axhline(factor * driven.limit, color=TONES["muted"].light, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_ylabel(_axis_label(driven.quantity))
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))


@in_style()
def pose_inputs(driven: Driven) -> Figure:
    """Draw the last inputs of each pose as bars beside its name; parts without inputs are left out."""
    factor = driven.quantity.shown_factor
    names, values = list(driven.values), factor * np.stack([rows[-1] for rows in driven.values.values()])
    used = np.flatnonzero(values.any(axis=0))
    count = max(1, len(used))
    height = 0.9 + len(names) * max(0.25, 0.1 * count)
    figure = new_figure(height)
    axes = figure.subplots()
    for place, part in enumerate(used):
        middle = np.arange(len(names)) + _BARS * ((place + 0.5) / count - 0.5)
        colour = CHAMBER_COLOURS[part % len(CHAMBER_COLOURS)]
        axes.barh(middle, values[:, part], 0.9 * _BARS / count, color=colour)
    if driven.limit is not None:
        axes.axvline(factor * driven.limit, color=TONES["muted"].light, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0, labelcolor=TONES["ink"].light)
    axes.set(xlabel=_axis_label(driven.quantity), ylim=(len(names) - 0.5, -0.5))
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=ROUND_STEPS))
    axes.grid(visible=False, axis="y")
    _part_legend(figure, driven, used.tolist())
    return figure


def _part_legend(figure: Figure, driven: Driven, used: Sequence[int] = ()) -> None:
    """Draw a legend of the parts, or of the used ones, below the figure."""
    handles: list[Any] = [
        Line2D([], [], color=CHAMBER_COLOURS[at % len(CHAMBER_COLOURS)], label=driven.channels[at].replace("_", " "))
        for at in used or range(len(driven.channels))
    ]
    if driven.limit is not None:
        handles.append(Line2D([], [], color=TONES["muted"].light, linestyle=(0, (4, 3)), label="limit"))
    figure.legend(handles=handles, loc="outside lower left", ncols=_LEGEND_ROW, columnspacing=1.4)


@in_style()
def motion_instants(frames: Pixels, titles: Sequence[str]) -> Figure:
    """Show the body at a few instants, each with a second view of its markers.

    Args:
        frames: (F, H, 2 * W, 4) drawn from `bodies.ComparedMotion.scene`.
        titles: Of the F instants.
    """
    count, height, width, _ = frames.shape
    rise = 2.0 * height / width
    figure = new_figure(2.0 * rise * WIDE / count + 0.35)
    panels = figure.subplots(2, count, squeeze=False)
    for row, frame, title in zip(panels.T, frames, titles, strict=True):
        for axes, picture in zip(row, np.split(frame, 2, axis=1), strict=True):
            axes.imshow(picture)
            axes.set_axis_off()
        row[0].set_title(title)
    return figure


@in_style()
def followed_paths(paths: Sequence[FollowedPath], controllers: Mapping[str, str], plane: FloatArray) -> Figure:
    """Draw paths and the paths of the controlled point, side by side in their plane.

    Args:
        paths: Paths and points.
        controllers: Names in words of the controllers that are drawn.
        plane: (2, 3) directions of the width and of the height.
    """
    columns = min(_COLUMNS, len(paths))
    rows = -(-len(paths) // columns)
    figure = new_figure(WIDE / columns * rows + 0.35)
    every = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    first = plane[0] / np.linalg.norm(plane[0])
    second = plane[1] - (plane[1] @ first) * first
    across = 1e3 * np.stack([first, second / np.linalg.norm(second)])
    middle = np.mean([followed.path.mean(axis=0) for followed in paths], axis=0)
    lines: dict[str, Any] = {}
    for axes, followed in zip(every, paths, strict=False):
        x, y = ((followed.path - middle) @ across.T).T
        (lines["path"],) = axes.plot(x, y, color=TONES["target"].light, linewidth=3.2)
        for controller, name in controllers.items():
            beginning, model = controller.split("_", 1)
            x, y = ((followed.points[controller] - middle) @ across.T).T
            tone = TONES[model].light
            (lines[name],) = axes.plot(x, y, color=tone, linestyle=_LINES[beginning], linewidth=1.1)
        axes.set_aspect("equal")
        axes.set_title(followed.name)
        axes.grid(False)
    for axes in every[len(paths) :]:
        axes.set_visible(False)
    for axes in every:
        axes.tick_params(labelsize=STYLE["xtick.labelsize"] - 1.5)
    every[0].set_ylabel("mm")
    figure.legend(list(lines.values()), list(lines), loc="outside upper left", ncols=4, columnspacing=1.6)
    return figure
