"""Figures of learning: losses of a training and of an identification, and the loss around identified parameters."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from .figures import LABELS, TONES, FloatArray, in_style, new_figure, positive, use_logarithm

_LEVELS: Final = 14  # Of a landscape.
_KILO: Final = 1e-3


@in_style()
def training_curves(records: Sequence[Mapping[str, Any]], *, narrow: bool) -> Figure:
    """Draw the losses and, where they were recorded, the validation roll-out error and the learning rate.

    Args:
        records: One for each epoch, with `epoch`, `train_loss`, `validation_loss`, and in some or all epochs
            `rollout_error_mm` and `learning_rate`; values that were not measured are None or absent.
        narrow: Whether the figure is for a narrow page.
    """
    heights = {"losses": 3, "rollout_error_mm": 3, "learning_rate": 1}
    heights = {key: height for key, height in heights.items() if key == "losses" or len(_measured(records, key)[0])}
    muted, strong = TONES["muted"].light, TONES["resphys"].light
    thin: dict[str, Any] = {"linewidth": 1.1, "marker": "." if len(records) == 1 else ""}
    height = 0.6 + 0.57 * sum(heights.values())
    figure = new_figure(height, height + 0.2, narrow=narrow)
    rows = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=[*heights.values()])[:, 0]
    axes = dict(zip(heights, rows, strict=True))
    for key, label, colour in (
        ("train_loss", "Training loss", muted),
        ("validation_loss", "Validation loss", strong),
    ):
        epochs, losses = _measured(records, key)
        if len(epochs):
            axes["losses"].plot(epochs, losses, color=colour, label=label, **thin)
    axes["losses"].set_ylabel("loss")
    axes["losses"].legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=2)
    if "rollout_error_mm" in axes:
        _rollout_curve(axes["rollout_error_mm"], *_measured(records, "rollout_error_mm"))
    if "learning_rate" in axes:
        axes["learning_rate"].plot(*_measured(records, "learning_rate"), color=muted, drawstyle="steps-mid", **thin)
        axes["learning_rate"].set_ylabel("learning\nrate")
    for row in rows:
        use_logarithm(row)
    rows[-1].set_xlabel("epoch")
    _count(rows[-1].xaxis, 6)
    figure.align_ylabels()
    return figure


@in_style()
def loss_histories(histories: Mapping[str, Sequence[Sequence[Mapping[str, float]]]], *, narrow: bool) -> Figure:
    """Draw the best loss so far over the evaluations of each start, with a panel for each identification.

    Args:
        histories: By identification: for every start its records with `loss`, one for each evaluation.
        narrow: Whether the figure is for a narrow page.
    """
    shape = (len(histories), 1) if narrow else (1, len(histories))
    figure = new_figure(2.6, 0.4 + 2.1 * len(histories), narrow=narrow)
    panels = list(figure.subplots(*shape, sharey=True, squeeze=False).flat)
    for axes, (name, starts) in zip(panels, histories.items(), strict=True):
        ends = [record["loss"] for start in starts for record in start if record["loss"] is not None]
        for start in filter(None, starts):
            losses = np.fmin.accumulate(np.array([record["loss"] for record in start], dtype=np.float64))
            best = bool(ends) and losses[-1] <= min(ends)
            tone = TONES["sysid" if best else "muted"].light
            count = np.arange(1, len(losses) + 1)
            axes.plot(count, positive(losses), ".-", color=tone, linewidth=1.8 if best else 0.9, markersize=3.5)
        axes.set_title(LABELS[name])
        axes.set_xlabel("evaluation")
        _count(axes.xaxis, 5)
    for axes in panels:  # Once everything is drawn, as they share their axis.
        use_logarithm(axes)
    for axes in panels if narrow else panels[:1]:
        axes.set_ylabel("loss")
    return figure


@in_style()
def landscape(
    modulus: FloatArray,
    ratio: FloatArray,
    loss: FloatArray,
    points: Mapping[str, tuple[float, float]],
    *,
    narrow: bool,
) -> Figure:
    """Draw the loss over Young's modulus and Poisson's ratio; as a curve where the grid has one ratio.

    Args:
        modulus: (A,) [Pa].
        ratio: (B,); one value, or none, for a curve.
        loss: (A, B) or (A,), NaN where the simulation failed.
        points: Modulus and ratio to be marked, by name.
        narrow: Whether the figure is for a narrow page.
    """
    values = positive(np.asarray(loss, dtype=np.float64))
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
        finite, e = np.isfinite(curve), np.array([e for e, _ in points.values()])
        heights = np.interp(e, modulus[finite], curve[finite]) if finite.any() else []
        places = {name: (_KILO * e, float(h)) for (name, (e, _)), h in zip(points.items(), heights, strict=False)}
    for (name, place), marker in zip(places.items(), "oDs^", strict=False):
        tone = TONES["simulation"].light if marker == "D" else "white"
        edge: dict[str, Any] = {"markeredgecolor": "black", "markeredgewidth": 0.9, "zorder": 5, "clip_on": False}
        axes.plot(*place, marker, color=tone, markersize=7.0, linestyle="none", label=name, **edge)
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


def _count(axis: Axis, most: int) -> None:
    """Label an axis at whole numbers only, even if there is just one."""
    axis.set_major_locator(MaxNLocator(most, integer=True, min_n_ticks=1))


def _measured(records: Sequence[Mapping[str, Any]], key: str) -> tuple[FloatArray, FloatArray]:
    """Epochs in which a quantity was measured, and its values."""
    measured = [(record["epoch"], record[key]) for record in records if record.get(key) is not None]
    epochs, values = np.asarray(measured, dtype=np.float64).reshape(-1, 2).T
    return epochs, positive(values)


def _rollout_curve(axes: Axes, epochs: FloatArray, errors: FloatArray) -> None:
    """The validation roll-out error [mm], its lowest value marked."""
    axes.plot(epochs, errors, color=TONES["resphys"].light)
    axes.set_ylabel("roll-out\nerror [mm]")
    if np.isfinite(errors).any():
        best = int(np.nanargmin(errors))
        axes.plot(epochs[best], errors[best], "o", color=TONES["simulation"].light, markersize=5)
        axes.set_title(f"lowest: {errors[best]:.2g} mm, epoch {epochs[best]:.0f}", loc="right")
