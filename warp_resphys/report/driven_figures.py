"""Figures of motions that pressure drives: errors over time and pressure, paths of the tip, and the pressures."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray

from ..learning.metrics import median_filter
from .figures import (
    CHAMBER_COLOURS,
    LARGEST_SHOWN,
    ROUND_STEPS,
    STYLE,
    TONES,
    legend_above,
    new_figure,
    positive,
    use_logarithm,
)
from .measured_figures import LEAST_SPAN, mean_of_trials, path_panel
from .measured_tables import MODELS

FloatArray = NDArray[np.float64]

_MILLI: Final = 1e3
_KILO: Final = 1e-3
_ABOVE: Final = 0.35  # What is seen around the measured path, over its longest side.
_LEAST: Final = 0.25  # Of the shortest side, over the longest.
_LEGEND_ROW: Final = 4  # Most names of chambers in one row.
_ROUND: Final = 0.5  # [s] between the points along a path in space.


def filtered_errors(
    time_step: float, errors: Mapping[str, FloatArray], window: float | None, *, narrow: bool
) -> Figure:
    """Draw each model's mean marker error over time, after a median filter, and thin behind it without one.

    Args:
        time_step: Between two frames, the first at zero [s].
        errors: For each model (R, T) errors [mm] of R trials; NaN where nothing was seen, infinite where the model
            diverged.
        window: Of the filter [s]; None for no filter.
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(3.6, 4.2, narrow=narrow)
        axes = figure.subplots()
        lowest = []
        for model, rows in errors.items():
            times = time_step * np.arange(rows.shape[1])
            mean = mean_of_trials(rows)
            smooth = positive(mean if window is None else median_filter(mean, time_step, window))
            tone = TONES[model].light
            if window is not None:
                axes.plot(times, positive(mean), color=tone, linewidth=0.6, alpha=0.45)
            axes.plot(times, smooth, color=tone, linewidth=2.0 if model == "resphys" else 1.4, label=MODELS[model][0])
            axes.set_xlim(0.0, times[-1])
            settled = smooth[len(smooth) // 10 :]
            lowest += [float(np.nanmin(settled))] if np.isfinite(settled).any() else []
        use_logarithm(axes, 0.4 * min(lowest, default=0.0))  # Models begin close to the measured rest: not shown.
        axes.set(xlabel="time [s]", ylabel="mean marker error [mm]")
        legend_above(figure, axes, narrow=narrow)
    return figure


def errors_over_factor(errors: Mapping[str, Mapping[float, float]], *, narrow: bool) -> Figure:
    """Draw the mean error against the factor of the pressure, a line a model.

    Args:
        errors: Mean errors [mm] by model and factor; a factor at which a roll-out diverged is left out.
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(3.0, 3.6, narrow=narrow)
        axes = figure.subplots()
        factors = sorted({factor for each in errors.values() for factor in each})
        for model, each in errors.items():
            values = positive(np.array([each.get(factor, np.nan) for factor in factors]))
            width = 2.0 if model == "resphys" else 1.4
            axes.plot(factors, values, "o-", color=TONES[model].light, linewidth=width, label=MODELS[model][0])
        use_logarithm(axes)
        axes.set_xticks(factors, [f"{factor:g}" for factor in factors])
        axes.set(xlabel="pressure over that of the training", ylabel="mean marker error [mm]")
        legend_above(figure, axes, narrow=narrow)
    return figure


def tip_planes(measured: FloatArray, models: Mapping[str, FloatArray], *, narrow: bool) -> Figure:
    """Draw the path of the tip in the plane across gravity, a panel a model, over the measured one.

    Args:
        measured: (T, 3) displacement from rest [m], NaN where it was not seen.
        models: (T, 3) [m] by model.
        narrow: Whether the figure is for a narrow page; there are then two panels in a row.
    """
    count = len(models)
    with mpl.rc_context(STYLE):
        columns = min(count, 2 if narrow else 4)
        rows = -(-count // columns)
        width = (3.7 if narrow else 7.3) / columns
        height = 0.55 + rows * (min(width, 3.4) + 0.05)
        figure = new_figure(height, height, narrow=narrow)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        centre, half = _range(measured[:, :2])
        for axes in panels.flat[count:]:
            axes.set_axis_off()
        for (model, path), axes in zip(models.items(), panels.flat, strict=False):
            axes.plot(*(_MILLI * measured[:, :2]).T, color=TONES["target"].light, linewidth=2.6, label="Measured")
            axes.plot(*_shown(path[:, :2]).T, color=TONES[model].light, linewidth=0.9)
            axes.set_title(MODELS[model][0])
            reach = half.max() * np.array([-1.0, 1.0])
            axes.set(xlim=centre[0] + reach, ylim=centre[1] + reach)
            axes.set_aspect("equal")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(5, steps=ROUND_STEPS))
        for column in range(columns):
            panels[(count - 1 - column) // columns, column].set_xlabel("x [mm]")
            panels[(count - 1 - column) // columns, column].tick_params(labelbottom=True)
        for row in panels:
            row[0].set_ylabel("y [mm]")
        legend_above(figure, panels[0, 0], narrow=narrow)
    return figure


def _range(measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The middle (D,) of a measured path (T, D) [m], and half the widths (D,) of a view of it [mm]."""
    seen = _MILLI * measured[np.isfinite(measured).all(axis=1)]
    if not len(seen):
        return np.zeros(measured.shape[1]), np.ones(measured.shape[1])
    low, high = seen.min(axis=0), seen.max(axis=0)
    widest = max(float((high - low).max()), 0.1)
    return 0.5 * (low + high), 0.5 * np.maximum(high - low, _LEAST * widest) + 0.5 * _ABOVE * widest


def _shown(path: FloatArray) -> FloatArray:
    """A path [mm], with gaps where it ran away."""
    with np.errstate(invalid="ignore", over="ignore"):
        shown: FloatArray = np.where(np.abs(_MILLI * path) < LARGEST_SHOWN, _MILLI * path, np.nan)
    return shown


def tip_in_space(times: FloatArray, measured: FloatArray, models: Mapping[str, FloatArray], *, narrow: bool) -> Figure:
    """Draw the path of the tip in space, a panel a model, with points at equal times joined to the measured ones.

    Args:
        times: (T,) [s].
        measured: (T, 3) displacement from rest [m], NaN where it was not seen.
        models: (T, 3) [m] by model.
        narrow: Whether the figure is for a narrow page; the panels then stand below each other.
    """
    every = max(1, round(_ROUND / float(times[1] - times[0]))) if len(times) > 1 else 1
    centre, half = _range(measured)
    with mpl.rc_context({**STYLE, "xtick.labelsize": 7.5, "ytick.labelsize": 7.5}):
        shape = (len(models), 1) if narrow else (1, len(models))
        figure = new_figure(3.3, 0.4 + 3.2 * len(models), narrow=narrow)
        panels = figure.subplots(*shape, squeeze=False, subplot_kw={"projection": "3d"})
        for (model, path), axes in zip(models.items(), panels.flat, strict=True):
            assert isinstance(axes, Axes3D)
            seen, simulated = _MILLI * measured, _inside(_shown(path), centre, half)
            axes.plot(*seen.T, color=TONES["target"].light, linewidth=2.4, label="Measured")
            axes.plot(*simulated.T, color=TONES[model].light, linewidth=1.2, label=MODELS[model][0])
            for at in range(0, len(times), every):
                pair = np.stack([seen[at], simulated[at]])
                axes.plot(*pair.T, color=TONES["ink"].light, linewidth=0.7)
                axes.plot(*pair[:1].T, "o", color=TONES["muted"].light, markersize=3.0)
                axes.plot(*pair[1:].T, "o", color=TONES[model].light, markersize=3.0)
            _space(axes, centre, half)
            axes.set_title(MODELS[model][0], y=0.92)
        handles, labels = panels.flat[0].get_legend_handles_labels()
        figure.legend(handles[:1], labels[:1], loc="outside upper left")
    return figure


def _inside(path: FloatArray, centre: FloatArray, half: FloatArray) -> FloatArray:
    """What of a path (T, 3) is in the box that is drawn, with gaps where it is not."""
    within = np.asarray((np.abs(path - centre) <= half).all(axis=1))
    return np.where(within[:, None], path, np.nan)


def _space(axes: Axes3D, centre: FloatArray, half: FloatArray) -> None:
    """The box of a picture in space, its axes and its view."""
    axes.set(
        xlim=(centre[0] - half[0], centre[0] + half[0]),
        ylim=(centre[1] - half[1], centre[1] + half[1]),
        zlim=(centre[2] - half[2], centre[2] + half[2]),
        xlabel="x [mm]",
        ylabel="y [mm]",
        zlabel="z [mm]",
    )
    axes.view_init(elev=28.0, azim=-58.0)
    axes.set_box_aspect(tuple(half), zoom=0.84)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))
        axis.set_pane_color((0.0, 0.0, 0.0, 0.0))
        axis.label.set_color(TONES["muted"].light)
        axis._axinfo["grid"]["color"] = TONES["rule"].light


def markers_and_pressures(
    times: FloatArray,
    measured: FloatArray,
    models: Mapping[str, FloatArray],
    labels: Sequence[str],
    start: FloatArray,
    pressure: FloatArray,
    chambers: Sequence[str],
    limit: float | None,
    *,
    narrow: bool,
) -> Figure:
    """Draw coordinates of markers over time, and below them the pressures, on one axis of time.

    Args:
        times: (T,) [s].
        measured: (T, M, 3) [m], NaN where a marker was not seen.
        models: (T, M, 3) [m] by model.
        labels: Of the M markers.
        start: (M, 3) [m] what is subtracted: where the markers are at rest.
        pressure: (T - 1, C) [Pa] between two frames.
        chambers: C names.
        limit: That no pressure may exceed [Pa].
        narrow: Whether the figure is for a narrow page.
    """
    count = len(labels)
    with mpl.rc_context(STYLE):
        height = 1.0 + 0.95 * 3 * count + 1.9
        figure = new_figure(height, height + 0.5, narrow=narrow)
        panels = figure.subplots(3 * count + 1, 1, sharex=True, height_ratios=[1.0] * 3 * count + [1.5])
        moved = np.nan_to_num(_MILLI * (measured - start))
        least = LEAST_SPAN * float(np.ptp(moved, axis=0).max())
        for marker, label in enumerate(labels):
            for axis in range(3):
                axes = panels[3 * marker + axis]
                seen, *rest = (
                    _MILLI * (q[:, marker, axis] - start[marker, axis]) for q in (measured, *models.values())
                )
                path_panel(axes, times, seen, least, dict(zip(models, rest, strict=True)))
                axes.set_ylabel(f"{'xyz'[axis]} [mm]")
                if axis == 0:
                    axes.set_title(f"Marker {label}")
        _pressures(panels[-1], times, pressure, limit)
        panels[-1].set(xlabel="time [s]", xlim=(0.0, times[-1]))
        panels[-1].set_title("Pressures")
        figure.align_ylabels(panels)
        legend_above(figure, panels[0], narrow=narrow)
        _chamber_legend(figure, panels[-1], chambers, narrow=narrow)
    return figure


def pressure_sequences(
    time_step: float,
    pressures: Mapping[str, FloatArray],
    chambers: Sequence[str],
    limit: float | None,
    *,
    narrow: bool,
) -> Figure:
    """Draw the pressures of a few trials, a panel a trial.

    Args:
        time_step: [s].
        pressures: (K, C) [Pa] during each step, by the panel's title.
        chambers: C names.
        limit: That none may exceed [Pa].
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        height = 0.9 + 1.35 * len(pressures)
        figure = new_figure(height, height + 0.4, narrow=narrow)
        panels = figure.subplots(len(pressures), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for (title, rows), axes in zip(pressures.items(), panels, strict=True):
            times = time_step * np.arange(len(rows) + 1, dtype=np.float64)
            _pressures(axes, times, rows, limit)
            axes.set_title(title)
        longest = max(len(rows) for rows in pressures.values())
        panels[-1].set(xlabel="time [s]", xlim=(0.0, time_step * longest))
        _chamber_legend(figure, panels[0], chambers, narrow=narrow)
    return figure


def _pressures(axes: Axes, times: FloatArray, pressure: FloatArray, limit: float | None) -> None:
    """Steps of the pressures (K, C) [Pa] between K + 1 times [s], and the limit as a dashed line."""
    for values, colour in zip(pressure.T, cycle(CHAMBER_COLOURS), strict=False):
        axes.stairs(_KILO * values, times, baseline=None, color=colour, linewidth=1.2)
    if limit is not None:
        axes.axhline(_KILO * limit, color=TONES["muted"].light, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_ylabel("pressure [kPa]")
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))


def _chamber_legend(figure: Figure, axes: Axes, chambers: Sequence[str], *, narrow: bool) -> None:
    """Names of the chambers, below the figure."""
    from matplotlib.lines import Line2D

    handles: list[Any] = [
        Line2D([], [], color=colour, label=name.replace("_", " "))
        for name, colour in zip(chambers, cycle(CHAMBER_COLOURS), strict=False)
    ]
    if axes.lines:
        (handle,) = axes.lines[-1:]
        handles.append(Line2D([], [], color=handle.get_color(), linestyle=(0, (4, 3)), label="limit"))
    figure.legend(handles=handles, loc="outside lower left", ncols=2 if narrow else _LEGEND_ROW, columnspacing=1.4)
