"""The figures of a search for settings: a function each."""

import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, PercentFormatter

from ...report.figures import STYLE, TONES, FloatArray, new_figure, use_logarithm
from .space import Dimension

_STOPPED = TONES["muted"].light
_TRIAL = TONES["resphys"].light
_BEST = TONES["simulation"].light


def search_history(errors: FloatArray, pruned: FloatArray, configured: float | None, *, narrow: bool) -> Figure:
    """Draws the error of each trial, and the lowest error so far.

    Args:
        errors: (R,) errors [mm] of complete trials, by number; infinite where they diverged, NaN for other trials.
        pruned: (R,) smallest errors [mm] of stopped trials; NaN for other trials.
        configured: error of training as configured [mm]; None where it diverges.
        narrow: whether the figure is for a narrow page, here and below.
    """
    numbers, finite, lost = np.arange(len(errors)), np.isfinite(errors), np.isposinf(errors)
    with mpl.rc_context(STYLE):
        figure = new_figure(3.2, 3.2, narrow=narrow)
        axes = figure.subplots()
        best = np.fmin.accumulate(np.where(finite, errors, np.nan))
        axes.step(numbers, best, where="post", color=_BEST, label="Best so far", zorder=1)
        axes.plot(numbers[finite], errors[finite], "o", color=_TRIAL, markersize=4.5, label="Trial")
        if np.isfinite(pruned).any():
            axes.plot(numbers, pruned, "o", color=_STOPPED, markersize=4.0, fillstyle="none", label="Stopped")
        if configured is not None:
            axes.axhline(configured, color=_STOPPED, linewidth=1.1, linestyle="--", label="As configured")
        _errors_axis(axes)
        if lost.any():
            top = axes.get_ylim()[1]
            axes.plot(numbers[lost], np.full(lost.sum(), top), "x", color=_STOPPED, clip_on=False, label="Diverged")
        axes.set(xlabel="trial", ylabel="validation roll-out\nerror [mm]", xlim=(-0.5, max(len(errors) - 0.5, 0.5)))
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=2 if narrow else 5, columnspacing=1.6)
    return figure


def importance_bars(importance: Mapping[str, float], *, narrow: bool) -> Figure:
    """Draws the importance of each setting, as shares that sum to one; a sentence where it is empty."""
    rows = sorted(importance.items(), key=lambda item: item[1])
    with mpl.rc_context(STYLE):
        height = 0.8 + 0.28 * max(len(rows), 3)
        figure = new_figure(height, height, narrow=narrow)
        axes = figure.subplots()
        if not rows:
            axes.set_axis_off()
            axes.text(0.5, 0.5, "known after four trials that did not diverge", ha="center", va="center")
            return figure
        axes.barh([name for name, _ in rows], [share for _, share in rows], color=_TRIAL, height=0.6)
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0, labelcolor=TONES["ink"].light)
        axes.set(xlabel="importance for being among the best quarter", xlim=(0.0, 1.05 * max(rows[-1][1], 0.05)))
    return figure


def setting_scatter(
    errors: FloatArray, settings: Sequence[Mapping[str, float | str]], space: Mapping[str, Dimension], *, narrow: bool
) -> Figure:
    """Draws the errors (R,) [mm] of trials over each setting, with a panel for each; the best trial is marked."""
    columns = min(2 if narrow else 3, len(space))
    rows = math.ceil(len(space) / columns)
    shown = [i for i, error in enumerate(errors) if np.isfinite(error)]
    with mpl.rc_context(STYLE):
        figure = new_figure(0.4 + 1.75 * rows, 0.4 + 1.6 * rows, narrow=narrow)
        panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
        for axes in panels.flat[len(space) :]:
            axes.set_axis_off()
        for axes, (name, dimension) in zip(panels.flat, space.items(), strict=False):
            places = _places(axes, dimension, [settings[i][name] for i in shown])
            axes.plot(places, errors[shown], "o", color=_TRIAL, markersize=3.5, alpha=0.7)
            if shown:
                best = int(np.argmin(errors[shown]))
                axes.plot(places[best], errors[shown][best], "o", color=_BEST, markersize=6)
            axes.set_xlabel(name.replace("_", " "))
        _errors_axis(panels[0, 0])
        for axes in panels[:, 0]:
            axes.set_ylabel("error [mm]")
    return figure


def _errors_axis(axes: Axes) -> None:
    """Sets a logarithmic axis with at least two labels."""
    use_logarithm(axes)
    low, high = axes.get_ylim()
    if low > 0.0 and high < 100.0 * low:
        axes.set_ylim(10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)))


def _places(axes: Axes, dimension: Dimension, values: Sequence[float | str]) -> FloatArray:
    """Positions of the values of a setting on an axis, which is labelled with them."""
    axes.xaxis.set_minor_locator(NullLocator())
    if dimension.values:
        axes.set_xticks(range(len(dimension.values)), [str(value) for value in dimension.values])
        axes.set_xlim(-0.5, len(dimension.values) - 0.5)
        return np.array([dimension.values.index(value) for value in values], dtype=np.float64)
    low, high = map(float, dimension.ends)
    if dimension.log:
        axes.set_xscale("log", subs=[])
        axes.set_xlim(low / (high / low) ** 0.06, high * (high / low) ** 0.06)
        axes.xaxis.set_major_locator(LogLocator(numticks=5))
    else:
        axes.set_xlim(low - 0.06 * (high - low), high + 0.06 * (high - low))
        whole = isinstance(dimension.ends[0], int)
        axes.xaxis.set_major_locator(MaxNLocator("auto" if whole else 5, integer=whole))
    return np.array(values, dtype=np.float64)
