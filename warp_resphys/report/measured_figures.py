"""Figures of measured motions: markers against models, errors over time, identification, and the moving body."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from .figures import (
    NARROW,
    ROUND_STEPS,
    STYLE,
    TONES,
    WIDE,
    legend_above,
    new_figure,
    positive,
    use_logarithm,
)
from .measured_tables import MODELS

FloatArray = NDArray[np.float64]

_DASHED: Final = {"published": (0, (1, 1.2)), "sysid_elastic": (0, (4, 2)), "resphys_uncorrected": (0, (4, 2))}
_LEVELS: Final = 14  # Of a landscape.
_MOST_DOTS: Final = 75  # Along an axis of time.
LEAST_SPAN: Final = 0.08  # Of a coordinate's axis, over the largest motion of the trial.
_KILO: Final = 1e-3
_MILLI: Final = 1e3


def errors_over_time(times: FloatArray, errors: Mapping[str, FloatArray], *, narrow: bool) -> Figure:
    """Draw each model's mean marker error over time, and around the main ones the standard deviation of the trials.

    Args:
        times: (T,) of the frames since the release [s].
        errors: For each model (R, T) errors [mm] of R trials; NaN where nothing was seen,
            infinite where the model diverged.
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(3.6, 4.2, narrow=narrow)
        axes = figure.subplots()
        for model, rows in errors.items():
            tone = TONES[model].light
            mean = mean_of_trials(rows)
            if len(rows) > 1 and model not in _DASHED:
                spread = np.sqrt(mean_of_trials((rows - np.where(np.isfinite(mean), mean, np.nan)) ** 2))
                low = np.maximum(mean - spread, 0.05 * mean)
                axes.fill_between(times, positive(low), positive(mean + spread), color=tone, alpha=0.12, linewidth=0)
            style: Any = _DASHED.get(model, "-")
            width = 2.0 if model == "resphys" else 1.2
            axes.plot(times, positive(mean), color=tone, linestyle=style, linewidth=width, label=MODELS[model][0])
        use_logarithm(axes)
        axes.set(xlabel="time since the release [s]", ylabel="mean marker error [mm]", xlim=(0.0, times[-1]))
        legend_above(figure, axes, narrow=narrow)
    return figure


def mean_of_trials(rows: FloatArray) -> FloatArray:
    """Return the mean of the trials that have a value; infinite where one has diverged, NaN where none has a value.

    Args:
        rows: (R, T) of R trials.
    """
    held = ~np.isnan(rows)
    count = held.sum(axis=0)
    mean: FloatArray = np.where(count > 0, np.where(held, rows, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
    return mean


def marker_paths(
    times: FloatArray,
    measured: FloatArray,
    models: Mapping[str, FloatArray],
    labels: Sequence[str],
    start: FloatArray,
    *,
    narrow: bool,
) -> Figure:
    """Draw each marker's coordinates over time: measured as dots, models as lines.

    Args:
        times: (T,) since the release [s].
        measured: (T, M, 3) [m], NaN where a marker was not seen.
        models: (T, M, 3) [m] by model.
        labels: Of the M markers.
        start: (M, 3) [m] what is subtracted: where the markers were held.
        narrow: Whether the figure is for a narrow page; the panels then stand below each other.
    """
    count = len(labels)
    with mpl.rc_context(STYLE):
        shape = (3 * count, 1) if narrow else (count, 3)
        figure = new_figure(0.9 + 1.25 * count, 1.2 + 1.05 * 3 * count, narrow=narrow)
        panels = figure.subplots(*shape, sharex=True, squeeze=False)
        moved = np.nan_to_num(_MILLI * (measured - start))  # (T, M, 3) [mm]
        least = LEAST_SPAN * float(np.ptp(moved, axis=0).max())
        for marker, label in enumerate(labels):
            for axis in range(3):
                axes = panels[3 * marker + axis, 0] if narrow else panels[marker, axis]
                seen, *rest = (
                    _MILLI * (q[:, marker, axis] - start[marker, axis]) for q in (measured, *models.values())
                )
                path_panel(axes, times, seen, least, dict(zip(models, rest, strict=True)))
                if narrow:
                    axes.set_title(f"{label}, {'xyz'[axis]} [mm]")
                elif axis == 0:
                    axes.set_ylabel(f"{label} [mm]")
                if not narrow and marker == 0:
                    axes.set_title("xyz"[axis])
        for axes in panels[-1]:
            axes.set(xlabel="time [s]", xlim=(0.0, times[-1]))
        figure.align_ylabels(panels[:, 0])
        legend_above(figure, panels[0, 0], narrow=narrow)
    return figure


def path_panel(
    axes: Axes, times: FloatArray, measured: FloatArray, least: float, models: Mapping[str, FloatArray]
) -> None:
    """Draw one coordinate [mm]; the measured motion sets the scale, so that a model that runs away does not.

    Args:
        axes: Where to draw.
        times: (T,) [s].
        measured: (T,).
        least: The shortest range that is shown, so that noise does not look like motion.
        models: (T,) by model.
    """
    every = -(-len(times) // _MOST_DOTS)
    axes.plot(
        times[::every], measured[::every], ".", color=TONES["ink"].light, markersize=3.2, label="Measured", zorder=1.5
    )
    for model, values in models.items():
        tone = TONES[model].light
        kept = np.where(np.abs(values) < 1e6, values, np.nan)
        style: Any = _DASHED.get(model, "-")
        axes.plot(times, kept, color=tone, linestyle=style, linewidth=1.1, label=MODELS[model][0])
    if np.isfinite(measured).any():
        low, high = np.nanmin(measured), np.nanmax(measured)
        margin = 0.6 * (high - low) + 0.02
        bottom, top = axes.get_ylim()
        bottom, top = max(low - margin, bottom), min(high + margin, top)
        more = max(0.0, 0.5 * (least - (top - bottom)))
        axes.set_ylim(bottom - more, top + more)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=ROUND_STEPS))


def loss_histories(histories: Mapping[str, Sequence[Sequence[Mapping[str, float]]]], *, narrow: bool) -> Figure:
    """Draw the best loss so far over the evaluations of each start, a panel an identification.

    Args:
        histories: By identification: for every start the records with `loss`, one an evaluation.
        narrow: Whether the figure is for a narrow page.
    """
    with mpl.rc_context(STYLE):
        shape = (len(histories), 1) if narrow else (1, len(histories))
        figure = new_figure(2.6, 0.4 + 2.1 * len(histories), narrow=narrow)
        panels = figure.subplots(*shape, sharey=True, squeeze=False).flat
        for axes, (name, starts) in zip(panels, histories.items(), strict=True):
            ends = [each["loss"] for start in starts for each in start if each["loss"] is not None]
            for start in (each for each in starts if each):
                losses = np.fmin.accumulate(np.array([record["loss"] for record in start], dtype=np.float64))
                best = bool(ends) and losses[-1] <= min(ends)
                tone = TONES["sysid" if best else "muted"].light
                count = np.arange(1, len(losses) + 1)
                axes.plot(count, positive(losses), ".-", color=tone, linewidth=1.8 if best else 0.9, markersize=3.5)
            use_logarithm(axes)
            axes.set_title(MODELS[name][0])
            axes.set_xlabel("evaluation")
            axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
            if narrow or name == next(iter(histories)):
                axes.set_ylabel("loss")
    return figure


def landscape(
    modulus: FloatArray,
    ratio: FloatArray,
    loss: FloatArray,
    points: Mapping[str, tuple[float, float]],
    *,
    narrow: bool,
) -> Figure:
    """Draw the loss over Young's modulus and Poisson's ratio; as a curve where the grid has one ratio only.

    Args:
        modulus: (A,) [Pa].
        ratio: (B,); one value, or none, for a curve.
        loss: (A, B) or (A,), NaN where the simulation failed.
        points: Modulus and ratio to be marked, by name.
        narrow: Whether the figure is for a narrow page.
    """
    values = positive(np.asarray(loss, dtype=np.float64))
    with mpl.rc_context(STYLE):
        figure = new_figure(3.6, 3.7, narrow=narrow)
        axes = figure.subplots()
        if values.ndim == 2 and values.shape[1] > 1 and np.isfinite(values).any():
            _contours(figure, axes, _KILO * modulus, ratio, values)
            places = {name: (_KILO * e, nu) for name, (e, nu) in points.items()}
        else:
            curve = values.reshape(len(modulus), -1)[:, 0]
            axes.plot(_KILO * modulus, curve, color=TONES["sysid"].light)
            use_logarithm(axes)
            axes.set_ylabel("loss")
            known = np.isfinite(curve)
            places = {
                name: (_KILO * e, float(np.interp(e, modulus[known], curve[known])))
                for name, (e, _) in points.items()
                if known.any()
            }
        for (name, place), marker in zip(places.items(), "oDs^", strict=False):
            _mark(axes, name, place, marker)
        if modulus.max() > 3.0 * modulus.min():
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("Young's modulus [kPa]")
        if places:
            handles, names = axes.get_legend_handles_labels()
            figure.legend(handles, names, loc="outside upper left", ncols=1 if narrow else 3, columnspacing=1.6)
    return figure


def _contours(figure: Figure, axes: Axes, modulus: FloatArray, ratio: FloatArray, loss: FloatArray) -> None:
    """Filled levels, evenly spaced in the logarithm of the loss, with lines between them."""
    level = np.log10(loss)
    low, high = float(np.nanmin(level)), float(np.nanmax(level))
    levels = np.linspace(low - 1e-9, (high if high > low else low + 1.0) + 1e-9, _LEVELS)
    masked = np.ma.masked_invalid(level.T)
    filled = axes.contourf(modulus, ratio, masked, levels=levels, cmap="viridis")
    axes.contour(modulus, ratio, masked, levels=levels, colors="white", linewidths=0.5, alpha=0.55)
    axes.set_ylabel("Poisson's ratio")
    axes.grid(visible=False)
    bar = figure.colorbar(filled, ax=axes, pad=0.02, aspect=28)
    bar.outline.set_visible(False)
    whole = [tick for tick in (-6, -5, -4, -3, -2, -1, 0, 1, 2, 3) if low <= tick <= high]
    ticks = whole if len(whole) > 1 else np.linspace(low, high, 4).tolist()
    bar.set_ticks(ticks, labels=[f"{10.0**tick:.2g}" for tick in ticks])
    bar.set_label("loss")


def _mark(axes: Axes, name: str, place: tuple[float, float], marker: str) -> None:
    tone = TONES["simulation"].light if marker == "D" else "white"
    axes.plot(
        *place,
        marker,
        color=tone,
        markersize=7.0,
        markeredgecolor="black",
        markeredgewidth=0.9,
        linestyle="none",
        label=name,
        clip_on=False,
        zorder=5,
    )


def motion_instants(frames: NDArray[np.uint8], titles: Sequence[str], *, narrow: bool) -> Figure:
    """Show the body at a few instants, and beside or below each picture its markers from nearby.

    Args:
        frames: (F, 2, H, W, 4) as `warp_resphys.report.video.draw_instants` drew them.
        titles: Of the F instants.
        narrow: Whether the figure is for a narrow page.
    """
    count, _, height, width, _ = frames.shape
    rise = height / width
    with mpl.rc_context(STYLE):
        size = NARROW / 2.0 if narrow else WIDE / count
        total = count * (rise * size + 0.3) if narrow else 2.0 * rise * size + 0.35
        figure = new_figure(total, total, narrow=narrow)
        shape = (count, 2) if narrow else (2, count)
        panels = figure.subplots(*shape, squeeze=False)
        for frame, title in enumerate(titles):
            for view in range(2):
                axes = panels[frame, view] if narrow else panels[view, frame]
                axes.imshow(frames[frame, view])
                axes.set_axis_off()
                if view == 0:
                    axes.set_title(title)
    return figure
